"""Which points of a surface a camera sees, by its depth image and its mask."""

from __future__ import annotations

import numpy as np

from mgs.camera import Camera
from mgs.data.dataset import Frame

GRAZING = 0.2
"""Cosine of the angle between normal and view. The tolerance grows with the slope of the surface only down to this cosine."""


def visible(
    points: np.ndarray,
    normals: np.ndarray,
    camera: Camera,
    depth: np.ndarray,
    tolerance: float,
    *,
    two_sided: bool = False,
) -> np.ndarray:
    """Which points are seen, bool [N]: they are inside the frame, face the camera, and have the depth that their pixel shows.

    points [N,3] world, metres; normals [N,3] unit; depth [H,W] z-depth, metres, 0 = no return; tolerance: largest difference of
    depth, metres; two_sided: points that face away count too. The depth of a slanted surface changes within a pixel, so the
    tolerance is widened by the size of a pixel on the surface times the slope.
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
    """Whether each point [N,3], world, metres, falls on a pixel of the rock's mask, bool [N].

    A point outside the frame is given the nearest pixel at its edge.
    """
    pixels, _ = frame.camera.project(points)
    column = np.clip(np.floor(pixels[:, 0]), 0, frame.camera.width - 1).astype(int)
    row = np.clip(np.floor(pixels[:, 1]), 0, frame.camera.height - 1).astype(int)
    return frame.mask()[row, column]
