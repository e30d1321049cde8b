"""The prior and some frames -> initial Gaussians (paper, section III-A), with a backing that keeps
the rock opaque.

Nothing in an image asks for an opaque surface. Where only a layer of Gaussians on the surface is
fitted, as in the paper, bright patches turn see-through, and what shines through is the far side of
the rock, another part of it from every camera. But a mesh prior knows that the rock is solid behind
its surface. So every second Gaussian on the surface has an opaque one a spacing behind it, larger,
so that together they close; all are fitted alike. What shines through the surface then ends on the
rock's own colour, one spacing deep. benchmarks/backing.py measures it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.special import logit

from mgs.camera import Camera
from mgs.data.dataset import Frame
from mgs.data.visibility import in_mask, visible
from mgs.gaussians import Gaussians, sh_from_rgb
from mgs.rotation import quat_from_normals

if TYPE_CHECKING:
    from mgs.prior.build import Prior

IN_PLANE_SCALE = 0.65
"""Standard deviation of a Gaussian along the surface, over the spacing of the samples."""

INITIAL_OPACITY = 0.9
"""Opacity of a Gaussian. IN_PLANE_SCALE and INITIAL_OPACITY are chosen together, such that the far
side of the rock is hidden from the first render on. Let Gaussians of standard deviation s and
opacity o lie on a plane, one per spacing^2. The logarithm of the transmittance of a ray across the
plane is on average the integral over the plane of ln(1 - o exp(-r^2 / (2 s^2))) / spacing^2, which
is -2 pi (s / spacing)^2 Li2(o), with the dilogarithm Li2. For 0.65 and 0.9 that is -3.45: 3 % of
the light passes. In an image it is less, because the renderer widens each Gaussian by EPS2D. An
opacity of 0.99 would hide more, but there the derivative of the opacity by its logit, o (1 - o), is
almost zero; at 0.9 it is 0.09."""

INSET = 0.6
"""How far below the surface a Gaussian lies, in pixels on the rock. The renderer widens every
footprint by EPS2D, about half a pixel, so that Gaussians on the surface would draw a rock that is
larger than the true one. A chosen constant (docs/fit.md)."""

THICKNESS = 0.1
"""Standard deviation of a Gaussian across the surface, over the spacing. It is flat, but thick
enough for its projection to be numerically well conditioned."""

BACKING_DEPTH = 1.0
"""How far behind its Gaussian on the surface one of the backing lies, over the spacing of the
surface's."""

BACKING_SCALE = (0.8, 0.8, 0.2)
"""Standard deviations of a backing Gaussian along the surface and along the normal, over the
spacing of the backing's own: more overlap than on the surface, since gaps are what it is there to
prevent."""

BACKING_OPACITY = 0.99

GREY = 0.5
"""Colour of a Gaussian that no frame sees, linear RGB in every channel: all its spherical harmonics
are zero."""


Colours = tuple[np.ndarray, np.ndarray]
"""What `seen_colours` returns."""


def initial_gaussians(
    prior: Prior,
    frames: Sequence[Frame],
    inset: float = INSET,
    gains: np.ndarray | None = None,
    colours: Callable[[Frame], Colours] | None = None,
) -> tuple[Gaussians, np.ndarray]:
    """One flat Gaussian for each of the N samples of a prior, with a colour averaged over the
    frames that see the sample; then one behind each of the first `prior.backed` samples, of the
    same colour.

    A frame sees a sample that lies inside its rock mask, whose normal points towards the camera,
    and whose depth agrees with the depth image, up to `prior.depth_tolerance` and the slope of the
    surface within a pixel. For a frame without depth image the depth of the prior's mesh is used. A
    sample that no frame sees is grey.
    inset: how far below its sample a Gaussian lies, over the `pixel_on` the prior. gains: [V,3] of
    the frames' exposures, by which their colours are divided (`mgs.prior.exposure`). colours:
    `colours_of` the prior, where it is kept between calls. Returns (N + backed Gaussians of degree
    0, seen [N] bool: which samples some frame sees). Raises InputError if a file of a frame cannot
    be read, and as `mesh_depth` where a frame has no depth image.
    """
    n = len(prior.points)
    total, count = np.zeros((n, 3)), np.zeros(n)
    colours = colours or colours_of(prior)
    for k, frame in enumerate(frames):
        seen, rgb = colours(frame)
        total[seen] += rgb if gains is None else rgb / gains[k]
        count[seen] += 1
    seen = count > 0
    rgb = np.where(seen[:, None], total / np.maximum(count, 1)[:, None], GREY)
    below = inset * pixel_on(prior, [frame.camera for frame in frames])
    scales = np.log(prior.spacing * np.array([IN_PLANE_SCALE, IN_PLANE_SCALE, THICKNESS]))
    surface = Gaussians(
        means=(prior.points - below * prior.normals).astype(np.float32),
        log_scales=np.tile(scales, (n, 1)).astype(np.float32),
        quats=quat_from_normals(prior.normals).astype(np.float32),
        logit_opacities=np.full(n, logit(INITIAL_OPACITY), np.float32),
        sh=sh_from_rgb(rgb),
    )
    return _with_backing(surface, prior), seen


