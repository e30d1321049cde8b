"""The lock file fits pyproject.toml: what `make` installs is what the package asks for."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
GROUPS = PROJECT["dependency-groups"]
EXTRAS = PROJECT["project"]["optional-dependencies"]
WANTED = (
    PROJECT["project"]["dependencies"] + EXTRAS["view"] + GROUPS["dev"] + GROUPS["docs"] + PROJECT["build-system"]["requires"]
)
LINES = [line for line in (ROOT / "requirements.lock").read_text().splitlines() if not line.startswith("#")]


def test_every_line_is_one_version():
    for line in LINES:
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line), line


@pytest.mark.parametrize("wanted", WANTED)
def test_what_the_package_asks_for_is_locked(wanted):
    locked = {canonicalize_name(name): version for name, version in (line.split("==") for line in LINES)}
    requirement = Requirement(wanted)
    version = locked.get(canonicalize_name(requirement.name))
    assert version is not None, f"{requirement.name} is not in requirements.lock; run `make lock`"
    assert requirement.specifier.contains(version), f"{requirement.name} {version}; run `make lock`"
