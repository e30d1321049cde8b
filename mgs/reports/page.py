"""The report as one HTML page that opens from the disk and loads nothing: `mgs report --html`."""

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mgs.colour import srgb_from_linear
from mgs.data.frames import Frame, has_masks
from mgs.evaluation import render_view
from mgs.files import write_text
from mgs.notebook import data_uri
from mgs.plotting import crop, painted
from mgs.policy.criteria import GAIN_UNIT, uncertainty
from mgs.progress import report
from mgs.reports.diagnostics import VISIBLE, view_maps
from mgs.reports.page_plots import (
    METRIC_NAMES,
    curve_plot,
    line_plot,
    links,
    measured,
    measured_views,
    notes,
    orbit_plot,
    psnr_of,
    setting_rows,
    step_facts,
    summary_rows,
    timing_plot,
    views_plot,
)
from mgs.reports.tables import compare_runs, least_trained, shown_view, step_curves
from mgs.run.folder import Run
from mgs.run.suggest import taken_in_order

PIXELS = 40e6  # most pixels of all pictures of a page: 4 to 8 MB of WebP
WIDEST = 640  # most pixels across a picture
QUALITY = 85  # quality of WebP, 0 to 100
ERROR_COLOURS, UNCERTAINTY_COLOURS = "magma", "cividis"  # perceptually uniform
GREY = (232, 232, 232)  # colour of pixels that show no model, in maps of uncertainty


@dataclass
class Album:
    """Pictures of equal size, by name, and error maps that share a colour scale.

    window: shown rows and columns of an image. width: of a picture, pixels, at most. pictures: name
    -> data URI. errors: name -> error map [h,w], which `finish` turns into pictures."""

    window: tuple[slice, slice] = (slice(None), slice(None))
    width: int = WIDEST
    pictures: dict[str, str] = field(default_factory=dict)
    errors: dict[str, np.ndarray] = field(default_factory=dict)

    def add_colours(self, name: str, linear: np.ndarray) -> None:
        pixels = np.round(srgb_from_linear(linear) * 255).astype(np.uint8)
        self.pictures[name] = web_picture(self._small(pixels))

    def add_error(self, name: str, truth: np.ndarray, rendered: np.ndarray) -> None:
        """Add the mean absolute difference of the sRGB channels of two images, linear RGB
        [H,W,3]."""
        difference = np.abs(srgb_from_linear(truth) - srgb_from_linear(rendered)).mean(axis=2)
        self.errors[name] = self._small(difference).astype(np.float16)

    def add_uncertainty(self, name: str, values: np.ndarray, alpha: np.ndarray) -> None:
        """Add a map of values [H,W] in [0,1], grey where the opacity alpha [H,W] is below
        VISIBLE."""
        colours = painted(values, UNCERTAINTY_COLOURS)
        colours[alpha < VISIBLE] = GREY
        self.pictures[name] = web_picture(self._small(colours))

    def finish(self) -> float:
        """Turn the error maps into pictures; return the error at the end of their colour scale.
        99.5 % of the pixels of every map are below it, and it is at least a step of 8 bits."""
        limit = max((float(np.quantile(e, 0.995)) for e in self.errors.values()), default=0.0)
        limit = max(round(limit, 3), 1 / 255)
        for name, error in self.errors.items():
            image = painted(error.astype(np.float32) / limit, ERROR_COLOURS)
            self.pictures[name] = web_picture(image)
        self.errors.clear()
        return limit

    def _small(self, image: np.ndarray) -> np.ndarray:
        """The window of an image, uint8 [H,W,3] or float32 [H,W], at most as wide as the album."""
        picture = Image.fromarray(np.ascontiguousarray(image[self.window]))
        if picture.width > self.width:
            height = max(1, round(picture.height * self.width / picture.width))
            picture = picture.resize((self.width, height), Image.Resampling.BOX)
        return np.asarray(picture)


def web_picture(pixels: np.ndarray) -> str:
    """Encode sRGB pixels, uint8 [h,w,3], as the WebP address of an <img>."""
    picture = Image.fromarray(np.ascontiguousarray(pixels))
    return data_uri(picture, "WEBP", quality=QUALITY, method=4)


def new_album(frames: Sequence[Frame], count: int) -> Album:
    """An empty album for `count` pictures of views of these frames, all cropped to what any mask
    holds, with a margin. Frames of different sizes are not cropped. Raises InputError if a mask
    cannot be read."""
    sizes = {(frame.camera.height, frame.camera.width) for frame in frames}
    window: tuple[slice, slice] = (slice(None), slice(None))
    if len(sizes) == 1:
        window = crop(np.logical_or.reduce([frame.mask() for frame in frames]))
    height, width = np.zeros(max(sizes), bool)[window].shape
    fits = (PIXELS / max(count, 1) * width / height) ** 0.5
    return Album(window, max(1, int(min(width, WIDEST, fits))))


