"""The error that stands for bad input: what the user can cause, and can mend."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

Row = TypeVar("Row")


class InputError(ValueError):
    """Bad input: the message is one line that says what is wrong, where, and how to mend it.

    The command line prints the message without a traceback and exits with code 2.
    """


def row_named(table: Mapping[str, Row], name: str, what: str) -> Row:
    """The row of a table that has this name. what: how the user calls the choice, as in --preset,
    for the message.

    Raises InputError, which lists the names of the table, where there is none.
    """
    if name not in table:
        raise InputError(f"{what} {name!r}: unknown; choose one of {', '.join(table)}")
    return table[name]
