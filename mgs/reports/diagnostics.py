"""Maps of what the training views of a run say about its model (docs/evaluation.md), in views (EXR,
PNG) and of Gaussians (PLY). A map of a scalar is its mean in each pixel by blending weights."""

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.evaluation import render_view
from mgs.files import write_columns
from mgs.gaussians import Gaussians, sh_from_rgb
from mgs.images import write_exr
from mgs.policy import criteria
from mgs.progress import report
from mgs.run.folder import Run, open_run

VIEWS = 3  # number of views that are drawn if none are named
VISIBLE = 0.5  # least opacity at which a pixel is drawn, else background
DECADES = 4  # largest range of the logarithmic colour scales, in powers of ten


def run_scalars(run: Run) -> dict[str, np.ndarray]:
    """Scalars of the model of a run (docs/evaluation.md), name -> [N]. H is about the fitted model,
    by the run's estimator. `unobserved` is of the Gaussians before training; a density control may
    have changed these, and then each has that of the nearest."""
    from mgs.splat import groups

    H, settings, degree = run.state.H, run.settings, run.state.gaussians.sh_degree
    columns = groups(degree, settings.train.means)
    lam = settings.regularisation(columns)
    scalars = {
        f"fisher.{name}": H[:, of].sum(axis=1, dtype=np.float64) for name, of in columns.items()
    }
    scalars["information"] = 0.5 * np.log1p(H / lam).sum(axis=1)
    scalars["uncertainty"] = criteria.uncertainty(H, lam)
    surface_lam = settings.regularisation(groups(degree), surface=True)
    unseen = ~criteria.observed(run.state.surface, surface_lam)
    scalars["unobserved"] = np.zeros(len(H))
    if settings.train.density == "fixed":
        scalars["unobserved"][: len(unseen)] = unseen
    else:  # they are no longer those before training
        near = cKDTree(run.prior.points).query(run.state.gaussians.means)[1]
        scalars["unobserved"][:] = unseen[near]
    return scalars


