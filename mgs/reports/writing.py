"""The report that compares runs on one dataset: figures and a table, from the runs' files alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from mgs.data.dataset import TEST_FOLDER
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.evaluation import read_comparison
from mgs.files import write_json, write_text
from mgs.policy.criteria import GAIN_UNIT
from mgs.reports import figures
from mgs.reports.runs import (
    check_finished,
    check_measured,
    compare_runs,
    least_trained,
    step_curves,
)
from mgs.reports.tables import comparison_rows, markdown_table, table_cell
from mgs.run.folder import Run

CHOICES = ("orbit", "gain", "coverage")
"""Figures of the chosen views."""

FIGURES = (*CHOICES, "comparison", "psnr")


def report_files(kind: str) -> list[str]:
    """Names of the files of a report; `report` says which are not in all."""
    return [*(f"{name}.{kind}" for name in FIGURES), "table.md", "table.json"]


def report(
    runs: str | PathLike[str] | Sequence[str | PathLike[str]],
    out: str | Path = "report",
    kind: str = "png",
) -> list[Path]:
    """Write all figures and the table of runs into the folder `out`; return the paths of the files.

    runs: runs, their folders, or a folder of runs. kind: format of the figures, one of
    `mgs.plotting.FORMATS`.

    - orbit.png, gain.png, coverage.png (`mgs.reports.figures`): only if a run has chosen views;
    - comparison.png: a view as `shown_view` chooses it;
    - psnr.png: only if all runs were evaluated after some of their steps; over the test views, or
      without them over all views;
    - table.md and table.json (`mgs.reports.tables.comparison_rows`).

    Files of an earlier report are replaced. Raises InputError as `compare_runs`; if a run is
    unfinished or was not evaluated since its last step; and if a picture of `mgs eval` is missing
    or damaged. Then nothing is written.
    """
    compared = compare_runs([runs] if isinstance(runs, str | PathLike) else runs)
    for run in compared.values():
        check_finished(run)
        check_measured(run)
    out = Path(out)
    frame, truth, renders, captions = _comparison(compared)
    chosen = any(run.settings.budget for run in compared.values())
    paths = {name: out / f"{name}.{kind}" for name in CHOICES if chosen}
    if chosen:
        _draw_choices(paths, compared)
    paths["comparison"] = out / f"comparison.{kind}"
    figures.comparison_figure(paths["comparison"], truth, renders, frame.name, captions)
    if panels := _psnr_panels(compared):
        paths["psnr"] = out / f"psnr.{kind}"
        figures.curves_figure(paths["psnr"], "Quality after each image", panels)

    rows = comparison_rows(compared)
    write_text(out / "table.md", markdown_table(rows))
    write_json(out / "table.json", rows)
    return [*paths.values(), out / "table.md", out / "table.json"]


def _draw_choices(paths: Mapping[str, Path], runs: Mapping[str, Run]) -> None:
    """Draw CHOICES into these files."""
    first = next(iter(runs.values()))
    positions = np.array([frame.camera.position for frame in first.dataset.frames])
    choices = {}
    for label, run in runs.items():
        seeds = run.settings.seeds
        choices[label] = run.indices[:seeds], run.indices[seeds:]
    world = first.up, first.dataset.unit
    figures.orbit_figure(paths["orbit"], positions, first.gaussians.means, choices, *world)
    gains = step_curves(runs, "information_gain", x="step")
    title, y = "Information that each chosen view promised", f"information gain ({GAIN_UNIT})"
    figures.curves_figure(paths["gain"], title, {y: gains}, "chosen view", bottom=0)
    title, y = "Gaussians whose colour the images determine", "Gaussians observed (%)"
    covered = step_curves(runs, "coverage", 100)
    figures.curves_figure(paths["coverage"], title, {y: covered}, top=100)


def _comparison(
    runs: Mapping[str, Run],
) -> tuple[Frame, np.ndarray, dict[str, np.ndarray], dict[str, str]]:
    """The shown view: frame, truth [H,W,3], renders [H,W,3] by label, captions by label."""
    frame, views = shown_view(list(runs.values()))
    within = Path("renders", TEST_FOLDER) if views == "test_views" else Path("renders")
    pictures, captions = {}, {}
    for label, run in runs.items():
        pictures[label] = picture = run.folder / within / f"{frame.name}.png"
        of_this_model = (run.metrics or {}).get("pictures", True)
        if not (of_this_model and picture.is_file()):
            raise InputError(
                f"{picture}: no picture of this model; draw it with `mgs eval {run.folder}`"
            )
        captions[label] = _caption(run, views, frame.name)
    pairs = {label: read_comparison(picture, frame.camera) for label, picture in pictures.items()}
    truth = next(iter(pairs.values()))[0]
    return frame, truth, {label: render for label, (_, render) in pairs.items()}, captions


def shown_view(runs: Sequence[Run]) -> tuple[Frame, str]:
    """The view that the comparison shows, and the key of metrics.json that lists it, "test_views"
    or "views".

    It is the most typical (`_typical_view`) of the test views if all runs were measured on them,
    else among those that the fewest runs were trained on. Of frames on demand, only those that all
    runs have taken have an image. Raises InputError as `Dataset.test_views`, and if there is no
    such frame.
    """
    dataset = runs[0].dataset
    tests = dataset.test_views()
    if tests is not None and all((run.metrics or {}).get("test_views") for run in runs):
        return _typical_view(runs, tests.frames, "test_views"), "test_views"
    shown = dataset.with_images(
        set.intersection(*({frame.name for frame in run.taken} for run in runs))
    )
    if not shown:
        raise InputError(
            f"{dataset.root}: has no test views, and no frame that all runs have taken; "
            "report them one by one"
        )
    return _typical_view(runs, least_trained(runs, shown), "views"), "views"


def _psnr_by_name(run: Run, views: str) -> dict[str, float]:
    """PSNR of the views that the key `views` of metrics.json lists."""
    listed = (run.metrics or {}).get(views, [])
    return {view["name"]: view["psnr"] for view in listed if view["psnr"] is not None}


def _typical_view(runs: Sequence[Run], frames: Sequence[Frame], views: str) -> Frame:
    """The frame whose PSNRs are closest to the runs' means, in least squares, of those that all
    runs were measured on by the key `views` of metrics.json; the first if there is none."""
    measured = [_psnr_by_name(run, views) for run in runs]
    known = [frame for frame in frames if all(frame.name in of for of in measured)]
    if not known:
        return frames[0]
    psnr = np.array([[of[frame.name] for frame in known] for of in measured])
    return known[int(np.argmin(((psnr - psnr.mean(1, keepdims=True)) ** 2).sum(0)))]


def _caption(run: Run, views: str, name: str) -> str:
    """Number of images, PSNR and SSIM of a render. views: key of metrics.json that lists it.
    Raises InputError if it was not evaluated."""
    view = next((view for view in (run.metrics or {})[views] if view["name"] == name), None)
    if view is None:
        raise InputError(
            f"{run.folder}: was not evaluated on {name}; measure it with `mgs eval {run.folder}`"
        )
    seen = ", trained on" if view["trained"] else ""
    decibels, ssim = (table_cell(key, view[key]) for key in ("psnr", "ssim"))
    return f"{len(run.indices)} images{seen}; {decibels} dB, SSIM {ssim}"


def _psnr_panels(runs: Mapping[str, Run]) -> dict[str, figures.Curves]:
    """Panels of PSNR, over the test views or else all views taken; empty without PSNR."""
    on_demand = next(iter(runs.values())).dataset.on_demand
    every = "views taken so far" if on_demand else "all views"
    for prefix, views in (("test_", "test views"), ("", every)):
        panels = {
            f"PSNR, {views} (dB)": step_curves(runs, f"{prefix}psnr"),
            f"masked PSNR, {views} (dB)": step_curves(runs, f"{prefix}psnr_mask"),
        }
        if all(len(curves) == len(runs) for curves in panels.values()):
            return panels
    return {}
