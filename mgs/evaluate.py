"""PSNR and SSIM of a model against the images of a dataset, and renders next to the truth.

Both compare sRGB display values in [0,1] with `Frame.masked_rgb()`: the rock on black, which is what the model was trained on.
"Full frame" includes that black, which any model gets right, so it flatters; "inside the mask" is over the rock's pixels only.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mgs.config import versions
from mgs.conventions import Camera, srgb_from_linear
from mgs.dataset import Dataset, Frame
from mgs.errors import InputError
from mgs.files import atomic_path, locked, read_json, read_png, write_json
from mgs.gaussians import Gaussians
from mgs.inputs import array_digest, camera_digest, frame_digests

Renderer = Callable[[Gaussians, Camera], np.ndarray]
"""(gaussians, camera) -> linear RGB [H,W,3]."""
Progress = Callable[[int, int], None]

PSNR_LIMIT = 100.0
"""dB, reported where two images are equal (8-bit images cannot tell more than 59 dB apart)."""
SSIM_SIGMA = 1.5
"""Pixels, of SSIM's Gaussian window (11 x 11), from Wang et al. 2004."""
SSIM_WINDOW = 11
DIFFERENCE_GAIN = 4
"""How much the pictures of differences are brightened."""
METRICS = ("psnr", "ssim", "psnr_mask", "ssim_mask")


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio, dB, of display values [H,W,3] in [0,1]; over the pixels of `mask` [H,W] where given.

    At most PSNR_LIMIT; NaN where the mask is empty. Raises InputError where the shapes differ.
    """
    _same_shape(a, b)
    squares = (np.asarray(a, np.float64) - b) ** 2
    if mask is not None:
        squares = squares[mask]
    if squares.size == 0:
        return math.nan
    error = float(squares.mean())
    return PSNR_LIMIT if error <= 10 ** (-PSNR_LIMIT / 10) else -10 * math.log10(error)


def ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of display values [H,W,3] in [0,1], mean over channels.

    With a mask [H,W]: the SSIM map averaged over the mask; NaN where that is empty. Raises InputError where the shapes differ
    or the images are smaller than the window.
    """
    from skimage.metrics import structural_similarity

    _same_shape(a, b)
    if min(a.shape[:2]) < SSIM_WINDOW:
        raise InputError(f"SSIM needs images of at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, not {a.shape[1]}x{a.shape[0]}")
    mean, similarity = structural_similarity(
        np.asarray(a, np.float64),
        np.asarray(b, np.float64),
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=SSIM_SIGMA,
        use_sample_covariance=False,
        full=True,
    )
    if mask is None:
        return float(mean)
    return float(similarity[mask].mean()) if mask.any() else math.nan


def _same_shape(a: np.ndarray, b: np.ndarray) -> None:
    if a.shape != b.shape:
        raise InputError(f"images of {a.shape} and {b.shape} cannot be compared; render at the size of the dataset")


def render_rgb(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Linear RGB [H,W,3] of the model on black."""
    from mgs.splat import render

    return np.asarray(render(gaussians, camera).rgb)


def compare(truth: np.ndarray, rendered: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """The four METRICS of one view: linear RGB [H,W,3] twice, rock mask [H,W]."""
    a, b = srgb_from_linear(truth), srgb_from_linear(rendered)
    return {"psnr": psnr(a, b), "ssim": ssim(a, b), "psnr_mask": psnr(a, b, mask), "ssim_mask": ssim(a, b, mask)}


def evaluate(
    gaussians: Gaussians,
    frames: Sequence[Frame],
    trained: Iterable[str],
    *,
    renderer: Renderer = render_rgb,
    pictures: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """METRICS of the model on every frame; means over all views and over the views whose name is not in `trained`.

    Returns {"images": how many were trained on, "all": means, "held_out": means, "views": [one dict a view]}; means come with
    a "count", and are None where there is nothing to average. Writes truth | render | difference as PNG into the folder
    `pictures` where given. progress: called as progress(done, total).
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
    """Mean of each metric over the views that have it."""
    means: dict[str, Any] = {"count": len(views)}
    for name in METRICS:
        values = [view[name] for view in views if not math.isnan(view[name])]
        means[name] = sum(values) / len(values) if values else None
    return means


def _without_nan(view: dict[str, Any]) -> dict[str, Any]:
    """JSON knows no NaN."""
    return {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in view.items()}


def write_comparison(path: str | Path, truth: np.ndarray, rendered: np.ndarray, decibels: float) -> None:
    """Write truth | render | brightened |difference| as one PNG, captions in a strip above. Linear RGB [H,W,3] twice."""
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
    """(truth, render), linear RGB [H,W,3], out of a picture by `write_comparison`; to 8 bits.

    Raises InputError where the picture is missing, damaged or not of this camera's size.
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
    from mgs.nbv import read_settings

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


def load_run(run: Path) -> tuple[Gaussians, Dataset, list[str], str]:
    """(model, dataset, names of the views trained on in order, policy) of a run folder.

    Raises InputError where the run is missing, it has no finished step, or its dataset has changed.
    """
    from mgs import nbv
    from mgs.dataset import load_dataset

    settings = nbv.read_settings(run)
    state = nbv.read_checkpoint(run)
    if state is None:
        raise InputError(f"{run}: has no finished step yet; continue it with `mgs nbv --resume {run}`")
    dataset = load_dataset(settings.dataset)
    nbv.check_same_frames(run, dataset)
    return state.gaussians, dataset, [dataset.frames[i].name for i in state.taken], settings.policy
