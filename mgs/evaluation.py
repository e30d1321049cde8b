"""Quality of a model: its renders against images, as numbers (`mgs.metrics`) and pictures. The
truth is `Frame.target`: the rock in front of black. Metrics of the full frame flatter, because any
model gets the black right. Held-out views are those that the model was never trained on."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.camera import Camera
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data.dataset import TEST_FOLDER, Dataset
from mgs.data.frames import Frame, as_captured
from mgs.data.world import UPRIGHT, World
from mgs.files import atomic_path
from mgs.gaussians import Gaussians, sh_from_rgb
from mgs.images import PNG_LEVEL
from mgs.memory import IMAGE_BYTES, kept_within
from mgs.metrics import METRICS, SURFACE_METRICS, compare, compare_psnr, compare_surface
from mgs.progress import report
from mgs.rotation import rotmat_from_quat

if TYPE_CHECKING:
    from mgs.splat import ListCache

Renderer = Callable[[Gaussians, Camera], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""(gaussians, camera) -> linear RGB [H,W,3], alpha [H,W], expected z-depth [H,W] in metres."""

MEASURED_AT_ONCE = 4  # most views that are measured at the same time, each in a thread
PIXELS_AT_ONCE = 4_000_000  # of all of these; a larger view is measured alone
DIFFERENCE_GAIN = 4  # factor by which differences are brightened in the pictures