def view_maps(
    gaussians: Gaussians, camera: Camera, scalars: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Channels of one view, name -> float32 [H,W]: R G B (linear colour on black), A (opacity), Z
    (expected z-depth, metres) and a map of each scalar.

    scalars: name -> [N]. They are drawn in place of the colours, three at a time. The map of
    `unobserved` is 1 where unobserved Gaussians have more than half of the weight, else 0."""
    from mgs.splat import ListCache, render

    cache = ListCache()
    rgb, alpha, depth = render_view(gaussians, camera, cache)
    maps = {channel: rgb[..., i] for i, channel in enumerate("RGB")}
    maps |= {"A": alpha, "Z": depth}
    names, weight = list(scalars), np.where(alpha > 0, alpha, 1.0)
    for first in range(0, len(names), 3):
        three = names[first : first + 3]
        # Divided by the largest value: float32 is precise for colours of about 1.
        largest = [max(float(scalars[name].max(initial=0)), 1e-30) for name in three]
        values = np.zeros((len(gaussians), 3))
        for i, name in enumerate(three):
            values[:, i] = scalars[name] / largest[i]
        coloured = replace(gaussians, sh=sh_from_rgb(values))
        mean = np.asarray(render(coloured, camera, cache=cache).rgb) / weight[..., None]
        for i, name in enumerate(three):
            maps[name] = (mean[..., i] * largest[i]).astype(np.float32)
    if "unobserved" in maps:
        maps["unobserved"] = (maps["unobserved"] > 0.5).astype(np.float32)
    return maps


def picture(maps: dict[str, np.ndarray]) -> np.ndarray:
    """Render of `view_maps` [H,W,3], sRGB in 0 to 1."""
    return srgb_from_linear(np.stack([maps[channel] for channel in "RGB"], axis=-1))


def write_information_ply(
    path: str | Path, gaussians: Gaussians, scalars: dict[str, np.ndarray]
) -> None:
    """Write a PLY with a vertex for each Gaussian, for MeshLab or CloudCompare: x y z, red green
    blue, and every scalar.

    Colours show the information, from 0 to its largest value (colour map viridis). Dots in names
    become underscores. scalars: name -> [N]. Raises InputError if the file cannot be written."""
    import matplotlib

    information = scalars["information"]
    share = information / max(float(information.max(initial=0)), 1e-30)
    rgb = matplotlib.colormaps["viridis"](share, bytes=True)
    columns = {axis: (gaussians.means[:, i], "f4") for i, axis in enumerate("xyz")}
    columns |= {name: (rgb[:, i], "u1") for i, name in enumerate(("red", "green", "blue"))}
    columns |= {name.replace(".", "_"): (values, "f4") for name, values in scalars.items()}
    write_columns(path, {"vertex": columns})


PANELS = {
    "Z": ("depth", "viridis"),
    "unobserved": ("unobserved", "cividis"),
    "fisher.colour": ("Fisher information, colour", "magma"),
    "fisher.scale": ("Fisher information, log-scale", "magma"),
    "fisher.rotation": ("Fisher information, quaternion", "magma"),
    "fisher.opacity": ("Fisher information, opacity logit", "magma"),
    "information": ("information gained (nats)", "viridis"),
    "uncertainty": ("posterior / prior variance", "cividis"),
}
"""Panels of a preview: channel -> title and colour map, which is perceptually uniform."""


def write_preview(
    path: str | Path, maps: dict[str, np.ndarray], title: str, unit: str = "m"
) -> None:
    """Write the preview of one view as a PNG: its render and the PANELS with colour bars, cropped
    to the model.

    maps: `view_maps` of all scalars; title: of the render; unit: name of a length of 1. Raises
    InputError if the file cannot be written."""
    from mgs.plotting import NO_GRID, crop, drawing, literal

    visible = maps["A"] >= VISIBLE
    window = crop(visible)
    height, width = visible[window].shape
    with drawing(path, 8.4, 3 * (2.3 * height / width + 0.35) + 0.4, NO_GRID, dpi=130) as figure:
        figure.suptitle("What the images taken determine")
        axes = figure.subplots(3, 3).flat
        axes[0].imshow(picture(maps)[window], interpolation="nearest")
        axes[0].set_title(literal(title))
        for axis, (channel, (label, name)) in zip(axes[1:], PANELS.items(), strict=True):
            norm = _norm(channel, maps[channel][visible])
            image = show_map(axis, maps, channel, window, name, norm=norm)
            axis.set_title(f"{label} ({unit})" if channel == "Z" else label)
            ticks = [0, 1] if channel == "unobserved" else None
            figure.colorbar(image, ax=axis, shrink=0.85, aspect=16, pad=0.02, ticks=ticks)
        axes[0].set_axis_off()


def show_map(
    axis: Any, maps: dict[str, np.ndarray], channel: str, window: Any, colours: str, **scale: Any
) -> Any:
    """Draw a channel of `view_maps` into axes without frame, grey where the opacity is below
    VISIBLE.

    window: rows and columns. colours: of a colour map. scale: `norm`, or `vmin` and `vmax`."""
    import matplotlib

    values = np.ma.masked_where(maps["A"] < VISIBLE, maps[channel])[window]
    axis.set_axis_off()
    grey = matplotlib.colormaps[colours].with_extremes(bad="#e8e8e8")
    return axis.imshow(values, cmap=grey, interpolation="nearest", **scale)


def _norm(channel: str, data: np.ndarray) -> Any:
    """Colour scale of a channel with visible values [M]."""
    from matplotlib.colors import LogNorm, Normalize

    if channel in ("uncertainty", "unobserved") or len(data) == 0:
        return Normalize(0, 1)
    high = float(np.quantile(data, 0.999))
    if not channel.startswith("fisher.") or high <= 0:
        return Normalize(float(data.min()), max(float(data.max()), float(data.min()) + 1e-9))
    low = max(float(np.quantile(data, 0.001)), high * 10.0**-DECADES)
    return LogNorm(min(low, high / 2), high, clip=True)


def choose_views(
    frames: Sequence[Frame], trained: Sequence[str], names: Sequence[str] | None
) -> list[Frame]:
    """The frames to draw: those of these names, or else VIEWS frames spread evenly over those
    not trained on.

    trained: names of the training frames; if these are all, the choice is among all frames. Raises
    InputError for a name that no frame has."""
    if names:
        by_name = {frame.name: frame for frame in frames}
        for name in names:
            if name not in by_name:
                span = f"{frames[0].name} to {frames[-1].name}"
                raise InputError(f"views {name}: no such frame; the dataset has {span}")
        return [by_name[name] for name in names]
    pool = [frame for frame in frames if frame.name not in trained] or list(frames)
    spread = np.linspace(0, len(pool), min(VIEWS, len(pool)), endpoint=False).astype(int)
    return [pool[i] for i in spread]


def diagnose(run: str | PathLike[str], views: Sequence[str] | None = None) -> list[Path]:
    """Write RUN/diagnostics: information.ply, and NAME.exr and NAME.png of each view. Returns the
    paths. views: names of frames (`choose_views`). Raises InputError for an unknown view, and as
    `open_run`."""
    opened = open_run(run)
    gaussians, trained = opened.state.gaussians, [frame.name for frame in opened.taken]
    frames = choose_views(opened.dataset.frames, trained, views)
    scalars, out = run_scalars(opened), opened.folder / "diagnostics"
    write_information_ply(out / "information.ply", opened.model, scalars)
    paths = [out / "information.ply"]
    for done, frame in enumerate(frames):
        report("mapping", done, len(frames))
        maps = view_maps(gaussians, frame.camera, scalars)
        title = f"{frame.name}, {'' if frame.name in trained else 'never '}trained on"
        if opened.settings.estimator != "exact":  # its numbers are not in the units of the panels
            title += f"; by {opened.settings.estimator}"
        files = [out / f"{frame.name}.exr", out / f"{frame.name}.png"]
        world = opened.dataset.world
        write_exr(files[0], maps, world.leave(frame.camera), world.unit)
        write_preview(files[1], maps, title, world.unit)
        paths += files
    return paths
