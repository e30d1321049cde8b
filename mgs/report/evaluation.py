"""Quality of a model: its renders against the images of a dataset, as numbers (`mgs.metrics`) and
pictures.

The truth is `Frame.target`: the rock in front of black, which the model was trained on. PSNR and
SSIM compare sRGB values in [0,1]. Over the full frame they flatter, because any model gets the
black right; those inside the mask are over the rock's pixels only.

Views come in three sets: all views of the dataset; held-out views, which are those the model was
never trained on; and the test views (`Dataset.test_views`), the same for every model.
"""

from __future__ import annotations

import gc
import json
import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data.dataset import TEST_FOLDER, Dataset, load_dataset
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.files import atomic_path, working_in, write_json
from mgs.gaussians import ARRAYS, Gaussians
from mgs.images import PNG_LEVEL, read_png
from mgs.memory import KEPT_BYTES, release
from mgs.metrics import METRICS, SURFACE_METRICS, compare, compare_surface
from mgs.provenance import versions
from mgs.report.runs import read_metrics
from mgs.run.folder import Run, holds_run, open_run, read_config
from mgs.run.inputs import array_digest, camera_digest, frame_digests
from mgs.splat_ply import read_ply

Renderer = Callable[[Gaussians, Camera], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""(gaussians, camera) -> linear RGB [H,W,3], alpha [H,W], expected z-depth [H,W] in metres."""

Progress = Callable[[int, int], None]
"""Called as progress(views done, all)."""

MEASURED_AT_ONCE = 4
"""Most views that are measured at the same time, each in a thread."""

PIXELS_AT_ONCE = 4_000_000
"""Most pixels of all of these, which bounds the memory; a larger view is measured alone."""

DIFFERENCE_GAIN = 4
"""Factor by which differences are brightened in the pictures."""


def no_progress(done: int, total: int) -> None:
    """Default callback: does nothing."""


def render_view(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render on black: linear RGB [H,W,3], alpha [H,W], expected z-depth [H,W] in metres."""
    from mgs.splat import render

    image = render(gaussians, camera)
    rgb = np.asarray(image.rgb)
    linear = rgb if gaussians.linear else linear_from_srgb(np.clip(rgb, 0, 1))
    return linear, np.asarray(image.alpha), np.asarray(image.depth)


def evaluate_model(
    gaussians: Gaussians,
    frames: Sequence[Frame],
    trained: Iterable[str],
    *,
    test_frames: Sequence[Frame] = (),
    renderer: Renderer = render_view,
    pictures: Path | None = None,
    progress: Progress = no_progress,
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

    Raises InputError if a file of a frame cannot be read or a picture cannot be written.
    """
    trained = set(trained)
    views: list[dict[str, Any]] = []
    tests: list[dict[str, Any]] = []
    work = [(views, frame, pictures) for frame in frames]
    work += [(tests, frame, pictures and pictures / TEST_FOLDER) for frame in test_frames]
    largest = max((frame.camera.width * frame.camera.height for _, frame, _ in work), default=1)
    at_once = max(1, min(MEASURED_AT_ONCE, PIXELS_AT_ONCE // largest))
    waiting: deque[Any] = deque()

    def finish_first() -> None:
        found, frame, future = waiting.popleft()
        known = found is views and frame.name in trained
        found.append({"name": frame.name, "trained": known} | future.result())
        progress(len(views) + len(tests), len(work))

    progress(0, len(work))
    # Filters take most of the time, and run beside other threads.
    with ThreadPoolExecutor(at_once) as pool:
        for found, frame, folder in work:
            if len(waiting) == at_once:
                finish_first()
            # Copies: memory of Dr.Jit must not be freed by another thread. That thread would wait
            # for a lock of Dr.Jit while it holds Python's, and this one the other way round.
            drawn = tuple(map(np.array, renderer(gaussians, frame.camera)))
            waiting.append((found, frame, pool.submit(_measured, frame, drawn, folder)))
        while waiting:
            finish_first()
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
    frame: Frame, rendered: tuple[np.ndarray, ...], folder: Path | None
) -> dict[str, float]:
    """METRICS and SURFACE_METRICS of one view; writes its picture into the folder."""
    (truth, weight), mask, (rgb, alpha, depth) = frame.target(), frame.mask(), rendered
    true_depth = frame.depth() if frame.depth_path else None
    shares = frame.rock_path is not None
    found = compare(truth, rgb, mask, weight)
    found |= compare_surface(
        truth, alpha, depth, mask, weight, fractional=shares, true_depth=true_depth
    )
    if folder is not None:
        write_comparison(folder / f"{frame.name}.png", truth[..., :3], rgb, found["psnr"])
    return found


def _means(views: list[dict[str, Any]], whole: list[dict[str, Any]]) -> dict[str, Any]:
    """Number of views, and the mean of each metric over the views that have it, None without such a
    view. whole: the set of the views; SURFACE_METRICS that none of it has are left out."""
    surface = [name for name in SURFACE_METRICS if any(name in view for view in whole)]
    means: dict[str, Any] = {"count": len(views)}
    for name in (*METRICS, *surface):
        values = [view[name] for view in views if not math.isnan(view.get(name, math.nan))]
        means[name] = sum(values) / len(values) if values else None
    return means


def _without_nan(view: dict[str, Any]) -> dict[str, Any]:
    """A view's numbers with None in place of NaN, which JSON cannot hold."""
    return {
        key: None if isinstance(value, float) and math.isnan(value) else value
        for key, value in view.items()
    }


def write_comparison(
    path: str | Path, truth: np.ndarray, rendered: np.ndarray, decibels: float
) -> None:
    """Write one PNG with three panels side by side: truth, render, and their absolute difference,
    brightened. A strip above holds their captions.

    truth, rendered: [H,W,3] linear RGB; decibels: the PSNR. Raises InputError if the file cannot be
    written.
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
        picture.save(temporary, format="PNG", compress_level=PNG_LEVEL)


def read_comparison(path: str | Path, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Read truth and render, linear RGB [H,W,3], rounded to 8 bits, out of a picture of
    `write_comparison`.

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
    run: str | Path | Run,
    *,
    pictures: bool = True,
    convergence: bool = False,
    progress: Progress = no_progress,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Evaluate a run of `mgs nbv` on its dataset and its test views; write RUN/metrics.json and,
    with `pictures`, RUN/renders. Returns the contents of metrics.json.

    - run: folder or opened run.
    - convergence: also estimate how far the loss of the last fit is above its minimum (entry "fit":
      `mgs.report.convergence.remaining_decrease`).
    - say: called with lines for the user: files written and kept.

    Metrics and pictures of the same model, dataset and version of mgs are kept, not made again. In
    an on-demand dataset only frames that the run has taken have an image, so none is held out.
    Raises InputError as `open_run`, if the test views cannot be read, and if another process works
    on the run.
    """
    from mgs.splat import as_drjit

    run = run if isinstance(run, Run) else open_run(run)
    gc.collect()  # images and lists of the run itself, if it ended in this process
    release(KEPT_BYTES)
    file, folder = run.folder / "metrics.json", run.folder / "renders"
    with working_in(run.folder):
        gaussians, dataset = run.state.gaussians, run.dataset
        trained = [frame.name for frame in run.taken]
        frames, tests = dataset.with_images(trained), dataset.test_views()
        test_frames = () if tests is None else tests.frames
        subject = _subject(gaussians, [*frames, *test_frames], trained)
        metrics = _measured_before(file, subject)
        if metrics is None:
            found = evaluate_model(
                as_drjit(gaussians),
                frames,
                trained,
                test_frames=test_frames,
                pictures=folder if pictures else None,
                progress=progress,
            )
            about = {"policy": run.label, "of": subject, "pictures": pictures}
            fit = _fit(run, progress) if convergence else {}
            metrics = about | fit | {"informed": _informed(run)} | found
            write_json(file, metrics)
            say(f"wrote {file}" + (f" and {folder}" if pictures else ""))
            return metrics
        kept = f"kept {file}, measured before on this very model and dataset"
        if convergence and "fit" not in metrics:
            metrics |= _fit(run, progress)
            write_json(file, metrics)
        paths = {folder / f"{frame.name}.png": frame for frame in frames}
        paths |= {folder / TEST_FOLDER / f"{frame.name}.png": frame for frame in test_frames}
        if not pictures:
            say(kept)
        elif metrics.get("pictures") and all(path.is_file() for path in paths):
            say(f"{kept}, and {folder}")
        else:
            views = [*metrics["views"], *metrics.get("test_views", [])]
            for done, ((path, frame), view) in enumerate(zip(paths.items(), views, strict=True)):
                progress(done, len(paths))
                rgb = render_view(gaussians, frame.camera)[0]
                write_comparison(path, frame.masked_rgb(), rgb, view["psnr"])
            metrics = metrics | {"pictures": True}
            write_json(file, metrics)
            say(f"{kept}; wrote {folder}")
        return metrics


def _fit(run: Run, progress: Progress) -> dict[str, Any]:
    """Entry "fit" of metrics.json. Raises InputError if the prior is gone or is not the run's."""
    from mgs.report.convergence import remaining_decrease

    given = run.state.gaussians, run.settings, run.prior, run.taken, run.dataset.cameras
    return {"fit": remaining_decrease(*given, progress)}


def _informed(run: Run) -> dict[str, dict[str, int]]:
    """Number of parameters by kind ("of"), and number of those about which the views say more than
    the prior ("informed", H > lambda)."""
    from mgs.splat import groups

    state, settings = run.state, run.settings
    columns = groups(state.gaussians.sh_degree, settings.train.means)
    more = settings.regularisation(columns) < state.H
    return {
        kind: {"of": int(more[:, of].size), "informed": int(more[:, of].sum())}
        for kind, of in columns.items()
    }


def _subject(gaussians: Gaussians, frames: Sequence[Frame], trained: list[str]) -> str:
    """Hash of all that the metrics of a run depend on."""
    kinds = ("image", "mask", "rock", "depth")
    views = [
        [frame.name, camera_digest(frame.camera), frame_digests(frame, kinds)] for frame in frames
    ]
    known = {name: version for name, version in versions().items() if name != "commit"}
    model = array_digest(getattr(gaussians, name) for name in ARRAYS), gaussians.antialiased
    text = json.dumps([*model, views, trained, known])
    return array_digest([np.frombuffer(text.encode(), np.uint8)])


def _measured_before(file: Path, subject: str) -> dict[str, Any] | None:
    """Contents of metrics.json if it exists and is of this subject."""
    try:
        metrics = read_metrics(file.parent)
    except InputError:
        return None
    return metrics if metrics is not None and metrics.get("of") == subject else None


def compare_models(models: Sequence[Gaussians], run: Run) -> tuple[str, list[float] | None]:
    """Mean PSNR of each model, dB, full frame, on views that a run did not train on.

    Returns the name of the set, "test" if the dataset has test views, else "held-out", and the
    means, None if there is no such view.
    """
    tests, taken = run.dataset.test_views(), [frame.name for frame in run.taken]
    name, frames = "test", tests.frames if tests else ()
    if not tests:
        name = "held-out"
        frames = tuple(f for f in run.dataset.with_images(taken) if f.name not in taken)
    if not frames:
        return name, None
    return name, [float(evaluate_model(model, frames, ())["all"]["psnr"]) for model in models]


def evaluate(
    subject: str | Path | Run | Gaussians,
    dataset: str | Path | Dataset | None = None,
    *,
    trained: Iterable[str] = (),
    progress: Progress = no_progress,
    **options: Any,
) -> dict[str, Any]:
    """Measure PSNR and SSIM of a run or a model; return the contents of metrics.json.

    - subject: a run or its folder, measured by `evaluate_run` with its options; or Gaussians, or a
      PLY file, whose metrics are written beside it as NAME.metrics.json.
    - dataset: of Gaussians or a PLY. Default for a PLY in a run folder: the run's.
    - trained: names of the frames that the model was trained on. Default for a PLY in a run folder,
      on the run's dataset: the views taken.

    Raises InputError as `evaluate_run`, `read_ply` and `load_dataset`, if a model comes without a
    dataset, if trained names no frame of it, and if dataset or trained are given for a run.
    """
    if isinstance(subject, Run) or (not isinstance(subject, Gaussians) and Path(subject).is_dir()):
        if dataset is not None or trained:
            raise InputError(
                f"{subject}: is a run, with its own dataset; leave out dataset and trained"
            )
        return evaluate_run(subject, progress=progress, **options)
    path = None
    if not isinstance(subject, Gaussians):
        path = Path(subject)
        if not path.exists():
            raise InputError(f"{path}: no such run folder or PLY file")
        subject = read_ply(path)
        if holds_run(path.parent):
            root = dataset.root if isinstance(dataset, Dataset) else dataset
            of_run = Path(read_config(path.parent)["settings"]["dataset"])
            if root is None or Path(root).resolve() == of_run:
                run = open_run(path.parent)
                dataset = run.dataset
                trained = list(trained) or [frame.name for frame in run.taken]
    if dataset is None:
        raise InputError(f"{path or 'the model'}: is in no run folder; give its --dataset")
    views = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    names, tests = list(trained), views.test_views()
    if unknown := sorted(set(names) - {frame.name for frame in views.frames}):
        raise InputError(f"{views.root}: has no frame {unknown[0]}, which `trained` names")
    metrics = evaluate_model(
        subject,
        views.with_images(names),
        names,
        test_frames=tests.frames if tests else (),
        progress=progress,
    )
    if path is not None:
        write_json(path.with_suffix(".metrics.json"), metrics)
    return metrics
