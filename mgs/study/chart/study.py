"""`mgs chart`: the cells of every chart, and the files that are made of what they found."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.errors import row_named
from mgs.files import locked, write_csv, write_json
from mgs.provenance import versions
from mgs.study.chart import core, drawing, fit, presets, scoring, sending
from mgs.study.chart.plan import PLANS, SCENE, Data, Plan, own, synthetic
from mgs.study.chart.subject import test_views_of
from mgs.study.chart.timing import with_seconds
from mgs.study.sweep import Cell, run_cells

Rows = list[dict[str, Any]]


def chart(
    out: Path,
    preset: str,
    kinds: Sequence[str],
    repeats: int | None = None,
    dataset: Path | None = None,
    report: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> dict[str, Any]:
    """Measure and draw; what is measured already is kept. kinds: of `mgs.study.chart.plan.KINDS`.

    Writes KIND.csv of every kind, its figures (`mgs.study.chart.drawing.FIGURES`), and chart.json,
    which has all rows; kinds
    that are not asked for are left as they are. dataset: in place of the one that is rendered; it
    needs test views. report(cell, done, total) is told before each cell. Returns what chart.json
    holds. Raises InputError for an unknown preset, as `load_dataset` and `run_cells`, and where the
    dataset has no test views.
    """
    from mgs import runtime
    from mgs.data.dataset import load_dataset

    plan = row_named(PLANS, preset, "--preset")
    repeats = repeats or plan.repeats
    if dataset is not None:
        test_views_of(load_dataset(dataset))
    runtime.start()
    out.mkdir(parents=True, exist_ok=True)
    data = synthetic(plan, SCENE) if dataset is None else own(dataset)
    cells = {
        cell.name: cell for kind in kinds for cell in cells_of(kind, plan, preset, data, repeats)
    }
    with locked(out):
        found = run_cells(out, list(cells.values()), report)
        unit = float(
            np.median(
                [result["reference"] for result in found.values() if "reference" in result] or [0.0]
            )
        )
        commands = {kind: command_of(kind, preset, data, out, repeats) for kind in kinds}
        rows = {kind: rows_of(kind, plan, data, out, found, unit, commands[kind]) for kind in kinds}
        about = {
            "preset": preset,
            "repeats": repeats,
            "reference_seconds": unit,
            "machine": runtime.processor(),
        }
        measured = {
            kind: {"command": commands[kind], **about, "rows": made} for kind, made in rows.items()
        }
        path = out / "chart.json"
        result = {**_known(path), **measured, "versions": versions()}
        for kind, made in rows.items():
            write_csv(out / f"{kind}.csv", made)
        for name, (kind, draw) in drawing.FIGURES.items():
            if kind in rows:
                draw(out / f"{name}.png", rows[kind])
        write_json(path, result)
    return result


def _known(path: Path) -> dict[str, Any]:
    """What an earlier call wrote."""
    from mgs.files import read_json

    found: dict[str, Any] = read_json(path) if path.is_file() else {}
    return found


def cells_of(kind: str, plan: Plan, preset: str, data: Data, repeats: int) -> list[Cell]:
    """The cells of a chart, and those that they need."""
    if kind == "fit":
        half = None if not data.cells else synthetic(plan, SCENE, half=True)
        points = [
            point for points in fit.factors(plan, half is not None).values() for point in points
        ]
        return fit.cells(plan, data, points, repeats, half)
    if kind == "scoring":
        return scoring.cells(plan, data, repeats, preset)
    if kind == "core":
        return core.cells(plan, repeats, preset)
    return sending.cells(plan, data, preset) if kind == "bytes" else presets.cells(plan, repeats)


def command_of(kind: str, preset: str, data: Data, out: Path, repeats: int) -> str:
    """The command that measures a chart in the folder `out`."""
    words = [
        "mgs",
        "chart",
        str(out),
        "--only",
        kind,
        "--preset",
        preset,
        "--repeats",
        str(repeats),
    ]
    return shlex.join([*words, *([] if data.cells else ["--dataset", data.folder])])


def rows_of(
    kind: str, plan: Plan, data: Data, root: Path, found: dict[str, Any], unit: float, command: str
) -> Rows:
    """The rows of a chart, with a command each. unit: seconds of the reference. command: that of
    the whole chart."""
    if kind == "fit":
        return fit.with_fronts(
            with_seconds(fit.rows(plan, data, root, found, bool(data.cells)), unit)
        )
    if kind == "scoring":
        return with_seconds(scoring.rows(plan, data, found, command), unit)
    if kind == "core":
        return with_seconds(core.rows(plan, found, command), unit)
    return (
        sending.rows(plan, data, found, command)
        if kind == "bytes"
        else presets.rows(plan, root, found, unit)
    )
