"""Maps of what the training views of a run say about its model, and where: for views (EXR, PNG) and
for Gaussians (PLY).

H [N,P] is the diagonal of the Fisher information, summed over the training views. lam [P] is the
information of the prior about each parameter (`mgs.policy.criteria.regularisation`). From these,
every Gaussian has the following numbers, its
*scalars*:

- `fisher.colour`, `fisher.scale`, `fisher.rotation`, `fisher.opacity`, and `fisher.mean` where the
run learns the means: the
  sum of H over its parameters of that kind, in (pixel value / parameter)^2. The preview has no
  panel of the last.
- `information`: 1/2 sum_k log(1 + H_k / lam_k) over its parameters k, in nats: what the training
views say about it. All kinds
  of parameters have the same unit here.
- `uncertainty`: the mean over its parameters of lam_k / (H_k + lam_k): the variance that is left
over the variance of the
  prior. 1 means that nothing is known, 0 that everything is.
- `unobserved`: 1 if no training view sees its place on the surface, otherwise 0, by the same rule
as the coverage of a run
  (`mgs.policy.criteria.observed`). The rule looks at the information about the colours of the
  Gaussians before training, because training hides some Gaussians behind others.

A map of a scalar v shows in each pixel the mean over the Gaussians that the pixel shows, with their
blending weights w: sum w v / sum w; 0 in pixels that show none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.dataset import Frame
from mgs.errors import InputError
from mgs.files import atomic_path
from mgs.gaussians import Gaussians, sh_from_rgb
from mgs.images import write_exr
from mgs.policy import criteria
from mgs.run import folder as run_folder

VIEWS = 3
"""Number of views that are drawn if none are named."""

VISIBLE = 0.5
"""Least opacity at which a pixel of a preview is drawn; with less it counts as background."""

DECADES = 4
"""Largest range of the logarithmic colour scales, in powers of ten."""


def gaussian_scalars(
    H: np.ndarray,
    surface: np.ndarray,
    lam: np.ndarray,
    prior_lam: np.ndarray,
    groups: dict[str, slice],
) -> dict[str, np.ndarray]:
    """The scalars that the module's docstring lists, name -> [N].

    H: [N,P] information of the training views about the fitted model, by the estimator of the run;
    surface: [S,P] their exact information about the Gaussians on the surface before training (both
    as in `mgs.run.folder.State`). lam: [P] the lambda that the run's criteria see; prior_lam: [P]
    information of the prior, which coverage is judged by. groups: columns of each kind of parameter
    (`mgs.splat.groups`).
    """
    scalars = {
        f"fisher.{name}": H[:, columns].sum(axis=1, dtype=np.float64)
        for name, columns in groups.items()
    }
    scalars["information"] = 0.5 * np.log1p(H / lam).sum(axis=1)
    scalars["uncertainty"] = criteria.uncertainty(H, lam)
    unseen = ~criteria.observed(surface, prior_lam)
    scalars["unobserved"] = np.zeros(len(H))
    scalars["unobserved"][: len(unseen)] = unseen
    return scalars


def view_maps(
    gaussians: Gaussians, camera: Camera, scalars: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The channels of one view, name -> float32 [H,W]: R G B (linear colour on black), A (opacity),
    Z (expected z-depth, metres) and a map of each scalar.

    scalars: name -> [N]. They are drawn in place of the colours of the Gaussians, three at a time.
    The map of `unobserved` is 1 where unobserved Gaussians have more than half of the weight,
    otherwise 0.
    """
    from mgs.splat import ListCache, render

    cache = ListCache()
    image = render(gaussians, camera, cache=cache)
    rgb, alpha = np.asarray(image.rgb), np.asarray(image.alpha)
    maps = {
        "R": rgb[..., 0],
        "G": rgb[..., 1],
        "B": rgb[..., 2],
        "A": alpha,
        "Z": np.asarray(image.depth),
    }
    names, shown = list(scalars), np.where(alpha > 0, alpha, 1.0)
    for first in range(0, len(names), 3):
        three = names[first : first + 3]
        # Divided by the largest value: float32 keeps its precision with colours of about 1,
        # whatever the unit of the scalar.
        largest = [max(float(scalars[name].max(initial=0)), 1e-30) for name in three]
        values = np.zeros((len(gaussians), 3))
        for i, name in enumerate(three):
            values[:, i] = scalars[name] / largest[i]
        g = gaussians
        coloured = Gaussians(g.means, g.log_scales, g.quats, g.logit_opacities, sh_from_rgb(values))
        mean = np.asarray(render(coloured, camera, cache=cache).rgb) / shown[..., None]
        for i, name in enumerate(three):
            maps[name] = (mean[..., i] * largest[i]).astype(np.float32)
    if "unobserved" in maps:
        maps["unobserved"] = (maps["unobserved"] > 0.5).astype(np.float32)
    return maps


