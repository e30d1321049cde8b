"""Tables and reports of runs, from files only: nothing is computed anew. The figures are in `mgs.figures`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, TypeAdapter, ValidationError

from mgs.config import validated
from mgs.errors import InputError
from mgs.figures import comparison_figure, coverage_figure, gain_figure, orbit_figure, psnr_figure
from mgs.files import atomic_path, read_json

if TYPE_CHECKING:
    from rich.console import Console


class _Settings(BaseModel):
    """What a report needs of config.json; the next: of the first line of steps.jsonl, the others, and metrics.json."""

    policy: str
    dataset: str
    seeds: int
    budget: int


class _Seeds(BaseModel):
    seeds: list[int]
    images: int
    coverage: float


class _Choice(BaseModel):
    frame: int
    information_gain: float
    images: int
    coverage: float


class _View(BaseModel):
    name: str
    trained: bool
    psnr: float
    ssim: float


class _Metrics(BaseModel):
    images: int
    all: dict[str, float | None]
    held_out: dict[str, float | None]
    views: list[_View]


@dataclass(frozen=True)
class Run:
    """What a run folder says: policy, lines of steps.jsonl, metrics.json where the run was evaluated, settings."""

    folder: Path
    policy: str
    steps: list[dict[str, Any]]
    metrics: dict[str, Any] | None
    settings: dict[str, Any]

    @property
    def seeds(self) -> list[int]:
        """Frame indices of the seeds."""
        return list(self.steps[0]["seeds"])

    @property
    def chosen(self) -> list[int]:
        """Frame indices in the order of their choice, without the seeds."""
        return [int(step["frame"]) for step in self.steps[1:]]


def read_run(folder: str | Path) -> Run:
    """Read config.json, steps.jsonl and, where it is there, metrics.json.

    Raises InputError where the folder holds no run, or a file is damaged, empty or lacks a number that a report needs.
    """
    folder = Path(folder)
    path = folder / "config.json"
    config = read_json(path)
    if not isinstance(config, dict) or not isinstance(config.get("settings"), dict):
        raise InputError(f"{path}: has no settings; the file is damaged, start the run anew")
    settings = validated(_Settings, config["settings"], path)
    steps = _read_steps(folder)
    path = folder / "metrics.json"
    metrics = read_json(path) if path.exists() else None
    try:
        TypeAdapter(_Metrics | None).validate_python(metrics)
    except ValidationError:
        raise InputError(f"{path}: is damaged; measure the run again with `mgs eval {folder}`") from None
    return Run(folder, settings.policy, steps, metrics, config["settings"])


def _read_steps(folder: Path) -> list[dict[str, Any]]:
    """The lines of steps.jsonl. Raises InputError, naming the line and the key, where one lacks a number or is no JSON."""
    path, resume = folder / "steps.jsonl", f"`mgs nbv --resume {folder}`"
    if not path.is_file():
        raise InputError(f"{path}: no such file; the run has no finished step, continue it with {resume}")
    steps: list[dict[str, Any]] = []
    for number, text in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines() or [""], 1):
        try:
            steps.append(json.loads(text))
            (_Seeds if number == 1 else _Choice).model_validate(steps[-1])
        except ValueError as error:
            raise InputError(f"{path}: line {number} is damaged ({_cause(error)}); write the file anew with {resume}") from None
    return steps


def _cause(error: ValueError) -> str:
    if not isinstance(error, ValidationError):
        return "no JSON"
    first = error.errors(include_url=False)[0]
    return ": ".join(str(part) for part in (*first["loc"], first["msg"]))


COLUMNS = {
    "policy": "policy",
    "images": "images",
    "all.psnr": "PSNR, all (dB)",
    "all.ssim": "SSIM, all",
    "held_out.psnr": "PSNR, held out (dB)",
    "held_out.ssim": "SSIM, held out",
    "held_out.psnr_mask": "PSNR, held out, rock only (dB)",
    "held_out.ssim_mask": "SSIM, held out, rock only",
    "coverage": "coverage (%)",
}
"""Columns of the table: where the number lies in metrics.json, and its heading."""


def check_finished(run: Run) -> None:
    """Raises InputError where the budget of a run is not spent, or its last files are missing."""
    taken, planned = len(run.seeds + run.chosen), run.settings["seeds"] + run.settings["budget"]
    resume = f"`mgs nbv --resume {run.folder}`"
    if taken < planned:
        raise InputError(f"{run.folder}: is unfinished, with {taken} of {planned} views; go on with {resume}, then report")
    if not (run.folder / "gaussians.ply").is_file():
        raise InputError(f"{run.folder}: has all {planned} views, but no gaussians.ply; write it with {resume}, then report")


def evaluated_runs(folders: Sequence[str | Path]) -> dict[str, Run]:
    """Runs by label: the policy, with the folder where several runs have the same one.

    Raises InputError where a run was not evaluated since its last step, two folders are the same, or the datasets differ.
    """
    runs = [read_run(folder) for folder in folders]
    policies = [run.policy for run in runs]
    labelled = {
        run.policy if policies.count(run.policy) == 1 else f"{run.policy} ({run.folder.resolve().name})": run for run in runs
    }
    if len(labelled) < len(runs):
        raise InputError("report: two of the runs have the same policy and folder name; give each run once, or rename a folder")
    for run in runs:
        if run.metrics is None or run.metrics["images"] != len(run.seeds + run.chosen):
            raise InputError(f"{run.folder}: was not evaluated since its last step; measure it with `mgs eval {run.folder}`")
        if run.settings["dataset"] != runs[0].settings["dataset"]:
            raise InputError(f"{run.folder}: is a run on another dataset than {runs[0].folder}; compare runs on one dataset")
    return labelled


def table_rows(folders: Sequence[str | Path]) -> list[list[str]]:
    """A row of text a run, in the order of COLUMNS. Raises InputError as `evaluated_runs`."""
    rows = []
    for label, run in evaluated_runs(folders).items():
        metrics = run.metrics or {}
        values = {"policy": label, "coverage": 100 * run.steps[-1]["coverage"], "images": metrics["images"]}
        values |= {f"{views}.{name}": metrics[views][name] for views in ("all", "held_out") for name in metrics[views]}
        rows.append([_cell(column, values.get(column)) for column in COLUMNS])
    return rows


def _cell(column: str, value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.4f}" if "ssim" in column else f"{value:.2f}" if isinstance(value, float) else str(value)


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """The table as Markdown, numbers right-aligned."""
    heading = "| " + " | ".join(COLUMNS.values()) + " |\n|" + " --- |" + " ---: |" * (len(COLUMNS) - 1) + "\n"
    return heading + "".join("| " + " | ".join(row) + " |\n" for row in rows)


def print_table(console: Console, rows: Sequence[Sequence[str]]) -> None:
    """Print the table, for 80 columns; names that do not fit beside the numbers stand below, by the number of their row."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    short = ["images", *(f"{name}\n{views}" for views in ("all", "new", "rock") for name in ("PSNR", "SSIM")), "cover"]
    names = [row[0] for row in rows]

    def table(heading: str, first: Sequence[str]) -> Table:
        made = Table(
            box=box.SIMPLE_HEAD,
            pad_edge=False,
            caption="dB and %; new: views never trained on; rock: those, inside its mask",
        )
        made.add_column(heading, no_wrap=True)
        for heading in short:
            made.add_column(heading, justify="right", no_wrap=True)
        for name, row in zip(first, rows, strict=True):
            made.add_row(Text(name), *row[1:])
        return made

    whole = table("policy", names)
    if console.measure(whole, options=console.options.update(max_width=1 << 16)).maximum <= console.width:
        console.print(whole)
        return
    numbers = [str(number) for number in range(1, len(rows) + 1)]
    console.print(table("run", numbers))
    for number, name in zip(numbers, names, strict=True):
        console.print(Text(f"{number}: {name}"), soft_wrap=True)


