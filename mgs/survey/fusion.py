"""Fusion of depth images into one cloud on a grid; and what the cameras of a dataset look at."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from mgs.data.frames import Frame, in_image, nearest_point
from mgs.errors import InputError
from mgs.survey.depth_sensor import depth_noise, filter_depth

# Beyond, rows and columns are skipped; of 100 frames of 640x480 ten still see each voxel.
MAX_FUSED_PIXELS = 6_000_000  # about the most pixels that are fused
# Beyond it lie silhouettes, where a depth may mix two surfaces, and grazing views.
EDGE_JUMP = 0.05  # largest depth difference around a pixel, over its depth
LEAST_OVERLAP = 0.5  # least share of cameras that have in their image the point that all look at
# Depth over that of this point, median of so many frames, from which nothing is there. Chosen.
BEHIND, JUDGES = 1.5, 24
REACH = 1.0  # radius of the cloud around the focus, over the cameras' distance from it
ALIKE = 1.25  # largest pixel of the nearest frames, over the lower quartile of all
FILTERED_SHARE = 0.5  # noise after the bilateral filter, over before; measured 0.27, with a margin


@dataclass(frozen=True)
class Cloud:
    """A fused cloud of N points."""

    points: np.ndarray  # [N,3] world, metres
    views: np.ndarray  # [N,3] unit, mean direction to the cameras that saw each point
    voxel: float  # cell of the grid, metres, about the distance between neighbours
    noise: float  # standard deviation of the depths before filtering, metres
    pixels: int  # number of fused depths
    sparse: float = 0.0  # distance between neighbours that only far cameras see, metres


@dataclass(frozen=True)
class Focus:
    """Point that the cameras look at [3], and their median distance from it, metres."""

    point: np.ndarray
    distance: float


def focus(frames: Sequence[Frame]) -> Focus:
    """Point nearest to all optical axes (least squares), and the cameras' distance from it."""
    cameras = [frame.camera for frame in frames]
    positions = [camera.position for camera in cameras]
    point = nearest_point(positions, [camera.world_to_camera[2, :3] for camera in cameras])
    return Focus(point, float(np.median([np.linalg.norm(eye - point) for eye in positions])))


def looking_at_one(frames: Sequence[Frame]) -> list[bool]:
    """Whether each camera has in its image the point that all look at."""
    point = focus(frames).point[None]
    return [bool(in_image(frame.camera, *frame.camera.project(point))[0]) for frame in frames]


def of_one_object(frames: Sequence[Frame]) -> bool:
    """Whether frames with depth look at one thing, and neither around them, as from the air, nor
    through the middle of a room (BEHIND). At most JUDGES frames are read."""
    if np.mean(looking_at_one(frames)) < LEAST_OVERLAP:
        return False
    point, ratios = focus(frames).point[None], list[float]()
    for frame in frames[:: -(-len(frames) // JUDGES)]:
        pixels, z = frame.camera.project(point)
        if in_image(frame.camera, pixels, z)[0]:
            column, row = pixels[0].astype(int)
            ratios += [depth / z[0] for depth in [frame.depth()[row, column]] if depth > 0]
    return not ratios or float(np.median(ratios)) < BEHIND


def usable_depth(depth: np.ndarray, size: int = 3) -> np.ndarray:
    """Depth image [H,W], metres, with pixels on silhouettes and at grazing angles set to 0
    (EDGE_JUMP). size: of the neighbourhood, pixels. Pixels beside a lost return are set to 0 too:
    returns are lost at grazing angles, and those left there are the worst. With them, registration
    drifted twice as far."""
    jump = maximum_filter(depth, size) - minimum_filter(depth, size)
    return np.where(jump <= EDGE_JUMP * depth, depth, 0.0)


def fuse_frames(frames: Sequence[Frame], reach: float = REACH) -> Cloud:
    """Fuse the depth images of frames into one cloud, averaged on a grid. What is farther from the
    point that all look at than `reach` times the cameras is left out. A cell is as large as a
    pixel of the nearest frames on the rock, or larger if the depths are noisy. With `depth_noise`
    over a quarter of a cell, the images are smoothed first by `filter_depth`. Raises InputError if
    a frame has no depth image or cannot be read, or no depth can be used."""
    depths = [frame.depth() for frame in frames]
    returns = [depth[depth > 0] for depth in depths]
    total = sum(map(len, returns))
    if total == 0:
        cure = "check the depth files, or their unit (metres)"
        raise InputError(f"cloud: no depth image has a return; {cure}")
    stride = max(1, int(np.ceil(np.sqrt(total / MAX_FUSED_PIXELS))))
    # The lower quartile of depths is about that of the rock; most of a frame is ground behind it.
    of_frames = zip(frames, returns, strict=True)
    pixels = [np.quantile(z, 0.25) / frame.camera.focal for frame, z in of_frames if len(z)]
    near = [p for p in pixels if p <= ALIKE * np.quantile(pixels, 0.25)]
    noise = float(np.median([depth_noise(depth) for depth in depths]))
    voxel = max(float(np.median(near)), FILTERED_SHARE * noise)
    target = focus(frames)
    points, views = [], []
    for frame, depth in zip(frames, depths, strict=True):
        z = usable_depth(filter_depth(depth, noise) if noise > voxel / 4 else depth)
        keep = np.zeros(z.shape, bool)
        keep[::stride, ::stride] = True
        world = frame.camera.unproject(z)
        keep &= (z > 0) & (np.linalg.norm(world - target.point, axis=-1) < reach * target.distance)
        p = world[keep]
        view = frame.camera.position - p
        points.append(p)
        views.append(view / np.linalg.norm(view, axis=1, keepdims=True))
    p, index = voxel_means(np.concatenate(points), voxel)
    if len(p) == 0:
        cure = (
            "check the depth files and poses; a whole scene is fitted without a prior (`mgs fit`)"
        )
        raise InputError(f"cloud: no usable depth near what the cameras look at; {cure}")
    view = _group_means(np.concatenate(views), index, len(p))
    norm = np.linalg.norm(view, axis=1, keepdims=True)
    unit = view / np.where(norm > 0, norm, 1.0)
    return Cloud(p, unit, voxel, noise, len(index), float(np.median(pixels)))


def _group_means(values: np.ndarray, index: np.ndarray, groups: int) -> np.ndarray:
    """Means [groups,3] of values [N,3] over groups given by `index` [N]."""
    sums = np.stack([np.bincount(index, values[:, k], groups) for k in range(3)], 1)
    return sums / np.bincount(index, minlength=groups)[:, None]


def voxel_means(points: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Average points [N,3] on a grid with cells of edge `voxel`, metres. Returns the mean point of
    each occupied cell [M,3], and each point's index among these [N]."""
    if len(points) == 0:
        return points, np.zeros(0, int)
    cells = np.floor((points - points.min(0)) / voxel).astype(np.int64)
    size = cells.max(0) + 1
    key = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    unique, index = np.unique(key, return_inverse=True)
    return _group_means(points, index, len(unique)), index
