"""The report that compares runs on one dataset: all figures and the table, drawn from the files of
the runs alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mgs.data.dataset import TEST_FOLDER, Dataset, Frame
from mgs.errors import InputError
from mgs.files import atomic_path, write_json
from mgs.report.evaluation import read_comparison
from mgs.report.figures import (
    comparison_figure,
    coverage_figure,
    gain_figure,
    orbit_figure,
    psnr_figure,
)
from mgs.report.runs import Run, check_finished, dataset_of, evaluated_runs, read_run, up_of
from mgs.report.tables import markdown_table, table_numbers
from mgs.splat_ply import read_ply


def write_report(out: str | Path, folders: Sequence[str | Path], kind: str = "png") -> list[Path]:
    """Write all figures and the table of runs into the folder `out`, and return the paths of the
    files.

    folders: the run folders. kind: what the figures are written as, one of `mgs.plotting.FORMATS`.
    The files: orbit.png, gain.png, coverage.png, comparison.png (of a test view, or where there are
    none, of a view that the fewest runs were trained on), psnr.png (only if all runs were evaluated
    after some of their steps; over the test views, or where there are none, over all views),
    table.md and table.json (`table_numbers`). Files of an earlier report are replaced. Raises
    InputError as `evaluated_runs` and `dataset_of`, if a run is unfinished, or if a picture of `mgs
    eval` is missing or damaged; then nothing is written.
    """
    for folder in folders:
        check_finished(read_run(folder))
    out, runs = Path(out), evaluated_runs(folders)
    first = next(iter(runs.values()))
    dataset = dataset_of(list(runs.values()))
    frame, views = shown_view(list(runs.values()), dataset)
    within = Path("renders", TEST_FOLDER) if views == "test_views" else Path("renders")
    pictures = {label: run.folder / within / f"{frame.name}.png" for label, run in runs.items()}
    for label, picture in pictures.items():
        stale = (runs[label].metrics or {}).get(
            "pictures"
        ) is False  # of an earlier model; older runs do not say
        if stale or not picture.is_file():
            raise InputError(
                f"{picture}: no picture of this model; draw it with `mgs eval {runs[label].folder}`"
            )
    captions = {label: _caption(run, views, frame.name) for label, run in runs.items()}
    pairs = {label: read_comparison(picture, frame.camera) for label, picture in pictures.items()}

    figures = {name: out / f"{name}.{kind}" for name in ("orbit", "gain", "coverage", "comparison")}
    positions = np.array([frame.camera.position for frame in dataset.frames])
    choices = {label: (run.seeds, run.chosen) for label, run in runs.items()}
    means, up = (
        read_ply(first.folder / "gaussians.ply").means,
        up_of(first.settings.get("prior", ""), dataset),
    )
    orbit_figure(figures["orbit"], positions, means, choices, up, dataset.unit)
    gain_figure(
        figures["gain"],
        {label: [s["information_gain"] for s in run.steps[1:]] for label, run in runs.items()},
    )
    curves = {
        label: ([s["images"] for s in run.steps], [s["coverage"] for s in run.steps])
        for label, run in runs.items()
    }
    coverage_figure(figures["coverage"], curves)

    truth = next(iter(pairs.values()))[0]
    renders = {label: rendered for label, (_, rendered) in pairs.items()}
    comparison_figure(figures["comparison"], truth, renders, title=frame.name, captions=captions)
    written = list(figures.values())

    panels = _psnr_panels(runs, "views taken so far" if dataset.on_demand else "all views")
    if panels:
        psnr_figure(out / f"psnr.{kind}", panels)
        written.append(out / f"psnr.{kind}")
    numbers = table_numbers(folders)
    with atomic_path(out / "table.md") as temporary:
        temporary.write_text(markdown_table(numbers), encoding="utf-8")
    write_json(out / "table.json", numbers)
    return [*written, out / "table.md", out / "table.json"]


def shown_view(runs: Sequence[Run], dataset: Dataset) -> tuple[Frame, str]:
    """The view that the comparison shows, and the key of metrics.json that has its numbers:
    "test_views" or "views".

    It is the middle one of the test views where all runs were measured on them, otherwise a view
    that the fewest runs were trained on (`unseen_view`); of frames on demand, one that all runs
    have taken. Raises InputError as `Dataset.test_views`, and where there is no such frame.
    """
    tests = dataset.test_views()
    if tests is not None and all((run.metrics or {}).get("test_views") for run in runs):
        return tests.frames[len(tests) // 2], "test_views"
    shared = set.intersection(
        *({dataset.frames[i].name for i in run.seeds + run.chosen} for run in runs)
    )
    shown = {frame.name for frame in dataset.with_images(shared)}
    if not shown:
        raise InputError(
            f"{dataset.root}: has no test views, and no frame that all runs have taken; report them one by one"
        )
    indices = [index for index, frame in enumerate(dataset.frames) if frame.name in shown]
    return dataset.frames[unseen_view(runs, indices)], "views"


def _psnr_panels(
    runs: Mapping[str, Run], every: str
) -> dict[str, dict[str, tuple[list[int], list[float]]]]:
    """What `psnr_figure` draws: PSNR over the test views, or, where a run was never measured on
    them, over all views, which are called `every`. Nothing where a run was never measured on these
    either.
    """
    for prefix, views in (("test_", "test views"), ("", every)):
        keys = {views: f"{prefix}psnr", f"{views}, rock only": f"{prefix}psnr_mask"}
        measured = {
            label: [s for s in run.steps if set(keys.values()) <= s.keys()]
            for label, run in runs.items()
        }
        if all(measured.values()):
            return {
                what: {
                    label: ([s["images"] for s in steps], [s[key] for s in steps])
                    for label, steps in measured.items()
                }
                for what, key in keys.items()
            }
    return {}


def unseen_view(runs: Sequence[Run], frames: Sequence[int]) -> int:
    """Index of a frame that the fewest runs were trained on; of several such frames, the middle
    one. frames: indices of those among which to choose."""
    counts = {index: sum(index in run.seeds + run.chosen for run in runs) for index in frames}
    fewest = [index for index in frames if counts[index] == min(counts.values())]
    return fewest[len(fewest) // 2]


def _caption(run: Run, views: str, name: str) -> str:
    """What stands above a render of the view `name`: number of images, PSNR, SSIM. views: key of
    metrics.json that lists it. Raises InputError if it was not evaluated."""
    view = next((view for view in (run.metrics or {})[views] if view["name"] == name), None)
    if view is None:
        raise InputError(
            f"{run.folder}: was not evaluated on {name}; measure it with `mgs eval {run.folder}`"
        )
    seen = ", trained on" if view["trained"] else ""
    return f"{len(run.seeds) + len(run.chosen)} images{seen}; {view['psnr']:.2f} dB, SSIM {view['ssim']:.4f}"
