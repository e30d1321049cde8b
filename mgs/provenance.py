"""What results depend on and files of results therefore record: the command and the versions."""

from __future__ import annotations

import platform
import shlex
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mgs import __version__


def versions() -> dict[str, str]:
    """Versions of mgs, of Python and of the libraries that compute results; "unknown" for one that is not installed."""
    found = {"mgs": __version__, "python": platform.python_version()}
    for package in ("mitsuba", "drjit", "numpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def command_line() -> str:
    """The command line of this process as the user typed it: the program's name without its folder, and the arguments.

    `python -m mgs` is called `mgs`."""
    program = Path(sys.argv[0])
    return shlex.join([program.parent.name if program.name == "__main__.py" else program.name, *sys.argv[1:]])
