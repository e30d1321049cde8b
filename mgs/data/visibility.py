"""Visibility of surface points in a camera, from its depth image and its mask."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_dilation

from mgs.camera import Camera
from mgs.data.frames import Frame

GRAZING = 0.2  # least cosine of the angle between normal and view that widens the tolerance


def in_image(camera: Camera, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Whether projected points lie in front of a camera and in its image, bool [N]. pixels [N,2], z
    [N]: from `Camera.project`."""
    return (z > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)


def visible(
    points: np.ndarray,
    normals: np.ndarray,
    camera: Camera,
    depth: np.ndarray,
    tolerance: float,
    *,
    two_sided: bool = False,
) -> np.ndarray:
    """Whether points are seen, bool [N]: in the image, facing the camera, at the pixel's depth.

    points [N,3] world, metres; normals [N,3] unit; depth [H,W] z-depth, metres, 0 = no return;
    tolerance: largest depth difference, metres; two_sided: include points that face away. The
    tolerance grows by the size of a pixel times the slope, since depth varies within a pixel."""
    pixels, z = camera.project(points)
    view = camera.position - points
    cosine = np.einsum("nk,nk->n", normals, view) / np.maximum(np.linalg.norm(view, axis=1), 1e-30)
    inside = in_image(camera, pixels, z)
    if not two_sided:
        inside &= cosine > 0
    surface = np.zeros(len(points))
    column, row = np.floor(pixels[inside]).astype(int).T
    surface[inside] = depth[row, column]
    steep = np.maximum(np.abs(cosine), GRAZING)
    slack = tolerance + z / camera.K[0, 0] * np.sqrt(np.maximum(1 - steep**2, 0)) / steep
    return inside & (surface > 0) & (np.abs(z - surface) < slack)


def has_masks(frames: Sequence[Frame]) -> bool:
    """Whether every frame has a mask or a rock image."""
    return all(frame.mask_path is not None or frame.rock_path is not None for frame in frames)


def mask_share(
    points: np.ndarray, frames: Sequence[Frame], slack: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Share of masks that contain each point [N,3], among the frames with it in their image, and
    the number of these frames: ([N] 0 to 1, [N]). A mask is the outline of the whole object, so
    points of the object fall into every mask, hidden or not. slack: dilation of the masks, pixels,
    for errors of points and poses."""
    inside, count = np.zeros(len(points)), np.zeros(len(points), int)
    for frame in frames:
        pixels, z = frame.camera.project(points)
        here = in_image(frame.camera, pixels, z)
        column, row = pixels[here].astype(int).T
        mask = binary_dilation(frame.mask(), iterations=slack) if slack else frame.mask()
        inside[here] += mask[row, column]
        count += here
    return inside / np.maximum(count, 1), count


def in_mask(points: np.ndarray, frame: Frame) -> np.ndarray:
    """Whether points [N,3], world, metres, project onto the rock mask, bool [N]; points outside the
    image take its nearest pixel."""
    pixels, _ = frame.camera.project(points)
    column = np.clip(np.floor(pixels[:, 0]), 0, frame.camera.width - 1).astype(int)
    row = np.clip(np.floor(pixels[:, 1]), 0, frame.camera.height - 1).astype(int)
    return frame.mask()[row, column]


def nearest_point(positions: Sequence[np.ndarray], directions: Sequence[np.ndarray]) -> np.ndarray:
    """Point [3] nearest to lines in the least-squares sense. positions, directions (unit): [3]."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for position, direction in zip(positions, directions, strict=True):
        across = np.eye(3) - np.outer(direction, direction)
        A, b = A + across, b + across @ position
    return np.linalg.lstsq(A, b, rcond=1e-9)[0]
