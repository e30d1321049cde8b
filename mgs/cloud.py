"""RGB-D frames -> one world cloud -> ground plane (RANSAC) -> the rock's points (DBSCAN)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from mgs.dataset import Frame
from mgs.errors import InputError
from mgs.files import atomic_path
from mgs.sensor import depth_noise, filter_depth

MAX_PIXELS = 6_000_000
"""Pixels that enter the cloud; more are thinned by a stride (100 frames at 640x480 still see each voxel ten times)."""
EDGE_JUMP = 0.05
"""A pixel whose 3x3 neighbourhood spans more than this share of its depth is a silhouette or a grazing view: its depth mixes
surfaces, so it is left out."""
REACH = 1.0
"""The cloud ends this many camera distances from the focus: far ground is not the ground under the rock."""
PLANE_TOLERANCE = 0.02
"""RANSAC inlier distance as a share of the camera distance: larger than the grain of a floor, smaller than a rock."""
PLANE_REACH = 0.5
"""The plane is refined on its inliers within this many camera distances of the focus: real ground undulates."""
PLANE_MIN_SHARE = 0.2
"""With fewer inliers than this share of the cloud, there is no dominant plane."""
FILTERED_SHARE = 0.5
"""Noise left by the bilateral filter, as a share of what entered, with a margin (measured: 0.27)."""
CLUSTER_POINTS = 20_000
"""DBSCAN runs on a cloud thinned to at most this many points; its labels are then passed to the full cloud."""
CLUSTER_NEIGHBOURS = 8
"""DBSCAN min_samples, and the neighbour whose median distance sets eps."""
EQUAL_SIZE = 0.8
"""Clusters of at least this share of the largest's points count as equally large; then nearness to the focus decides."""


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
class Plane:
    """Points x with normal . x = offset; normal [3] unit, towards the cameras. sigma: robust spread of the inliers, metres;
    tolerance: points nearer than this to the plane, or below it, belong to the ground."""

    normal: np.ndarray
    offset: float
    sigma: float
    tolerance: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """Signed distance [N] of points [N,3] above the plane, metres."""
        return points @ self.normal - self.offset


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


class _PlaneModel:
    """Least-squares plane in the interface of skimage.measure.ransac."""

    def __init__(self, normal: np.ndarray, offset: float) -> None:
        self.normal, self.offset = normal, offset

    @classmethod
    def from_estimate(cls, points: np.ndarray) -> _PlaneModel:
        centre = points.mean(0)
        normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
        return cls(normal, float(normal @ centre))

    def residuals(self, points: np.ndarray) -> np.ndarray:
        return points @ self.normal - self.offset


def ground_plane(cloud: Cloud, frames: Sequence[Frame], seed: int) -> Plane:
    """The dominant plane by RANSAC (Fischler and Bolles 1981, scikit-image) on 10,000 points, refined on all its inliers.

    Raises InputError where no plane holds a fifth of the cloud.
    """
    from skimage.measure import ransac

    target = focus(frames)
    tolerance = PLANE_TOLERANCE * target.distance
    rng = np.random.default_rng(seed)
    sample = cloud.points if len(cloud.points) <= 10_000 else rng.choice(cloud.points, 10_000, replace=False)
    if len(sample) < 3:
        raise InputError(f"cloud: only {len(sample)} points; too few for a plane, give more depth frames")
    model, inliers = ransac(sample, _PlaneModel, 3, tolerance, max_trials=300, rng=rng)
    share = 0.0 if inliers is None else float(np.mean(inliers))
    if share < PLANE_MIN_SHARE:
        raise InputError(f"cloud: no ground plane (the best holds {share:.0%} of the cloud); show ground, or give --mesh")
    around = cloud.points[np.linalg.norm(cloud.points - target.point, axis=1) < PLANE_REACH * target.distance]
    for _ in range(3):
        residual = model.residuals(around)
        core = np.abs(residual) < tolerance
        if core.sum() < 3:
            raise InputError("cloud: no ground around what the cameras look at; show ground, or give --mesh")
        sigma = 1.4826 * float(np.median(np.abs(residual[core] - np.median(residual[core]))))
        tolerance = min(tolerance, max(3 * sigma, 2 * cloud.voxel))
        model = _PlaneModel.from_estimate(around[core & (np.abs(residual) < tolerance)])
    cameras = np.stack([frame.camera.position for frame in frames])
    sign = 1.0 if np.median(cameras @ model.normal) > model.offset else -1.0
    return Plane(sign * model.normal, sign * model.offset, sigma, tolerance)


