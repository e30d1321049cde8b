"""Run folders as a report reads them: checked, and fit to be compared. Nothing is computed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from mgs.data.dataset import Dataset
from mgs.data.frames import Frame
from mgs.data.up import Up, unit_up
from mgs.errors import InputError
from mgs.files import read_json, reading
from mgs.policy.from_file import label
from mgs.report.figures import Curves
from mgs.run.ending import RunEnd
from mgs.run.folder import (
    check_frames,
    check_line,
    check_same_frames,
    frames_of,
    open_run,
    read_config,
)
from mgs.run.settings import validated


class _Settings(BaseModel):
    """Settings in config.json that a report needs."""

    policy: str
    dataset: str
    seeds: int
    budget: int


class _View(BaseModel):
    """A view in metrics.json."""

    name: str
    trained: bool
    psnr: float
    ssim: float
    psnr_mask: float | None = None
    ssim_mask: float | None = None


class _Fit(BaseModel):
    predicted_decrease: float
    converged: bool


class _Metrics(BaseModel):
    """Contents of metrics.json that a report needs."""

    images: int
    all: dict[str, float | None]
    held_out: dict[str, float | None]
    views: list[_View]
    test: dict[str, float | None] = {}
    test_views: list[_View] = []
    fit: _Fit | None = None


@dataclass(frozen=True)
class RunFiles:
    """Contents of the files of a run folder.

    policy: its name, or "fit". steps: the lines of steps.jsonl (`mgs.run.folder` lists their keys).
    metrics: metrics.json (`mgs.evaluation.evaluate_model`), None if the run was not
    evaluated. settings, versions: those in config.json.
    """

    folder: Path
    policy: str
    steps: list[dict[str, Any]]
    metrics: dict[str, Any] | None
    settings: dict[str, Any]
    versions: dict[str, str]

    @property
    def seeds(self) -> list[int]:
        """Indices of the seed frames."""
        return list(self.steps[0]["seeds"])

    @property
    def chosen(self) -> list[int]:
        """Indices of the chosen frames, in the order of their choice."""
        return [int(step["frame"]) for step in self.steps[1:]]

    @property
    def taken(self) -> list[int]:
        """Indices of all frames trained on: seeds, then chosen ones."""
        return frames_of(self.steps)

    @property
    def measured(self) -> dict[str, Any] | None:
        """metrics.json, if it is of the model after the last step."""
        fresh = self.metrics is not None and self.metrics["images"] == len(self.taken)
        return self.metrics if fresh else None

    @property
    def ended(self) -> dict[str, Any] | None:
        """Why the run ended, as in steps.jsonl; None for an unfinished run, also where the budget
        was raised after it was spent."""
        ended = self.steps[-1].get("ended")
        spent = ended is not None and ended["reason"] == RunEnd.BUDGET
        return None if spent and len(self.chosen) < self.settings["budget"] else ended


@dataclass(frozen=True)
class Comparison:
    """Runs on one dataset, by label: the policy, with the folder's name if several runs have it."""

    runs: dict[str, RunFiles]
    dataset: Dataset


def read_run(folder: str | PathLike[str]) -> RunFiles:
    """Read config.json, steps.jsonl and, if it exists, metrics.json of a run folder.

    Raises InputError if the folder holds no run, or a file is damaged, empty, or lacks a number
    that a report needs.
    """
    folder = Path(folder)
    config = read_config(folder)
    settings = validated(_Settings, config["settings"], folder / "config.json")
    steps = _read_steps(folder)
    metrics = read_metrics(folder)
    name, versions = label(settings.policy, settings.budget), config.get("versions")
    versions = versions if isinstance(versions, dict) else {}
    return RunFiles(folder, name, steps, metrics, config["settings"], versions)


def read_metrics(folder: Path) -> dict[str, Any] | None:
    """Read metrics.json of a run; None if there is none. Raises InputError if it is damaged."""
    path = folder / "metrics.json"
    metrics: dict[str, Any] | None = read_json(path) if path.exists() else None
    try:
        TypeAdapter(_Metrics | None).validate_python(metrics)
    except ValidationError:
        raise InputError(
            f"{path}: is damaged; measure the run again with `mgs eval {folder}`"
        ) from None
    return metrics


