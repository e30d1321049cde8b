"""Segmentation of the fused cloud: ground plane (RANSAC), rock points (DBSCAN), normals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mgs.data.dataset import Dataset
from mgs.data.frames import Frame, has_masks, mask_share
from mgs.errors import InputError
from mgs.prior.settings import PriorSettings
from mgs.progress import report
from mgs.seeds import derive_seed
from mgs.survey.depth_sensor import SIGMA_FROM_MAD
from mgs.survey.fusion import FILTERED_SHARE, Cloud, focus, fuse_frames, voxel_means

PLANE_TOLERANCE = 0.02  # largest distance of RANSAC's inliers, over the cameras' distance
PLANE_REACH = 0.5  # radius around the focus of the plane's refinement, over the cameras' distance
PLANE_MIN_SHARE = 0.2  # least share of the cloud on the plane for it to be the ground
CLUSTER_POINTS = 20_000  # most points that DBSCAN sees; others take the label of the nearest
CLUSTER_NEIGHBOURS = 8  # DBSCAN's min_samples; eps: twice the median distance to this neighbour
EQUAL_SIZE = 0.8  # least share of the largest cluster for one to count as equally large
NEARER = 1.25  # least ratio of distances from the focus that tells equally large clusters apart
IN_MASKS = 0.8  # least share of masks with the median point of another cluster of the rock
# Without masks, another cluster belongs to the rock if the gap is at most this share of its extent,
# and its median point is above or below the rock, but for a tenth of that.
STACKED = 0.5
LEAST_PART = 0.02  # least number of points of another part of the rock, over that of its largest
NORMAL_NEIGHBOURS = (16, 128)  # neighbours for a normal: without noise, and at most
# Points within two plane tolerances of the ground are left out at the foot of the rock.
FLOOR_UPRIGHT = 0.9  # least cosine between their normals and the ground's


@dataclass(frozen=True)
class Plane:
    """The ground plane normal . x = offset, metres."""

    normal: np.ndarray  # [3] unit, on the side of the cameras
    offset: float
    sigma: float  # robust standard deviation of the inliers' distances, metres
    tolerance: float  # points below this height are ground, metres

    @classmethod
    def from_estimate(cls, points: np.ndarray) -> "Plane":
        """Least-squares plane of points [N,3], for skimage.measure.ransac; sigma, tolerance 0."""
        centre = points.mean(0)
        normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
        return cls(normal, float(normal @ centre), 0.0, 0.0)

    def height(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of points [N,3] from the plane [N], metres."""
        return points @ self.normal - self.offset

    residuals = height


class NoSurface(InputError):
    """A cloud gives no surface. points: [P,3]; kept: [P] bool, taken for the object."""

    def __init__(self, message: str, points: np.ndarray, kept: np.ndarray) -> None:
        super().__init__(message)
        self.points, self.kept = points, kept


def ground_plane(cloud: Cloud, frames: Sequence[Frame], seed: int) -> Plane:
    """Plane that holds most points of a cloud, by RANSAC (Fischler and Bolles 1981, scikit-image).

    RANSAC sees at most 10,000 points, drawn by the seed. The plane is then refined three times on
    its inliers near what the cameras look at, within three of their standard deviations, but at
    least two voxels. Raises InputError if the plane holds under a fifth of the cloud, or nothing
    near the focus."""
    from skimage.measure import ransac

    target = focus(frames)
    tolerance = PLANE_TOLERANCE * target.distance
    rng = np.random.default_rng(seed)
    sample = cloud.points
    if len(sample) > 10_000:
        sample = rng.choice(sample, 10_000, replace=False)
    if len(sample) < 3:
        cure = "too few for a plane, give more depth frames"
        raise InputError(f"cloud: only {len(sample)} points; {cure}")
    model, inliers = ransac(sample, Plane, 3, tolerance, max_trials=300, rng=rng)
    share = 0.0 if inliers is None else float(np.mean(inliers))
    if share < PLANE_MIN_SHARE:
        why = f"no ground plane (the best holds {share:.0%} of the cloud)"
        raise InputError(f"cloud: {why}; photograph more ground, or give `mesh`")
    away = np.linalg.norm(cloud.points - target.point, axis=1)
    around = cloud.points[away < PLANE_REACH * target.distance]
    for _ in range(3):
        residual = model.residuals(around)
        core = np.abs(residual) < tolerance
        if core.sum() < 3:
            cure = "photograph it, or give `mesh`"
            raise InputError(f"cloud: no ground near what the cameras look at; {cure}")
        spread = np.abs(residual[core] - np.median(residual[core]))
        sigma = SIGMA_FROM_MAD * float(np.median(spread))
        tolerance = min(tolerance, max(3 * sigma, 2 * cloud.voxel))
        model = Plane.from_estimate(around[core & (np.abs(residual) < tolerance)])
    cameras = np.stack([frame.camera.position for frame in frames])
    sign = 1.0 if np.median(cameras @ model.normal) > model.offset else -1.0
    return Plane(sign * model.normal, sign * model.offset, sigma, tolerance)


