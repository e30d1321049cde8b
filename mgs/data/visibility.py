"""Which points of a surface a camera sees, by its depth image and its mask."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_dilation

from mgs.camera import Camera
from mgs.data.dataset import Frame

GRAZING = 0.2
"""Cosine of the angle between normal and view. The tolerance grows with the slope of the surface
only down to this cosine."""


def visible(
    points: np.ndarray,
    normals: np.ndarray,
    camera: Camera,
    depth: np.ndarray,
    tolerance: float,
    *,
    two_sided: bool = False,
) -> np.ndarray:
    """Which points are seen, bool [N]: they are inside the frame, face the camera, and have the
    depth that their pixel shows.

    points [N,3] world, metres; normals [N,3] unit; depth [H,W] z-depth, metres, 0 = no return;
    tolerance: largest difference of depth, metres; two_sided: points that face away count too. The
    depth of a slanted surface changes within a pixel, so the tolerance is widened by the size of a
    pixel on the surface times the slope.
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


def has_masks(frames: Sequence[Frame]) -> bool:
    """Whether frames say which of their pixels are the object: all have a file of a mask, or of the
    rock alone."""
    return all(frame.mask_path is not None or frame.rock_path is not None for frame in frames)


def mask_share(
    points: np.ndarray, frames: Sequence[Frame], slack: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """In how many masks each point [N,3] falls, over the frames that have it in their image, and
    the number of these frames: ([N] 0 to 1, [N]).

    A point of the object falls into the mask of every frame, whether it is hidden or not, because a
    mask is the outline of the
    whole object. slack: pixels by which masks are widened, for the errors of points and poses.
    """
    inside, count = np.zeros(len(points)), np.zeros(len(points), int)
    for frame in frames:
        pixels, z = frame.camera.project(points)
        here = (
            (z > 0)
            & (pixels >= 0).all(1)
            & (pixels < [frame.camera.width, frame.camera.height]).all(1)
        )
        column, row = pixels[here].astype(int).T
        mask = binary_dilation(frame.mask(), iterations=slack) if slack else frame.mask()
        inside[here] += mask[row, column]
        count += here
    return inside / np.maximum(count, 1), count


def in_mask(points: np.ndarray, frame: Frame) -> np.ndarray:
    """Whether each point [N,3], world, metres, falls on a pixel of the rock's mask, bool [N].

    A point outside the frame is given the nearest pixel at its edge.
    """
    pixels, _ = frame.camera.project(points)
    column = np.clip(np.floor(pixels[:, 0]), 0, frame.camera.width - 1).astype(int)
    row = np.clip(np.floor(pixels[:, 1]), 0, frame.camera.height - 1).astype(int)
    return frame.mask()[row, column]