def rock_cluster(points: np.ndarray, voxel: float, target: np.ndarray, root: str = "cloud") -> tuple[np.ndarray, float, int]:
    """The rock among the points above ground [N,3] (metres), by DBSCAN (Ester et al. 1996, scikit-learn).

    eps is twice the median distance to the 8th neighbour. The cluster with the most points is the rock; among clusters of
    nearly that size, the one nearest to `target` [3], the point the cameras look at.
    Returns (inside [N] bool, eps in metres, number of clusters).
    Raises InputError where there is no cluster, or where two clusters are equally large and equally near.
    """
    from sklearn.cluster import DBSCAN

    thin, cell = points, voxel
    while len(thin) > CLUSTER_POINTS:
        cell *= 1.25
        thin = _voxel_means(points, cell)[0]
    if len(thin) <= CLUSTER_NEIGHBOURS:
        raise InputError(f"{root}: no rock in the cloud ({len(points)} points above the ground plane); aim the cameras at one")
    eps = 2 * float(np.median(cKDTree(thin).query(thin, CLUSTER_NEIGHBOURS + 1)[0][:, -1]))
    labels = DBSCAN(eps=eps, min_samples=CLUSTER_NEIGHBOURS).fit_predict(thin)
    count = int(labels.max()) + 1
    if count == 0:
        raise InputError(f"{root}: no rock in the cloud (only scattered points above the ground plane); aim the cameras at one")
    sizes = np.bincount(labels[labels >= 0])
    large = np.flatnonzero(sizes >= EQUAL_SIZE * sizes.max())
    away = np.array([np.linalg.norm(thin[labels == k].mean(0) - target) for k in large])
    order = np.argsort(away, kind="stable")
    if len(large) > 1 and away[order[1]] < 1.25 * away[order[0]]:
        raise InputError(
            f"{root}: clusters of {sizes[large[order[0]]]} and {sizes[large[order[1]]]} points are equally large and equally "
            "near to what the cameras look at; aim them at one rock"
        )
    rock = int(large[order[0]])
    distance, nearest = cKDTree(thin).query(points, distance_upper_bound=eps)
    inside = np.isfinite(distance) & (np.append(labels, -1)[nearest] == rock)
    return inside, eps, count


def degrade(points: np.ndarray, noise: float, holes: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Spoil a rock's points [N,3] on purpose: Gaussian noise of standard deviation `noise` (metres) on every coordinate, and
    round holes of a tenth of the rock's extent until the share `holes` of the points is gone.

    Returns (points [N,3], kept [N] bool).
    """
    kept = np.ones(len(points), bool)
    radius = 0.1 * float(np.ptp(points, axis=0).max())
    while (~kept).mean() < holes:
        centre = points[rng.choice(np.flatnonzero(kept))]
        kept &= np.linalg.norm(points - centre, axis=1) > radius
    return points + noise * rng.standard_normal(points.shape), kept


def write_points(path: str | Path, points: np.ndarray, normals: np.ndarray) -> None:
    """Write points and normals [N,3] as a binary PLY (x y z nx ny nz, float32), atomically."""
    columns = np.concatenate([points, normals], 1).astype(np.float32)
    vertices = np.empty(len(columns), dtype=[(name, "f4") for name in ("x", "y", "z", "nx", "ny", "nz")])
    for k, name in enumerate(vertices.dtype.names or ()):
        vertices[name] = columns[:, k]
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")]).write(str(temporary))
