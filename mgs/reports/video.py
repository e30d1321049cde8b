"""Pictures of a model through given cameras, and films of a run: a turntable, in a whole scene a
flight among the cameras, or the story of the run, the model after each view."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter1d

from mgs.camera import Camera, look_at
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data.dataset import Dataset
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.files import atomic_path
from mgs.gaussians import Gaussians
from mgs.images import write_exr, write_png
from mgs.learning import learn
from mgs.metrics import psnr
from mgs.plotting import NO_GRID, crop, literal, new_figure, painted, styled
from mgs.policy import criteria
from mgs.policy.tour import flying_order, legs
from mgs.progress import report
from mgs.reports.diagnostics import VISIBLE, picture, run_scalars, show_map, view_maps
from mgs.reports.figures import NEWEST, draw_cameras
from mgs.run.folder import Run
from mgs.run.nbv import scene_of
from mgs.scene import Scene, State

Film = Iterator[np.ndarray]  # frames, sRGB uint8 [H,W,3], all of one size

FORMATS = (".mp4", ".gif", ".png")  # endings of films; .png is an animated PNG
GAP = 4  # pixels between two pictures of a frame
UNKNOWN = "cividis"  # colour map of what is unknown: blue is known, yellow unknown


def camera_path(dataset: Dataset, means: np.ndarray, count: int, width: int) -> list[Camera]:
    """Cameras of a turntable, at equal angles.

    means: [N,3] of the Gaussians. count: of cameras. width: of their images, pixels."""
    first = dataset.frames[0].camera
    centre = np.median(means, axis=0)
    eyes = np.array([frame.camera.position for frame in dataset.frames])
    away = eyes - centre
    distances = np.linalg.norm(away, axis=1)
    distance = float(np.median(distances))
    elevation = np.median(np.arcsin(np.clip(away[:, 2] / distances, -1, 1)))
    angle = np.arctan2(away[0, 1], away[0, 0]) + 2 * np.pi * np.arange(count) / count
    flat, rise = distance * np.cos(elevation), np.full(count, distance * np.sin(elevation))
    places = np.column_stack([flat * np.cos(angle), flat * np.sin(angle), rise]) + centre
    return [replace(_even(first, width), world_to_camera=look_at(eye, centre)) for eye in places]


def path_among(cameras: Sequence[Camera], count: int, width: int) -> list[Camera]:
    """Cameras on a smooth closed path through given ones, at equal distances. count: of cameras.
    width: of their images, pixels."""
    eyes = np.stack([camera.position for camera in cameras])
    order = flying_order(legs(eyes, eyes[0, :2]), 0, range(1, len(eyes)), 0)
    tour = [0, *order, 0]
    turns = np.stack([cameras[k].camera_to_world[:3, 1:].T.ravel() for k in tour])  # down, ahead
    along = np.cumsum([0, *np.linalg.norm(np.diff(eyes[tour], axis=0), axis=1)])
    at = np.linspace(0, along[-1], count, endpoint=False)
    path = np.column_stack([np.interp(at, along, column) for column in turns.T])
    path = gaussian_filter1d(path, count / len(tour) / 2, axis=0, mode="wrap")
    poses = [look_at(eye, eye + ahead, -down) for down, ahead, eye in path.reshape(-1, 3, 3)]
    return [replace(_even(cameras[0], width), world_to_camera=pose) for pose in poses]


def _even(camera: Camera, width: int) -> Camera:
    """The camera with an even width and height, as encoders need."""
    shape = camera.resized(width + width % 2)
    return replace(shape, height=shape.height + shape.height % 2)


def path_frames(run: Run, beside: str | None, count: int, width: int) -> Film:
    """Frames of a turntable, or of a whole scene among its cameras; with beside="uncertainty", the
    map of what is unknown to the right."""
    model = run.gaussians[run.shown]
    scalars = {"uncertainty": run_scalars(run)["uncertainty"][run.shown]} if beside else {}
    path = camera_path(run.dataset, model.means, count, width)
    if run.of_scene:
        path = path_among([frame.camera for frame in run.taken], count, width)
    for camera in path:
        maps = view_maps(model, camera, scalars)
        pictures = [picture(maps)]
        if beside:
            unknown = painted(maps["uncertainty"], UNKNOWN) / np.float32(255)
            pictures.append(np.where(maps["A"][..., None] >= VISIBLE, unknown, 0))
        yield _side_by_side(*pictures)


def _side_by_side(*pictures: np.ndarray) -> np.ndarray:
    gap = np.ones((pictures[0].shape[0], GAP, 3), np.float32)
    parts = [part for picture in pictures for part in (gap, picture)][1:]
    frame = np.concatenate(parts, axis=1)
    return np.round(frame[: frame.shape[0] // 2 * 2] * 255).astype(np.uint8)


def write_film(
    path: str | Path,
    frames: Film,
    seconds: Sequence[float],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write a film as MP4 (H.264), GIF or animated PNG, by its ending; the file appears complete.

    seconds: of each frame; an MP4 shows all as long as the first. Raises InputError for another
    ending, if imageio-ffmpeg is missing for an MP4, and as `mgs.files.atomic_path`."""
    check_film(path)
    kind = Path(path).suffix.lower()
    shown = _reported(frames, len(seconds), progress)
    with atomic_path(path) as temporary:
        if kind == ".mp4":
            _write_mp4(temporary, shown, len(seconds), 1 / seconds[0])
        else:
            _write_animation(temporary, shown, seconds, kind == ".gif")


