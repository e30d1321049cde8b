"""The exception for bad input: what the user can cause and can correct."""

from collections.abc import Mapping
from typing import TypeVar

Row = TypeVar("Row")

EXTRAS = dict.fromkeys(("pymeshlab", "manifold3d", "sklearn", "cv2"), "prior")
EXTRAS |= {"pycolmap": "import", "gtsam": "survey", "small_gicp": "survey", "pyoidn": "denoise"}
EXTRAS |= {"plotly": "page", "jinja2": "page", "viser": "view", "gsply": "export"}
EXTRAS |= {"constriction": "export", "imageio_ffmpeg": "video", "rosbags": "ros"}
"""Modules that only some commands need -> extra of pyproject.toml that installs them."""


def missing(module: str | None) -> str:
    """Line for a module that is not installed; empty if mgs does not know it."""
    name = (module or "").partition(".")[0]
    if name not in EXTRAS:
        return ""
    return f'this needs {name}, which is not installed; `pip install "mgs[{EXTRAS[name]}]"`'


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
    """Bad input. The message is one line: what is wrong, where, and how to correct it. It names
    settings as Python, config.json and the command line do, and escapes control characters. The
    command line prints it without a traceback and exits with code 2."""

    def __str__(self) -> str:
        return printable(str(self.args[0]))


def from_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C caused an exception: during a call, Dr.Jit raises one of its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


class NoRoom(InputError):
    """A disk is nearly full; what was done so far is kept."""


class Notice(UserWarning):
    """Something that a user should know and that ends nothing. Commands print it as one line."""


def row_named(table: Mapping[str, Row], name: str, what: str) -> Row:
    """Look a name up in a table. what: the setting, for the message. Raises InputError, which lists
    the names of the table, if it has no such name."""
    if name not in table:
        raise InputError(f"{what} {name!r}: unknown; choose one of {', '.join(table)}")
    return table[name]
