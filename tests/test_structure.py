"""The package's own imports, read from its sources: no cycle between modules, and rooms that import
only from those below.

A room is a module or a sub-package directly in mgs/. Every import counts, those inside functions
and under TYPE_CHECKING too: the first are there to start quickly and the second for annotations,
neither to close a circle.
"""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = "mgs"
ROOMS = (
    "errors", "seeds", "runtime", "resources", "provenance", "colour", "rotation", "memory", "camera", "gaussians", "files",
    "images", "splat_ply", "metrics", "plotting",
    "data", "synth", "survey", "prior", "splat", "policy", "fit", "run", "report", "view", "bench", "study", "cli", "__main__",
)  # fmt: skip
"""All rooms, lowest first: each may import from those before it, and from none after it."""


def sources(root: Path, package: str) -> dict[str, Path]:
    """{dotted name: file} of every module of a package that lies in root."""
    names = {
        path: path.relative_to(root).with_suffix("").parts
        for path in (root / package).rglob("*.py")
    }
    return {
        ".".join(parts[:-1] if parts[-1] == "__init__" else parts): path
        for path, parts in names.items()
    }


def imported(node: ast.AST, module: str, is_package: bool) -> list[str]:
    """Dotted names that one statement may load: of `from a import b` both a and a.b, since b may be
    a module."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    base = node.module or ""
    if node.level:
        parts = module.split(".")
        parts = parts[: len(parts) - node.level + is_package]
        base = ".".join([*parts, base] if base else parts)
    return [base, *(f"{base}.{alias.name}" for alias in node.names)]


def import_graph(root: Path, package: str) -> dict[str, set[str]]:
    """{module: modules of the same package that it imports}; of names that hold one another, only
    the innermost module.

    The root of the package is left out as an import: Python loads it before any of its modules,
    whatever they import.
    """
    files, graph = sources(root, package), {}
    for module, path in files.items():
        graph[module] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            found = [
                name for name in imported(node, module, path.name == "__init__.py") if name in files
            ]
            inner = {
                name for name in found if not any(other.startswith(f"{name}.") for other in found)
            }
            graph[module] |= inner - {package, module}
    return graph


def room(module: str) -> str:
    """What lies directly in the package: `splat` of `mgs.splat.blocks`; empty for the root of the
    package."""
    return module.partition(".")[2].partition(".")[0]


def misplaced(graph: dict[str, set[str]], rooms: tuple[str, ...]) -> list[str]:
    """Imports from a room that does not lie below the importing one."""
    height = {name: i for i, name in enumerate(rooms)}
    pairs = [
        (module, other)
        for module, others in graph.items()
        for other in others
        if room(module) != room(other)
    ]
    return sorted(
        f"{a} imports {b}" for a, b in pairs if height.get(room(a), len(rooms)) < height[room(b)]
    )


def cycle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import one another in a circle; empty where there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


GRAPH = import_graph(ROOT, PACKAGE)


def test_modules_import_one_another_in_no_circle():
    found = cycle(GRAPH)
    assert not found, " < ".join(found)


def test_every_room_has_its_place_in_the_order():
    assert sorted(ROOMS) == sorted({room(module) for module in GRAPH} - {""})


@pytest.mark.parametrize("name", ROOMS)
def test_a_room_imports_only_from_rooms_below_it(name):
    of_it = {module: others for module, others in GRAPH.items() if room(module) == name}
    found = misplaced(of_it, ROOMS)
    assert not found, "; ".join(found)


@pytest.mark.parametrize("folder", ["mgs", "plugins", "benchmarks", "tools"])
def test_nothing_but_tests_imports_tests(folder):
    tests = {"tests", *(path.stem for path in (ROOT / "tests").rglob("*.py"))} - {"__init__"}
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not getattr(node, "level", 0):
                roots = {name.partition(".")[0] for name in imported(node, "", False)}
                assert not roots & tests, (
                    f"{path} line {node.lineno} imports {sorted(roots & tests)}"
                )


@pytest.mark.parametrize(
    "statement",
    [
        "import p.low.b",
        "import p.low.b as other",
        "from p.low import b",
        "from p.low.b import name",
        "from ..low import b",
        "from ..low.b import name",
        "def f():\n    from p.low import b",
        "if TYPE_CHECKING:\n    from p.low.b import name",
    ],
)
def test_every_kind_of_import_is_seen(tmp_path, statement):
    """A package of two rooms in which the lower one imports from the upper one, which imports it in
    turn."""
    files = {
        "__init__": "",
        "low/__init__": "",
        "low/b": "from p.high.a import name",
        "high/__init__": "",
        "high/a": statement,
    }
    for name, text in files.items():
        (tmp_path / f"p/{name}.py").parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / f"p/{name}.py").write_text(text)
    graph = import_graph(tmp_path, "p")
    assert graph["p.high.a"] == {"p.low.b"}
    assert misplaced(graph, ("low", "high")) == ["p.low.b imports p.high.a"]
    assert misplaced(graph, ("high", "low")) == ["p.high.a imports p.low.b"]
    assert set(cycle(graph)) == {"p.low.b", "p.high.a"}
