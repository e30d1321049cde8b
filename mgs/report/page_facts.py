"""Words and numbers of the report page, read from the files of runs: notes, tables, links."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mgs.data.dataset import Dataset, Frame
from mgs.data.up import PLUS_Z, Up
from mgs.gaussians import Gaussians
from mgs.report.page_plots import metric_name
from mgs.report.runs import RunFiles, up_of
from mgs.report.tables import path_of, table_cell
from mgs.run.ending import fit_line, why_ended
from mgs.run.folder import read_checkpoint
from mgs.splat_ply import read_ply

GROUP_NAMES = {"all": "all views", "held_out": "held out", "test": "test views"}
"""Sets of views in metrics.json -> headings. Other groups are called by their key."""

STEP_KEYS = {
    "step", "frame", "images", "iterations", "score", "information_gain", "coverage",
    "uncertainty", "loss", "seconds", "indicators", "residual", "exposure", "ended",
}  # fmt: skip
"""Keys of steps.jsonl that hold numbers, but no metrics of images."""


@dataclass(frozen=True)
class Shown:
    """A run as the page shows it.

    run: with the steps of the checkpoint, which can be one ahead of steps.jsonl. model: None if the
    folder holds none. metrics: of this model; None if it was not measured since its last step.
    frames: taken, in their order. notes: sentences for the reader. up, unit: of the world.
    """

    label: str
    run: RunFiles
    model: Gaussians | None
    metrics: dict[str, Any] | None
    frames: list[Frame]
    notes: list[str]
    up: Up = PLUS_Z
    unit: str = "m"

    def psnr_of(self, view: str) -> str:
        """PSNR of a view as part of a caption; empty if it was not measured."""
        found = next((v for v in measured_views(self) if v["name"] == view), {})
        return f", {found['psnr']:.2f} dB" if found.get("psnr") is not None else ""


def read_shown(label: str, run: RunFiles, dataset: Dataset) -> Shown:
    """Read what the page shows of a run. Raises InputError if its checkpoint or PLY is damaged."""
    state, ply = read_checkpoint(run.folder), run.folder / "gaussians.ply"
    model = None
    if state is not None:
        run, model = replace(run, steps=state.steps), state.gaussians
    elif ply.is_file():
        model = read_ply(ply)
    fresh = run.metrics is not None and run.metrics["images"] == len(run.taken)
    return Shown(
        label,
        run,
        model,
        run.metrics if fresh else None,
        [dataset.frames[i] for i in run.taken],
        _notes(run, model is not None, fresh),
        up_of(run.settings.get("prior", ""), dataset),
        dataset.unit,
    )


def _notes(run: RunFiles, drawn: bool, measured: bool) -> list[str]:
    """Sentences about what is unfinished or missing, the end of the run and of its last fit, and
    the run's warnings."""
    taken, planned = len(run.taken), run.settings["seeds"] + run.settings["budget"]
    if run.ended is None:
        notes = [
            f"Unfinished: {taken} of {planned} views are taken; "
            f"`mgs nbv --resume {run.folder}` goes on."
        ]
    else:
        notes = [f"The run has ended: {why_ended(run.ended)}."]
    if run.metrics is None:
        notes.append(f"Not measured: `mgs eval {run.folder}` adds its PSNR and SSIM.")
    elif not measured:
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


def summary_rows(shown: Sequence[Shown]) -> list[tuple[str, list[str]]]:
    """Rows of the table of results, (heading, a cell for each run): numbers of the steps, then
    every mean in metrics.json."""
    last, unit = [one.run.steps[-1] for one in shown], shown[0].unit
    seconds = [sum(sum(s.get("seconds", {}).values()) for s in one.run.steps) for one in shown]
    rows = [
        ("images", [str(step["images"]) for step in last]),
        (f"path from view to view ({unit})", [f"{path_of(one.frames):.2f}" for one in shown]),
        ("surface coverage (%)", [f"{100 * step['coverage']:.2f}" for step in last]),
        ("Gaussians", ["–" if one.model is None else f"{len(one.model):,}" for one in shown]),
        ("time of all steps (s)", [f"{value:.1f}" for value in seconds]),
    ]
    means = [_means(one.metrics or {}) for one in shown]
    held_out = any(("held_out", "count") in found for found in means)
    names = GROUP_NAMES if held_out else GROUP_NAMES | {"all": "views trained on"}
    for path in dict.fromkeys(path for found in means for path in found):
        *groups, key = path
        name = "number" if key == "count" else metric_name(key, unit)
        headings = [names.get(group, group.replace("_", " ")) for group in groups]
        cells = [table_cell(key, found.get(path)) for found in means]
        rows.append((", ".join([*headings, name]), cells))
    return rows


def _means(metrics: Mapping[str, Any]) -> dict[tuple[str, ...], Any]:
    """Numbers of metrics.json that belong to a set of views with views in it, or to another
    group."""
    groups = {key: value for key, value in metrics.items() if isinstance(value, dict)}
    return _flat({key: value for key, value in groups.items() if value.get("count") != 0})


def measured(step: Mapping[str, Any]) -> dict[str, float]:
    """Metrics of images in a line of steps.jsonl, whatever their names; nested keys are joined by
    spaces."""
    rest = {key: value for key, value in step.items() if key not in STEP_KEYS}
    return {
        " ".join(path): float(value) for path, value in _flat(rest).items() if value is not None
    }


def measured_views(one: Shown) -> list[dict[str, Any]]:
    """Views in metrics.json: those of the dataset, then its test views, as `test/NAME`."""
    metrics = one.metrics or {}
    tests = [view | {"name": f"test/{view['name']}"} for view in metrics.get("test_views", [])]
    return [*metrics.get("views", []), *tests]


def _flat(values: Mapping[str, Any], path: tuple[str, ...] = ()) -> dict[tuple[str, ...], Any]:
    """Numbers and None in nested dictionaries, by their path of keys."""
    found: dict[tuple[str, ...], Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            found |= _flat(value, (*path, key))
        elif value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
            found[(*path, key)] = value
    return found


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
