"""The exception for bad input: what the user can cause and can correct."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

Row = TypeVar("Row")

FLAGS = {"rates": "--rate", "seeds": "--seed-views", "seed": "--random-seed"}
"""Settings whose option has another name."""


def flag(setting: str) -> str:
    """Option of a setting on the command line."""
    return FLAGS.get(setting) or f"--{setting.replace('_', '-')}"


class InputError(ValueError):
    """Bad input. The message is one line: what is wrong, where, and how to correct it.

    The command line prints the message without a traceback and exits with code 2.
    """


class Notice(UserWarning):
    """Something that a user should know and that ends nothing. Commands print it as one line."""


def row_named(table: Mapping[str, Row], name: str, what: str) -> Row:
    """Look a name up in a table. what: the option for the message, as in --preset.

    Raises InputError, which lists the names of the table, if it has no such name.
    """
    if name not in table:
        raise InputError(f"{what} {name!r}: unknown; choose one of {', '.join(table)}")
    return table[name]
