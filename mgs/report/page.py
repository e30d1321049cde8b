"""The report as one HTML page that opens from the disk and loads nothing: `mgs report --html`.

Everything is taken from the files of the runs and of their dataset; only the pictures are drawn
anew, from the models that the
run folders hold. A run may be unfinished, and may have been measured or not: what is not there is
left out, and said.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import Dataset, Frame
from mgs.data.up import upright
from mgs.files import atomic_path
from mgs.report.page_facts import (
    Shown,
    cell,
    links,
    measured,
    measured_views,
    read_shown,
    setting_rows,
    summary_rows,
)
from mgs.report.page_pictures import (
    ERROR_COLOURS,
    UNCERTAINTY_COLOURS,
    WIDEST,
    Album,
    colour_scale,
    draw_render,
    draw_taken,
    new_album,
)
from mgs.report.page_plots import (
    Curves,
    line_plot,
    metric_name,
    orbit_plot,
    timing_plot,
    views_plot,
)
from mgs.report.runs import Run, dataset_of, labelled_runs
from mgs.run.folder import read_settings

COMPARED = 6
"""Most views of the dataset, and most of its test views, that truth and renders are compared on."""


def write_page(
    path: str | Path,
    folders: Sequence[str | Path],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write the page of these runs as one HTML file, and return its size in bytes.

    folders: run folders on one dataset, finished or not. progress: called as progress(pictures of
    views drawn, in all). Links to other files are relative to the page. The same files give the
    same page, byte for byte. Raises InputError as `mgs.report.runs.labelled_runs` and `dataset_of`,
    and if a file is damaged or the page cannot be written.
    """
    path = Path(path)
    runs = labelled_runs(folders)
    dataset = dataset_of(list(runs.values()))
    shown = [read_shown(label, run, dataset) for label, run in runs.items()]
    album, views = draw_pictures(shown, dataset, progress)
    limit = album.finish()
    data = {
        "pictures": album.pictures,
        "runs": [_sections(one, dataset) for one in shown],
        "compared": _compared(shown, views),
        "plots": _plots(shown),
    }
    scales = {
        "error": colour_scale(ERROR_COLOURS),
        "uncertainty": colour_scale(UNCERTAINTY_COLOURS),
    }
    text = _fill_in(
        title=", ".join(runs),
        dataset=dataset.root.resolve().name,
        shown=shown,
        summary=summary_rows(shown),
        settings=setting_rows(shown),
        files=[(one.label, links(one.run, path)) for one in shown],
        data=data,
        limit=limit,
        scales=scales,
    )
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return len(text.encode("utf-8"))


def draw_pictures(
    shown: Sequence[Shown],
    dataset: Dataset,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Album, list[Frame]]:
    """(album, frames) of the page: of every run the views that it took, and of the frames returned
    the truth and the renders of all runs.

    These frames are up to COMPARED that the fewest runs were trained on, spread evenly, and as many
    test views of the dataset, whose names begin with `test/`. Raises InputError if a file of a
    frame cannot be read.
    """
    from mgs.splat import render

    modelled = [one for one in shown if one.model is not None]
    if not modelled:
        return Album((slice(None), slice(None)), WIDEST), []
    views = compared_frames([one.run for one in shown], dataset)
    frames = [*views, *(frame for one in modelled for frame in one.frames)]
    total = sum(len(one.frames) for one in modelled) + len(views) * len(modelled)
    count = (
        2 * total
        + 2 * sum(len(one.frames) for one in modelled)
        + len({frame.name for frame in frames})
    )
    album, done = new_album(frames, count), 0

    def drawn() -> None:
        nonlocal done
        done += 1
        progress(done, total)

    progress(0, total)
    for one in modelled:
        assert one.model is not None
        settings = read_settings(one.run.folder)
        draw_taken(
            album,
            one.label,
            one.model,
            one.frames,
            (settings.pixel_noise, settings.prior_std),
            drawn,
        )
        for frame in views:
            if f"render/{frame.name}/{one.label}" not in album.pictures:
                draw_render(
                    album,
                    f"{frame.name}/{one.label}",
                    frame,
                    np.asarray(render(one.model, frame.camera).rgb),
                )
            drawn()
    return album, views


