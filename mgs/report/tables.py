"""What run folders say, read and checked, and the table that compares them. Nothing is computed anew."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from mgs.active.settings import validated
from mgs.errors import InputError
from mgs.files import read_json

if TYPE_CHECKING:
    pass


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


def table_numbers(folders: Sequence[str | Path]) -> list[dict[str, Any]]:
    """A row of the table a run, as numbers: COLUMNS, in their units, and the other means of metrics.json (`all.psnr_mask`).

    Raises InputError as `evaluated_runs`.
    """
    rows = []
    for label, run in evaluated_runs(folders).items():
        metrics = run.metrics or {}
        row = {"policy": label, "images": metrics["images"]}
        row |= {f"{views}.{name}": metrics[views][name] for views in ("all", "held_out") for name in metrics[views]}
        rows.append(row | {"coverage": 100 * run.steps[-1]["coverage"]})
    return rows


def table_rows(folders: Sequence[str | Path]) -> list[list[str]]:
    """A row of text a run, in the order of COLUMNS. Raises InputError as `evaluated_runs`."""
    return [[table_cell(column, row.get(column)) for column in COLUMNS] for row in table_numbers(folders)]


def table_cell(column: str, value: Any) -> str:
    """A number of the table as text: two decimals, an SSIM four."""
    if value is None:
        return "–"
    return f"{value:.4f}" if "ssim" in column else f"{value:.2f}" if isinstance(value, float) else str(value)


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """The table as Markdown, numbers right-aligned."""
    heading = "| " + " | ".join(COLUMNS.values()) + " |\n|" + " --- |" + " ---: |" * (len(COLUMNS) - 1) + "\n"
    return heading + "".join("| " + " | ".join(row) + " |\n" for row in rows)
