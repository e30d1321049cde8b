"""The report as one HTML page that opens from the disk and loads nothing: `mgs report --html`.

Everything is taken from the files of the runs and of their dataset. Only pictures are drawn, of the
models that the run folders hold. A run may be unfinished or not measured; the page says what is
missing.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Sequence
from dataclasses import replace
from hashlib import sha256
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import Dataset
from mgs.data.frames import Frame
from mgs.data.up import upright
from mgs.files import atomic_path
from mgs.policy.criteria import GAIN_UNIT
from mgs.report.page_facts import (
    Shown,
    links,
    measured,
    measured_views,
    read_shown,
    setting_rows,
    step_facts,
    summary_rows,
)
from mgs.report.page_pictures import (
    ERROR_COLOURS,
    UNCERTAINTY_COLOURS,
    Album,
    colour_scale,
    draw_render,
    draw_taken,
    new_album,
)
from mgs.report.page_plots import METRIC_NAMES, line_plot, orbit_plot, timing_plot, views_plot
from mgs.report.runs import RunFiles, compare_runs, least_trained, step_curves
from mgs.report.writing import shown_view

COMPARED = 6
"""Most views of the dataset, and most test views, on which truth and renders are compared."""


def write_page(
    path: str | Path,
    folders: Sequence[str | PathLike[str]],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write the page of these runs as one HTML file; return its size in bytes.

    folders: run folders on one dataset, finished or not. progress: called as progress(pictures of
    views drawn, all). Links to other files are relative to the page. The same files give the same
    page, byte for byte. Raises InputError as `mgs.report.runs.compare_runs`, and if a file is
    damaged or the page cannot be written.
    """
    path, compared = Path(path), compare_runs(folders)
    dataset = compared.dataset
    shown = [read_shown(label, run, dataset) for label, run in compared.runs.items()]
    album, views = draw_pictures(shown, dataset, progress)
    limit = album.finish()
    text = _fill_in(
        title=", ".join(compared.runs),
        dataset=dataset.root.resolve().name,
        shown=shown,
        summary=summary_rows(shown, dataset),
        settings=setting_rows(shown),
        files=[(one.label, links(one.run, path)) for one in shown],
        data={
            "pictures": album.pictures,
            "runs": [_section(one, dataset) for one in shown],
            "compared": [_compared(shown, frame) for frame in views],
            "plots": _plots(shown),
        },
        limit=limit,
        scales={
            "error": colour_scale(ERROR_COLOURS),
            "uncertainty": colour_scale(UNCERTAINTY_COLOURS),
        },
    )
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return len(text.encode("utf-8"))


def draw_pictures(
    shown: Sequence[Shown],
    dataset: Dataset,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Album, list[Frame]]:
    """Draw the pictures of the page: of every run the views that it took, and of the returned
    frames (`compared_frames`) the truth and the renders of all runs.

    Raises InputError if a file of a frame cannot be read.
    """
    from mgs.splat import render

    modelled = [(one, one.model) for one in shown if one.model is not None]
    if not modelled:
        return Album(), []
    views = compared_frames([one.run for one in shown], dataset)
    frames = [*views, *(frame for one, _ in modelled for frame in one.frames)]
    taken = sum(len(one.frames) for one, _ in modelled)
    total, done = taken + len(views) * len(modelled), 0
    # Of each view a render and an error, of taken ones two maps more, of each frame a truth.
    count = 2 * total + 2 * taken + len({frame.name for frame in frames})
    album = new_album(frames, count)

    def drawn() -> None:
        nonlocal done
        done += 1
        progress(done, total)

    progress(0, total)
    for one, model in modelled:
        noise = one.run.settings["pixel_noise"], one.run.settings["prior_std"]
        draw_taken(album, one.label, model, one.frames, noise, drawn)
        for frame in views:
            name = f"{frame.name}/{one.label}"
            if f"render/{name}" not in album.pictures:
                draw_render(album, name, frame, np.asarray(render(model, frame.camera).rgb))
            drawn()
    return album, views


def compared_frames(runs: Sequence[RunFiles], dataset: Dataset) -> list[Frame]:
    """Frames on which the page compares truth and renders: up to COMPARED that the fewest runs were
    trained on, spread evenly, and as many test views, named `test/NAME`. Of measured runs the first
    is that of `shown_view`."""
    there = dataset.with_images({dataset.frames[i].name for run in runs for i in run.taken})
    pool, tests = least_trained(runs, dataset, there), dataset.test_views()
    frames = () if tests is None else tests.frames
    views = [*_spread(pool), *_spread([replace(f, name=f"test/{f.name}") for f in frames])]
    if not views or any(run.measured is None for run in runs):
        return views
    first, of = shown_view(runs, dataset)
    first = replace(first, name=f"test/{first.name}") if of == "test_views" else first
    return [first, *(view for view in views if view.name != first.name)]