def warm_start(model: Gaussians, before: Gaussians, start: Gaussians) -> Gaussians:
    """The model from which a fit goes on after images were added.

    model: the result of the fit before, to the images taken until then. before, start: the
    Gaussians before any training, in the mean colours of those images, and of all images now
    (`initial_gaussians`). Each colour of the model is changed by the difference of the two; all
    else stays as it was fitted. So a Gaussian that no image showed before has the colour of the new
    images at once, for which a fit would need many passes.
    """
    return replace(model, sh=model.sh + (start.sh - before.sh))


def colours_of(prior: Prior) -> Callable[[Frame], Colours]:
    """A function that gives `seen_colours` of a frame for the samples of a prior."""
    depth = depth_of(prior)
    return lambda frame: seen_colours(
        prior.points, prior.normals, frame, depth(frame), prior.depth_tolerance
    )


def pixel_on(prior: Prior, cameras: Sequence[Camera]) -> float:
    """Size of a pixel on the surface, metres: z-depth over focal length, the median over the
    samples and then over the cameras that have some in front of them; 0 where none has."""
    depths = [(camera, camera.project(prior.points)[1]) for camera in cameras]
    sizes = [
        np.median(z[z > 0]) / np.sqrt(camera.K[0, 0] * camera.K[1, 1])
        for camera, z in depths
        if (z > 0).any()
    ]
    return float(np.median(sizes)) if sizes else 0.0


def initial_normals(prior: Prior) -> np.ndarray:
    """The normal of each of the Gaussians of `initial_gaussians`, [N + backed,3], unit: of its
    sample, or of the sample that it stands behind."""
    return np.concatenate([prior.normals, prior.normals[: prior.backed]])


def _with_backing(surface: Gaussians, prior: Prior) -> Gaussians:
    """The surface's Gaussians, then those behind the first `prior.backed` of them."""
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
    return Gaussians(
        *(
            np.concatenate([getattr(g, field.name) for g in (surface, backing)])
            for field in fields(Gaussians)
        )
    )


def sees(
    points: np.ndarray, normals: np.ndarray, frame: Frame, depth: np.ndarray, tolerance: float
) -> np.ndarray:
    """Which points [N] of a surface a frame sees inside its mask, bool.

    normals, depth [H,W], tolerance: as in `mgs.data.visibility.visible`. Raises InputError if the
    mask cannot be read.
    """
    return visible(points, normals, frame.camera, depth, tolerance) & in_mask(points, frame)


def seen_colours(
    points: np.ndarray, normals: np.ndarray, frame: Frame, depth: np.ndarray, tolerance: float
) -> Colours:
    """(which points [N] of a surface a frame `sees`; the colours of these there, [seen,3] linear
    RGB). Raises InputError if a file cannot be read."""
    seen = sees(points, normals, frame, depth, tolerance)
    pixels, _ = frame.camera.project(points[seen])
    at, rgb = [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5], frame.rgb()
    return seen, np.stack(
        [map_coordinates(rgb[..., k], at, order=1, mode="nearest") for k in range(3)], 1
    )


def depth_of(prior: Prior) -> Callable[[Frame], np.ndarray]:
    """A function that gives the depth image [H,W] of a frame, metres: its own, or where it has
    none, that of the prior's mesh.

    Raises InputError as `mesh_depth`, when the mesh is first needed, and as `Frame.depth`.
    """

    @cache
    def of_mesh() -> Callable[[Camera], np.ndarray]:
        from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

        return mesh_depth(prior.mesh)

    return lambda frame: of_mesh()(frame.camera) if frame.depth_path is None else frame.depth()


def with_share_seen(prior: Prior, seed_frames: Sequence[Frame]) -> Prior:
    """The prior with one more of its `numbers`, seen_by_seeds: the share of its samples that some
    of the seed frames see.

    The others would start grey. Raises InputError if a depth image or a mask cannot be read.
    """
    depth = depth_of(prior)
    seen = np.logical_or.reduce(
        [sees(prior.points, prior.normals, f, depth(f), prior.depth_tolerance) for f in seed_frames]
    )
    return replace(prior, numbers=prior.numbers | {"seen_by_seeds": float(seen.mean())})
