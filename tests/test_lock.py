"""requirements.lock fits pyproject.toml."""

import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent


def requires_python(name):
    try:
        return metadata(name).get("Requires-Python") or ""
    except PackageNotFoundError:
        return ""


def test_the_lock_pins_every_requirement_for_the_lowest_python():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    lines = [line for line in lines if not line.startswith("#")]
    locked = {canonicalize_name(name): pin for name, pin in (line.split("==") for line in lines)}

    groups, package = project["dependency-groups"], project["project"]
    extras = package["optional-dependencies"]
    wanted = package["dependencies"] + extras["view"] + extras["ros"]
    wanted += [one for name in ("studies", "dev", "docs") for one in groups[name]]
    wanted = [one for one in wanted if isinstance(one, str)] + project["build-system"]["requires"]
    unmet = [
        text
        for text, requirement in ((text, Requirement(text)) for text in wanted)
        if not requirement.specifier.contains(locked.get(canonicalize_name(requirement.name), "0"))
    ]
    assert unmet == [], "run `make lock`"

    # The first patch of the lowest Python: distributions ship early ones (Debian 12: 3.11.2).
    lowest = package["requires-python"].removeprefix(">=") + ".0"
    too_new = [name for name in locked if lowest not in SpecifierSet(requires_python(name))]
    assert too_new == []
