"""The cloud -> ground plane (RANSAC) -> the rock's points (DBSCAN)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from mgs.data.dataset import Frame
from mgs.errors import InputError

if TYPE_CHECKING:
    pass
from collections.abc import Callable

from mgs.data.dataset import Dataset
from mgs.prior.settings import PriorSettings
from mgs.seeds import derive_seed, generator
from mgs.survey.fusion import FILTERED_SHARE, Cloud, focus, fuse_frames, sparse_cloud, voxel_means

PLANE_TOLERANCE = 0.02
"""RANSAC inlier distance as a share of the camera distance: larger than the grain of a floor, smaller than a rock."""

PLANE_REACH = 0.5
"""The plane is refined on its inliers within this many camera distances of the focus: real ground undulates."""

PLANE_MIN_SHARE = 0.2
"""With fewer inliers than this share of the cloud, there is no dominant plane."""

CLUSTER_POINTS = 20_000
"""DBSCAN runs on a cloud thinned to at most this many points; its labels are then passed to the full cloud."""

CLUSTER_NEIGHBOURS = 8
"""DBSCAN min_samples, and the neighbour whose median distance sets eps."""

EQUAL_SIZE = 0.8
"""Clusters of at least this share of the largest's points count as equally large; then nearness to the focus decides."""


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
        thin = voxel_means(points, cell)[0]
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


NORMAL_NEIGHBOURS = (16, 128)
"""Points of the local plane fit of a normal: without noise, and at most."""


def estimate_normals(points: np.ndarray, views: np.ndarray, roughness: float = 0.0) -> np.ndarray:
    """Unit normals [N,3] by plane fits to neighbours (Hoppe et al. 1992), turned towards the cameras (views [N,3]).

    roughness: noise over the distance of neighbouring points; the number of neighbours, 16, grows with it.
    """
    least, most = NORMAL_NEIGHBOURS
    count = min(int(least * (1 + 2 * roughness)), most, len(points))
    neighbours = points[cKDTree(points).query(points, count)[1]]
    centred = neighbours - neighbours.mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][..., 0]
    return normals * np.where(np.einsum("nk,nk->n", normals, views) < 0, -1.0, 1.0)[:, None]


FLOOR_UPRIGHT = 0.9
"""A cluster point within two plane tolerances of the ground whose normal is this upright (cosine) is a swell of the ground at
the foot of the rock, not rock."""


@dataclass(frozen=True)
class Rock:
    """From the cloud to the rock: ground [P] bool, points of the cloud on the plane; points [M,3], the rock's cluster, and
    normals [M,3]; eps: metres, and clusters: how many DBSCAN found."""

    cloud: Cloud
    plane: Plane
    ground: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    eps: float
    clusters: int


def find_rock(dataset: Dataset, settings: PriorSettings, on_stage: Callable[[str], None]) -> Rock:
    """Cloud, ground plane, rock cluster and its normals (spoilt as `settings` say). Raises InputError as `build_prior`."""
    on_stage("cloud")
    sparse = dataset.root / "sparse.ply"
    if sparse.is_file() and not any(frame.depth_path for frame in dataset.frames):
        cloud = sparse_cloud(sparse)
    else:
        cloud = fuse_frames(dataset.frames)
    on_stage("ground plane")
    plane = ground_plane(cloud, dataset.frames, derive_seed(settings.seed, "prior/plane"))
    ground = np.abs(plane.height(cloud.points)) <= plane.tolerance
    above = plane.height(cloud.points) > plane.tolerance
    on_stage("rock cluster")
    inside, eps, clusters = rock_cluster(cloud.points[above], cloud.voxel, focus(dataset.frames).point, str(dataset.root))
    points, views = cloud.points[above][inside], cloud.views[above][inside]
    points, kept = degrade(points, settings.noise, settings.holes, generator(settings.seed, "prior/degrade"))
    points, views = points[kept], views[kept]
    normals = estimate_normals(points, views, (FILTERED_SHARE * cloud.noise + settings.noise) / cloud.voxel)
    floor = (plane.height(points) < 2 * plane.tolerance) & (normals @ plane.normal > FLOOR_UPRIGHT)
    return Rock(cloud, plane, ground, points[~floor], normals[~floor], eps, clusters)
