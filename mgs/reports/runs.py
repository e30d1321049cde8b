"""Runs that are compared: read, checked, and their numbers as curves. Nothing is computed."""

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path

from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.files import read_text
from mgs.reports.figures import Curves
from mgs.run.folder import STEPS, Run, holds_run, open_run, text_of


def compare_runs(runs: Sequence[str | PathLike[str]]) -> dict[str, Run]:
    """Open runs that are to be compared, by label: the policy, with the folder's name if several
    runs have it. They share their dataset.

    runs: opened runs, their folders, or folders of these. Raises InputError as `open_run`,
    `Run.steps`, `Run.metrics` and `Run.dataset`; if steps.jsonl is not that of the run; if two runs
    have the same policy and folder name; and if the runs are on different datasets."""
    opened = [one for run in runs for one in _opened(run)]
    policies = [run.label for run in opened]
    labelled = {}
    for run in opened:
        folder = f" ({run.folder.resolve().name})" if policies.count(run.label) > 1 else ""
        labelled[run.label + folder] = run
    if len(labelled) < len(opened):
        same = "two of the runs have the same policy and folder name"
        raise InputError(f"report: {same}; give each run once, or rename a folder")
    first = opened[0]
    for run in opened:
        if run.settings.dataset != first.settings.dataset:
            other = f"is a run on another dataset than {first.folder}"
            raise InputError(f"{run.folder}: {other}; compare runs on one dataset")
        run.check_frames(first.dataset)
        run.dataset = first.dataset
        _check_lines(run)
        run.metrics  # noqa: B018 a damaged file ends the command here
    return labelled


def _opened(run: str | PathLike[str]) -> list[Run]:
    """A run, or all runs in a folder that is none, by name."""
    if isinstance(run, Run):
        return [run]
    path = Path(run)
    inside = [] if (path / "config.json").exists() else sorted(path.glob("*/config.json"))
    folders = [file.parent for file in inside if holds_run(file.parent)]
    return [open_run(folder) for folder in folders or [path]]


def _check_lines(run: Run) -> None:
    """Raises InputError if steps.jsonl is not that of the run; its last step may be missing."""
    path = run.folder / STEPS
    text = read_text(path) if path.is_file() else ""
    if not (text and text_of(run.steps).startswith(text)):
        resume = f"`mgs nbv --resume {run.folder}`"
        raise InputError(f"{path}: is missing or damaged; write it anew with {resume}")


def check_measured(run: Run) -> None:
    """Raises InputError if a run was not evaluated since its last step."""
    if run.measured is None:
        say = f"was not evaluated since its last step; measure it with `mgs eval {run.folder}`"
        raise InputError(f"{run.folder}: {say}")


def step_curves(
    runs: Mapping[str, Run], key: str, factor: float = 1.0, x: str = "images"
) -> Curves:
    """A number of the steps of each run that has it, against another one."""
    curves = {}
    for name, run in runs.items():
        points = [(s[x], factor * s[key]) for s in run.steps if s.get(key) is not None]
        if points:
            curves[name] = ([x for x, _ in points], [y for _, y in points])
    return curves


def least_trained(runs: Iterable[Run], frames: Sequence[Frame]) -> list[Frame]:
    """The frames among these that the fewest runs were trained on, in their order."""
    taken = [{frame.name for frame in run.taken} for run in runs]
    counts = [sum(frame.name in names for names in taken) for frame in frames]
    return [frame for frame, count in zip(frames, counts, strict=True) if count == min(counts)]
