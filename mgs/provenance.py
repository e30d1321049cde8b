"""What results depend on and files of results therefore record: the command and the versions."""

from __future__ import annotations

import platform
import shlex
import subprocess
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mgs import __version__


def versions() -> dict[str, str]:
    """Versions of mgs, of Python and of the libraries that compute results; "unknown" for one that
    is not installed. Where mgs runs from a checkout, its commit too."""
    found = {"mgs": __version__, **_commit(), "python": platform.python_version()}
    for package in ("mitsuba", "drjit", "numpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


@cache
def _commit() -> dict[str, str]:
    """The commit of the checkout that mgs runs from, with a + where files differ from it; nothing
    where it is no checkout."""
    checkout = Path(__file__).parent.parent
    if not (checkout / ".git").exists():
        return {}
    asked = [
        "git",
        "-C",
        str(checkout),
        "describe",
        "--always",
        "--exclude",
        "*",
        "--abbrev=7",
        "--dirty=+",
    ]
    try:
        told = subprocess.run(asked, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return {}
    return {"commit": told.stdout.strip()}


def command_line() -> str:
    """The command line of this process as the user typed it: the program's name without its folder,
    and the arguments.

    `python -m mgs` is called `mgs`."""
    program = Path(sys.argv[0])
    return shlex.join(
        [program.parent.name if program.name == "__main__.py" else program.name, *sys.argv[1:]]
    )