def dbscan(points: np.ndarray, eps: float, least: int) -> np.ndarray:
    """Cluster of each point [N], from 0, or -1, by DBSCAN (Ester et al. 1996). points: [N,3]; eps:
    radius of neighbourhoods; least: points in one, its own among them, that make a core.

    The same labels as scikit-learn's DBSCAN, which takes a second to import."""
    n, pairs = len(points), cKDTree(points).query_pairs(eps, output_type="ndarray")
    core = 1 + np.bincount(pairs.ravel(), minlength=n) >= least
    joined = pairs[core[pairs].all(axis=1)]
    graph = coo_array((np.ones(len(joined), bool), tuple(joined.T)), shape=(n, n))
    piece = connected_components(graph, directed=False)[1]
    number = np.full(n, n)
    number[core] = np.unique(piece[core], return_inverse=True)[1]
    # A point at the border of several clusters belongs to the first.
    labels = number.copy()
    for near, of in (pairs.T, pairs[:, ::-1].T):
        np.minimum.at(labels, near, np.where(core[near], n, number[of]))
    return np.where(labels == n, -1, labels)


def rock_cluster(
    points: np.ndarray,
    voxel: float,
    target: np.ndarray,
    name: str = "cloud",
    weight: Callable[[np.ndarray], np.ndarray] = lambda points: np.ones(len(points)),
    sparse: float = 0.0,
    belongs: Callable[[np.ndarray, np.ndarray], bool] = lambda part, rock: False,
) -> tuple[np.ndarray, float, int]:
    """Find the rock among points above the ground [N,3], by `dbscan`.

    voxel: distance between neighbours, metres. target: [3] point that the cameras look at, metres.
    name: of the cloud, for messages. weight: points [N,3] -> weights [N]. sparse: distance between
    neighbours where the cloud is sparse, metres; DBSCAN sees no finer points, since it takes one
    density for all. The rock is the cluster of largest weight, or of several nearly as large ones
    (EQUAL_SIZE) the nearest to the target; with it go the clusters of which belongs(points of the
    cluster, points of the rock so far) is true. Returns (inside [N] bool, eps in metres, number of
    clusters). Raises InputError if there is no cluster, or two that do not belong together are
    equally large and about equally near."""
    thin, cell = points, voxel
    while cell < sparse or len(thin) > CLUSTER_POINTS:
        cell = max(1.25 * cell, sparse)
        thin = voxel_means(points, cell)[0]
    if len(thin) <= CLUSTER_NEIGHBOURS:
        why = f"no rock in the cloud ({len(points)} points above the ground plane)"
        raise InputError(f"{name}: {why}; aim the cameras at one")
    eps = 2 * float(np.median(cKDTree(thin).query(thin, CLUSTER_NEIGHBOURS + 1)[0][:, -1]))
    labels = dbscan(thin, eps, CLUSTER_NEIGHBOURS)
    count = int(labels.max()) + 1
    if count == 0:
        why = "no rock in the cloud (only scattered points above the ground plane)"
        raise InputError(f"{name}: {why}; aim the cameras at one")
    sizes = np.bincount(labels[labels >= 0], weight(thin)[labels >= 0])
    large = np.flatnonzero(sizes >= EQUAL_SIZE * sizes.max())
    away = np.array([np.linalg.norm(thin[labels == k].mean(0) - target) for k in large])
    order = np.argsort(away, kind="stable")
    rock = int(large[order[0]])
    parts, least = [rock], LEAST_PART * (labels == rock).sum()
    others = [k for k in range(count) if k != rock and (labels == k).sum() >= least]
    while more := [k for k in others if belongs(thin[labels == k], thin[np.isin(labels, parts)])]:
        parts, others = parts + more, [k for k in others if k not in more]
    if len(large) > 1 and away[order[1]] < NEARER * away[order[0]] and large[order[1]] not in parts:
        first, second = ((labels == large[k]).sum() for k in order[:2])
        raise InputError(
            f"{name}: clusters of {first} and {second} points are equally large and equally near "
            "to what the cameras look at; aim them at one rock"
        )
    distance, nearest = cKDTree(thin).query(points, distance_upper_bound=eps)
    inside = np.isfinite(distance) & np.isin(np.append(labels, -1)[nearest], parts)
    return inside, eps, count


