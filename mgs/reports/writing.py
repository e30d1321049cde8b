"""The report that compares runs on one dataset: figures and a table, from the runs' files."""

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.evaluation import render_view
from mgs.files import write_json, write_text
from mgs.policy.criteria import GAIN_UNIT
from mgs.reports import figures
from mgs.reports.tables import (
    check_measured,
    compare_runs,
    comparison_rows,
    least_trained,
    markdown_table,
    step_curves,
    table_cell,
)
from mgs.run.folder import Run

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
