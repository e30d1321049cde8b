"""The project: imports without a circle, pins and extras that fit, the commit of results, and the
page of diffs. A room is a module or sub-package directly in mgs/. Imports inside functions and
under TYPE_CHECKING count, too.
"""

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from program import python
from refusals import refused

from mgs import provenance
from mgs.errors import EXTRAS
from mgs.provenance import versions

ROOT = Path(__file__).parent.parent
ROOMS = [
    "errors", "progress", "seeds", "runtime", "resources", "provenance", "colour", "rotation",
    "memory", "notebook", "camera", "gaussians", "files", "images", "metrics", "plotting",
    "data", "synth", "survey", "prior", "splat",
    "splat_places", "compact", "splat_ply", "splat_gltf", "splat_files", "evaluation",
    "policy", "fit", "scene", "learning", "run", "reports", "view",
    "cli", "__main__",
]  # fmt: skip
"""All rooms; each may import from those before it."""


def import_graph() -> dict[str, set[str]]:
    """{module: modules of mgs that it imports}. Of `from a import b` only a.b counts if it is a
    module. The package itself is left out, since Python loads it before any of its modules."""
    files, graph = {}, {}
    for path in (ROOT / "mgs").rglob("*.py"):
        parts = path.relative_to(ROOT).with_suffix("").parts
        files[".".join(parts).removesuffix(".__init__")] = path
    for module, path in files.items():
        graph[module] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                graph[module] |= {alias.name for alias in node.names} & set(files)
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, f"{module}: a relative import, which this test cannot read"
                inner = {f"{node.module}.{alias.name}" for alias in node.names} & set(files)
                graph[module] |= inner or {node.module} & set(files)
        graph[module] -= {"mgs", module}
    return graph


def room(module: str) -> str:
    """Room of a module: `splat` of `mgs.splat.blocks`; empty for the package itself."""
    return module.partition(".")[2].partition(".")[0]


GRAPH = import_graph()


def test_modules_import_one_another_in_no_circle():
    TopologicalSorter(GRAPH).prepare()  # raises a CycleError that names them


def test_every_room_has_its_place_and_imports_only_from_rooms_below_it():
    assert sorted(ROOMS) == sorted({room(module) for module in GRAPH} - {""})
    pairs = [(a, b) for a, others in GRAPH.items() if room(a) for b in others]
    assert [(a, b) for a, b in pairs if ROOMS.index(room(b)) > ROOMS.index(room(a))] == []


def importers(names: str, folders: list[str]) -> list[Path]:
    """Files in these folders that import one of the names."""
    pattern = re.compile(rf"^\s*(import|from) ({names})\b", re.MULTILINE)
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    return [path for path in files if pattern.search(path.read_text())]


def test_nothing_but_tests_imports_tests():
    names = "|".join({path.stem for path in (ROOT / "tests").rglob("[!_]*.py")} | {"tests"})
    assert importers(names, ["mgs", "studies", "plugins", "tools"]) == []


def test_the_package_imports_no_study():
    assert importers("studies", ["mgs", "plugins"]) == []
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    assert "studies" not in wheel["targets"]["wheel"]["only-include"]


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


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

DISTRIBUTIONS = {"sklearn": "scikit-learn", "cv2": "opencv-python-headless"}
"""Module -> package that brings it, where the names differ."""

CORE = """
import sys
for name in {blocked}:
    sys.modules[name] = None
import mgs
dataset, prior, out = sys.argv[1:]
run = mgs.run_nbv(dataset, out, prior=prior, seeds=3, budget=1, train={{"passes": 1}})
image = mgs.render(run.gaussians, run.dataset.frames[0].camera)
print(mgs.evaluate(run)["images"], image.rgb.shape)
mgs.report(run, out + "-report")
"""


def packages(requirements: list[str]) -> set[str]:
    return {re.split(r"[<>=\[]", one)[0].lower().replace("_", "-") for one in requirements}


def test_every_extra_names_its_packages_and_all_has_them():
    extras = PROJECT["optional-dependencies"]
    for module, extra in EXTRAS.items():
        package = DISTRIBUTIONS.get(module, module).lower().replace("_", "-")
        assert package in packages(extras[extra])
        assert package not in packages(PROJECT["dependencies"])
    assert set(EXTRAS.values()) == set(extras) - {"all"}  # `mgs doctor` lists them
    (every,) = extras["all"]
    assert set(every[4:-1].split(",")) == set(extras) - {"all"}


@pytest.mark.slow
def test_the_core_chooses_measures_and_reports_without_extras(dataset, prior, tmp_path):
    said = python(CORE.format(blocked=[*EXTRAS]), dataset, prior, tmp_path / "run")
    assert said.stdout == "4 (12, 16, 3)\n", said.stderr


def test_a_missing_package_is_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    model = tmp_path / "model/sparse/0"
    model.mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.bin").write_bytes(bytes(8))
    line = refused(capsys, ["import", tmp_path / "model", "--out", tmp_path / "out"])
    assert line == 'mgs: this needs pycolmap, which is not installed; `pip install "mgs[import]"`'


def test_a_checkout_tells_its_commit(monkeypatch, tmp_path):
    def git(*words):
        who = ["-c", "user.name=nobody", "-c", "user.email=nobody@example.org"]
        command = ["git", "-C", tmp_path, *who, *words]
        return subprocess.check_output(command, text=True, stderr=subprocess.DEVNULL).strip()

    def told():
        provenance._commit.cache_clear()
        return versions().get("commit")

    (tmp_path / "mgs").mkdir()
    (tmp_path / "mgs/provenance.py").write_text("")
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "mgs/provenance.py"))
    assert told() is None
    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "begun")
    commit = git("rev-parse", "--short=7", "HEAD")
    assert told() == commit
    (tmp_path / "mgs/provenance.py").write_text("changed")
    assert told() == f"{commit}+"
    monkeypatch.setenv("PATH", "")  # no git
    assert told() is None
    provenance._commit.cache_clear()


USE = """
import numpy as np
from mgs import runtime
runtime.start()
import mitsuba as mi
from mgs.fit.losses import LOSSES
from mgs.metrics import METRICS, compare
from mgs.run.policies import POLICIES
from mgs.splat import ESTIMATORS

scores = POLICIES["highest"].rule(np.array([[0, 0, 1.0], [0, 0, 3]]), None, None)
assert scores.tolist() == [1, 3]
one, two = mi.Float([1, 2, 3]), mi.Float([1, 4, 0])
assert LOSSES["absolute"](one, two, mi.Float(1), (1, 1, 3), True).numpy().tolist() == [0, 2, 3]
assert "halved" in ESTIMATORS
white = np.ones((16, 16, 4))
metrics = compare(white, np.zeros((16, 16, 3)), np.ones((16, 16), bool), np.ones((16, 16)))
assert list(metrics) == list(METRICS)
assert abs(metrics["mae"] - 1) < 1e-6
"""


def test_each_diff_touches_one_file_and_what_they_add_works(tmp_path):
    page = (ROOT / "docs/howto/extend.md").read_text()
    diffs = re.findall(r"```diff\n(.*?)```", page, re.DOTALL)
    assert len(diffs) == 4
    shutil.copytree(ROOT / "mgs", tmp_path / "mgs", ignore=shutil.ignore_patterns("__pycache__"))
    for diff in diffs:
        assert diff.count("\n+++ ") == 1
        command = ["git", "apply", "-"]
        subprocess.run(command, input=diff, text=True, cwd=tmp_path, check=True)
    python(USE, cwd=tmp_path, check=True)