def estimate_normals(points: np.ndarray, views: np.ndarray, roughness: float = 0.0) -> np.ndarray:
    """Unit normals [N,3] of points [N,3], of the plane through their neighbours (Hoppe et al.
    1992). views [N,3]: directions to the cameras, which decide the sign. roughness: noise over the
    distance between neighbours; the more, the more neighbours are used."""
    least, most = NORMAL_NEIGHBOURS
    count = min(int(least * (1 + 2 * roughness)), most, len(points))
    neighbours = points[cKDTree(points).query(points, count)[1]]
    centred = neighbours - neighbours.mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][..., 0]
    return normals * np.where(np.einsum("nk,nk->n", normals, views) < 0, -1.0, 1.0)[:, None]


@dataclass(frozen=True)
class SegmentedCloud:
    """A cloud of P points, divided into ground, rock and the rest."""

    cloud: Cloud
    plane: Plane | None  # None if there is none or it was not needed
    ground: np.ndarray  # [P] bool, points on the plane
    rock_points: np.ndarray  # [M,3] of which the mesh is built, without the ground at its foot
    rock_normals: np.ndarray  # [M,3] unit
    eps: float  # of DBSCAN, metres
    clusters: int


def segment_dataset(dataset: Dataset, settings: PriorSettings) -> SegmentedCloud:
    """Fuse the depth images of a dataset into a cloud, and find the ground and the rock. Raises
    InputError as `fuse_frames`, `ground_plane` and `rock_cluster`."""
    report("cloud")
    cloud = fuse_frames(dataset.frames)
    report("ground plane")
    plane = ground_plane(cloud, dataset.frames, derive_seed(settings.seed, "prior/plane"))
    ground = np.abs(plane.height(cloud.points)) <= plane.tolerance
    above = plane.height(cloud.points) > plane.tolerance
    report("rock cluster")
    target = focus(dataset.frames).point

    def weight(points: np.ndarray) -> np.ndarray:
        height = plane.height(points)  # a low rise of the ground may have more points than a rock
        masked = has_masks(dataset.frames)
        return height * (mask_share(points, dataset.frames)[0] if masked else 1)

    def belongs(part: np.ndarray, rock: np.ndarray) -> bool:
        if has_masks(dataset.frames):
            return float(np.median(mask_share(part, dataset.frames)[0])) >= IN_MASKS
        reach = STACKED * float(np.ptp(rock, axis=0).max())
        gap = float(cKDTree(rock).query(part)[0].min())
        flat = [points - np.outer(points @ plane.normal, plane.normal) for points in (rock, part)]
        beside = float(np.median(cKDTree(flat[0]).query(flat[1])[0]))
        return gap < reach and beside < reach / 10

    name = str(dataset.root)
    inside, eps, clusters = rock_cluster(
        cloud.points[above], cloud.voxel, target, name, weight, cloud.sparse, belongs
    )
    points, views = cloud.points[above][inside], cloud.views[above][inside]
    roughness = FILTERED_SHARE * cloud.noise / cloud.voxel
    normals = estimate_normals(points, views, roughness)
    floor = (plane.height(points) < 2 * plane.tolerance) & (normals @ plane.normal > FLOOR_UPRIGHT)
    return SegmentedCloud(cloud, plane, ground, points[~floor], normals[~floor], eps, clusters)
