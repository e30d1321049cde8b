"""RGB-D frames -> one world cloud, averaged on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyParseError
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from mgs.data.dataset import Frame
from mgs.errors import InputError
from mgs.survey.depth_sensor import depth_noise, filter_depth

MAX_PIXELS = 6_000_000
"""Pixels that enter the cloud; more are thinned by a stride (100 frames at 640x480 still see each voxel ten times)."""

EDGE_JUMP = 0.05
"""A pixel whose 3x3 neighbourhood spans more than this share of its depth is a silhouette or a grazing view: its depth mixes
surfaces, so it is left out."""

REACH = 1.0
"""The cloud ends this many camera distances from the focus: far ground is not the ground under the rock."""

FILTERED_SHARE = 0.5
"""Noise left by the bilateral filter, as a share of what entered, with a margin (measured: 0.27)."""


@dataclass(frozen=True)
class Cloud:
    """A fused cloud: points [N,3] world, metres; views [N,3] unit, mean direction from each point to the cameras that saw it;
    voxel: edge of the fusion grid, metres, so also the distance of neighbouring points; noise: standard deviation of the
    depths before they were filtered and averaged, metres; pixels: how many depths were fused."""

    points: np.ndarray
    views: np.ndarray
    voxel: float
    noise: float
    pixels: int


@dataclass(frozen=True)
class Focus:
    """What the cameras look at: point [3] world, metres; distance: of the median camera from it, metres."""

    point: np.ndarray
    distance: float


def focus(frames: Sequence[Frame]) -> Focus:
    """The point nearest to all optical axes (least squares), and how far the cameras are from it."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for frame in frames:
        axis = frame.camera.world_to_camera[2, :3]
        across = np.eye(3) - np.outer(axis, axis)
        A, b = A + across, b + across @ frame.camera.position
    point = np.linalg.lstsq(A, b, rcond=1e-9)[0]
    return Focus(point, float(np.median([np.linalg.norm(frame.camera.position - point) for frame in frames])))


def usable_depth(depth: np.ndarray, size: int = 3) -> np.ndarray:
    """Depth [H,W] with silhouettes and grazing pixels set to 0 (see EDGE_JUMP); size: edge of the neighbourhood, pixels.

    A neighbour without return counts as a silhouette: returns are lost where the view grazes, and what is left there is the
    worst (with such pixels kept, a survey's registration drifted twice as far).
    """
    jump = maximum_filter(depth, size) - minimum_filter(depth, size)
    return np.where(jump <= EDGE_JUMP * depth, depth, 0.0)


def fuse_frames(frames: Sequence[Frame]) -> Cloud:
    """Fuse RGB-D frames into one world cloud, averaged on a grid of one pixel footprint, or coarser where the depth is noisy.

    Noisy depth images (see `depth_noise`) pass the bilateral filter first.
    Raises InputError where frames have no depth, or no pixel has a return.
    """
    depths = [frame.depth() for frame in frames]
    returns = [depth[depth > 0] for depth in depths]
    total = sum(map(len, returns))
    if total == 0:
        raise InputError("cloud: no depth image has a return (all pixels are 0); check the depth files or their unit (metres)")
    stride = max(1, int(np.ceil(np.sqrt(total / MAX_PIXELS))))
    # The lower quartile of depth: the rock stands in front of the ground that fills most of a frame.
    near = [np.quantile(z, 0.25) / frame.camera.K[0, 0] for frame, z in zip(frames, returns, strict=True) if len(z)]
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
    p, index = _voxel_means(np.concatenate(points), voxel)
    if len(p) == 0:
        raise InputError("cloud: no usable depth near what the cameras look at; check the depth files and poses")
    view = _group_means(np.concatenate(views), index, len(p))
    norm = np.linalg.norm(view, axis=1, keepdims=True)
    return Cloud(p, view / np.where(norm > 0, norm, 1.0), voxel, noise, len(index))


def sparse_cloud(path: Path) -> Cloud:
    """The cloud of an import's sparse.ply (x y z, nx ny nz direction to the cameras). Raises InputError if damaged."""
    try:
        data = PlyData.read(str(path))["vertex"].data
        columns = np.stack([np.asarray(data[name], np.float64) for name in ("x", "y", "z", "nx", "ny", "nz")], 1)
    except (PlyParseError, KeyError, ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a readable cloud ({error}); import the data again") from None
    if len(columns) < 2 or not np.isfinite(columns).all():
        raise InputError(f"{path}: has NaN values, or fewer than two points; import the data again")
    # Randomly scattered points are half as far from their nearest neighbour as a grid of the same density.
    spacing = 2 * float(np.median(cKDTree(columns[:, :3]).query(columns[:, :3], 2)[0][:, 1]))
    return Cloud(columns[:, :3], columns[:, 3:], spacing, 0.0, len(columns))


def _group_means(values: np.ndarray, index: np.ndarray, groups: int) -> np.ndarray:
    """Mean of values [N,3] by group index [N] -> [groups,3]."""
    count = np.bincount(index, minlength=groups)
    return np.stack([np.bincount(index, values[:, k], groups) for k in range(3)], 1) / count[:, None]


def _voxel_means(points: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean point of each occupied voxel [M,3], and the voxel of each point [N]."""
    if len(points) == 0:
        return points, np.zeros(0, int)
    cells = np.floor((points - points.min(0)) / voxel).astype(np.int64)
    size = cells.max(0) + 1
    key = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    unique, index = np.unique(key, return_inverse=True)
    return _group_means(points, index, len(unique)), index
