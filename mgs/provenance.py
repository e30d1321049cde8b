"""What a result depends on, written beside it: the command, the versions."""

from __future__ import annotations

import platform
import shlex
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mgs import __version__


def versions() -> dict[str, str]:
    """What a result depends on: versions of mgs, Python and the libraries that compute it."""
    found = {"mgs": __version__, "python": platform.python_version()}
    for package in ("mitsuba", "drjit", "numpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def command_line() -> str:
    """What the user typed: the program's name without its folder, and the arguments."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
