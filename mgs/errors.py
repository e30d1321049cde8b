"""The exception for bad input: what the user can cause and can correct."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TypeVar

Row = TypeVar("Row")

EXTRAS = {
    "pymeshlab": "prior",
    "manifold3d": "prior",
    "sklearn": "prior",
    "cv2": "prior",
    "pycolmap": "import",
    "gtsam": "survey",
    "small_gicp": "survey",
    "pyoidn": "denoise",
    "plotly": "page",
    "jinja2": "page",
    "viser": "view",
    "tensorboardX": "tensorboard",
    "distributed": "study",
    "dask": "study",
}
"""Modules that only some commands need -> extra of pyproject.toml that installs them."""


def missing(module: str | None) -> str:
    """Line for a module that is not installed; empty if mgs does not know it."""
    name = (module or "").partition(".")[0]
    if name not in EXTRAS:
        return ""
    return f'this needs {name}, which is not installed; `pip install "mgs[{EXTRAS[name]}]"`'


FLAGS = {"rates": "--rate", "seeds": "--seed-views", "seed": "--random-seed"}
"""Settings whose option has another name."""


def flag(setting: str) -> str:
    """Option of a setting on the command line."""
    return FLAGS.get(setting) or f"--{setting.replace('_', '-')}"


def printable(text: str) -> str:
    """Text for a terminal, a page or a figure: control characters and half characters, which names
    of files and frames may have, are escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def printable_lines(text: str) -> str:
    """Text of several lines, each `printable`."""
    return "\n".join(map(printable, text.split("\n")))


class InputError(ValueError):
    """Bad input. The message is one line: what is wrong, where, and how to correct it.

    The command line prints `line`, without a traceback, and exits with code 2. In Python the same
    message names arguments and functions in place of options and commands.
    """

    @property
    def line(self) -> str:
        """The message for the command line, `printable`."""
        return printable(str(self.args[0]))

    def __str__(self) -> str:
        return in_python(self.line)


ARGUMENTS = {option: setting for setting, option in FLAGS.items()} | {
    "--from": "source",
    "--prior-noise": "noise",
}
"""Options whose argument in Python has another name."""

FUNCTIONS = {
    r"`mgs nbv --resume (\S+) --policy (\S+)`": r"`mgs.resume_nbv('\1', policy='\2')`",
    r"`mgs nbv --resume (\S+)`": r"`mgs.resume_nbv('\1')`",
    r"`mgs nbv (\S+) --out (\S+)`": r"`mgs.run_nbv('\1', '\2')`",
    r"`mgs eval (\S+)`": r"`mgs.evaluate('\1')`",
    r"`mgs prior DATASET --out (\S+)`": r"`mgs.save_prior('\1', mgs.build_prior(dataset))`",
}
"""Commands in messages -> calls that do the same."""


def in_python(line: str) -> str:
    """A message with Python's arguments and functions in place of options and commands."""
    for command, call in FUNCTIONS.items():
        line = re.sub(command, call, line)

    def argument(found: re.Match[str]) -> str:
        option = found[0]
        if option.startswith("`"):
            return option  # another command
        return ARGUMENTS.get(option) or option.removeprefix("--").replace("-", "_")

    return re.sub(r"`[^`]*`|(?<![^\s(/])--[a-z][a-z-]+", argument, line)


class Notice(UserWarning):
    """Something that a user should know and that ends nothing. Commands print it as one line."""


def row_named(table: Mapping[str, Row], name: str, what: str) -> Row:
    """Look a name up in a table. what: the option for the message, as in --preset.

    Raises InputError, which lists the names of the table, if it has no such name.
    """
    if name not in table:
        raise InputError(f"{what} {name!r}: unknown; choose one of {', '.join(table)}")
    return table[name]
