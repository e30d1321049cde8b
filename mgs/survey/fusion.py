"""Depth images -> one cloud of points in the world, averaged on a grid; and what the cameras of a
dataset look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from mgs.data.dataset import Frame
from mgs.errors import InputError
from mgs.survey.depth_sensor import depth_noise, filter_depth

MAX_FUSED_PIXELS = 6_000_000
"""About how many pixels are fused at most. If there are more, only every second, third ... row and
column of each image is used. Of 100 frames of 640x480, each voxel is then still seen ten times."""

EDGE_JUMP = 0.05
"""Largest difference between the depths in the neighbourhood of a pixel, as a share of the pixel's
own depth. Pixels beyond it
are left out: they lie on a silhouette, where a depth may be a mixture of two surfaces, or the
camera sees the surface at a grazing angle."""

REACH = 1.0
"""Radius of the cloud around the focus, as a multiple of the cameras' distance from it. Points
farther away are left out, because the ground there says nothing of the ground under the rock."""

FILTERED_SHARE = 0.5
"""Noise that the bilateral filter leaves, as a share of the noise before. It was measured to be
0.27; this leaves a margin."""


@dataclass(frozen=True)
class Cloud:
    """A fused cloud of N points.

    points: [N,3] in the world, metres.
    views: [N,3] unit vectors, the mean direction from each point to the cameras that saw it.
    voxel: edge of a cell of the grid on which points were averaged, metres: about the distance
    between neighbouring points.
    noise: standard deviation of the measured depths, before they were filtered and averaged,
    metres.
    pixels: how many depths were fused.
    """

    points: np.ndarray
    views: np.ndarray
    voxel: float
    noise: float
    pixels: int


@dataclass(frozen=True)
class Focus:
    """What the cameras look at. point: [3] in the world, metres; distance: the median of the
    cameras' distances from it, metres."""

    point: np.ndarray
    distance: float


def focus(frames: Sequence[Frame]) -> Focus:
    """The point nearest to the optical axes of all cameras, in the least-squares sense, and how far
    the cameras are from it."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for frame in frames:
        axis = frame.camera.world_to_camera[2, :3]
        across = np.eye(3) - np.outer(axis, axis)
        A, b = A + across, b + across @ frame.camera.position
    point = np.linalg.lstsq(A, b, rcond=1e-9)[0]
    return Focus(
        point, float(np.median([np.linalg.norm(frame.camera.position - point) for frame in frames]))
    )


def usable_depth(depth: np.ndarray, size: int = 3) -> np.ndarray:
    """A depth image [H,W], metres, with pixels on silhouettes and at grazing angles set to 0 (see
    EDGE_JUMP).

    size: width and height of the neighbourhood that is looked at, pixels. A pixel with a neighbour
    that has no return is set to 0 too: returns are lost at grazing angles, and those that are left
    there are the worst. With such pixels kept, the registration of a survey drifted twice as far.
    """
    jump = maximum_filter(depth, size) - minimum_filter(depth, size)
    return np.where(jump <= EDGE_JUMP * depth, depth, 0.0)


def fuse_frames(frames: Sequence[Frame]) -> Cloud:
    """Fuse the depth images of frames into one cloud.

    The points of all images are averaged on a grid, whose cells are as large as a pixel appears on
    the rock, or larger if the depths are noisy. If the noise (`depth_noise`) is more than a quarter
    of a cell, the images are smoothed first by `filter_depth`.
    Raises InputError if a frame has no depth image or cannot be read, or no depth can be used.
    """
    depths = [frame.depth() for frame in frames]
    returns = [depth[depth > 0] for depth in depths]
    total = sum(map(len, returns))
    if total == 0:
        raise InputError(
            "cloud: no depth image has a return (all pixels are 0); check the depth files or their unit (metres)"
        )
    stride = max(1, int(np.ceil(np.sqrt(total / MAX_FUSED_PIXELS))))
    # The lower quartile of the depths is about that of the rock, which stands in front of the
    # ground that fills most of a frame.
    near = [
        np.quantile(z, 0.25) / frame.camera.K[0, 0]
        for frame, z in zip(frames, returns, strict=True)
        if len(z)
    ]
    noise = float(np.median([depth_noise(depth) for depth in depths]))
    voxel = max(float(np.median(near)), FILTERED_SHARE * noise)
    target = focus(frames)
    points, views = [], []
    for frame, depth in zip(frames, depths, strict=True):
        z = usable_depth(filter_depth(depth, noise) if noise > voxel / 4 else depth)
        keep = np.zeros(z.shape, bool)
        keep[::stride, ::stride] = True
        world = frame.camera.unproject(z)
        keep &= (z > 0) & (np.linalg.norm(world - target.point, axis=-1) < REACH * target.distance)
        p = world[keep]
        view = frame.camera.position - p
        points.append(p)
        views.append(view / np.linalg.norm(view, axis=1, keepdims=True))
    p, index = voxel_means(np.concatenate(points), voxel)
    if len(p) == 0:
        raise InputError(
            "cloud: no usable depth near what the cameras look at; check the depth files and poses"
        )
    view = _group_means(np.concatenate(views), index, len(p))
    norm = np.linalg.norm(view, axis=1, keepdims=True)
    return Cloud(p, view / np.where(norm > 0, norm, 1.0), voxel, noise, len(index))


def _group_means(values: np.ndarray, index: np.ndarray, groups: int) -> np.ndarray:
    """Means [groups,3] of values [N,3] over the groups that `index` [N] assigns them to, 0 to
    groups - 1."""
    count = np.bincount(index, minlength=groups)
    return (
        np.stack([np.bincount(index, values[:, k], groups) for k in range(3)], 1) / count[:, None]
    )


def voxel_means(points: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Average points [N,3] on a grid with cells of edge `voxel`, metres.

    Returns the mean point of each cell that has points [M,3], and for each point the index of its
    cell among these [N].
    """
    if len(points) == 0:
        return points, np.zeros(0, int)
    cells = np.floor((points - points.min(0)) / voxel).astype(np.int64)
    size = cells.max(0) + 1
    key = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    unique, index = np.unique(key, return_inverse=True)
    return _group_means(points, index, len(unique)), index