def write_information_ply(
    path: str | Path, gaussians: Gaussians, scalars: dict[str, np.ndarray]
) -> None:
    """Write a PLY with a vertex for each Gaussian: x y z, red green blue, and every scalar; the
    file appears complete.

    The colours show the information, from 0 to its largest value (colour map viridis). Dots in
    names become underscores. It
    opens in MeshLab and CloudCompare. scalars: name -> [N]. Raises InputError if the file cannot be
    written.
    """
    import matplotlib
    from plyfile import PlyData, PlyElement

    information = scalars["information"]
    rgb = matplotlib.colormaps["viridis"](
        information / max(float(information.max(initial=0)), 1e-30), bytes=True
    )[:, :3]
    names = [name.replace(".", "_") for name in scalars]
    layout = (
        [(axis, "f4") for axis in "xyz"]
        + [(c, "u1") for c in ("red", "green", "blue")]
        + [(name, "f4") for name in names]
    )
    vertices = np.empty(len(gaussians), dtype=layout)
    for i, axis in enumerate("xyz"):
        vertices[axis] = gaussians.means[:, i]
    for i, channel in enumerate(("red", "green", "blue")):
        vertices[channel] = rgb[:, i]
    for name, values in zip(names, scalars.values(), strict=True):
        vertices[name] = values
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")]).write(str(temporary))


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
"""Panels of a preview: channel -> title and colour map. The colour maps are perceptually
uniform."""


def write_preview(
    path: str | Path, maps: dict[str, np.ndarray], title: str, unit: str = "m"
) -> None:
    """Write the preview of one view as a PNG: its render and the PANELS with colour bars, cropped
    to the model.

    maps: as `view_maps` gives them, of all scalars; title: of the render; unit: what a length of 1
    is called. Raises InputError if the file cannot be written.
    """
    import matplotlib

    from mgs.plotting import STYLE, crop, new_figure, save_figure

    rgb = np.stack([maps[channel] for channel in "RGB"], axis=-1)
    visible = maps["A"] >= VISIBLE
    window = crop(visible)
    height, width = visible[window].shape
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = new_figure(8.4, 3 * (2.3 * height / width + 0.35), dpi=130)
        axes = figure.subplots(3, 3).flat
        axes[0].imshow(srgb_from_linear(rgb)[window], interpolation="nearest")
        axes[0].set_title(title)
        for axis, (channel, (label, colours)) in zip(axes[1:], PANELS.items(), strict=True):
            values = np.ma.masked_where(~visible, maps[channel])[window]
            shown = axis.imshow(
                values, cmap=_on_grey(colours), norm=_norm(channel, values), interpolation="nearest"
            )
            axis.set_title(f"{label} ({unit})" if channel == "Z" else label)
            ticks = [0, 1] if channel == "unobserved" else None
            figure.colorbar(shown, ax=axis, shrink=0.85, aspect=16, pad=0.02, ticks=ticks)
        for axis in axes:
            axis.set_axis_off()
        save_figure(figure, path)


