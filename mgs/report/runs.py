"""Run folders as a report needs them: read, checked, and found fit to be compared. Nothing is
computed anew."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from mgs.data.dataset import Dataset, load_dataset
from mgs.data.up import Up, unit_up
from mgs.errors import InputError
from mgs.files import read_json
from mgs.policy.from_file import label
from mgs.run.ending import RunEnd
from mgs.run.folder import check_same_frames, read_config, read_settings
from mgs.run.settings import validated


class _Settings(BaseModel):
    """What a report needs of the settings in config.json."""

    policy: str
    dataset: str
    seeds: int
    budget: int


class _Ended(BaseModel):
    """What it needs of why a run ended."""

    reason: RunEnd
    views: int


class _SeedLine(BaseModel):
    """What it needs of the first line of steps.jsonl, which is about the seeds."""

    seeds: list[int]
    images: int
    coverage: float
    ended: _Ended | None = None


class _ChoiceLine(BaseModel):
    """What it needs of each other line of steps.jsonl, which is about one view that was chosen."""

    frame: int
    information_gain: float
    images: int
    coverage: float
    ended: _Ended | None = None


class _View(BaseModel):
    """What it needs of each view in metrics.json."""

    name: str
    trained: bool
    psnr: float
    ssim: float


class _Metrics(BaseModel):
    """What it needs of metrics.json."""

    images: int
    all: dict[str, float | None]
    held_out: dict[str, float | None]
    views: list[_View]
    test: dict[str, float | None] = {}
    test_views: list[_View] = []


@dataclass(frozen=True)
class Run:
    """What the files of a run folder say.

    policy: its name. steps: the lines of steps.jsonl (`mgs.run.folder` says what they hold).
    metrics: metrics.json as `mgs.report.evaluation.evaluate` returns it, None if the run was not
    evaluated. settings: those in config.json.
    """

    folder: Path
    policy: str
    steps: list[dict[str, Any]]
    metrics: dict[str, Any] | None
    settings: dict[str, Any]

    @property
    def seeds(self) -> list[int]:
        """Indices of the seed frames."""
        return list(self.steps[0]["seeds"])

    @property
    def chosen(self) -> list[int]:
        """Indices of the frames that the policy chose, in the order of their choice."""
        return [int(step["frame"]) for step in self.steps[1:]]

    @property
    def ended(self) -> dict[str, Any] | None:
        """Why the run ended, as `ended` of steps.jsonl, which older runs lack; None: it is
        unfinished."""
        views, recorded = len(self.chosen), self.steps[-1].get("ended")
        if views >= self.settings["budget"]:
            return {"reason": str(RunEnd.BUDGET), "views": views}
        return None if recorded is None or recorded["reason"] == RunEnd.BUDGET else recorded


def read_run(folder: str | Path) -> Run:
    """Read config.json, steps.jsonl and, if it is there, metrics.json from a run folder.

    Raises InputError if the folder holds no run, or a file is damaged, empty, or lacks a number
    that a report needs.
    """
    folder = Path(folder)
    config = read_config(folder)
    settings = validated(_Settings, config["settings"], folder / "config.json")
    steps = _read_steps(folder)
    path = folder / "metrics.json"
    metrics = read_json(path) if path.exists() else None
    try:
        TypeAdapter(_Metrics | None).validate_python(metrics)
    except ValidationError:
        raise InputError(
            f"{path}: is damaged; measure the run again with `mgs eval {folder}`"
        ) from None
    return Run(folder, label(settings.policy), steps, metrics, config["settings"])


def _read_steps(folder: Path) -> list[dict[str, Any]]:
    """The lines of steps.jsonl. Raises InputError if the file is missing, or naming the line that
    is damaged and how."""
    path, resume = folder / "steps.jsonl", f"`mgs nbv --resume {folder}`"
    if not path.is_file():
        raise InputError(
            f"{path}: no such file; the run has no finished step, continue it with {resume}"
        )
    steps: list[dict[str, Any]] = []
    for number, text in enumerate(
        path.read_text(encoding="utf-8", errors="replace").splitlines() or [""], 1
    ):
        try:
            steps.append(json.loads(text))
            (_SeedLine if number == 1 else _ChoiceLine).model_validate(steps[-1])
        except ValueError as error:
            raise InputError(
                f"{path}: line {number} is damaged ({_cause(error)}); write the file anew with {resume}"
            ) from None
    return steps


def _cause(error: ValueError) -> str:
    """What is wrong with a line, in a few words: the key and what it lacks, or that the line is not
    JSON."""
    if not isinstance(error, ValidationError):
        return "no JSON"
    first = error.errors(include_url=False)[0]
    return ": ".join(str(part) for part in (*first["loc"], first["msg"]))


def check_finished(run: Run) -> None:
    """Raises InputError if a run has not ended, or its last file, gaussians.ply, is missing."""
    taken, planned = len(run.seeds + run.chosen), run.settings["seeds"] + run.settings["budget"]
    resume = f"`mgs nbv --resume {run.folder}`"
    if run.ended is None:
        raise InputError(
            f"{run.folder}: is unfinished, with {taken} of {planned} views; go on with {resume}, then report"
        )
    if not (run.folder / "gaussians.ply").is_file():
        raise InputError(
            f"{run.folder}: has all {taken} views, but no gaussians.ply; write it with {resume}, then report"
        )


def labelled_runs(folders: Sequence[str | Path]) -> dict[str, Run]:
    """Read runs that are to be compared, by label: the policy, with the folder's name if several
    runs have the same policy.

    Raises InputError as `read_run`, if two runs have the same policy and folder name, or if the
    runs are on different datasets.
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
            "report: two of the runs have the same policy and folder name; give each run once, or rename a folder"
        )
    for run in runs:
        if run.settings["dataset"] != runs[0].settings["dataset"]:
            raise InputError(
                f"{run.folder}: is a run on another dataset than {runs[0].folder}; compare runs on one dataset"
            )
    return labelled


def evaluated_runs(folders: Sequence[str | Path]) -> dict[str, Run]:
    """`labelled_runs`, all of which were evaluated. Raises InputError as that, or if a run was not
    since its last step."""
    labelled = labelled_runs(folders)
    for run in labelled.values():
        if run.metrics is None or run.metrics["images"] != len(run.seeds + run.chosen):
            raise InputError(
                f"{run.folder}: was not evaluated since its last step; measure it with `mgs eval {run.folder}`"
            )
    return labelled


def dataset_of(runs: Sequence[Run]) -> Dataset:
    """Load the dataset that runs have in common (see `evaluated_runs`).

    Raises InputError if it is missing, cannot be read, or no longer has the frames that a run was
    started on.
    """
    dataset = load_dataset(read_settings(runs[0].folder).dataset)
    for run in runs:
        check_same_frames(run.folder, dataset)
    return dataset


def up_of(prior: str | Path, dataset: Dataset) -> Up:
    """Which way was up for a run: as the folder of its prior says, or, where that is not there, as
    the dataset does.

    Raises InputError if the prior's file is damaged.
    """
    file = Path(prior) / "prior.json"
    numbers = read_json(file) if file.is_file() else None
    return unit_up(numbers["up"]) if isinstance(numbers, dict) and "up" in numbers else dataset.up
