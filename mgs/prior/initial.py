"""Initial Gaussians from the prior and some frames (paper, section III-A): one layer, and for every
second one a larger, opaque one behind it, so that the far side does not show through
(docs/fit.md)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.special import logit

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.frames import Frame, in_image, in_mask, visible
from mgs.gaussians import ARRAYS, Gaussians, sh_from_rgb
from mgs.prior.build import Prior
from mgs.progress import Stage, report
from mgs.rotation import quat_from_normals

IN_PLANE_SCALE = 0.65  # standard deviation of a Gaussian along the surface, over the spacing
# Opacity of a Gaussian, chosen with IN_PLANE_SCALE so that the far side is hidden from the start:
# the mean log transmittance across the surface is -2 pi (s / spacing)^2 Li2(o) = -3.45. With 0.99
# the derivative by the logit, o (1 - o), would be almost zero.
INITIAL_OPACITY = 0.9
# Depth of a Gaussian below the surface, in pixels of the closest cameras, by whether it is
# antialiased: EPS2D widens every footprint by about half a pixel, which would draw the rock too
# large. Chosen constants (docs/fit.md).
INSET = {True: 0.5, False: 0.6}
CLOSEST = 10  # percentile of the cameras' pixel sizes for the closest; the smallest may be wrong
THICKNESS = 0.1  # standard deviation of a Gaussian across the surface, over the spacing
BACKING_DEPTH = 1.0  # distance of the backing behind the surface's Gaussians, over their spacing
BACKING_SCALE = (0.8, 0.8, 0.2)  # standard deviations of a backing Gaussian, over its spacing
BACKING_OPACITY = 0.99
AGREEMENT_FRAMES = 24  # most frames whose colours are compared on the surface (`colour_agreement`)
# Least `colour_agreement` of a right surface. Measured: 0.93 for a rendered rock, 0.83 with its
# surface 10 % too large and 0.74 with it 10 % too small, 0.79 for the hull of hollow bricks.
AGREEMENT = 0.85
RANDOM_OPACITY = 0.1  # opacity of a Gaussian of a random start, as in 3DGS (Kerbl et al. 2023)
GREY = 0.5  # colour of a Gaussian that no frame sees: all its spherical harmonics are zero
Colours = tuple[np.ndarray, np.ndarray]  # result of `seen_colours`


def initial_gaussians(
    prior: Prior,
    frames: Sequence[Frame],
    pixel: float | None = None,
    gains: np.ndarray | None = None,
    colours: Callable[[Frame], Colours] | None = None,
    antialiased: bool = True,
    linear: bool = True,
) -> tuple[Gaussians, np.ndarray]:
    """Place one flat Gaussian per sample of a prior, in its mean colour, then one behind each
    backed sample.

    pixel: unit of INSET, metres, by default `pixel_on` for the frames' cameras. gains: [V,3]
    exposures that divide the colours (`mgs.prior.exposure`). colours: `colours_of(prior)`, to reuse
    it between calls. antialiased, linear: as in `Gaussians`.

    Returns (N + backed Gaussians of degree 0, seen [N] bool). A frame sees a sample that lies in
    its rock mask, faces the camera and agrees with the depth image (or else the mesh's depth) up to
    `prior.depth_tolerance` and the slope. A sample that no frame sees is grey. Raises InputError if
    a file of a frame cannot be read, and as `mesh_depth`."""
    if prior.kind == "random":
        start, seen = round_gaussians(prior.points, frames, gains, linear)
        return replace(start, antialiased=antialiased), seen
    n = len(prior.points)
    total, count = np.zeros((n, 3)), np.zeros(n)
    colours = colours or colours_of(prior)
    for k, frame in enumerate(frames):
        report(Stage.READ, k, len(frames))
        seen, rgb = colours(frame)
        total[seen] += rgb if gains is None else rgb / gains[k]
        count[seen] += 1
    seen = count > 0
    if pixel is None:
        pixel = pixel_on(prior, [frame.camera for frame in frames])
    below = INSET[antialiased] * pixel
    scales = np.log(prior.spacing * np.array([IN_PLANE_SCALE, IN_PLANE_SCALE, THICKNESS]))
    surface = Gaussians(
        means=(prior.points - below * prior.normals).astype(np.float32),
        log_scales=np.tile(scales, (n, 1)).astype(np.float32),
        quats=quat_from_normals(prior.normals).astype(np.float32),
        logit_opacities=np.full(n, logit(INITIAL_OPACITY), np.float32),
        sh=_mean_sh(total, count, linear),
        antialiased=antialiased,
        linear=linear,
    )
    return _with_backing(surface, prior), seen


def _mean_sh(total: np.ndarray, count: np.ndarray, linear: bool) -> np.ndarray:
    """Coefficients [N,1,3] of mean colours, from sums [N,3] of linear RGB over `count` [N] frames;
    GREY where there is none. linear: as in `Gaussians`."""
    rgb = total / np.maximum(count, 1)[:, None]
    return sh_from_rgb(np.where(count[:, None] > 0, rgb if linear else srgb_from_linear(rgb), GREY))


def round_gaussians(
    points: np.ndarray,
    frames: Sequence[Frame],
    gains: np.ndarray | None = None,
    linear: bool = True,
) -> tuple[Gaussians, np.ndarray]:
    """Round, nearly transparent Gaussians at points [N,3], and whether a frame shows them [N].
    gains, linear: as in `initial_gaussians`."""
    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for k, frame in enumerate(frames):
        report(Stage.READ, k, len(frames))
        pixels, z = frame.camera.project(points)
        here = in_image(frame.camera, pixels, z) & in_mask(points, frame)
        column, row = pixels[here].astype(int).T
        total[here] += frame.rgb()[row, column] / (1 if gains is None else gains[k])
        count[here] += 1
    seen = count > 0
    size = np.log(cKDTree(points).query(points, min(4, len(points)))[0][:, 1:].mean(1))
    start = Gaussians(
        means=points.astype(np.float32),
        log_scales=np.tile(size[:, None], 3).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(points), 1)),
        logit_opacities=np.full(len(points), logit(RANDOM_OPACITY), np.float32),
        sh=_mean_sh(total, count, linear),
        linear=linear,
    )
    return start, seen


def warm_start(model: Gaussians, before: Gaussians, start: Gaussians) -> Gaussians:
    """Model to continue a fit from after images were added. model: result of the fit so far.
    before, start: `initial_gaussians` of the images until then, and of all images now. Colours
    change by the difference of the two, so a Gaussian that is newly seen takes its new colour at
    once; all else stays as fitted."""
    return replace(model, sh=model.sh + (start.sh - before.sh))


def colours_of(prior: Prior) -> Callable[[Frame], Colours]:
    """Return colours(frame): `seen_colours` for the samples of a prior."""
    depth = depth_of(prior)
    return lambda frame: seen_colours(
        prior.points, prior.normals, frame, depth(frame), prior.depth_tolerance
    )


def pixel_on(prior: Prior, cameras: Sequence[Camera]) -> float:
    """Size of a pixel of the closest cameras on the surface, metres: z-depth over focal length,
    median over samples, then percentile CLOSEST of the cameras that have some in front; 0 if none
    has."""
    sizes = []
    for camera in cameras:
        z = camera.project(prior.points)[1]
        if (z > 0).any():
            sizes.append(np.median(z[z > 0]) / camera.focal)
    return float(np.percentile(sizes, CLOSEST)) if sizes else 0.0


def _with_backing(surface: Gaussians, prior: Prior) -> Gaussians:
    """The surface's Gaussians, then those behind the first `prior.backed`."""
    count = prior.backed
    if count == 0:
        return surface
    over = surface[:count]
    behind = over.means - BACKING_DEPTH * prior.spacing * prior.normals[:count]
    scales = np.log(prior.spacing * np.sqrt(len(surface) / count) * np.array(BACKING_SCALE))
    backing = Gaussians(
        means=behind.astype(np.float32),
        log_scales=np.tile(scales, (count, 1)).astype(np.float32),
        quats=over.quats,
        logit_opacities=np.full(count, logit(BACKING_OPACITY), np.float32),
        sh=over.sh,
    )
    both: dict[str, Any] = {
        name: np.concatenate([getattr(surface, name), getattr(backing, name)]) for name in ARRAYS
    }
    return replace(surface, **both)


def seen_colours(
    points: np.ndarray, normals: np.ndarray, frame: Frame, depth: np.ndarray, tolerance: float
) -> Colours:
    """Mask [N] of the surface points that a frame sees inside its mask, and their colours, [seen,3]
    linear RGB. normals, depth [H,W], tolerance: as `visible`. Raises InputError if a file cannot be
    read."""
    seen = visible(points, normals, frame.camera, depth, tolerance) & in_mask(points, frame)
    pixels, _ = frame.camera.project(points[seen])
    at, rgb = [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5], frame.rgb()
    colours = [map_coordinates(rgb[..., k], at, order=1, mode="nearest") for k in range(3)]
    return seen, np.stack(colours, 1)


def depth_of(prior: Prior) -> Callable[[Frame], np.ndarray]:
    """Return depth(frame): [H,W], metres, the frame's own, or that of the prior's mesh. depth
    raises InputError as `mesh_depth` and `Frame.depth`."""

    @cache
    def of_mesh() -> Callable[[Camera], np.ndarray]:
        from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

        return mesh_depth(prior.mesh)

    return lambda frame: of_mesh()(frame.camera) if frame.depth_path is None else frame.depth()


def colour_agreement(prior: Prior, frames: Sequence[Frame]) -> float:
    """Share of the variance of the colours seen that is between samples, not between frames at one
    sample; NaN if no sample is seen twice. A point of a real surface has about one colour in all
    frames that see it; a wrong surface shows another thing in each. Up to AGREEMENT_FRAMES frames,
    evenly spread, are read. Raises InputError if a file cannot be read."""
    step = max(1, -(-len(frames) // AGREEMENT_FRAMES))
    colours = colours_of(prior)
    n = len(prior.points)
    count, total, squares = np.zeros(n), np.zeros((n, 3)), np.zeros(n)
    for frame in frames[::step]:
        seen, rgb = colours(frame)
        count[seen] += 1
        total[seen] += rgb
        squares[seen] += np.square(rgb).sum(1)
    twice = count > 1
    count, total, squares = count[twice], total[twice], squares[twice]
    if not twice.any():
        return float("nan")
    within = (squares - np.square(total).sum(1) / count).sum() / (count - 1).sum()
    mean = total.sum(0) / count.sum()
    whole = squares.sum() / count.sum() - np.square(mean).sum()
    return float(1 - within / max(whole, 1e-12))
