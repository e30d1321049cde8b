"""What the report page says of each run in words and numbers: notes, tables, links. All of it is
read from files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from mgs.data.dataset import Dataset, Frame
from mgs.data.up import PLUS_Z, Up
from mgs.gaussians import Gaussians
from mgs.policy.poses import path_length
from mgs.report.page_plots import metric_name
from mgs.report.runs import Run, up_of
from mgs.run.ending import fit_line, why_ended
from mgs.run.folder import read_checkpoint, read_config
from mgs.splat_ply import read_ply

GROUP_NAMES = {"all": "all views", "held_out": "held out", "test": "test views"}
"""What metrics.json calls the views that it has means of -> headings. Other groups are called by
their key."""

STEP_KEYS = {
    "step", "frame", "images", "iterations", "score", "information_gain", "coverage", "uncertainty", "loss", "seconds", "signs",
    "residual", "exposure", "ended",
}  # fmt: skip
"""Keys of steps.jsonl that hold numbers, and no metrics of images."""


@dataclass(frozen=True)
class Shown:
    """A run as the page shows it.

    run: with the steps of the checkpoint where there is one, as steps.jsonl can be a step behind.
    model: its Gaussians; None
    where the folder holds none. metrics: of this very model; None where it was not measured since
    its last step. frames: taken,
    in their order. notes: what a reader should know. up, unit: of the world
    (`mgs.data.dataset.Dataset`).
    """

    label: str
    run: Run
    model: Gaussians | None
    metrics: dict[str, Any] | None
    frames: list[Frame]
    notes: list[str]
    up: Up = PLUS_Z
    unit: str = "m"


def read_shown(label: str, run: Run, dataset: Dataset) -> Shown:
    """Read what the page needs of a run. Raises InputError if its checkpoint or its PLY is
    damaged."""
    state = read_checkpoint(run.folder)
    model = state.gaussians if state is not None else None
    if state is not None:
        run = replace(run, steps=state.steps)
    elif (run.folder / "gaussians.ply").is_file():
        model = read_ply(run.folder / "gaussians.ply")
    taken = run.seeds + run.chosen
    fresh = run.metrics is not None and run.metrics["images"] == len(taken)
    metrics = run.metrics if fresh else None
    frames, notes = [dataset.frames[i] for i in taken], _notes(run, model is not None, fresh)
    return Shown(
        label,
        run,
        model,
        metrics,
        frames,
        notes,
        up_of(run.settings.get("prior", ""), dataset),
        dataset.unit,
    )


def _notes(run: Run, drawn: bool, measured: bool) -> list[str]:
    """What a reader of a run's numbers should know: what is unfinished or missing, whether its last
    fit converged, and warnings."""
    taken, planned, notes = (
        len(run.seeds + run.chosen),
        run.settings["seeds"] + run.settings["budget"],
        [],
    )
    if run.ended is None:
        notes.append(
            f"Unfinished: {taken} of {planned} views are taken; `mgs nbv --resume {run.folder}` goes on."
        )
    else:
        notes.append(f"The run has ended: {why_ended(run.ended)}.")
    if run.metrics is None:
        notes.append(f"Not measured: `mgs eval {run.folder}` adds its PSNR and SSIM.")
    elif not measured:
        notes.append(
            f"metrics.json is of {run.metrics['images']} images, the model of {taken}: its numbers are left out; "
            f"`mgs eval {run.folder}` measures again."
        )
    elif "fit" in run.metrics and "stop_reason" in run.steps[-1]:
        line = fit_line(run.metrics["fit"], run.steps[-1]["stop_reason"])
        notes.append(f"{line[0].upper()}{line[1:]}.")
    estimator = run.settings.get("estimator", "exact")
    if estimator != "exact":
        notes.append(
            f"Its information gain is by the estimator {estimator}: compare it with that of the same estimator only."
        )
    if not drawn:
        notes.append(
            "Its folder holds no model (checkpoint.npz or gaussians.ply), so there are no renders of it."
        )
    for step in run.steps:
        notes += [f"step {step['step']}: {warning}" for warning in step.get("warnings", [])]
    return notes


def summary_rows(shown: Sequence[Shown]) -> list[tuple[str, list[str]]]:
    """Rows of the table of results, (heading, a cell for each run): what the steps say, then every
    mean in metrics.json."""
    last = [one.run.steps[-1] for one in shown]
    rows = [
        ("images", [str(step["images"]) for step in last]),
        (
            f"path from view to view ({shown[0].unit})",
            [f"{_path(one.frames):.2f}" for one in shown],
        ),
        ("surface coverage (%)", [f"{100 * step['coverage']:.2f}" for step in last]),
        ("Gaussians", ["–" if one.model is None else f"{len(one.model):,}" for one in shown]),
        (
            "time of all steps (s)",
            [
                f"{sum(sum(s.get('seconds', {}).values()) for s in one.run.steps):.1f}"
                for one in shown
            ],
        ),
    ]
    means = [
        _flat(
            {
                k: v
                for k, v in (one.metrics or {}).items()
                if isinstance(v, dict) and v.get("count") != 0
            }
        )
        for one in shown
    ]
    names = (
        GROUP_NAMES
        if any(("held_out", "count") in found for found in means)
        else GROUP_NAMES | {"all": "views trained on"}
    )
    for path in dict.fromkeys(path for found in means for path in found):
        *groups, key = path
        name = "number" if key == "count" else metric_name(key, shown[0].unit)
        heading = ", ".join(
            [*(names.get(group, group.replace("_", " ")) for group in groups), name]
        )
        rows.append((heading, [cell(key, found.get(path)) for found in means]))
    return rows


def _path(frames: Sequence[Frame]) -> float:
    """Length of the straight lines from frame to frame."""
    return path_length(np.array([frame.camera.position for frame in frames]))


def measured(step: Mapping[str, Any]) -> dict[str, float]:
    """The metrics of images in a line of steps.jsonl, whatever they are called; keys of nested ones
    are joined by spaces."""
    rest = {key: value for key, value in step.items() if key not in STEP_KEYS}
    return {
        " ".join(path): float(value) for path, value in _flat(rest).items() if value is not None
    }


def measured_views(one: Shown) -> list[dict[str, Any]]:
    """What metrics.json holds of each view: those of the dataset, then its test views, whose names
    here begin with `test/`."""
    metrics = one.metrics or {}
    return [
        *metrics.get("views", []),
        *(view | {"name": f"test/{view['name']}"} for view in metrics.get("test_views", [])),
    ]


def _flat(values: Mapping[str, Any], path: tuple[str, ...] = ()) -> dict[tuple[str, ...], Any]:
    """The numbers in nested dictionaries, by their path of keys; None, which stands for a mean of
    nothing, included."""
    found: dict[tuple[str, ...], Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            found |= _flat(value, (*path, key))
        elif value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
            found[(*path, key)] = value
    return found


def cell(key: str, value: Any) -> str:
    """A number as text: dB with two decimals, SSIM with four, others with five digits; a dash for
    None."""
    if value is None:
        return "–"
    if "psnr" in key:
        return f"{value:.2f}"
    return f"{value:.4f}" if "ssim" in key else f"{value:.5g}"


def setting_rows(shown: Sequence[Shown]) -> list[tuple[str, list[str], bool]]:
    """Rows of the table of settings and versions: (key, a value for each run, whether they
    differ)."""
    rows = []
    columns = []
    for one in shown:
        config = read_config(one.run.folder)
        versions = config.get("versions", {})
        columns.append(
            _texts(config["settings"])
            | {f"version of {name}": str(v) for name, v in versions.items()}
        )
    for key in dict.fromkeys(key for column in columns for key in column):
        values = [column.get(key, "–") for column in columns]
        rows.append((key, values, len(set(values)) > 1))
    return rows


def _texts(values: Mapping[str, Any], path: str = "") -> dict[str, str]:
    """Nested settings as text, by their keys joined by dots."""
    found: dict[str, str] = {}
    for key, value in values.items():
        found |= (
            _texts(value, f"{path}{key}.")
            if isinstance(value, dict)
            else {f"{path}{key}": str(value)}
        )
    return found


def links(run: Run, page: Path) -> list[tuple[str, str]]:
    """(address relative to the page, name) of the files of a run that a reader may want to open:
    those that are there."""
    wanted = [
        "gaussians.ply",
        "metrics.json",
        "steps.jsonl",
        "config.json",
        "diagnostics/information.ply",
    ]
    wanted += sorted(
        p.relative_to(run.folder).as_posix() for p in run.folder.glob("diagnostics/*.exr")
    )
    there = [name for name in wanted if (run.folder / name).is_file()]
    prior = Path(str(run.settings.get("prior", "")))
    others = [prior / name for name in ("mesh.ply", "points.ply")] if prior.name else []
    start = page.resolve().parent
    found = [(os.path.relpath(run.folder.resolve() / name, start), name) for name in there]
    found += [
        (os.path.relpath(file.resolve(), start), f"prior: {file.name}")
        for file in others
        if file.is_file()
    ]
    return [(quote(Path(address).as_posix()), name) for address, name in found]