def compared_frames(runs: Sequence[Run], dataset: Dataset) -> list[Frame]:
    """The frames that `draw_pictures` compares truth and renders on."""
    taken = [{dataset.frames[i].name for i in run.seeds + run.chosen} for run in runs]
    there = dataset.with_images(set.union(*taken))
    counts = [sum(frame.name in names for names in taken) for frame in there]
    pool = [frame for frame, count in zip(there, counts, strict=True) if count == min(counts)]
    tests = dataset.test_views()
    named = (
        []
        if tests is None
        else [replace(frame, name=f"test/{frame.name}") for frame in tests.frames]
    )
    return [*_spread(pool), *_spread(named)]


def _spread(frames: Sequence[Frame]) -> list[Frame]:
    """Up to COMPARED of the frames, spread evenly."""
    count = min(COMPARED, len(frames))
    return [frames[i * len(frames) // count] for i in range(count)]


def _sections(one: Shown, dataset: Dataset) -> dict[str, Any]:
    """What the section of one run shows: its views in the order they were taken, the orbit and the
    times."""
    steps, seeds = one.run.steps, len(one.run.seeds)
    views = []
    for k, frame in enumerate(one.frames):
        step = steps[max(0, k - seeds + 1)]
        what = f"seed {k + 1} of {seeds}" if k < seeds else f"step {step['step']}"
        facts = [("view", frame.name), ("taken as", what), ("images so far", str(k + 1))]
        if k >= seeds:
            facts.append(("information gain", f"{step['information_gain']:.4g}"))
        if k >= seeds - 1:  # of the seeds, the coverage is known after the last
            facts.append(("surface coverage", f"{100 * step['coverage']:.2f} %"))
            facts += [(metric_name(key), cell(key, value)) for key, value in measured(step).items()]
        views.append(
            {
                "name": frame.name,
                "facts": facts,
                "pictures": _pictures(one, frame, k + 1),
                "eye": (upright(one.up) @ frame.camera.position).tolist(),
            }
        )
    cameras, names = (
        [frame.camera for frame in dataset.frames],
        [frame.name for frame in dataset.frames],
    )
    orbit = orbit_plot(
        one.label, cameras, names, one.run.seeds, one.run.chosen, one.model, one.up, one.unit
    )
    return {
        "label": one.label,
        "views": views,
        "orbit": orbit,
        "time": timing_plot(one.label, steps),
    }


def _pictures(one: Shown, frame: Frame, images: int) -> list[dict[str, str]]:
    """The pictures of a view that a run took: their names in the album, captions and alternative
    texts."""
    if one.model is None:
        return []
    last, view, quality = (
        f"the model of {len(one.frames)} images",
        frame.name,
        _quality(one, frame.name),
    )
    before, after = (f"{n} image{'' if n == 1 else 's'}" for n in (images - 1, images))
    return [
        {
            "name": f"truth/{view}",
            "caption": "truth",
            "alt": f"Truth: the image of {view}, the rock in front of black.",
        },
        {
            "name": f"render/{view}/{one.label}",
            "caption": f"render{quality}",
            "alt": f"Render of {last} at {view}{quality}.",
        },
        {
            "name": f"error/{view}/{one.label}",
            "caption": "error",
            "alt": f"Absolute difference of truth and render at {view}, bright where it is large{quality}.",
        },
        {
            "name": f"before/{view}/{one.label}",
            "caption": f"uncertainty before ({before})",
            "alt": f"Uncertainty seen from {view} before it was taken, with {before}: bright where little is known.",
        },
        {
            "name": f"after/{view}/{one.label}",
            "caption": f"uncertainty after ({after})",
            "alt": f"Uncertainty seen from {view} after it was taken, with {after}: bright where little is known.",
        },
    ]


def _quality(one: Shown, view: str) -> str:
    """PSNR of a view as part of a caption; empty where it was not measured."""
    found = next((v for v in measured_views(one) if v["name"] == view), None)
    decibels = None if found is None else found.get("psnr")
    return "" if decibels is None else f", {decibels:.2f} dB"


def _compared(shown: Sequence[Shown], views: Sequence[Frame]) -> list[dict[str, Any]]:
    """For each view that is compared: what can stand on either side of the divider, the truth
    first."""
    found = []
    for frame in views:
        sides = [
            {"label": "truth", "name": f"truth/{frame.name}", "alt": f"Truth at {frame.name}."}
        ]
        trained = []
        for one in shown:
            if one.model is not None:
                quality = _quality(one, frame.name)
                alt = f"Render of {one.label} at {frame.name}{quality}."
                sides.append(
                    {
                        "label": one.label + quality,
                        "name": f"render/{frame.name}/{one.label}",
                        "alt": alt,
                    }
                )
            trained += [one.label] if frame.name in {f.name for f in one.frames} else []
        note = f"trained on by {', '.join(trained)}" if trained else "never trained on"
        found.append({"view": frame.name, "note": note, "sides": sides})
    return found


def _plots(shown: Sequence[Shown]) -> list[dict[str, Any]]:
    """The plots that compare runs: the paper's figures, and every metric that the steps or the
    views were measured by."""

    def curves(key: str, factor: float = 1.0) -> Curves:
        lines = {
            one.label: [(s["images"], (s | measured(s)).get(key)) for s in one.run.steps]
            for one in shown
        }
        known = {
            label: [(x, factor * y) for x, y in points if y is not None]
            for label, points in lines.items()
        }
        return {
            label: ([x for x, _ in points], [y for _, y in points])
            for label, points in known.items()
            if points
        }

    covered = curves("coverage", 100)
    added = {
        label: (x[1:], [b - a for a, b in pairwise(y)])
        for label, (x, y) in covered.items()
        if len(y) > 1
    }
    wanted = [
        (
            "Information gain of each chosen view (the paper's Fig. 2)",
            curves("information_gain"),
            "gain, Eq. 7",
            True,
        ),
        ("Surface coverage (Fig. 3)", covered, "coverage (%)", False),
        ("Coverage that each view added (Fig. 3)", added, "percentage points", True),
        (
            "Variance that is left, over that of the prior",
            curves("uncertainty"),
            "mean over all parameters",
            True,
        ),
    ]
    keys = dict.fromkeys(key for one in shown for step in one.run.steps for key in measured(step))
    wanted += [
        (f"{metric_name(key)} after each step", curves(key), metric_name(key), False)
        for key in keys
    ]
    wanted.append(("Loss at the end of each fit", curves("loss"), "mean squared error", True))
    plots = [
        line_plot(title, found, "images", y, zero) for title, found, y, zero in wanted if found
    ]
    views = {one.label: measured_views(one) for one in shown if one.metrics is not None}
    if views:
        plots.append(
            views_plot("psnr_mask", views)
            if _all_have("psnr_mask", views)
            else views_plot("psnr", views)
        )
    return plots


def _all_have(key: str, runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> bool:
    """Whether each run has this metric for some view."""
    return all(any(view.get(key) is not None for view in views) for views in runs.values())


def _fill_in(**values: Any) -> str:
    """The page, from the template beside this file."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    folder = Path(__file__).parent / "templates"
    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    parts = {
        name: Markup((folder / f"page.{name}").read_text(encoding="utf-8"))
        for name in ("css", "js")
    }
    return environment.get_template("page.html").render(
        **values, **parts, plotly=Markup(get_plotlyjs())
    )
