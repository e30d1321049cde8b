"""Words and numbers of the report page, read from the files of runs: notes, tables, links."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mgs.data.dataset import Dataset
from mgs.data.frames import Frame
from mgs.data.up import Up
from mgs.gaussians import Gaussians
from mgs.policy.criteria import GAIN_UNIT
from mgs.report.page_plots import METRIC_NAMES
from mgs.report.runs import RunFiles, up_of
from mgs.report.tables import table_cell, table_columns, table_heading, table_row
from mgs.run.ending import RunEnd, fit_line, why_ended
from mgs.run.folder import read_checkpoint
from mgs.splat_ply import read_ply


@dataclass(frozen=True)
class Shown:
    """A run as the page shows it.

    run: with the steps of the checkpoint, which can be one ahead of steps.jsonl. model: None if the
    folder holds none. frames: taken, in their order. notes: sentences for the reader. up: of the
    world.
    """

    label: str
    run: RunFiles
    model: Gaussians | None
    frames: list[Frame]
    notes: list[str]
    up: Up

    def psnr_of(self, view: str) -> str:
        """PSNR of a view as part of a caption; empty if it was not measured."""
        found = next((v for v in measured_views(self.run) if v["name"] == view), {})
        return f", {found['psnr']:.2f} dB" if found.get("psnr") is not None else ""


def read_shown(label: str, run: RunFiles, dataset: Dataset) -> Shown:
    """Read what the page shows of a run. Raises InputError if its checkpoint or PLY is damaged."""
    state, ply = read_checkpoint(run.folder), run.folder / "gaussians.ply"
    model = None
    if state is not None:
        run, model = replace(run, steps=state.steps), state.gaussians
    elif ply.is_file():
        model = read_ply(ply)
    frames, up = (
        [dataset.frames[i] for i in run.taken],
        up_of(run.settings.get("prior", ""), dataset),
    )
    return Shown(label, run, model, frames, _notes(run, model is not None), up)


def _notes(run: RunFiles, drawn: bool) -> list[str]:
    """Sentences about what is unfinished or missing, the end of the run and of its last fit, and
    the run's warnings."""
    taken, planned = len(run.taken), run.settings["seeds"] + run.settings["budget"]
    if run.ended is None:
        notes = [
            f"Unfinished: {taken} of {planned} views are taken; "
            f"`mgs nbv --resume {run.folder}` goes on."
        ]
    else:  # a spent budget is no news
        spent = run.ended["reason"] == RunEnd.BUDGET
        notes = [] if spent else [f"The run has ended: {why_ended(run.ended)}."]
    if run.metrics is None:
        notes.append(f"Not measured: `mgs eval {run.folder}` adds its PSNR and SSIM.")
    elif run.measured is None:
        notes.append(
            f"metrics.json is of {run.metrics['images']} images, the model of {taken}: its numbers "
            f"are left out; `mgs eval {run.folder}` measures again."
        )
    elif "fit" in run.metrics and "stop_reason" in run.steps[-1]:
        line = fit_line(run.metrics["fit"], run.steps[-1]["stop_reason"])
        notes.append(f"{line[0].upper()}{line[1:]}.")
    estimator = run.settings.get("estimator", "exact")
    if estimator != "exact":
        notes.append(
            f"Its information gain is by the estimator {estimator}: "
            "compare it with that of the same estimator only."
        )
    if not drawn:
        notes.append(
            "Its folder holds no model (checkpoint.npz or gaussians.ply), "
            "so there are no renders of it."
        )
    for step in run.steps:
        notes += [f"step {step['step']}: {warning}" for warning in step.get("warnings", [])]
    return notes


def summary_rows(shown: Sequence[Shown], dataset: Dataset) -> list[tuple[str, list[str]]]:
    """Rows of the table of results, (heading, a cell for each run): the report's table, without
    what no run has, then the size of the model and the time."""
    rows = [table_row(one.label, one.run, dataset) for one in shown]
    seconds = [sum(sum(s.get("seconds", {}).values()) for s in one.run.steps) for one in shown]
    return [
        *(
            (table_heading(key, rows), [table_cell(key, row.get(key)) for row in rows])
            for key in table_columns(rows)[1:]
        ),
        ("Gaussians", ["–" if one.model is None else f"{len(one.model):,}" for one in shown]),
        ("time of all steps (s)", [f"{value:.1f}" for value in seconds]),
    ]


def measured(step: Mapping[str, Any]) -> dict[str, float]:
    """Metrics of images in a line of steps.jsonl."""
    return {key: step[key] for key in METRIC_NAMES if step.get(key) is not None}


def step_facts(step: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(name, value) of a line of steps.jsonl: images, information gain, coverage, and metrics."""
    facts = [("images", str(step["images"]))]
    if step.get("information_gain") is not None:
        facts.append(("information gain", f"{step['information_gain']:.4g} {GAIN_UNIT}"))
    facts.append(("Gaussians observed", f"{100 * step['coverage']:.2f} %"))
    return facts + [(METRIC_NAMES[key], table_cell(key, v)) for key, v in measured(step).items()]


def measured_views(run: RunFiles) -> list[dict[str, Any]]:
    """Views in metrics.json: those of the dataset, then its test views, as `test/NAME`."""
    metrics = run.measured or {}
    tests = [view | {"name": f"test/{view['name']}"} for view in metrics.get("test_views", [])]
    return [*metrics.get("views", []), *tests]


def setting_rows(shown: Sequence[Shown]) -> list[tuple[str, list[str], bool]]:
    """Rows of the table of settings and versions: (key, a value for each run, whether they
    differ)."""
    columns = []
    for one in shown:
        versions = one.run.versions.items()
        named = {f"version of {name}": str(version) for name, version in versions}
        columns.append(_texts(one.run.settings) | named)
    rows = []
    for key in dict.fromkeys(key for column in columns for key in column):
        values = [column.get(key, "–") for column in columns]
        rows.append((key, values, len(set(values)) > 1))
    return rows


def _texts(values: Mapping[str, Any], path: str = "") -> dict[str, str]:
    """Nested settings as text, by their keys joined by dots."""
    found: dict[str, str] = {}
    for key, value in values.items():
        name = f"{path}{key}"
        found |= _texts(value, f"{name}.") if isinstance(value, dict) else {name: str(value)}
    return found


def links(run: RunFiles, page: Path) -> list[tuple[str, str]]:
    """(address relative to the page, name) of the existing files of a run that a reader may
    open."""
    names = ["gaussians.ply", "metrics.json", "steps.jsonl", "config.json"]
    files = [(run.folder / name, name) for name in [*names, "diagnostics/information.ply"]]
    maps = sorted(run.folder.glob("diagnostics/*.exr"))
    files += [(file, file.relative_to(run.folder).as_posix()) for file in maps]
    prior = Path(str(run.settings.get("prior", "")))
    if prior.name:
        files += [(prior / name, f"prior: {name}") for name in ("mesh.ply", "points.ply")]
    start = page.resolve().parent
    return [
        (quote(Path(os.path.relpath(file.resolve(), start)).as_posix()), name)
        for file, name in files
        if file.is_file()
    ]
