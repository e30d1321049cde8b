"""Imports of the package, read from its sources: no cycle, and rooms import from those below.

A room is a module or sub-package directly in mgs/. Imports inside functions and under TYPE_CHECKING
count, too.
"""

import ast
import re
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parent.parent
ROOMS = [
    "errors", "progress", "seeds", "runtime", "resources", "provenance", "colour", "rotation",
    "memory", "notebook", "camera", "gaussians", "files", "images", "metrics", "plotting",
    "data", "synth", "survey", "prior", "splat",
    "splat_places", "splat_ply", "splat_gltf", "splat_files", "evaluation",
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