def write_report(out: str | Path, folders: Sequence[str | Path]) -> list[Path]:
    """Every figure and the table of runs on one dataset, into the folder `out`; returns the files written.

    orbit.png, gain.png, coverage.png, comparison.png (a view that the fewest runs were trained on), psnr.png (where runs were
    evaluated on the way), table.md. Raises InputError as `evaluated_runs`, where a run is unfinished, and where the pictures of
    `mgs eval` are missing.
    """
    from mgs.dataset import load_dataset
    from mgs.evaluate import read_comparison
    from mgs.gaussians import read_ply
    from mgs.nbv import check_same_frames, read_settings

    for folder in folders:
        check_finished(read_run(folder))
    out, runs = Path(out), evaluated_runs(folders)
    first = next(iter(runs.values()))
    dataset = load_dataset(read_settings(first.folder).dataset)
    for run in runs.values():
        check_same_frames(run.folder, dataset)
    frames = dataset.frames
    frame = frames[unseen_view(list(runs.values()), len(frames))]
    pictures = {label: run.folder / "renders" / f"{frame.name}.png" for label, run in runs.items()}
    for label, picture in pictures.items():
        stale = (runs[label].metrics or {}).get("pictures") is False  # of an earlier model; older runs do not say
        if stale or not picture.is_file():
            raise InputError(f"{picture}: no picture of this model; draw it with `mgs eval {runs[label].folder}`")
    captions = {label: _caption(run, frame.name) for label, run in runs.items()}
    pairs = {label: read_comparison(picture, frame.camera) for label, picture in pictures.items()}

    positions = np.array([frame.camera.position for frame in frames])
    choices = {label: (run.seeds, run.chosen) for label, run in runs.items()}
    orbit_figure(out / "orbit.png", positions, read_ply(first.folder / "gaussians.ply").means, choices)
    gain_figure(out / "gain.png", {label: [s["information_gain"] for s in run.steps[1:]] for label, run in runs.items()})
    curves = {label: ([s["images"] for s in run.steps], [s["coverage"] for s in run.steps]) for label, run in runs.items()}
    coverage_figure(out / "coverage.png", curves)

    truth = next(iter(pairs.values()))[0]
    renders = {label: rendered for label, (_, rendered) in pairs.items()}
    comparison_figure(out / "comparison.png", truth, renders, title=frame.name, captions=captions)
    written = [out / f"{name}.png" for name in ("orbit", "gain", "coverage", "comparison")]

    measured = {label: [s for s in run.steps if {"psnr", "psnr_mask"} <= s.keys()] for label, run in runs.items()}
    if all(measured.values()):
        panels = {
            what: {label: ([s["images"] for s in steps], [s[key] for s in steps]) for label, steps in measured.items()}
            for what, key in (("all views", "psnr"), ("all views, rock only", "psnr_mask"))
        }
        psnr_figure(out / "psnr.png", panels)
        written.append(out / "psnr.png")
    with atomic_path(out / "table.md") as temporary:
        temporary.write_text(markdown_table(table_rows(folders)), encoding="utf-8")
    return [*written, out / "table.md"]


def unseen_view(runs: Sequence[Run], frames: int) -> int:
    """A frame that the fewest runs were trained on; of those, the one in the middle."""
    counts = [sum(index in run.seeds + run.chosen for run in runs) for index in range(frames)]
    fewest = [index for index in range(frames) if counts[index] == min(counts)]
    return fewest[len(fewest) // 2]


def _caption(run: Run, name: str) -> str:
    """PSNR and SSIM of one view, and how many images the model had. Raises InputError where the view was not evaluated."""
    view = next((view for view in (run.metrics or {})["views"] if view["name"] == name), None)
    if view is None:
        raise InputError(f"{run.folder}: was not evaluated on {name}; measure it with `mgs eval {run.folder}`")
    seen = ", trained on" if view["trained"] else ""
    return f"{len(run.seeds) + len(run.chosen)} images{seen}; {view['psnr']:.2f} dB, SSIM {view['ssim']:.4f}"