def _read_steps(folder: Path) -> list[dict[str, Any]]:
    """Read steps.jsonl. Raises InputError if it is missing or damaged."""
    path, resume = folder / "steps.jsonl", f"`mgs nbv --resume {folder}`"
    if not path.is_file():
        raise InputError(
            f"{path}: no such file; the run has no finished step, continue it with {resume}"
        )
    steps: list[dict[str, Any]] = []
    with reading(path):
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines() or [""]
    for number, text in enumerate(lines, 1):
        try:
            steps.append(json.loads(text))
            check_line(number, steps[-1])
        except (ValueError, RecursionError) as error:  # RecursionError: nested too deeply
            raise InputError(
                f"{path}: line {number} is damaged ({_cause(error)}); "
                f"write the file anew with {resume}"
            ) from None
    return steps


def _cause(error: Exception) -> str:
    """Error of a damaged line: its key and what it lacks, or "no JSON"."""
    if not isinstance(error, ValidationError):
        return "no JSON"
    first = error.errors(include_url=False)[0]
    return ": ".join(str(part) for part in (*first["loc"], first["msg"]))


def check_finished(run: RunFiles) -> None:
    """Raises InputError if a run has not ended, or its last file, gaussians.ply, is missing."""
    taken, planned = len(run.taken), run.settings["seeds"] + run.settings["budget"]
    resume = f"`mgs nbv --resume {run.folder}`"
    if run.ended is None:
        raise InputError(
            f"{run.folder}: is unfinished, with {taken} of {planned} views; "
            f"go on with {resume}, then report"
        )
    if not (run.folder / "gaussians.ply").is_file():
        raise InputError(
            f"{run.folder}: has all {taken} views, but no gaussians.ply; "
            f"write it with {resume}, then report"
        )


def check_measured(run: RunFiles) -> None:
    """Raises InputError if a run was not evaluated since its last step."""
    if run.measured is None:
        raise InputError(
            f"{run.folder}: was not evaluated since its last step; "
            f"measure it with `mgs eval {run.folder}`"
        )


def compare_runs(folders: Sequence[str | PathLike[str]]) -> Comparison:
    """Read runs that are to be compared, and load their dataset.

    Raises InputError as `read_run`; if two runs have the same policy and folder name; if the runs
    are on different datasets; and if the dataset is missing, unreadable, or no longer has the
    frames that a run was started on.
    """
    runs = [read_run(folder) for folder in folders]
    policies = [run.policy for run in runs]
    labelled = {
        run.policy
        if policies.count(run.policy) == 1
        else f"{run.policy} ({run.folder.resolve().name})": run
        for run in runs
    }
    if len(labelled) < len(runs):
        raise InputError(
            "report: two of the runs have the same policy and folder name; "
            "give each run once, or rename a folder"
        )
    for run in runs:
        if run.settings["dataset"] != runs[0].settings["dataset"]:
            raise InputError(
                f"{run.folder}: is a run on another dataset than {runs[0].folder}; "
                "compare runs on one dataset"
            )
    dataset = open_run(runs[0].folder).dataset
    for run in runs:
        check_same_frames(run.folder, dataset)
        check_frames(run.folder / "steps.jsonl", run.taken, len(dataset.frames))
    return Comparison(labelled, dataset)


def step_curves(runs: Mapping[str, RunFiles], key: str, factor: float = 1.0) -> Curves:
    """A number of the steps of each run that has it, against the number of images."""
    curves = {}
    for name, run in runs.items():
        points = [(s["images"], factor * s[key]) for s in run.steps if s.get(key) is not None]
        if points:
            curves[name] = ([x for x, _ in points], [y for _, y in points])
    return curves


def least_trained(
    runs: Iterable[RunFiles], dataset: Dataset, frames: Sequence[Frame]
) -> list[Frame]:
    """The frames among these that the fewest runs were trained on, in their order."""
    taken = [{dataset.frames[i].name for i in run.taken} for run in runs]
    counts = [sum(frame.name in names for names in taken) for frame in frames]
    return [frame for frame, count in zip(frames, counts, strict=True) if count == min(counts)]


def up_of(prior: str | Path, dataset: Dataset) -> Up:
    """Up direction of a run: that of its prior, or of the dataset if the prior's folder is gone.

    Raises InputError if prior.json is damaged.
    """
    file = Path(prior) / "prior.json"
    numbers = read_json(file) if file.is_file() else None
    return unit_up(numbers["up"]) if isinstance(numbers, dict) and "up" in numbers else dataset.up
