"""Versions, which files of results record."""

import hashlib
import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from mgs import __version__


def versions() -> dict[str, str]:
    """Versions of mgs, Python and the libraries that compute results; "unknown" if not installed.
    If mgs runs from a checkout, also its "commit"."""
    numbers = {"mgs": __version__, **_commit(), "python": platform.python_version()}
    for package in ("mitsuba", "drjit", "numpy"):
        try:
            numbers[package] = version(package)
        except PackageNotFoundError:
            numbers[package] = "unknown"
    return numbers


@cache
def source_digest() -> str:
    """Hash of the source files of mgs, which also differ within one commit and version."""
    digest, folder = hashlib.sha256(), Path(__file__).parent
    for file in sorted(folder.rglob("*.py")):
        digest.update(f"{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return digest.hexdigest()


@cache
def _commit() -> dict[str, str]:
    """Commit of the checkout, with a + if files differ from it; {} outside a checkout."""
    checkout = Path(__file__).parent.parent
    if not (checkout / ".git").exists():
        return {}
    git = ["git", "-C", str(checkout), "describe", "--always", "--exclude", "*"]
    git += ["--abbrev=7", "--dirty=+"]
    try:
        said = subprocess.check_output(git, stderr=subprocess.DEVNULL, text=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return {}
    return {"commit": said.strip()}