def render_view(
    gaussians: Gaussians, camera: Camera, cache: "ListCache | None" = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render on black: linear RGB [H,W,3], alpha [H,W], expected z-depth [H,W] in metres."""
    from mgs.splat import render

    image = render(gaussians, camera, cache=cache)
    rgb = gaussians.linear_rgb(np.asarray(image.rgb))
    return rgb, np.asarray(image.alpha), np.asarray(image.depth)


def normals(gaussians: Gaussians, camera: Camera, cache: "ListCache | None" = None) -> np.ndarray:
    """Unit normals of a view in the world's axes, towards the camera, float32 [H,W,3]; 0 where
    nothing is drawn. The normal of a Gaussian is its shortest axis, and that of a pixel their mean
    by blending weight. Raises InputError as `render`."""
    from mgs.splat import render

    axes, shortest = rotmat_from_quat(gaussians.quats), np.argmin(gaussians.log_scales, 1)
    n = np.take_along_axis(axes, np.asarray(shortest)[:, None, None], 2)[..., 0]
    eye = camera.seen_from(gaussians.origin).position
    n *= np.where(((gaussians.means - eye) * n).sum(1, keepdims=True) > 0, -1, 1)
    # Colours are at least 0, so (n + 1) / 2 is drawn: sum w n = 2 sum w (n + 1) / 2 - sum w.
    image = render(replace(gaussians, sh=sh_from_rgb((n + 1) / 2)), camera, cache=cache)
    mean = 2 * np.asarray(image.rgb, np.float64) - np.asarray(image.alpha)[..., None]
    length = np.linalg.norm(mean, axis=2, keepdims=True)
    return np.where(length > 0, mean / np.where(length > 0, length, 1), 0).astype(np.float32)


def psnr_measure(
    dataset: Dataset, cache: "ListCache", exposure: bool = False
) -> Callable[[Gaussians, list[int]], dict[str, float]]:
    """Returns measure(gaussians, frames taken) -> mean PSNR, dB, by the names of `psnr_over`.

    `test_psnr...` over the test views. A dataset without test views: `psnr...` over all views that
    have an image, `held_out_psnr...` over those not taken. A mean over no view is left out. Raises
    InputError as `Dataset.test_views`."""
    tests = dataset.test_views()
    frames = dataset.frames if tests is None else tests.frames
    of = psnr_over(frames, cache, exposure, dataset.world)

    def measure(gaussians: Gaussians, taken: list[int]) -> dict[str, float]:
        if tests is not None:
            return _psnr_means(of(gaussians, range(len(frames))), "test_")
        there = [i for i, frame in enumerate(frames) if i in taken or not frame.on_demand]
        views = of(gaussians, there)
        held_out = {key: v[[i not in taken for i in there]] for key, v in views.items()}
        return _psnr_means(views) | _psnr_means(held_out, "held_out_")

    return measure


def psnr_over(
    frames: Sequence[Frame], cache: "ListCache", exposure: bool = False, world: World = UPRIGHT
) -> Callable[[Gaussians, Sequence[int]], dict[str, np.ndarray]]:
    """Returns a function (gaussians, indices of frames) -> PSNR of each of these views, dB.

    Keys: those of `mgs.metrics.compare_psnr`, `..._corrected` only with `exposure`. Images are kept
    for the next call. world: of the frames' files."""
    names = ("psnr", "psnr_mask", *(("psnr_corrected", "psnr_mask_corrected") if exposure else ()))

    def read(index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        frame = as_captured(frames[index], world)
        rgba, weight = frame.target()
        return srgb_from_linear(rgba[..., :3]), weight > 0, frame.mask() & (weight > 0)

    truth = kept_within(IMAGE_BYTES, read, lambda parts: sum(part.nbytes for part in parts))

    def compared(index: int, rendered: np.ndarray, *_: np.ndarray) -> dict[str, float]:
        image, valid, rock = truth(index)
        linear = linear_from_srgb(image) if exposure else None
        return compare_psnr(image, rendered, valid, rock, linear)

    def measured(gaussians: Gaussians, indices: Sequence[int]) -> dict[str, np.ndarray]:
        from mgs.splat import as_drjit

        model = as_drjit(gaussians)
        cameras = {i: as_captured(frames[i], world).camera for i in indices}
        renders = ((i, render_view(model, camera, cache)) for i, camera in cameras.items())
        rows = list(_compared(renders, compared, 2))
        return {name: np.array([row[name] for row in rows], float) for name in names}

    return measured


def _psnr_means(values: Mapping[str, np.ndarray], prefix: str = "") -> dict[str, float]:
    numbers = {key: column[~np.isnan(column)] for key, column in values.items()}
    return {prefix + key: float(column.mean()) for key, column in numbers.items() if len(column)}


def _compared(
    renders: Iterable[tuple[Any, tuple[np.ndarray, ...]]],
    compare: Callable[..., dict[str, float]],
    at_once: int,
) -> Iterator[dict[str, float]]:
    """Yield compare(view, *arrays) of each view and its rendered arrays, in order, from threads."""
    queue: deque[Future[dict[str, float]]] = deque()
    with ThreadPoolExecutor(at_once) as pool:
        for view, arrays in renders:
            # Copies: memory of Dr.Jit must not be freed by another thread. That thread would wait
            # for a lock of Dr.Jit while it holds Python's, and this one the other way round.
            queue.append(pool.submit(compare, view, *map(np.array, arrays)))
            del arrays
            if len(queue) == at_once:
                yield queue.popleft().result()
        while queue:
            yield queue.popleft().result()


def evaluate_model(
    gaussians: Gaussians,
    frames: Sequence[Frame],
    trained: Iterable[str],
    *,
    test_frames: Sequence[Frame] = (),
    renderer: Renderer = render_view,
    pictures: Path | None = None,
) -> dict[str, Any]:
    """Compare a model with every frame of a dataset, and with its test views if it has some.

    trained: names of the training frames; the others are held out. pictures: folder for the
    comparisons (`write_comparison`), NAME.png of every frame and test/NAME.png of every test view.

    Returns the contents of metrics.json, without the entries that are about a run:

    - images: number of training frames.
    - test (if there are test views), all, held_out: number of views ("count") and the mean of each
      of METRICS, and of each of SURFACE_METRICS that the data has a truth for; None if no view has
      it.
    - views, test_views: for each view its "name", "trained" (bool) and its metrics, None if there
      is no pixel to measure, as in an empty mask.

    Raises InputError if a file of a frame cannot be read or a picture cannot be written."""
    trained = set(trained)
    work = [(frame, pictures) for frame in frames]
    work += [(frame, pictures and pictures / TEST_FOLDER) for frame in test_frames]
    largest = max((frame.camera.width * frame.camera.height for frame, _ in work), default=1)
    at_once = max(1, min(MEASURED_AT_ONCE, PIXELS_AT_ONCE // largest))
    renders = ((view, renderer(gaussians, view[0].camera)) for view in work)
    views: list[dict[str, Any]] = []
    for (frame, _), metrics in zip(work, _compared(renders, _measured, at_once), strict=True):
        in_training = len(views) < len(frames) and frame.name in trained
        views.append({"name": frame.name, "trained": in_training} | metrics)
        report("rendering and comparing", len(views), len(work))
    views, tests = views[: len(frames)], views[len(frames) :]
    result: dict[str, Any] = {"images": len(trained)}
    if tests:
        result["test"] = _means(tests, tests)
    result["all"] = _means(views, views)
    result["held_out"] = _means([view for view in views if not view["trained"]], views)
    result["views"] = [_without_nan(view) for view in views]
    if tests:
        result["test_views"] = [_without_nan(view) for view in tests]
    return result


def _measured(
    view: tuple[Frame, Path | None], rgb: np.ndarray, alpha: np.ndarray, depth: np.ndarray
) -> dict[str, float]:
    frame, folder = view
    (truth, weight), mask = frame.target(), frame.mask()
    true_depth = frame.depth() if frame.depth_path else None
    shares = frame.rock_path is not None
    metrics, surface = compare(truth, rgb, mask, weight), (truth, alpha, depth, mask, weight)
    metrics |= compare_surface(*surface, fractional=shares, true_depth=true_depth)
    if folder is not None:
        write_comparison(folder / f"{frame.name}.png", truth[..., :3], rgb, metrics["psnr"])
    return metrics


def _means(views: list[dict[str, Any]], whole: list[dict[str, Any]]) -> dict[str, Any]:
    """Number of views, and the mean of each metric over those that have it, else None."""
    surface = [name for name in SURFACE_METRICS if any(name in view for view in whole)]
    means: dict[str, Any] = {"count": len(views)}
    for name in (*METRICS, *surface):
        values = [view[name] for view in views if not math.isnan(view.get(name, math.nan))]
        means[name] = sum(values) / len(values) if values else None
    return means


def _without_nan(view: dict[str, Any]) -> dict[str, Any]:
    absent = [key for key, value in view.items() if isinstance(value, float) and math.isnan(value)]
    return view | dict.fromkeys(absent)


def write_comparison(
    path: str | Path, truth: np.ndarray, rendered: np.ndarray, decibels: float
) -> None:
    """Write one PNG with three panels side by side: truth, render, and their absolute difference,
    brightened. A strip above holds their captions.

    truth, rendered: [H,W,3] linear RGB; decibels: the PSNR. Raises InputError if the file cannot be
    written."""
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
        picture.save(temporary, format="PNG", compress_level=PNG_LEVEL)
