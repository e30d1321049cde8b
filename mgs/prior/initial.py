"""The Gaussians that a fit starts from: from the prior and the seed frames (paper, section III-A)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import map_coordinates

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
"""Opacity of a Gaussian. IN_PLANE_SCALE and INITIAL_OPACITY are chosen together, such that the far side of the rock is hidden
from the first render on. Let Gaussians of standard deviation s and opacity o lie on a plane, one per spacing^2. The logarithm
of the transmittance of a ray across the plane is on average the integral over the plane of ln(1 - o exp(-r^2 / (2 s^2))) /
spacing^2, which is -2 pi (s / spacing)^2 Li2(o), with the dilogarithm Li2. For 0.65 and 0.9 that is -3.45: 3 % of the light
passes. In an image it is less, because the renderer widens each Gaussian by EPS2D. An opacity of 0.99 would hide more, but
there the derivative of the opacity by its logit, o (1 - o), is almost zero; at 0.9 it is 0.09."""

THICKNESS = 0.1
"""Standard deviation of a Gaussian across the surface, over the spacing. It is flat, but thick enough for its projection to be
numerically well conditioned."""

GREY = 0.5
"""Colour of a Gaussian that no seed frame sees, linear RGB in every channel: all its spherical harmonics are zero."""


def initial_gaussians(prior: Prior, seed_frames: Sequence[Frame]) -> tuple[Gaussians, np.ndarray]:
    """One flat Gaussian for each of the N samples of a prior, with a colour averaged over the seed frames that see the sample.

    A frame sees a sample that lies inside its rock mask, whose normal points towards the camera, and whose depth agrees with
    the depth image, up to `prior.depth_tolerance` and the slope of the surface within a pixel. For a frame without depth image
    the depth of the prior's mesh is used, which needs Mitsuba's variant to be set (`mgs.runtime.start`). A sample that no frame
    sees is grey.
    Returns (Gaussians of degree 0, seen [N] bool: which samples some frame sees).
    Raises InputError if a file of a frame cannot be read.
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
    gaussians = Gaussians(
        means=prior.points.astype(np.float32),
        log_scales=np.tile(scales, (n, 1)).astype(np.float32),
        quats=quat_from_normals(prior.normals).astype(np.float32),
        logit_opacities=np.full(n, np.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY)), np.float32),
        sh=sh_from_rgb(rgb),
    )
    return gaussians, seen


def _depth_of_mesh(prior: Prior) -> Callable[[Camera], np.ndarray]:
    """A function that gives the depth image [H,W], metres, of the prior's mesh in a camera."""
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    return mesh_depth(prior.mesh)


def with_share_seen(prior: Prior, seed_frames: Sequence[Frame]) -> Prior:
    """The prior with one more of its `numbers`, seen_by_seeds: the share of its samples that some of the seed frames see.

    The others would start grey. Needs and raises what `initial_gaussians` does.
    """
    seen = initial_gaussians(prior, seed_frames)[1]
    return replace(prior, numbers=prior.numbers | {"seen_by_seeds": float(seen.mean())})