def _on_grey(name: str) -> Any:
    """The colour map of this name, with light grey for masked pixels."""
    import matplotlib

    return matplotlib.colormaps[name].with_extremes(bad="#e8e8e8")


def _norm(channel: str, values: np.ma.MaskedArray) -> Any:
    """The scale of a channel's colours: logarithmic for Fisher information, which spans many powers
    of ten; from 0 to 1 for the uncertainty and for `unobserved`; otherwise from the least to about
    the largest of the values [H,W] that are not masked."""
    from matplotlib.colors import LogNorm, Normalize

    data = values.compressed()
    if channel in ("uncertainty", "unobserved") or len(data) == 0:
        return Normalize(0, 1)
    high = float(np.quantile(data, 0.999))
    if not channel.startswith("fisher.") or high <= 0:
        return Normalize(float(data.min()), max(float(data.max()), float(data.min()) + 1e-9))
    low = max(float(np.quantile(data, 0.001)), high * 10.0**-DECADES)
    return LogNorm(min(low, high / 2), high, clip=True)


def choose_views(
    frames: Sequence[Frame], trained: Sequence[str], wanted: Sequence[str] | None
) -> list[Frame]:
    """The frames to draw: those named in `wanted`, or, without it, VIEWS frames spread evenly over
    those not trained on.

    trained: names of the frames that were trained on; if these are all, the choice is among all
    frames. Raises InputError for a name that no frame has.
    """
    if wanted:
        by_name = {frame.name: frame for frame in frames}
        for name in wanted:
            if name not in by_name:
                raise InputError(
                    f"--views {name}: no such frame; the dataset has {frames[0].name} to {frames[-1].name}"
                )
        return [by_name[name] for name in wanted]
    pool = [frame for frame in frames if frame.name not in trained] or list(frames)
    spread = np.linspace(0, len(pool), min(VIEWS, len(pool)), endpoint=False).astype(int)
    return [pool[i] for i in spread]


def diagnose_run(
    run: str | Path,
    wanted: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Write the folder RUN/diagnostics: information.ply, and NAME.exr and NAME.png for each view.
    Returns the paths of the files.

    wanted: names of frames, see `choose_views`; progress: called as progress(views done, views in
    all). Raises InputError as `mgs.run.folder.load_run` (no run, no finished step, a dataset that
    has changed), and for an unknown view.
    """
    from mgs.splat import groups

    run = Path(run)
    gaussians, dataset, trained, _ = run_folder.load_run(run)
    frames = choose_views(dataset.frames, trained, wanted)
    settings, state = run_folder.read_settings(run), run_folder.read_checkpoint(run)
    assert state is not None
    columns = groups(gaussians.sh_degree, settings.train.means)
    prior_lam = criteria.regularisation(
        groups(gaussians.sh_degree), settings.pixel_noise, settings.prior_std
    )
    scalars = gaussian_scalars(
        state.H, state.surface, settings.regularisation(columns), prior_lam, columns
    )
    out = run / "diagnostics"
    write_information_ply(out / "information.ply", gaussians, scalars)
    written = [out / "information.ply"]
    for done, frame in enumerate(frames):
        if progress:
            progress(done, len(frames))
        maps = view_maps(gaussians, frame.camera, scalars)
        write_exr(out / f"{frame.name}.exr", maps)
        seen = "trained on" if frame.name in trained else "never trained on"
        if (
            settings.estimator != "exact"
        ):  # then the maps are not in the units that their panels name
            seen += f"; by {settings.estimator}"
        write_preview(out / f"{frame.name}.png", maps, f"{frame.name}, {seen}", dataset.unit)
        written += [out / f"{frame.name}.exr", out / f"{frame.name}.png"]
    if progress:
        progress(len(frames), len(frames))
    return written