def check_film(path: str | Path) -> None:
    if Path(path).suffix.lower() not in FORMATS:
        raise InputError(f"{path}: films are written as {', '.join(FORMATS)}; choose one of them")
    if Path(path).suffix.lower() == ".mp4":
        _ffmpeg()


def _reported(frames: Film, count: int, progress: Callable[[int, int], None]) -> Film:
    for done, frame in enumerate(frames):
        progress(done, count)
        yield frame
    progress(count, count)


def _ffmpeg() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError:
        cure = "`pip install imageio-ffmpeg`, or write a .gif"
        raise InputError(f"mgs video: MP4 needs imageio-ffmpeg; {cure}") from None
    return imageio_ffmpeg


def _write_mp4(path: Path, frames: Film, count: int, rate: float) -> None:
    """Raises OSError if not all frames are in the file, which ffmpeg does not report."""
    first, ffmpeg = next(frames), _ffmpeg()
    size, options = first.shape[1::-1], {"codec": "libx264", "macro_block_size": 2, "quality": 7}
    writer = ffmpeg.write_frames(str(path), size, fps=rate, **options)
    writer.send(None)
    for frame in (first, *frames):
        writer.send(np.ascontiguousarray(frame))
    writer.close()
    written = 0
    with suppress(RuntimeError):  # no whole file
        written, _ = ffmpeg.count_frames_and_secs(str(path))
    if written != count:
        raise OSError(f"only {written} of {count} frames could be written")


def _write_animation(path: Path, frames: Film, seconds: Sequence[float], gif: bool) -> None:
    pictures = [Image.fromarray(frame) for frame in frames]
    if gif:
        pictures = [picture.quantize(256, Image.Quantize.MAXCOVERAGE) for picture in pictures]
    options: dict[str, Any] = {"save_all": True, "append_images": pictures[1:], "loop": 0}
    options["duration"] = [round(1000 * each) for each in seconds[: len(pictures)]]
    pictures[0].save(path, format="GIF" if gif else "PNG", optimize=True, **options)


SIZE = (8.4, 3.1)  # width and height of a frame, inches

DPI = 110


def models(run: Run, scene: Scene) -> Iterator[State]:
    """Fit the run's views again, one more each time; yield every model."""
    taken, seeds = run.state.taken, run.settings.seeds
    before: State | None = None
    for count in range(1, len(taken) + 1):
        before = learn(scene, taken[:count], before if count > seeds else None)
        yield before


