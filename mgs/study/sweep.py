"""A sweep: cells of work, each done once, so that a long study can stop at any moment and go on.

A cell is a function and its arguments. What it finds is kept in CELLS/NAME/result.json below the study's folder, beside the
files that it makes. A cell whose result is there, with the same function and arguments, is not done again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path
from typing import Any

from mgs.errors import InputError
from mgs.files import read_json, write_json

CELLS = "cells"


@dataclass(frozen=True)
class Cell:
    """One piece of work of a study."""

    name: str
    """Its folder below CELLS; may have slashes."""
    task: str
    """MODULE:FUNCTION. The function is called as f(root, out, **arguments), root: the folder of the study, out: the cell's own
    folder, which is there and may hold what an interrupted call left. It returns what JSON can hold."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """JSON values."""
    needs: tuple[str, ...] = ()
    """Names of the cells that must be done before."""


def cell_folder(root: Path, name: str) -> Path:
    """The folder of a cell."""
    return root / CELLS / name


def found(root: Path, cell: Cell) -> dict[str, Any] | None:
    """What a cell found; None if it is not done. Raises InputError if the folder holds the result of another question."""
    path = cell_folder(root, cell.name) / "result.json"
    if not path.is_file():
        return None
    record = read_json(path)
    if record["task"] != cell.task or record["arguments"] != cell.arguments:
        raise InputError(f"{path}: was made with other settings or by another version; delete that folder, or give a new one")
    result: dict[str, Any] = record["found"]
    return result


def do(root: Path, cell: Cell) -> dict[str, Any]:
    """Do a cell, unless it is done, and return what it found."""
    known = found(root, cell)
    if known is not None:
        return known
    module, _, name = cell.task.partition(":")
    out = cell_folder(root, cell.name)
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = getattr(import_module(module), name)(root, out, **cell.arguments)
    write_json(out / "result.json", {"task": cell.task, "arguments": cell.arguments, "found": result})
    return result


def run_cells(root: Path, cells: Sequence[Cell], report: Callable[[str, int, int], None]) -> dict[str, dict[str, Any]]:
    """Do all cells, those that others need first; returns what each found, by name.

    report(name, done, total) is told before each cell that is not done yet.
    """
    by_name = {cell.name: cell for cell in cells}
    order = TopologicalSorter({cell.name: cell.needs for cell in cells}).static_order()
    results: dict[str, dict[str, Any]] = {}
    for name in order:
        if found(root, by_name[name]) is None:
            report(name, len(results), len(cells))
        results[name] = do(root, by_name[name])
    return results
