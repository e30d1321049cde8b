"""The one error a user can cause and mend."""


class InputError(ValueError):
    """Bad input: the message is one line that says what is wrong, where, and how to mend it.

    The command line prints the message without a traceback and exits with code 2.
    """
