"""How good a model is: its renders against the images of a dataset, in numbers (`mgs.metrics`) and
in pictures.

The truth is `Frame.target`: the rock in front of black, which is what the model was trained on.
PSNR and SSIM compare sRGB values in [0,1]. Over the full frame they flatter, because any model gets
the black right; those inside the mask are over the rock's pixels only.

Views come in three sets: all views of the dataset; of these, the views held out, which the model
was never trained on; and the dataset's test views (`Dataset.test_views`), which are the same for
every model and which no model is trained on.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.dataset import TEST_FOLDER, Dataset, Frame
from mgs.errors import InputError
from mgs.files import atomic_path, locked, read_json, write_json
from mgs.gaussians import Gaussians
from mgs.images import read_png
from mgs.metrics import METRICS, SURFACE_METRICS, compare, compare_surface
from mgs.prior.build import load_prior
from mgs.provenance import versions
from mgs.run.folder import load_run, read_checkpoint, read_settings
from mgs.run.inputs import array_digest, camera_digest, frame_digests
from mgs.run.settings import NbvSettings

Renderer = Callable[[Gaussians, Camera], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""A function that draws a model: (gaussians, camera) -> linear RGB [H,W,3], alpha [H,W], expected
z-depth [H,W] in metres."""

Progress = Callable[[int, int], None]
"""A function that is told how the work goes on: (frames done, frames in all)."""

MEASURED_AT_ONCE = 4
"""Most views that are measured at the same time, each in a thread."""

PIXELS_AT_ONCE = 4_000_000
"""Most pixels of all of these, which bounds the memory; a larger view is measured alone."""

DIFFERENCE_GAIN = 4
"""Factor by which differences are brightened in the pictures."""


