"""Runs that are compared: read and checked; their numbers as curves, and as a table of numbers, of
cells of text, or as Markdown."""

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.files import read_text
from mgs.policy.poses import path_length
from mgs.reports.figures import Curves
from mgs.run.ending import RunEnd
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


SETS = {"test": "test views", "all": "all views", "held_out": "held-out views"}
WHOLE = {"psnr": "PSNR, {} (dB)", "ssim": "SSIM, {}"}
OTHERS = {
    "psnr_corrected": "PSNR, {}, exposure fitted (dB)",
    "psnr_mask": "masked PSNR, {} (dB)",
    "ssim_mask": "masked SSIM, {}",
    "psnr_mask_corrected": "masked PSNR, {}, exposure fitted (dB)",
}
HEADERS = {"policy": "policy", "images": "images"}
HEADERS |= {
    f"{key}.{metric}": heading.format(views)
    for key, views in SETS.items()
    for metric, heading in (WHOLE if key == "all" else WHOLE | OTHERS).items()
}
HEADERS |= {"coverage": "coverage (%)", "path": "path ({unit})", "ended": "ended by"}
"""Columns of the table: key in a row of `comparison_rows` -> heading."""


def comparison_rows(runs: Mapping[str, Run]) -> list[dict[str, Any]]:
    """Numbers of each run, a row each. runs: by label (`mgs.reports.tables.compare_runs`).

    policy: the label; images: number of training images; coverage: per cent. path: length of the
    lines from view to view, in `unit`. test.NAME, all.NAME, held_out.NAME: means in metrics.json,
    PSNR in dB. exposure: True, if the run estimated it. ended: the reason, only if before the
    budget was spent. Raises InputError if a run was not evaluated since its last step."""
    for run in runs.values():
        check_measured(run)
    return [table_row(label, run) for label, run in runs.items()]


def table_row(label: str, run: Run) -> dict[str, Any]:
    """Row of `comparison_rows`; without metrics if they are not of the run's last step."""
    row = metrics_row(label, (run.measured or {}) | {"images": len(run.indices)})
    if run.settings.exposure:
        row["exposure"] = True
    if run.ended and run.ended["reason"] != RunEnd.BUDGET:
        row["ended"] = run.ended["reason"]
    positions = np.array([frame.camera.position for frame in run.taken])
    row |= {"coverage": 100 * run.steps[-1]["coverage"], "path": path_length(positions)}
    return row | {"unit": run.dataset.unit}


def metrics_row(label: str, metrics: Mapping[str, Any]) -> dict[str, Any]:
    row = {"policy": label, "images": metrics["images"]}
    for views in ("test", "all", "held_out"):
        row |= {f"{views}.{name}": value for name, value in metrics.get(views, {}).items()}
    return row


def table_columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Keys of HEADERS of which some row has a value, in order."""
    exposure, masked = any(row.get("exposure") for row in rows), is_masked(rows)
    return [
        key
        for key in HEADERS
        if any(row.get(key) is not None for row in rows)
        and (masked or "mask" not in key)
        and ("corrected" not in key or (exposure and masked == ("mask" in key)))
    ]


def is_masked(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Whether values in masks differ from those of whole images in some row."""
    sets = [f"{views}.psnr" for views in ("test", "held_out")]
    return any(row.get(key) != row.get(f"{key}_mask") for row in rows for key in sets)


def has_held_out(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a run of these rows has views with images that it was not trained on."""
    return any(row.get("held_out.count", 1) for row in rows)


def table_cell(key: str, value: Any) -> str:
    """Format a number as a table cell: SSIM with four decimals, PSNR (dB), coverage (%) and path
    with two, others with five digits; a dash for None. key: as in HEADERS or metrics.json."""
    if value is None:
        return "–"
    if not isinstance(value, float):
        return str(value)
    if "ssim" in key:
        return f"{value:.4f}"
    return f"{value:.2f}" if "psnr" in key or key in ("coverage", "path") else f"{value:.5g}"


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    columns = table_columns(rows)
    headings = [table_heading(key, rows) for key in columns]
    return markdown(headings, [[table_cell(key, row.get(key)) for key in columns] for row in rows])


def table_heading(key: str, rows: Sequence[Mapping[str, Any]]) -> str:
    every = "all views" if has_held_out(rows) else "training views"
    return HEADERS[key].replace("{unit}", rows[0]["unit"]).replace("all views", every)


def markdown(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table; all columns but the first are right-aligned."""
    lines = [heading, ["---", *["---:"] * (len(heading) - 1)], *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
