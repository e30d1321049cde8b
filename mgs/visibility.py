"""Which surface points a camera sees, by depth test."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from mgs.conventions import Camera

SILHOUETTE_JUMP = 0.05
"""A 3x3 neighbourhood that spans more than this share of its depth holds two surfaces."""


def visible(points: np.ndarray, normals: np.ndarray, camera: Camera, depth: np.ndarray, tolerance: float) -> np.ndarray:
    """[N] bool: inside the frame, facing the camera, and not behind the surface in `depth`.

    points [N,3] world, metres; normals [N,3]; depth [H,W] z-depth, metres, 0 = no return; tolerance: metres. The point is
    compared with the range of depth in the 3x3 pixels around it, because a slanted surface changes depth within a pixel; at a
    silhouette, where that range spans two surfaces, with its own pixel alone.
    """
    pixels, z = camera.project(points)
    facing = np.einsum("nk,nk->n", normals, camera.position - points) > 0
    column, row = np.floor(pixels[:, 0]), np.floor(pixels[:, 1])
    inside = (z > 0) & facing & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    seen = np.zeros(len(points), bool)
    r, c = row[inside].astype(int), column[inside].astype(int)
    here = depth[r, c]
    far, near = maximum_filter(depth, 3)[r, c], minimum_filter(depth, 3)[r, c]
    slanted = far - near < SILHOUETTE_JUMP * far
    far, near = np.where(slanted, far, here), np.where(slanted, near, here)
    seen[inside] = (here > 0) & (np.abs(z[inside] - np.clip(z[inside], near, far)) < tolerance)
    return seen


def depth_of_points(points: np.ndarray, camera: Camera, spacing: float) -> np.ndarray:
    """z-buffer [H,W] of a sampled surface, metres, 0 where it is not hit: each point covers the pixels within `spacing`.

    points [N,3] world, metres; spacing: distance of neighbouring points, metres.
    """
    pixels, z = camera.project(points)
    near = z[z > 0]
    if len(near) == 0:
        return np.zeros((camera.height, camera.width))
    pad = int(np.ceil(spacing * camera.K[0, 0] / near.min()))
    column, row = np.floor(pixels[:, 0]).astype(int) + pad, np.floor(pixels[:, 1]).astype(int) + pad
    shape = (camera.height + 2 * pad, camera.width + 2 * pad)
    inside = (z > 0) & (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    buffer = np.full(shape, np.inf)
    np.minimum.at(buffer, (row[inside], column[inside]), z[inside])
    buffer = minimum_filter(buffer, 2 * pad + 1)[pad : shape[0] - pad, pad : shape[1] - pad]
    return np.where(np.isfinite(buffer), buffer, 0.0)
