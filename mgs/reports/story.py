"""The story of a run: the model after each view. Fits are repeated: a run keeps the last model."""

from collections.abc import Iterator

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.data.frames import Frame
from mgs.learning import learn
from mgs.metrics import psnr
from mgs.plotting import NO_GRID, crop, new_figure
from mgs.policy import criteria
from mgs.progress import Progress, listening
from mgs.reports.diagnostics import VISIBLE, picture, show_map, view_maps
from mgs.reports.figures import NEWEST, draw_cameras
from mgs.reports.video import UNKNOWN, Film
from mgs.run.folder import Run
from mgs.run.nbv import scene_of
from mgs.scene import Scene, State

SIZE = (8.4, 3.1)  # width and height of a frame, inches

DPI = 110


def models(run: Run, scene: Scene) -> Iterator[State]:
    """Fit the run's views again, one more each time; yield every model."""
    taken, seeds = run.state.taken, run.settings.seeds
    before: State | None = None
    for count in range(1, len(taken) + 1):
        before = learn(scene, taken[:count], before if count > seeds else None)
        yield before


def story_frames(run: Run, progress: Progress) -> Film:
    """Frames of the story, one for each view taken: the cameras from above, the render of one view,
    and the share of the variance that is left in it. The view is the brightest of those that the
    first image leaves more unknown than most, among test views, views never taken, or all. Raises
    InputError as `models`, and if an image cannot be read."""
    scene, view = scene_of(run), None
    with listening(progress):
        for model in models(run, scene):
            unknown = {"uncertainty": criteria.uncertainty(model.H, scene.lam)}
            view = view or _shown_view(run, model, unknown)
            maps = view_maps(model.gaussians, view.camera, unknown)
            yield _drawn(run, model, maps, view)


def _shown_view(run: Run, model: State, unknown: dict[str, np.ndarray]) -> Frame:
    tests, frames = run.dataset.test_views(), run.dataset.frames
    new = [frame for i, frame in enumerate(frames) if i not in run.state.taken]
    others = tests.frames if tests is not None else run.dataset.with_images({f.name for f in new})
    choice = list(others or run.taken)
    shares = [_left(view_maps(model.gaussians, frame.camera, unknown)) for frame in choice]
    least_known = [f for f, mean in zip(choice, shares, strict=True) if mean >= np.median(shares)]
    return max(least_known, key=lambda frame: srgb_from_linear(frame.masked_rgb()).mean())


def _left(maps: dict[str, np.ndarray]) -> float:
    """Mean share of the variance that is left, over the pixels that show the model."""
    return float(maps["uncertainty"][maps["A"] >= VISIBLE].mean())


def _drawn(run: Run, model: State, maps: dict[str, np.ndarray], view: Frame) -> np.ndarray:
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    truth = srgb_from_linear(view.masked_rgb())
    rgb = picture(maps)
    window = crop(truth.max(axis=2) > 0)
    count, seeds = len(model.taken), run.settings.seeds
    why = f"one of {seeds} to begin with" if count <= seeds else f"chosen by {run.label}"
    title = f"image {count} of {len(run.state.taken)}: {why}"
    with matplotlib.rc_context(NO_GRID | {"font.size": 11}):
        figure = new_figure(*SIZE, dpi=DPI)
        orbit, render, map_ = figure.subplots(1, 3, width_ratios=(1, 1, 1))
        figure.suptitle(title, fontsize=14, color=NEWEST)
        eyes = np.array([frame.camera.position for frame in run.dataset.frames])
        views = model.taken[:seeds], model.taken[seeds:]
        draw_cameras(orbit, eyes, model.gaussians.means, *views, model.taken[-1])
        orbit.set_xlabel("cameras, from above")
        render.imshow(rgb[window], interpolation="nearest")
        render.set_xlabel(f"render of a new view: {psnr(rgb, truth):.1f} dB")
        image = show_map(map_, maps, "uncertainty", window, UNKNOWN, vmin=0, vmax=1)
        map_.set_axis_on()
        map_.set_xlabel(f"still unknown: {100 * _left(maps):.0f} %")
        bar = figure.colorbar(image, ax=map_, shrink=0.7, aspect=14)
        bar.set_ticks([0, 1], labels=["known", "unknown"])
        for axis in (render, map_):
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    return np.ascontiguousarray(pixels[: pixels.shape[0] // 2 * 2, : pixels.shape[1] // 2 * 2])
