"""The report that compares runs on one dataset: figures, and their numbers as curves, as a table of
numbers, of cells of text, or as Markdown."""

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.evaluation import render_view
from mgs.files import read_text, write_json, write_text
from mgs.policy.criteria import GAIN_UNIT
from mgs.policy.poses import path_length
from mgs.reports import figures
from mgs.reports.figures import Curves
from mgs.run.ending import RunEnd
from mgs.run.folder import STEPS, Run, holds_run, open_run, text_of, up_of_prior


def compare_runs(runs: Sequence[str | PathLike[str]]) -> dict[str, Run]:
    """Open runs that are to be compared, by label: the policy, with the folder's name if several
    runs have it. They share their dataset.

    runs: opened runs, their folders, or folders of these. Raises InputError as `open_run`,
    `Run.steps`, `Run.metrics` and `Run.dataset`; if steps.jsonl is not that of the run; if two runs
    have the same policy and folder name; and if the runs are on different datasets, or their
    priors have different upward directions."""
    opened = [one for run in runs for one in _opened(run)]
    if not opened:
        raise InputError("report: there are no runs; give the folder of one, or of several")
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
        up = first.dataset.world.up
        if not np.allclose(up_of_prior(run.settings.prior) or up, up):
            other = f"its prior has another upward direction than that of {first.folder}"
            raise InputError(f"{run.folder}: {other}; compare runs of one direction")
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
TOLD_APART = ("test", "held_out")  # SETS of views that no run, or not each, was trained on
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
    for metric, heading in (WHOLE | OTHERS).items()
}
HEADERS |= {"coverage": "coverage (%)", "path": "path ({unit})", "ended": "ended by"}
"""Columns of the table: key in a row of `comparison_rows` -> heading."""


def comparison_rows(runs: Mapping[str, Run]) -> list[dict[str, Any]]:
    """Numbers of each run, a row each. runs: by label (`mgs.reports.tables.compare_runs`).

    policy: the label; images: number of training images; coverage: per cent. path: length of the
    lines from view to view, in `unit`. test.NAME, all.NAME, held_out.NAME: means in metrics.json,
    PSNR in dB. Fits, which choose no views, have neither coverage nor path. exposure: True, if the
    run estimated it. ended: the reason, only if before the budget was spent. Raises InputError if a
    run was not evaluated since its last step."""
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
    if run.settings.budget:
        positions = np.array([frame.camera.position for frame in run.taken])
        row |= {"coverage": 100 * run.steps[-1]["coverage"], "path": path_length(positions)}
    return row | {"unit": "units" if run.dataset.unit == "unit" else run.dataset.unit}


def metrics_row(label: str, metrics: Mapping[str, Any]) -> dict[str, Any]:
    row = {"policy": label, "images": metrics["images"]}
    for views in ("test", "all", "held_out"):
        row |= {f"{views}.{name}": value for name, value in metrics.get(views, {}).items()}
    return row


def table_columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Keys of HEADERS of which some row has a value, in order. Of all views only WHOLE, where some
    are others than those that runs were trained on."""
    exposure, masked = any(row.get("exposure") for row in rows), is_masked(rows)
    others = any(row.get(f"{views}.psnr") is not None for row in rows for views in TOLD_APART)
    short = {f"all.{metric}" for metric in OTHERS if others}
    return [
        key
        for key in HEADERS
        if any(row.get(key) is not None for row in rows)
        and key not in short
        and (masked or "mask" not in key)
        and ("corrected" not in key or (exposure and masked == ("mask" in key)))
    ]


def is_masked(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Whether values in masks differ from those of whole images in some row."""
    sets = [f"{views}.psnr" for views in SETS]
    return any(row.get(key) != row.get(f"{key}_mask") for row in rows for key in sets)