def story_frames(run: Run) -> Film:
    """Frames of the story, one for each view taken: the cameras from above, the render of one view,
    and the share of the variance that is left in it. The view is the brightest of those that the
    first image leaves more unknown than most, among test views, views never taken, or all. Raises
    InputError as `models`, and if an image cannot be read."""
    scene, view = scene_of(run), None
    for model in models(run, scene):
        unknown = {"uncertainty": criteria.uncertainty(model.H, scene.lam)}
        view = view or _shown_view(run, model, unknown)
        maps = view_maps(model.gaussians, view.camera, unknown)
        yield _drawn(run, model, maps, view)


def _shown_view(run: Run, model: State, unknown: dict[str, np.ndarray]) -> Frame:
    tests, taken = run.dataset.test_views(), run.taken
    there = tests.frames if tests else run.dataset.with_images([frame.name for frame in taken])
    choice = [frame for frame in there if frame not in taken] or taken
    shares = [_left(view_maps(model.gaussians, frame.camera, unknown)) for frame in choice]
    least_known = [f for f, mean in zip(choice, shares, strict=True) if mean >= np.median(shares)]
    return max(least_known, key=lambda frame: srgb_from_linear(frame.masked_rgb()).mean())


def _left(maps: dict[str, np.ndarray]) -> float:
    """Mean share of the variance that is left, over the pixels that show the model; 0 without."""
    shown = maps["uncertainty"][maps["A"] >= VISIBLE]
    return float(shown.mean()) if len(shown) else 0.0


def _drawn(run: Run, model: State, maps: dict[str, np.ndarray], view: Frame) -> np.ndarray:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    truth = srgb_from_linear(view.masked_rgb())
    rgb = picture(maps)
    window = crop(truth.max(axis=2) > 0)
    count, seeds = len(model.taken), run.settings.seeds
    why = f"one of {seeds} to begin with" if count <= seeds else f"chosen by {run.label}"
    title = f"image {count} of {len(run.state.taken)}: {why}"
    with styled(NO_GRID | {"font.size": 11}):
        figure = new_figure(*SIZE, dpi=DPI)
        orbit, render, map_ = figure.subplots(1, 3, width_ratios=(1, 1, 1))
        figure.suptitle(literal(title), fontsize=14, color=NEWEST)
        eyes = np.array([frame.camera.position for frame in run.dataset.frames])
        views = model.taken[:seeds], model.taken[seeds:]
        draw_cameras(orbit, eyes, model.gaussians.means, *views, model.taken[-1])
        orbit.set_xlabel("cameras, from above")
        render.imshow(rgb[window], interpolation="nearest")
        which = "one view" if view in run.taken else "a new view"
        render.set_xlabel(f"render of {which}: {psnr(rgb, truth):.1f} dB")
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


def draw_views(
    out: Path,
    gaussians: Gaussians,
    views: Sequence[tuple[str, Camera]],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    exr: bool = False,
) -> None:
    """Draw a model through every camera; write one PNG for each into the folder `out`.

    views: (path of the view's image, camera); a picture takes the name of the image (`file_names`).
    background: sRGB in [0,1]. exr: write an OpenEXR file too, with linear R G B over the
    background, opacity A and expected z-depth Z in metres, 0 where nothing is drawn. Raises
    InputError as `mgs.splat.render`, and if a file cannot be written."""
    from mgs.splat import as_drjit, render

    model, linear = as_drjit(gaussians), gaussians.linear
    behind = linear_from_srgb(background) if linear else np.asarray(background, np.float32)
    names = file_names([path for path, _ in views])
    for done, (name, (_, camera)) in enumerate(zip(names, views, strict=True)):
        report("rendering", done, len(views))
        image = render(model, camera, behind.tolist())
        rgb = np.asarray(image.rgb)
        write_png(out / f"{name}.png", rgb, linear=linear)
        if exr:
            r, g, b = np.moveaxis(rgb if linear else linear_from_srgb(rgb), -1, 0)
            alpha, depth = np.asarray(image.alpha), np.asarray(image.depth)
            channels = {"R": r, "G": g, "B": b, "A": alpha, "Z": depth}
            write_exr(out / f"{name}.exr", channels, camera)


def file_names(paths: Sequence[str]) -> list[str]:
    """File names without suffix for image paths; numbered if some are equal."""
    stems = [Path(path).stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    return [f"{i:04d}_{stem}" for i, stem in enumerate(stems)]
