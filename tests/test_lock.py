"""The lock file fits pyproject.toml: what `make` installs is what the package asks for."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
GROUPS = PROJECT["dependency-groups"]
EXTRAS = PROJECT["project"]["optional-dependencies"]
WANTED = (
    PROJECT["project"]["dependencies"]
    + EXTRAS["view"]
    + GROUPS["dev"]
    + GROUPS["docs"]
    + PROJECT["build-system"]["requires"]
)
LINES = [
    line
    for line in (ROOT / "requirements.lock").read_text().splitlines()
    if not line.startswith("#")
]


def test_every_line_is_one_version():
    for line in LINES:
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line), line


@pytest.mark.parametrize("wanted", WANTED)
def test_what_the_package_asks_for_is_locked(wanted):
    locked = {
        canonicalize_name(name): version for name, version in (line.split("==") for line in LINES)
    }
    requirement = Requirement(wanted)
    version = locked.get(canonicalize_name(requirement.name))
    assert version is not None, f"{requirement.name} is not in requirements.lock; run `make lock`"
    assert requirement.specifier.contains(version), f"{requirement.name} {version}; run `make lock`"


@pytest.mark.parametrize("line", LINES)
def test_what_is_locked_installs_on_the_lowest_python(line):
    """The first version of the oldest Python that the package supports: distributions ship early
    ones (Debian 12: 3.11.2)."""
    lowest = PROJECT["project"]["requires-python"].removeprefix(">=") + ".0"
    try:
        found = metadata(line.split("==")[0])
    except PackageNotFoundError:
        pytest.skip("not installed here")
    needed = found.get("Requires-Python") or ""
    assert lowest in SpecifierSet(needed), f"{line} needs Python {needed}"