def draw_taken(album: Album, label: str, run: Run, tick: Callable[[], None]) -> None:
    """Draw the views that a run has taken, in order: `truth/NAME`, `render/NAME/LABEL`,
    `error/NAME/LABEL`, and the uncertainty of the model before and after, `before/...`,
    `after/...`. tick: called after each view. Raises InputError if a file of a frame cannot be
    read."""
    from mgs.splat import fisher, groups

    gaussians = run.gaussians
    lam = run.settings.regularisation(groups(gaussians.sh_degree), surface=True)
    H = np.zeros((len(gaussians), len(lam)))
    for frame in taken_in_order(run):
        before = uncertainty(H, lam)
        H += fisher(gaussians, frame.camera)
        maps = view_maps(gaussians, frame.camera, {"before": before, "after": uncertainty(H, lam)})
        rendered = np.stack([maps[channel] for channel in "RGB"], axis=-1)
        draw_render(album, f"{frame.name}/{label}", frame, rendered)
        for when in ("before", "after"):
            album.add_uncertainty(f"{when}/{frame.name}/{label}", maps[when], maps["A"])
        tick()


def draw_render(album: Album, name: str, frame: Frame, rendered: np.ndarray) -> None:
    """Add `render/NAME`, `error/NAME`, and the frame's truth if it is missing. rendered: linear RGB
    [H,W,3]."""
    truth = frame.masked_rgb()
    if f"truth/{frame.name}" not in album.pictures:
        album.add_colours(f"truth/{frame.name}", truth)
    album.add_colours(f"render/{name}", rendered)
    album.add_error(f"error/{name}", truth, rendered)


def colour_scale(name: str) -> list[str]:
    """16 colours of a colour map, from its low to its high end, as CSS writes them."""
    import matplotlib

    rows: Any = matplotlib.colormaps[name](np.linspace(0, 1, 16), bytes=True)
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b, _ in rows.tolist()]


COMPARED = 6  # views of the dataset, and test views, on which truth and renders are compared


def write_page(path: str | Path, folders: Sequence[str | PathLike[str]]) -> int:
    """Write the page of these runs as one HTML file; return its size in bytes.

    folders: run folders on one dataset, finished or not. Links to other files are relative to the
    page. The same files give the same page, byte for byte. Raises InputError as
    `mgs.reports.tables.compare_runs`, and if a file is damaged or the page cannot be written."""
    path, runs = Path(path), compare_runs(folders)
    views = compared_frames(list(runs.values()))
    album = draw_pictures(runs, views)
    limit = album.finish()
    dataset = next(iter(runs.values())).dataset
    text = _fill_in(
        title=", ".join(runs),
        dataset=dataset.root.resolve().name,
        labels=list(runs),
        command="nbv" if any(run.settings.budget for run in runs.values()) else "fit",
        outlined=has_masks(dataset.frames),
        notes={label: notes(run) for label, run in runs.items()},
        summary=summary_rows(runs),
        settings=setting_rows(runs),
        files=[(label, links(run, path)) for label, run in runs.items()],
        data={
            "pictures": album.pictures,
            "runs": [
                {
                    "label": label,
                    "views": [_view(label, run, *view) for view in enumerate(taken_in_order(run))],
                    "orbit": orbit_plot(label, run),
                    "time": timing_plot(label, run.steps) if run.settings.budget else None,
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


def draw_pictures(runs: Mapping[str, Run], views: Sequence[Frame]) -> Album:
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
        report("drawing", done, total)

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
    first = "seed" if run.settings.budget else "image"
    role = f"{first} {k + 1} of {seeds}" if k < seeds else f"step {step['step']}"
    facts = [("view", view), ("taken as", role)]
    if run.settings.budget:  # its numbers are known after the last of the seeds
        facts += step_facts(step) if k >= seeds - 1 else [("images", str(k + 1))]
    black = ", the object in front of black" if frame.mask_path or frame.rock_path else ""
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
    of_steps["loss"] = ("Loss at the end of each fit", "loss", True)
    for key, (title, axis, zero) in of_steps.items():
        plots.append((title, step_curves(runs, key), axis, zero))
    drawn = [
        line_plot(title, curves, axis, zero)
        for title, curves, axis, zero in plots
        if any(len(xs) > 1 for xs, _ in curves.values())  # a fit has one step
    ]
    for label, run in runs.items():
        certificate = run.steps[0].get("certificate", {})
        if certificate.get("curve"):
            drawn.append(curve_plot(label, certificate))
    views = {label: measured_views(run) for label, run in runs.items() if run.measured}
    if views:
        values = [[(one["psnr"], one.get("psnr_mask")) for one in of] for of in views.values()]
        masked = all(any(inside not in (None, whole) for whole, inside in of) for of in values)
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
