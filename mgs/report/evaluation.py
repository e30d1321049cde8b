"""How good a model is: PSNR and SSIM of its renders against the images of a dataset, and pictures of both side by side.

The truth is `Frame.masked_rgb`: the rock on black, which is what the model was trained on. Both numbers compare sRGB values in
[0,1]. Over the full frame they flatter, because any model gets the black right; those inside the mask are over the rock's
pixels only (`mgs.metrics`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mgs.active.inputs import array_digest, camera_digest, frame_digests
from mgs.active.run_folder import load_run, read_settings
from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.dataset import Dataset, Frame
from mgs.errors import InputError
from mgs.files import atomic_path, locked, read_json, write_json
from mgs.gaussians import Gaussians
from mgs.images import read_png
from mgs.metrics import METRICS, compare
from mgs.provenance import versions

Renderer = Callable[[Gaussians, Camera], np.ndarray]
"""A function that draws a model: (gaussians, camera) -> linear RGB [H,W,3]."""

Progress = Callable[[int, int], None]
"""A function that is told how the work goes on: (frames done, frames in all)."""

DIFFERENCE_GAIN = 4
"""Factor by which differences are brightened in the pictures."""


def render_rgb(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """The model on black, linear RGB [H,W,3]."""
    from mgs.splat import render

    return np.asarray(render(gaussians, camera).rgb)


def evaluate(
    gaussians: Gaussians,
    frames: Sequence[Frame],
    trained: Iterable[str],
    *,
    renderer: Renderer = render_rgb,
    pictures: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare a model with every frame of a dataset.

    trained: names of the frames that the model was trained on; the others are held out. renderer: draws the model. pictures: a
    folder; if given, `write_comparison` writes NAME.png of every frame into it. progress: told the number of frames done.

    Returns what metrics.json holds, without its policy:

    - images: how many frames the model was trained on.
    - all, held_out: over all frames, and over those held out, the number of frames ("count") and the mean of each of
      `mgs.metrics.METRICS`, None if no frame has it.
    - views: for each frame its "name", "trained" (bool) and its METRICS, None where the rock's mask is empty.

    Raises InputError if a file of a frame cannot be read or a picture cannot be written.
    """
    trained = set(trained)
    views: list[dict[str, Any]] = []
    for done, frame in enumerate(frames):
        if progress:
            progress(done, len(frames))
        truth, rendered = frame.masked_rgb(), renderer(gaussians, frame.camera)
        measured = compare(truth, rendered, frame.mask())
        views.append({"name": frame.name, "trained": frame.name in trained} | measured)
        if pictures is not None:
            write_comparison(pictures / f"{frame.name}.png", truth, rendered, measured["psnr"])
    if progress:
        progress(len(frames), len(frames))
    return {
        "images": len(trained),
        "all": _means(views),
        "held_out": _means([view for view in views if not view["trained"]]),
        "views": [_without_nan(view) for view in views],
    }


def _means(views: list[dict[str, Any]]) -> dict[str, Any]:
    """Number of views, and the mean of each of METRICS over those views that have it; None if there is no such view."""
    means: dict[str, Any] = {"count": len(views)}
    for name in METRICS:
        values = [view[name] for view in views if not math.isnan(view[name])]
        means[name] = sum(values) / len(values) if values else None
    return means


def _without_nan(view: dict[str, Any]) -> dict[str, Any]:
    """A view's numbers with None in place of NaN, for which JSON has no notation."""
    return {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in view.items()}


def write_comparison(path: str | Path, truth: np.ndarray, rendered: np.ndarray, decibels: float) -> None:
    """Write one PNG with three panels side by side: truth, render, and their absolute difference, brightened.

    truth, rendered: [H,W,3] linear RGB; decibels: the PSNR, for the caption. The captions stand in a strip above the panels.
    Raises InputError if the file cannot be written.
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
    """Truth and render, linear RGB [H,W,3] each, out of a picture that `write_comparison` wrote. They were rounded to 8 bits.

    camera: of the view. Raises InputError if the picture is missing, damaged or not of this camera's size.
    """
    pixels, (height, width) = read_png(path), (camera.height, camera.width)
    if pixels.shape[0] <= height or pixels.shape[1] != 3 * width:
        raise InputError(f"{path}: is not a comparison of {width}x{height} views; write it again with `mgs eval`")
    return pixels[-height:, :width], pixels[-height:, width : 2 * width]


def evaluate_run(
    run: str | Path,
    *,
    pictures: bool = True,
    progress: Progress | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """`evaluate` of a run of `mgs nbv` on its dataset; writes RUN/metrics.json, and RUN/renders/*.png where `pictures`.

    What is there of this very model, dataset and version of mgs is kept: nothing is measured or drawn twice. say is told what
    was written and what was kept. Raises InputError as `load_run`, and where another process works on the run.
    """
    run = Path(run)
    file, folder = run / "metrics.json", run / "renders"
    read_settings(run)  # a folder that is no run is not locked
    with locked(run):
        gaussians, dataset, trained, policy = load_run(run)
        subject = _subject(gaussians, dataset, trained)
        metrics = _measured_before(file, subject)
        if metrics is None:
            found = evaluate(gaussians, dataset.frames, trained, pictures=folder if pictures else None, progress=progress)
            metrics = {"policy": policy, "of": subject, "pictures": pictures} | found
            write_json(file, metrics)
            say(f"wrote {file}" + (f" and {folder}" if pictures else ""))
            return metrics
        kept = f"kept {file}, measured before on this very model and dataset"
        drawn = metrics["pictures"] and all((folder / f"{frame.name}.png").is_file() for frame in dataset.frames)
        if pictures and not drawn:
            decibels = [view["psnr"] for view in metrics["views"]]
            _draw(gaussians, dataset.frames, decibels, folder, progress)
            metrics = metrics | {"pictures": True}
            write_json(file, metrics)
            say(f"{kept}; wrote {folder}")
        else:
            say(kept + (f", and {folder}" if pictures else ""))
        return metrics


def _subject(gaussians: Gaussians, dataset: Dataset, trained: list[str]) -> str:
    """Hash of all that the metrics of a run depend on: the model, the dataset's cameras, images and masks, and the versions."""
    frames = [[frame.name, camera_digest(frame.camera), frame_digests(frame, ("image", "mask"))] for frame in dataset.frames]
    text = json.dumps([array_digest(asdict(gaussians).values()), frames, trained, versions()])
    return array_digest([np.frombuffer(text.encode(), np.uint8)])


def _measured_before(file: Path, subject: str) -> dict[str, Any] | None:
    """The contents of metrics.json, where it is there and of this subject."""
    try:
        metrics = read_json(file)
    except InputError:
        return None
    return metrics if isinstance(metrics, dict) and metrics.get("of") == subject else None


def _draw(
    gaussians: Gaussians, frames: Sequence[Frame], decibels: Sequence[float], folder: Path, progress: Progress | None
) -> None:
    """The pictures of `evaluate` alone, of frames whose PSNR is known."""
    for done, (frame, value) in enumerate(zip(frames, decibels, strict=True)):
        if progress:
            progress(done, len(frames))
        write_comparison(folder / f"{frame.name}.png", frame.masked_rgb(), render_rgb(gaussians, frame.camera), value)
