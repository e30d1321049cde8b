"""Imports of the package, read from its sources: no cycle, and rooms import from those below.

A room is a module or sub-package directly in mgs/. Imports inside functions and under TYPE_CHECKING
count, too.
"""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parent.parent
ROOMS = [
    "errors", "seeds", "runtime", "resources", "provenance", "colour", "rotation", "memory",
    "notebook", "camera", "gaussians", "files", "images", "splat_ply", "splat_gltf", "splat_files",
    "metrics", "plotting",
    "data", "synth", "survey", "prior", "splat", "policy", "fit", "run", "report", "view",
    "bench", "study", "cli", "__main__",
]  # fmt: skip
"""All rooms; each may import from those before it."""


def imported(node: ast.AST, module: str, is_package: bool) -> list[str]:
    """Dotted names that a statement may load: a and a.b of `from a import b`."""
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
    """{module: modules of the same package that it imports}; a.b counts, and a beside it does not.

    The package itself is left out, since Python loads it before any of its modules.
    """
    files, graph = {}, {}
    for path in (root / package).rglob("*.py"):
        parts = path.relative_to(root).with_suffix("").parts
        files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    for module, path in files.items():
        graph[module] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            names = imported(node, module, path.name == "__init__.py")
            found = [name for name in names if name in files]
            inner = {a for a in found if not any(b.startswith(f"{a}.") for b in found)}
            graph[module] |= inner - {package, module}
    return graph


def room(module: str) -> str:
    """Room of a module: `splat` of `mgs.splat.blocks`; empty for the package itself."""
    return module.partition(".")[2].partition(".")[0]


def misplaced(graph: dict[str, set[str]], rooms: list[str]) -> list[str]:
    """Imports from a room that is not below the importing one."""
    height = {name: i for i, name in enumerate(rooms)}
    return sorted(
        f"{a} imports {b}"
        for a, others in graph.items()
        for b in others
        if room(a) != room(b) and height.get(room(a), len(rooms)) < height[room(b)]
    )


def cycle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import one another in a circle; empty where there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


GRAPH = import_graph(ROOT, "mgs")


def test_modules_import_one_another_in_no_circle():
    found = cycle(GRAPH)
    assert not found, " < ".join(found)


def test_every_room_has_its_place_and_imports_only_from_rooms_below_it():
    assert sorted(ROOMS) == sorted({room(module) for module in GRAPH} - {""})
    found = misplaced(GRAPH, ROOMS)
    assert not found, "; ".join(found)


def test_nothing_but_tests_imports_tests():
    names = "|".join({path.stem for path in (ROOT / "tests").rglob("[!_]*.py")} | {"tests"})
    pattern = re.compile(rf"^\s*(import|from) ({names})\b", re.MULTILINE)
    for folder in ("mgs", "plugins", "tools"):
        for path in (ROOT / folder).rglob("*.py"):
            assert pattern.findall(path.read_text()) == [], path