def render_view(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The model on black: linear RGB [H,W,3], alpha [H,W], expected z-depth [H,W] in metres."""
    from mgs.splat import render

    image = render(gaussians, camera)
    return np.asarray(image.rgb), np.asarray(image.alpha), np.asarray(image.depth)


def evaluate(
    gaussians: Gaussians,
    frames: Sequence[Frame],
    trained: Iterable[str],
    *,
    test_frames: Sequence[Frame] = (),
    spacing: float | None = None,
    renderer: Renderer = render_view,
    pictures: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare a model with every frame of a dataset, and with every test view where there are some.

    trained: names of the frames that the model was trained on; the others are held out.
    test_frames: the test views, on which
    it was not trained. spacing: of the prior's samples, metres; without it the shares that are too
    deep are left out. renderer:
    draws the model. pictures: a folder; if given, `write_comparison` writes NAME.png of every frame
    into it, and test/NAME.png
    of every test view. progress: told the number of views done.

    Returns what metrics.json holds, without its policy:

    - images: how many frames the model was trained on.
    - test (only where there are test views), all, held_out: over the test views, over all frames,
    and over those held out, the
      number of views ("count") and the mean of each of `mgs.metrics.METRICS`, and of each of
      `mgs.metrics.SURFACE_METRICS` that the data has a truth for; None if no view has it.
    - views, and with test views test_views: for each view its "name", "trained" (bool) and its
    metrics, None where there is no
      pixel to measure, as where the rock's mask is empty.

    Raises InputError if a file of a frame cannot be read or a picture cannot be written.
    """
    trained, views, tests = set(trained), list[dict[str, Any]](), list[dict[str, Any]]()
    work = [(views, frame, pictures) for frame in frames]
    work += [(tests, frame, pictures and pictures / TEST_FOLDER) for frame in test_frames]
    largest = max((frame.camera.width * frame.camera.height for _, frame, _ in work), default=1)
    at_once = max(1, min(MEASURED_AT_ONCE, PIXELS_AT_ONCE // largest))
    waiting: deque[Future[dict[str, float]]] = deque()
    tell = progress or (lambda done, of: None)
    tell(0, len(work))
    with ThreadPoolExecutor(
        at_once
    ) as pool:  # most of the time goes into filters that run beside other threads
        for begun in range(len(work) + at_once):
            if begun >= at_once:
                found, frame, _ = work[begun - at_once]
                measured = waiting.popleft().result()
                found.append(
                    {"name": frame.name, "trained": found is views and frame.name in trained}
                    | measured
                )
                tell(begun - at_once + 1, len(work))
            if begun < len(work):
                _, frame, folder = work[begun]
                # Copies: what a renderer returns may be memory of Dr.Jit, and a thread that frees
                # it waits for a lock of Dr.Jit with Python's own lock in its hands, while this
                # thread, which draws the next view, holds the first one.
                rgb, alpha, depth = map(np.array, renderer(gaussians, frame.camera))
                waiting.append(pool.submit(_measured, frame, (rgb, alpha, depth), spacing, folder))
    held_out = [view for view in views if not view["trained"]]
    result: dict[str, Any] = {"images": len(trained)} | (
        {"test": _means(tests, tests)} if tests else {}
    )
    result |= {"all": _means(views, views), "held_out": _means(held_out, views)}
    result["views"] = [_without_nan(view) for view in views]
    return result | ({"test_views": [_without_nan(view) for view in tests]} if tests else {})


def _measured(
    frame: Frame,
    rendered: tuple[np.ndarray, np.ndarray, np.ndarray],
    spacing: float | None,
    folder: Path | None,
) -> dict[str, float]:
    """The METRICS of one view, and those of the SURFACE_METRICS that it has a truth for. Its
    picture goes into the folder."""
    (truth, weight), mask, (rgb, alpha, depth) = frame.target(), frame.mask(), rendered
    found = compare(truth, rgb, mask, weight) | compare_surface(
        truth, alpha, depth, mask, weight,
        fractional=frame.rock_path is not None, true_depth=frame.depth() if frame.depth_path else None, spacing=spacing,
    )  # fmt: skip
    if folder is not None:
        write_comparison(folder / f"{frame.name}.png", truth[..., :3], rgb, found["psnr"])
    return found


def _means(views: list[dict[str, Any]], whole: list[dict[str, Any]]) -> dict[str, Any]:
    """Number of views, and the mean of each metric over those views that have it; None if there is
    no such view.

    whole: the set that the views are from. Of the SURFACE_METRICS, those are left out that none of
    it has a truth for.
    """
    means: dict[str, Any] = {"count": len(views)}
    for name in (
        *METRICS,
        *(name for name in SURFACE_METRICS if any(name in view for view in whole)),
    ):
        values = [view[name] for view in views if not math.isnan(view.get(name, math.nan))]
        means[name] = sum(values) / len(values) if values else None
    return means


def _without_nan(view: dict[str, Any]) -> dict[str, Any]:
    """A view's numbers with None in place of NaN, for which JSON has no notation."""
    return {
        key: None if isinstance(value, float) and math.isnan(value) else value
        for key, value in view.items()
    }


def write_comparison(
    path: str | Path, truth: np.ndarray, rendered: np.ndarray, decibels: float
) -> None:
    """Write one PNG with three panels side by side: truth, render, and their absolute difference,
    brightened.

    truth, rendered: [H,W,3] linear RGB; decibels: the PSNR, for the caption. The captions stand in
    a strip above the panels. Raises InputError if the file cannot be written.
    """
    from PIL import Image, ImageDraw, ImageFont

    a, b = srgb_from_linear(truth), srgb_from_linear(rendered)
    panels = np.concatenate([a, b, np.clip(DIFFERENCE_GAIN * np.abs(a - b), 0, 1)], axis=1)
    height, width = a.shape[:2]
    size = max(10, height // 24)
    picture = Image.new("RGB", (3 * width, height + 2 * size), (255, 255, 255))
    picture.paste(Image.fromarray(np.round(panels * 255).astype(np.uint8)), (0, 2 * size))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size)
    captions = ("truth", f"render, {decibels:.2f} dB", f"|difference| x {DIFFERENCE_GAIN}")
    for i, caption in enumerate(captions):
        draw.text(((i + 0.5) * width, size), caption, fill=(0, 0, 0), font=font, anchor="mm")
    with atomic_path(path) as temporary:
        picture.save(temporary, format="PNG")


def read_comparison(path: str | Path, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Truth and render, linear RGB [H,W,3] each, out of a picture that `write_comparison` wrote.
    They were rounded to 8 bits.

    camera: of the view. Raises InputError if the picture is missing, damaged or not of this
    camera's size.
    """
    pixels, (height, width) = read_png(path), (camera.height, camera.width)
    if pixels.shape[0] <= height or pixels.shape[1] != 3 * width:
        raise InputError(
            f"{path}: is not a comparison of {width}x{height} views; write it again with `mgs eval`"
        )
    return pixels[-height:, :width], pixels[-height:, width : 2 * width]


def evaluate_run(
    run: str | Path,
    *,
    pictures: bool = True,
    progress: Progress | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """`evaluate` of a run of `mgs nbv` on its dataset and its test views; writes RUN/metrics.json,
    and RUN/renders where
    `pictures`: NAME.png of every view, test/NAME.png of every test view.

    Of an on-demand dataset only the frames that the run has taken are measured: the others have no
    image, so none is held out.
    What is there of this very model, dataset and version of mgs is kept: nothing is measured or
    drawn twice. say is told which metrics are left out because there is no truth for them, then
    what was written and what was kept. Raises InputError as `load_run`, where the test views cannot
    be read, and where another process works on the run.
    """
    run = Path(run)
    file, folder = run / "metrics.json", run / "renders"
    settings = read_settings(run)  # read before the lock: a folder that is no run is not locked
    prior = settings.prior
    with locked(run):
        gaussians, dataset, trained, policy = load_run(run)
        frames = dataset.with_images(trained)
        tests, spacing = _test_frames(dataset), _spacing(prior)
        subject = _subject(gaussians, [*frames, *tests], trained, spacing)
        for reason in _left_out(dataset, prior, spacing):
            say(reason)
        metrics = _measured_before(file, subject)
        if metrics is None:
            found = evaluate(
                gaussians, frames, trained,
                test_frames=tests, spacing=spacing, pictures=folder if pictures else None, progress=progress,
            )  # fmt: skip
            fit = _fit(gaussians, dataset, trained, settings, progress, say)
            informed = {"informed": _informed(run, gaussians, settings)}
            metrics = (
                {"policy": policy, "of": subject, "pictures": pictures} | fit | informed | found
            )
            write_json(file, metrics)
            say(f"wrote {file}" + (f" and {folder}" if pictures else ""))
            return metrics
        kept = f"kept {file}, measured before on this very model and dataset"
        paths = [folder / f"{frame.name}.png" for frame in frames]
        paths += [folder / TEST_FOLDER / f"{frame.name}.png" for frame in tests]
        if pictures and not (metrics["pictures"] and all(path.is_file() for path in paths)):
            decibels = [
                view["psnr"] for view in [*metrics["views"], *metrics.get("test_views", [])]
            ]
            _draw(gaussians, [*frames, *tests], paths, decibels, progress)
            metrics = metrics | {"pictures": True}
            write_json(file, metrics)
            say(f"{kept}; wrote {folder}")
        else:
            say(kept + (f", and {folder}" if pictures else ""))
        return metrics


def _test_frames(dataset: Dataset) -> tuple[Frame, ...]:
    """The test views of a dataset, none where it has none. Raises InputError as
    `Dataset.test_views`."""
    tests = dataset.test_views()
    return () if tests is None else tests.frames


def _fit(
    gaussians: Gaussians,
    dataset: Dataset,
    trained: list[str],
    settings: NbvSettings,
    progress: Progress | None,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """How far the last fit is from its end, as the entry "fit". It is left out, and why is said,
    where the prior that the fit started from is not there or no longer fits."""
    from mgs.report.convergence import remaining_decrease

    by_name = {frame.name: frame for frame in dataset.frames}
    frames, report = [by_name[name] for name in trained], progress or (lambda done, most: None)
    try:
        return {
            "fit": remaining_decrease(
                gaussians, settings, load_prior(settings.prior), frames, report
            )
        }
    except InputError as error:
        say(f"{error}; so it is left out how far the fit is from its end")
        return {}


def _informed(run: Path, gaussians: Gaussians, settings: NbvSettings) -> dict[str, dict[str, int]]:
    """Of each kind of parameter their number, and how many of them the views say more about than
    the prior does (H > lambda). The others are about where the prior put them."""
    from mgs.splat import groups

    state = read_checkpoint(run)
    assert state is not None  # the model was read from it
    columns = groups(gaussians.sh_degree, settings.train.means)
    more = settings.regularisation(columns) < state.H
    return {
        kind: {"of": int(more[:, of].size), "informed": int(more[:, of].sum())}
        for kind, of in columns.items()
    }


def _spacing(prior: Path) -> float | None:
    """Spacing of the prior's samples, metres, None where the folder of the prior is not there.
    Raises InputError if its file is damaged."""
    file = prior / "prior.json"
    if not file.is_file():
        return None
    numbers = read_json(file)
    spacing = numbers.get("spacing") if isinstance(numbers, dict) else None
    if not isinstance(spacing, float | int) or not 0 < spacing < math.inf:
        raise InputError(
            f"{file}: spacing must be positive metres; make the prior again with `mgs prior`"
        )
    return float(spacing)


def _left_out(dataset: Dataset, prior: Path, spacing: float | None) -> list[str]:
    """Why some of the SURFACE_METRICS are not measured, in a line each."""
    reasons = []
    if not any(frame.rock_path for frame in dataset.frames):
        reasons.append(
            f"{dataset.root}: has no images of the rock alone, so the error of alpha is left out"
        )
    if not any(frame.depth_path for frame in dataset.frames):
        reasons.append(f"{dataset.root}: has no depth images, so the errors of depth are left out")
    elif spacing is None:
        reasons.append(
            f"{prior}: is not there, so the shares that are too deep, in its spacings, are left out"
        )
    return reasons


def _subject(
    gaussians: Gaussians, frames: Sequence[Frame], trained: list[str], spacing: float | None
) -> str:
    """Hash of all that the metrics of a run depend on: the model, the cameras and files of all
    views, the prior's spacing, and the versions, but not the commit, which changes with every word
    in a page."""
    kinds = ("image", "mask", "rock", "depth")
    views = [
        [frame.name, camera_digest(frame.camera), frame_digests(frame, kinds)] for frame in frames
    ]
    known = {name: version for name, version in versions().items() if name != "commit"}
    text = json.dumps([array_digest(asdict(gaussians).values()), views, trained, spacing, known])
    return array_digest([np.frombuffer(text.encode(), np.uint8)])


def _measured_before(file: Path, subject: str) -> dict[str, Any] | None:
    """The contents of metrics.json, where it is there and of this subject."""
    try:
        metrics = read_json(file)
    except InputError:
        return None
    return metrics if isinstance(metrics, dict) and metrics.get("of") == subject else None


def _draw(
    gaussians: Gaussians,
    frames: Sequence[Frame],
    paths: Sequence[Path],
    decibels: Sequence[float],
    progress: Progress | None,
) -> None:
    """The pictures of `evaluate` alone, of views whose PSNR is known."""
    for done, (frame, path, value) in enumerate(zip(frames, paths, decibels, strict=True)):
        if progress:
            progress(done, len(frames))
        write_comparison(path, frame.masked_rgb(), render_view(gaussians, frame.camera)[0], value)


def other_views(dataset: Dataset, taken: Sequence[str]) -> tuple[str, Sequence[Frame]]:
    """The views on which two models of a run are compared: ("test", the test views) where the
    dataset has some, or else ("held out", those never taken). taken: names of frames."""
    tests = dataset.test_views()
    if tests:
        return "test", tests.frames
    return "held out", [frame for frame in dataset.with_images(taken) if frame.name not in taken]


def mean_psnr(gaussians: Gaussians, frames: Sequence[Frame]) -> float:
    """Mean PSNR over views, full frame, dB."""
    return float(evaluate(gaussians, frames, ())["all"]["psnr"])
