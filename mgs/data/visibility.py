"""Which surface points a camera sees: depth test and mask."""

from __future__ import annotations

import numpy as np

from mgs.camera import Camera
from mgs.data.dataset import Frame

GRAZING = 0.2
"""Cosine between normal and view below which the slope no longer widens the tolerance."""


def visible(
    points: np.ndarray,
    normals: np.ndarray,
    camera: Camera,
    depth: np.ndarray,
    tolerance: float,
    *,
    two_sided: bool = False,
) -> np.ndarray:
    """[N] bool: inside the frame, facing the camera (or two_sided), and at the depth that its pixel shows.

    points [N,3] world, metres; normals [N,3] unit; depth [H,W] z-depth, metres, 0 = no return; tolerance: metres. A slanted
    surface changes depth within its pixel, so the tolerance grows by one pixel footprint times the slope.
    """
    pixels, z = camera.project(points)
    view = camera.position - points
    cosine = np.einsum("nk,nk->n", normals, view) / np.maximum(np.linalg.norm(view, axis=1), 1e-30)
    column, row = np.floor(pixels[:, 0]), np.floor(pixels[:, 1])
    seen = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    if not two_sided:
        seen &= cosine > 0
    shown = np.zeros(len(points))
    shown[seen] = depth[row[seen].astype(int), column[seen].astype(int)]
    steep = np.maximum(np.abs(cosine), GRAZING)
    slack = tolerance + z / camera.K[0, 0] * np.sqrt(np.maximum(1 - steep**2, 0)) / steep
    return seen & (shown > 0) & (np.abs(z - shown) < slack)


def in_mask(points: np.ndarray, frame: Frame) -> np.ndarray:
    """[N] bool: the pixel of each point [N,3] (clamped to the frame) is inside the frame's rock mask."""
    pixels, _ = frame.camera.project(points)
    column = np.clip(np.floor(pixels[:, 0]), 0, frame.camera.width - 1).astype(int)
    row = np.clip(np.floor(pixels[:, 1]), 0, frame.camera.height - 1).astype(int)
    return frame.mask()[row, column]
