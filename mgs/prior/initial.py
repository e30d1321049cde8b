"""The prior and the seed frames -> initial Gaussians (paper, section III-A), with a backing that keeps the rock opaque.

Nothing in an image asks for an opaque surface. Where only a layer of Gaussians on the surface is fitted, as in the paper,
bright patches turn see-through, and what shines through is the far side of the rock, another part of it from every camera.
But a mesh prior knows that the rock is solid behind its surface. So every second Gaussian on the surface has an opaque one a
spacing behind it, larger, so that together they close; all are fitted alike. What shines through the surface then ends on the
rock's own colour, one spacing deep. benchmarks/backing.py measures it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
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
"""Standard deviation along the surface over the spacing, and
INITIAL_OPACITY: with Gaussians of standard deviation s, opacity o and one per spacing^2, light crosses one layer face on with a
mean log-transmittance of -2 pi (s / spacing)^2 Li2(o) (the integral of ln(1 - o exp(-r^2 / 2 s^2)) over the plane). 0.65 and
0.9 give -3.45: 3 % shines through (less in an image, where the renderer widens each Gaussian by EPS2D), so the far side is
hidden from the first render, while the derivative of opacity by its logit, o (1 - o) = 0.09, does not vanish as at 0.99."""

INITIAL_OPACITY = 0.9

THICKNESS = 0.1
"""Standard deviation along the normal over the spacing: flat on the surface, yet thick enough to stay well conditioned."""

BACKING_DEPTH = 1.0
"""How far behind the surface a backing Gaussian lies, over the spacing of the surface's."""

BACKING_SCALE = (0.8, 0.8, 0.2)
"""Standard deviations of a backing Gaussian along the surface and along the normal, over the spacing of the backing's own: more
overlap than on the surface, since gaps are what it is there to prevent."""

BACKING_OPACITY = 0.99

GREY = 0.5
"""Linear RGB of a Gaussian that no seed frame sees: zero spherical harmonics."""


def initial_gaussians(prior: Prior, seed_frames: Sequence[Frame]) -> tuple[Gaussians, np.ndarray]:
    """One flat Gaussian per sample of the prior, then one behind each of its backed samples, of the same colour.

    Colours are averages over the seed frames that see the sample, and grey where none does.

    A frame sees a point that is inside its rock mask, faces it, and agrees with its depth image within `prior.depth_tolerance`
    and the slope of the surface in its pixel. For a frame without depth it is the depth of the prior's mesh: that needs the
    variant to be set (`mgs.runtime.start`).
    Returns (N + backed Gaussians of SH degree 0, which samples a seed frame sees [N] bool). Raises InputError where a seed
    frame cannot be read.
    """
    n = len(prior.points)
    total, count = np.zeros((n, 3)), np.zeros(n)
    depth_of_mesh = None if all(frame.depth_path for frame in seed_frames) else _depth_of_mesh(prior)
    for frame in seed_frames:
        depth = depth_of_mesh(frame.camera) if depth_of_mesh and frame.depth_path is None else frame.depth()
        seen = visible(prior.points, prior.normals, frame.camera, depth, prior.depth_tolerance) & in_mask(prior.points, frame)
        pixels, _ = frame.camera.project(prior.points[seen])
        at = [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5]
        rgb = frame.rgb()
        total[seen] += np.stack([map_coordinates(rgb[..., k], at, order=1, mode="nearest") for k in range(3)], 1)
        count[seen] += 1
    seen = count > 0
    rgb = np.where(seen[:, None], total / np.maximum(count, 1)[:, None], GREY)
    scales = np.log(prior.spacing * np.array([IN_PLANE_SCALE, IN_PLANE_SCALE, THICKNESS]))
    surface = Gaussians(
        means=prior.points.astype(np.float32),
        log_scales=np.tile(scales, (n, 1)).astype(np.float32),
        quats=quat_from_normals(prior.normals).astype(np.float32),
        logit_opacities=np.full(n, logit(INITIAL_OPACITY), np.float32),
        sh=sh_from_rgb(rgb),
    )
    return _with_backing(surface, prior), seen


def _with_backing(surface: Gaussians, prior: Prior) -> Gaussians:
    """The surface's Gaussians, then those behind its first `prior.backed`."""
    count = prior.backed
    if count == 0:
        return surface
    over = surface[:count]
    behind = prior.points[:count] - BACKING_DEPTH * prior.spacing * prior.normals[:count]
    scales = np.log(prior.spacing * np.sqrt(len(surface) / count) * np.array(BACKING_SCALE))
    backing = Gaussians(
        means=behind.astype(np.float32),
        log_scales=np.tile(scales, (count, 1)).astype(np.float32),
        quats=over.quats,
        logit_opacities=np.full(count, logit(BACKING_OPACITY), np.float32),
        sh=over.sh,
    )
    return Gaussians(*(np.concatenate([getattr(g, field.name) for g in (surface, backing)]) for field in fields(Gaussians)))


def _depth_of_mesh(prior: Prior) -> Callable[[Camera], np.ndarray]:
    from mgs.data.raycast import mesh_depth  # only here: it wants the variant to be set

    return mesh_depth(prior.mesh)
