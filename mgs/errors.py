"""The error that stands for bad input: what the user can cause, and can mend."""


class InputError(ValueError):
    """Bad input: the message is one line that says what is wrong, where, and how to mend it.

    The command line prints the message without a traceback and exits with code 2.
    """