def _spread(frames: Sequence[Frame]) -> list[Frame]:
    """Up to COMPARED of the frames, spread evenly."""
    count = min(COMPARED, len(frames))
    return [frames[i * len(frames) // count] for i in range(count)]


def _section(one: Shown, dataset: Dataset) -> dict[str, Any]:
    """Section of one run: its views in the order they were taken, orbit, and times."""
    return {
        "label": one.label,
        "views": [_view(one, k) for k in range(len(one.frames))],
        "orbit": orbit_plot(one.label, one.run, dataset, one.model, one.up),
        "time": timing_plot(one.label, one.run.steps),
    }


def _view(one: Shown, k: int) -> dict[str, Any]:
    """The k-th view that a run took: facts, pictures, and the position of its camera in the
    plot."""
    frame, seeds = one.frames[k], len(one.run.seeds)
    step = one.run.steps[max(0, k - seeds + 1)]
    role = f"seed {k + 1} of {seeds}" if k < seeds else f"step {step['step']}"
    facts = [("view", frame.name), ("taken as", role)]
    # The numbers are known after the last of the seeds.
    facts += step_facts(step) if k >= seeds - 1 else [("images", str(k + 1))]
    pictures = [] if one.model is None else _pictures(one, frame.name, k + 1)
    eye = (upright(one.up) @ frame.camera.position).tolist()
    return {"name": frame.name, "facts": facts, "pictures": pictures, "eye": eye}


def _pictures(one: Shown, view: str, images: int) -> list[dict[str, str]]:
    """Pictures of a view that a run took: names in the album, captions, alternative texts. images:
    number of images with this one."""
    quality, own = one.psnr_of(view), f"{view}/{one.label}"
    before, after = (f"{n} image{'' if n == 1 else 's'}" for n in (images - 1, images))
    known = f"Uncertainty seen from {view}"
    rows = [
        (f"truth/{view}", "truth", f"Truth: the image of {view}, the rock in front of black."),
        (
            f"render/{own}",
            f"render{quality}",
            f"Render of the model of {len(one.frames)} images at {view}{quality}.",
        ),
        (
            f"error/{own}",
            "error",
            f"Absolute difference of truth and render at {view}, bright where it is large"
            f"{quality}.",
        ),
        (
            f"before/{own}",
            f"uncertainty before ({before})",
            f"{known} before it was taken, with {before}: bright where little is known.",
        ),
        (
            f"after/{own}",
            f"uncertainty after ({after})",
            f"{known} after it was taken, with {after}: bright where little is known.",
        ),
    ]
    return [{"name": name, "caption": caption, "alt": alt} for name, caption, alt in rows]


def _compared(shown: Sequence[Shown], frame: Frame) -> dict[str, Any]:
    """Pictures for either side of the divider at a view: the truth, and the renders of all runs."""
    view = frame.name
    sides = [{"label": "truth", "name": f"truth/{view}", "alt": f"Truth at {view}."}]
    for one in shown:
        if one.model is not None:
            quality, name = one.psnr_of(view), f"render/{view}/{one.label}"
            alt = f"Render of {one.label} at {view}{quality}."
            sides.append({"label": one.label + quality, "name": name, "alt": alt})
    trained = [one.label for one in shown if view in {f.name for f in one.frames}]
    note = f"trained on by {', '.join(trained)}" if trained else "held out"
    return {"view": view, "note": note, "sides": sides}


def _plots(shown: Sequence[Shown]) -> list[dict[str, Any]]:
    """Plots that compare runs: the paper's figures, and every metric that was measured after steps
    or of views."""
    runs = {one.label: one.run for one in shown}
    covered = step_curves(runs, "coverage", 100)
    added = {
        label: (x[1:], [b - a for a, b in pairwise(y)])
        for label, (x, y) in covered.items()
        if len(y) > 1
    }
    gain, left = step_curves(runs, "information_gain"), step_curves(runs, "uncertainty")
    wanted = [
        (
            "Information gain of each chosen view (the paper's Fig. 2)",
            gain,
            f"information gain ({GAIN_UNIT})",
            True,
        ),
        ("Gaussians observed (coverage, Fig. 3)", covered, "coverage (%)", False),
        ("Coverage that each view added (Fig. 3)", added, "percentage points", True),
        ("Variance left, over that of the prior", left, "mean over all parameters", True),
    ]
    for key in dict.fromkeys(key for one in shown for s in one.run.steps for key in measured(s)):
        name = METRIC_NAMES[key]
        wanted.append((f"{name} after each step", step_curves(runs, key), name, False))
    loss = step_curves(runs, "loss")
    wanted.append(("Loss at the end of each fit", loss, "mean squared error", True))
    plots = [line_plot(title, found, y, zero) for title, found, y, zero in wanted if found]
    views = {one.label: measured_views(one.run) for one in shown if one.run.measured}
    if views:
        masked = all(
            any(view.get("psnr_mask") is not None for view in of_run) for of_run in views.values()
        )
        plots.append(views_plot("psnr_mask" if masked else "psnr", views))
    return plots


def _fill_in(**values: Any) -> str:
    """Fill in the template beside this file."""
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
    for name in ("css", "js"):
        values[name] = Markup((folder / f"page.{name}").read_text(encoding="utf-8"))
    values["plotly"] = Markup(get_plotlyjs())
    hashes = (sha256(values[name].encode()).digest() for name in ("plotly", "js"))
    values["scripts"] = Markup(" ".join(f"'sha256-{b64encode(h).decode()}'" for h in hashes))
    return environment.get_template("page.html").render(**values)
