"""The report as one HTML page that opens from the disk and loads nothing: `mgs report --html`."""

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

from mgs.data.frames import Frame
from mgs.evaluation import render_view
from mgs.files import write_text
from mgs.policy.criteria import GAIN_UNIT
from mgs.reports.page_facts import (
    links,
    measured,
    measured_views,
    notes,
    psnr_of,
    setting_rows,
    step_facts,
    summary_rows,
)
from mgs.reports.page_pictures import (
    ERROR_COLOURS,
    UNCERTAINTY_COLOURS,
    Album,
    colour_scale,
    draw_render,
    draw_taken,
    new_album,
)
from mgs.reports.page_plots import (
    METRIC_NAMES,
    curve_plot,
    line_plot,
    orbit_plot,
    timing_plot,
    views_plot,
)
from mgs.reports.runs import compare_runs, least_trained, step_curves
from mgs.reports.writing import shown_view
from mgs.run.folder import Run

COMPARED = 6  # views of the dataset, and test views, on which truth and renders are compared


def write_page(
    path: str | Path,
    folders: Sequence[str | PathLike[str]],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write the page of these runs as one HTML file; return its size in bytes.

    folders: run folders on one dataset, finished or not. progress: called as progress(pictures of
    views drawn, all). Links to other files are relative to the page. The same files give the same
    page, byte for byte. Raises InputError as `mgs.reports.runs.compare_runs`, and if a file is
    damaged or the page cannot be written."""
    path, runs = Path(path), compare_runs(folders)
    views = compared_frames(list(runs.values()))
    album = draw_pictures(runs, views, progress)
    limit = album.finish()
    dataset = next(iter(runs.values())).dataset
    text = _fill_in(
        title=", ".join(runs),
        dataset=dataset.root.resolve().name,
        labels=list(runs),
        command="nbv" if any(run.settings.budget for run in runs.values()) else "fit",
        outlined=dataset.outlined,
        notes={label: notes(run) for label, run in runs.items()},
        summary=summary_rows(runs),
        settings=setting_rows(runs),
        files=[(label, links(run, path)) for label, run in runs.items()],
        data={
            "pictures": album.pictures,
            "runs": [
                {
                    "label": label,
                    "views": [_view(label, run, k, frame) for k, frame in enumerate(run.taken)],
                    "orbit": orbit_plot(label, run),
                    "time": timing_plot(label, run.steps),
                }
                for label, run in runs.items()
            ],
            "compared": [_compared(runs, frame) for frame in views],
            "plots": _plots(runs),
        },
        limit=limit,
        error_scale=colour_scale(ERROR_COLOURS),
        uncertainty_scale=colour_scale(UNCERTAINTY_COLOURS),
    )
    write_text(path, text)
    return path.stat().st_size


def draw_pictures(
    runs: Mapping[str, Run],
    views: Sequence[Frame],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Album:
    """Draw the pictures of the page: of every run the views that it took, and of `views` the truth
    and the renders of all runs. Raises InputError if a file of a frame cannot be read."""
    frames = [*views, *(frame for run in runs.values() for frame in run.taken)]
    taken = len(frames) - len(views)
    total, done = taken + len(views) * len(runs), 0
    # Of each view a render and an error, of taken ones two maps more, of each frame a truth.
    album = new_album(frames, 2 * total + 2 * taken + len({frame.name for frame in frames}))

    def drawn() -> None:
        nonlocal done
        done += 1
        progress(done, total)

    progress(0, total)
    for label, run in runs.items():
        draw_taken(album, label, run, drawn)
        for frame in views:
            name = f"{frame.name}/{label}"
            if f"render/{name}" not in album.pictures:
                draw_render(album, name, frame, render_view(run.gaussians, frame.camera)[0])
            drawn()
    return album


def compared_frames(runs: Sequence[Run]) -> list[Frame]:
    """Frames on which the page compares truth and renders: up to COMPARED that the fewest runs were
    trained on, spread evenly, and as many test views, named `test/NAME`. Of measured runs the first
    is that of `shown_view`."""
    dataset = runs[0].dataset
    there = dataset.with_images({frame.name for run in runs for frame in run.taken})
    tests = dataset.test_views()
    dome = [replace(f, name=f"test/{f.name}") for f in (tests.frames if tests else ())]
    views = [*_spread(least_trained(runs, there)), *_spread(dome)]
    if not views or any(run.measured is None for run in runs):
        return views
    first, of = shown_view(runs)
    first = replace(first, name=f"test/{first.name}") if of == "test_views" else first
    return [first, *(view for view in views if view.name != first.name)]


def _spread(frames: Sequence[Frame]) -> list[Frame]:
    count = min(COMPARED, len(frames))
    return [frames[i * len(frames) // count] for i in range(count)]


def _view(label: str, run: Run, k: int, frame: Frame) -> dict[str, Any]:
    """Facts, pictures (name in the album, caption, alternative text) of the k-th view taken."""
    seeds, view, quality = run.settings.seeds, frame.name, psnr_of(run, frame.name)
    step = run.steps[max(0, k - seeds + 1)]
    role = f"seed {k + 1} of {seeds}" if k < seeds else f"step {step['step']}"
    facts = [("view", view), ("taken as", role)]
    # The numbers are known after the last of the seeds.
    facts += step_facts(step) if k >= seeds - 1 else [("images", str(k + 1))]
    black = ", the rock in front of black" if frame.mask_path or frame.rock_path else ""
    own, where, bright = f"{view}/{label}", f"seen from {view}", "bright where little is known"
    pictures = [
        (f"truth/{view}", "truth", f"Truth: the image of {view}{black}."),
        (f"render/{own}", f"render{quality}", f"Render of the last model at {view}{quality}."),
        (f"error/{own}", "error", f"Absolute difference of truth and render at {view}{quality}."),
    ]
    for when, count in (("before", k), ("after", k + 1)):
        caption = f"uncertainty {when} ({count} image{'' if count == 1 else 's'})"
        alt = f"Uncertainty {where} {when} it was taken: {bright}."
        pictures.append((f"{when}/{own}", caption, alt))
    return {
        "name": view,
        "facts": facts,
        "pictures": [dict(zip(("name", "caption", "alt"), row, strict=True)) for row in pictures],
        "eye": frame.camera.position.tolist(),
    }


def _compared(runs: Mapping[str, Run], frame: Frame) -> dict[str, Any]:
    view = frame.name
    sides = [{"label": "truth", "name": f"truth/{view}", "alt": f"Truth at {view}."}]
    for label, run in runs.items():
        quality, name = psnr_of(run, view), f"render/{view}/{label}"
        alt = f"Render of {label} at {view}{quality}."
        sides.append({"label": label + quality, "name": name, "alt": alt})
    trained = [label for label, run in runs.items() if view in {f.name for f in run.taken}]
    note = f"trained on by {', '.join(trained)}" if trained else "held out"
    return {"view": view, "note": note, "sides": sides}


def _plots(runs: Mapping[str, Run]) -> list[dict[str, Any]]:
    gain, covered = step_curves(runs, "information_gain"), step_curves(runs, "coverage", 100)
    longer = {label: (x, y) for label, (x, y) in covered.items() if len(y) > 1}
    added = {key: (x[1:], [b - a for a, b in pairwise(y)]) for key, (x, y) in longer.items()}
    title, axis = "Information gain of each chosen view", f"information gain ({GAIN_UNIT})"
    plots = [
        (f"{title} (the paper's Fig. 2)", gain, axis, True),
        ("Gaussians observed (coverage, Fig. 3)", covered, "coverage (%)", False),
        ("Coverage that each view added (Fig. 3)", added, "percentage points", True),
    ]
    steps = [step for run in runs.values() for step in run.steps]
    left = "Variance left, over that of the prior", "mean over all parameters", True
    of_steps = {"uncertainty": left}
    for key in dict.fromkeys(key for step in steps for key in measured(step)):
        of_steps[key] = f"{METRIC_NAMES[key]} after each step", METRIC_NAMES[key], False
    of_steps["loss"] = ("Loss at the end of each fit", "mean squared error", True)
    for key, (title, axis, zero) in of_steps.items():
        plots.append((title, step_curves(runs, key), axis, zero))
    drawn = [line_plot(title, curves, axis, zero) for title, curves, axis, zero in plots if curves]
    for label, run in runs.items():
        certificate = run.steps[0].get("certificate", {})
        if certificate.get("curve"):
            drawn.append(curve_plot(label, certificate))
    views = {label: measured_views(run) for label, run in runs.items() if run.measured}
    if views:
        masked = all(any(one.get("psnr_mask") is not None for one in of) for of in views.values())
        drawn.append(views_plot("psnr_mask" if masked else "psnr", views))
    return drawn


def _fill_in(**values: Any) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    folder = Path(__file__).parent / "templates"
    options: dict[str, Any] = {"undefined": StrictUndefined, "autoescape": True}
    options |= {"trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(loader=FileSystemLoader(folder), **options)
    for name in ("css", "js"):
        values[name] = Markup((folder / f"page.{name}").read_text(encoding="utf-8"))
    values["plotly"] = Markup(get_plotlyjs())
    hashes = (sha256(values[name].encode()).digest() for name in ("plotly", "js"))
    values["scripts"] = Markup(" ".join(f"'sha256-{b64encode(h).decode()}'" for h in hashes))
    return environment.get_template("page.html").render(**values)