def has_held_out(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a run of these rows has views with images that it was not trained on."""
    return any(row.get("held_out.count", 1) for row in rows)


def table_cell(key: str, value: Any) -> str:
    """Format a number as a table cell: SSIM with four decimals, PSNR (dB), coverage (%) and path
    with two, others with five digits; a dash for None. key: its name, as in HEADERS or
    metrics.json."""
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


CHOICES = ("orbit", "gain", "coverage")  # figures of the chosen views

FIGURES = (*CHOICES, "comparison", "psnr")


def report_files(kind: str) -> list[str]:
    return [*(f"{name}.{kind}" for name in FIGURES), "table.md", "table.json"]


def report(
    runs: str | PathLike[str] | Sequence[str | PathLike[str]],
    out: str | Path = "report",
    kind: str = "png",
) -> list[Path]:
    """Write all figures and the table of runs into the folder `out`; return the paths of the files.

    runs: runs, their folders, or a folder of runs. kind: one of `mgs.plotting.FORMATS`.

    - orbit.png, gain.png, coverage.png (`mgs.reports.figures`): only if a run has chosen views;
    - comparison.png: a view as `shown_view` chooses it;
    - psnr.png: only if all runs were evaluated after some of their steps; over the test views, or
      without them over all views;
    - table.md and table.json (`mgs.reports.tables.comparison_rows`).

    Files of an earlier report are replaced. Raises InputError as `compare_runs`; if a run is
    unfinished or was not evaluated since its last step. Then nothing is written."""
    by_label = compare_runs([runs] if isinstance(runs, str | PathLike) else runs)
    for run in by_label.values():
        if run.ended is None:
            few = f"is unfinished, with {len(run.indices)} of {run.planned} views"
            cure = f"go on with `mgs nbv --resume {run.folder}`, then report"
            raise InputError(f"{run.folder}: {few}; {cure}")
        check_measured(run)
    out, (frame, views) = Path(out), shown_view(list(by_label.values()))
    choices = any(run.settings.budget for run in by_label.values())
    paths = {name: out / f"{name}.{kind}" for name in CHOICES if choices}
    if choices:
        _draw_choices(paths, by_label)
    paths["comparison"] = out / f"comparison.{kind}"
    _draw_comparison(paths["comparison"], by_label, frame, views)
    if panels := _psnr_panels(by_label):
        paths["psnr"] = out / f"psnr.{kind}"
        figures.curves_figure(paths["psnr"], "Quality after each image", panels)

    rows = comparison_rows(by_label)
    write_text(out / "table.md", markdown_table(rows))
    write_json(out / "table.json", rows)
    return [*paths.values(), out / "table.md", out / "table.json"]


def _draw_choices(paths: Mapping[str, Path], runs: Mapping[str, Run]) -> None:
    first = next(iter(runs.values()))
    positions = np.array([frame.camera.position for frame in first.dataset.frames])
    parts = {label: (run.indices, run.settings.seeds) for label, run in runs.items()}
    choices = {label: (views[:seeds], views[seeds:]) for label, (views, seeds) in parts.items()}
    means, unit = first.gaussians.means, first.dataset.unit
    figures.orbit_figure(paths["orbit"], positions, means, choices, unit)
    gains = step_curves(runs, "information_gain", x="step")
    title, y = "Information that each chosen view promised", f"information gain ({GAIN_UNIT})"
    figures.curves_figure(paths["gain"], title, {y: gains}, "chosen view", bottom=0)
    title, y = "Gaussians whose colour the images determine", "Gaussians observed (%)"
    covered = step_curves(runs, "coverage", 100)
    figures.curves_figure(paths["coverage"], title, {y: covered}, top=100)


def shown_view(runs: Sequence[Run]) -> tuple[Frame, str]:
    """The view that the comparison shows, and its key in metrics.json, "test_views" or "views".

    It is one of the test views if all runs were measured on them, else of those that the fewest
    runs were trained on: the one whose PSNRs are closest to the runs' means, in least squares. Of
    frames on demand, only those that all runs have taken have an image. Raises InputError as
    `Dataset.test_views`, and if there is no frame on which all runs were measured."""
    dataset, key = runs[0].dataset, "views"
    frames: Sequence[Frame]
    tests = dataset.test_views()
    if tests is not None and all((run.metrics or {}).get("test_views") for run in runs):
        frames, key = tests.frames, "test_views"
    else:
        taken = set.intersection(*({frame.name for frame in run.taken} for run in runs))
        frames = least_trained(runs, dataset.with_images(taken))
    psnr = [{view["name"]: view["psnr"] for view in (run.metrics or {})[key]} for run in runs]
    frames = [frame for frame in frames if all(of.get(frame.name) is not None for of in psnr)]
    if not frames:
        raise InputError(f"{dataset.root}: has no view on which all runs were measured; drop some")
    values = np.array([[of[frame.name] for frame in frames] for of in psnr])
    return frames[int(np.argmin(((values - values.mean(1, keepdims=True)) ** 2).sum(0)))], key


def _draw_comparison(path: Path, runs: Mapping[str, Run], frame: Frame, views: str) -> None:
    renders, captions = {}, {}
    for label, run in runs.items():
        renders[label] = render_view(run.gaussians, frame.camera)[0]
        view = next(view for view in (run.metrics or {})[views] if view["name"] == frame.name)
        note = ", trained on" if view["trained"] else ""
        decibels, ssim = (table_cell(key, view[key]) for key in ("psnr", "ssim"))
        captions[label] = f"{len(run.indices)} images{note}; {decibels} dB, SSIM {ssim}"
    figures.comparison_figure(path, frame.masked_rgb(), renders, frame.name, captions)


def _psnr_panels(runs: Mapping[str, Run]) -> dict[str, figures.Curves]:
    """Panels of PSNR, over the test views or else all views taken; empty without PSNR."""
    on_demand = next(iter(runs.values())).dataset.on_demand
    every = "views taken so far" if on_demand else "all views"
    for prefix, views in (("test_", "test views"), ("", every)):
        keys = {f"PSNR, {views} (dB)": "psnr", f"masked PSNR, {views} (dB)": "psnr_mask"}
        panels = {title: step_curves(runs, prefix + key) for title, key in keys.items()}
        if all(len(curves) == len(runs) for curves in panels.values()):
            return panels
    return {}
