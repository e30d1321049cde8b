"""Triangulated points -> the points of the object, with normals.

Clouds of real photographs are uneven: dense on texture, empty on plain parts, with wrong points
anywhere, and often without ground. So points are judged one by one (track, reprojection error),
then by masks where there are some, otherwise by the ground plane where there is one and by clusters
that follow density (HDBSCAN), and last by their neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mgs.data.clouds import SparseCloud, views_of
from mgs.data.dataset import Dataset, Frame
from mgs.data.up import Up
from mgs.data.visibility import has_masks, mask_share
from mgs.errors import InputError
from mgs.prior.segmentation import (
    NoSurface,
    Plane,
    SegmentedCloud,
    degrade,
    estimate_normals,
    ground_plane,
)
from mgs.prior.settings import PriorSettings
from mgs.seeds import derive_seed, generator
from mgs.survey.depth_sensor import SIGMA_FROM_MAD
from mgs.survey.fusion import REACH, Cloud, focus

LEAST_TRACK = 3
"""Fewest images that must have seen a point: two can agree by chance."""

ERROR_LIMIT = 2.5
"""Largest reprojection error of a point: the median plus this many robust standard deviations."""

MASK_SHARE = 0.95
"""Least share of the frames that have a point in their image in whose mask it must fall
(`mask_share`)."""

MASK_SLACK = 2
"""Pixels by which masks are widened for this, for the errors of points and poses."""

LEAST_POINTS = 100
"""Fewest points of the object from which a surface is built."""

CLUSTER_SHARE = 0.02
"""HDBSCAN's min_cluster_size as a share of the points; at least CLUSTER_SAMPLES of them."""

CLUSTER_SAMPLES = 10
"""HDBSCAN's min_samples: the neighbours that the density at a point is measured by."""

JOINED = 4.0
"""Clusters with points nearer to each other than this many distances between neighbouring points
are one: texture that comes and goes makes several of one object."""

GROWN, GROWN_NEIGHBOURS = 0.15, 4
"""Above a ground plane, points that are joined to the cluster belong to it too: DBSCAN with eps
this share of the cluster's extent, and min_samples. A part with few points, for instance in shade,
is no cluster of its own, but nothing else stands there."""

PLANE_TILT = 45.0
"""Largest angle between the ground plane's normal and the dataset's up, degrees: the front of a
building is a plane as well."""

PLANE_VOXEL = 0.25
"""What the ground plane takes for the voxel of a cloud, over the distance between its points:
points of a fused cloud are as far from the plane as their voxels are large, triangulated ones are
better than they are dense."""

NEIGHBOURS = 16
"""Neighbours that a point is compared with to see whether it lies off the surface."""

OFF_SURFACE = 3.0
"""Largest distance of a point from the plane of its neighbours, in robust standard deviations of
this distance."""

ALONE = 5.0
"""Largest distance of a point to the eighth of its neighbours, over the median of this distance."""


def spacing_of(points: np.ndarray) -> float:
    """The distance between neighbours in a regular grid as dense as points [N,3]: in a random
    cloud, twice the median distance to the nearest neighbour."""
    return 2 * float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))


def reliable(cloud: SparseCloud) -> np.ndarray:
    """Which points are triangulated well, bool [N]: by their track and reprojection error, where
    these are known."""
    kept = np.ones(len(cloud.points), bool)
    if cloud.track is not None:
        kept &= cloud.track >= LEAST_TRACK
    if cloud.error is not None:
        middle = np.median(cloud.error)
        sigma = SIGMA_FROM_MAD * np.median(np.abs(cloud.error - middle))
        kept &= cloud.error <= middle + ERROR_LIMIT * sigma
    return kept if kept.sum() >= LEAST_POINTS else np.ones(len(kept), bool)


def on_surface(points: np.ndarray) -> np.ndarray:
    """Which points [N,3] have neighbours, and lie near the plane through them; bool [N]."""
    count = min(NEIGHBOURS + 1, len(points))
    distance, index = cKDTree(points).query(points, count)
    around = points[index[:, 1:]]
    middle = around.mean(1)
    across = around - middle[:, None]
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", across, across))[1][..., 0]
    off = np.abs(np.einsum("nk,nk->n", points - middle, normals))
    apart = distance[:, min(8, count - 1)]
    return (off < OFF_SURFACE * SIGMA_FROM_MAD * np.median(off)) & (
        apart < ALONE * np.median(apart)
    )


def main_cluster(points: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, int]:
    """Which points [N,3] belong to the cluster of the largest total weight [N], by HDBSCAN
    (Campello et al. 2013, scikit-learn), and how many clusters there are. All points, and 0, where
    no part is denser than another.

    Points that HDBSCAN gives to no cluster, because few are around them, belong to the one that
    they are next to."""
    from sklearn.cluster import HDBSCAN

    least = max(CLUSTER_SAMPLES, int(CLUSTER_SHARE * len(points)))
    if len(points) < 2 * least:
        return np.ones(len(points), bool), 0
    labels = HDBSCAN(min_cluster_size=least, min_samples=CLUSTER_SAMPLES, copy=True).fit_predict(
        points
    )
    if labels.max() < 0:
        return np.ones(len(points), bool), 0
    pairs = labels[cKDTree(points).query_pairs(JOINED * spacing_of(points), output_type="ndarray")]
    pairs = pairs[(pairs >= 0).all(1)]
    count = int(labels.max()) + 1
    touching = coo_array(
        (np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count)
    )
    pieces, piece = connected_components(touching, directed=False)
    joined = np.where(labels >= 0, piece[labels], -1)
    total = np.bincount(joined[joined >= 0], weight[joined >= 0], pieces)
    chosen = joined == total.argmax()
    near = cKDTree(points[chosen]).query(points)[0] < JOINED * spacing_of(points)
    return chosen | (near & (joined < 0)), int(pieces)


def segment_points(
    sparse: SparseCloud, dataset: Dataset, settings: PriorSettings, tell: Callable[[str], None]
) -> SegmentedCloud:
    """The object in a triangulated cloud. With masks: what lies inside all of them. Without: what
    stands above the ground, or where there is none, the densest thing near what the cameras look
    at.

    tell(name) is called as each stage starts. Raises NoSurface where too few points are left.
    """
    tell("points")
    frames = dataset.frames
    good = reliable(sparse)
    points, views = sparse.points[good], views_of(sparse, [frame.camera for frame in frames])[good]
    cloud = Cloud(points, views, spacing_of(points), 0.0, len(sparse.points))
    plane, ground, clusters = None, np.zeros(len(points), bool), 0
    if has_masks(frames):
        share, count = mask_share(points, frames, MASK_SLACK)
        kept = (share >= MASK_SHARE) & (count >= LEAST_TRACK)
        where = "inside the masks; give masks and poses that fit, or --from hull"
    else:
        tell("ground plane and clusters")
        plane = _plane_or_none(cloud, frames, dataset.up, settings)
        ground = (
            np.zeros(len(points), bool)
            if plane is None
            else np.abs(plane.height(points)) <= plane.tolerance
        )
        kept, clusters = _cluster_looked_at(cloud, frames, plane)
        where = f"in one cluster {'above the ground' if plane else 'near what the cameras look at'}; give masks of the object"
    if kept.sum() >= LEAST_POINTS:
        kept[kept] = on_surface(points[kept])
    if kept.sum() < LEAST_POINTS:
        raise NoSurface(
            f"{dataset.root}: only {kept.sum()} of {len(sparse.points)} points lie {where}",
            points,
            kept,
        )
    rock, left = degrade(
        points[kept], settings.noise, settings.holes, generator(settings.seed, "prior/degrade")
    )
    normals = estimate_normals(rock[left], views[kept][left], settings.noise / cloud.voxel)
    return SegmentedCloud(cloud, plane, ground, rock[left], normals, 0.0, clusters)


def _plane_or_none(
    cloud: Cloud, frames: Sequence[Frame], up: Up, settings: PriorSettings
) -> Plane | None:
    """The ground plane, where a fifth of the points near what the cameras look at lie on one that
    all cameras are above, and that is about level."""
    target = focus(frames)
    near = np.linalg.norm(cloud.points - target.point, axis=1) < REACH * target.distance
    fine = PLANE_VOXEL * cloud.voxel
    part = Cloud(cloud.points[near], cloud.views[near], fine, cloud.noise, cloud.pixels)
    try:
        plane = ground_plane(part, frames, derive_seed(settings.seed, "prior/plane"))
    except InputError:
        return None
    above = plane.height(np.stack([frame.camera.position for frame in frames])) > 0
    level = abs(plane.normal @ up) > np.cos(np.radians(PLANE_TILT))
    return plane if above.all() and level else None


def _cluster_looked_at(
    cloud: Cloud, frames: Sequence[Frame], plane: Plane | None
) -> tuple[np.ndarray, int]:
    """Which points [N] are the object's where there are no masks, and the number of clusters among
    those in question.

    A cluster weighs more the higher its points stand above the ground, and the nearer they are to
    what the cameras look at: a long low rise of the ground has more points than a rock.
    """
    target = focus(frames)
    away = np.linalg.norm(cloud.points - target.point, axis=1) / target.distance
    height = np.ones(len(away)) if plane is None else plane.height(cloud.points)
    kept = (away < REACH) & (height > (0 if plane is None else plane.tolerance))
    inside, clusters = main_cluster(
        cloud.points[kept], (height * (1 - np.minimum(away / REACH, 1)))[kept]
    )
    if plane is not None and inside.sum() >= LEAST_POINTS:
        inside = _grown(cloud.points[kept], inside)
    kept[kept] = inside
    return kept, clusters


def _grown(points: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Which points [N,3] above the ground belong to a cluster [N] bool, or are joined to it
    (GROWN)."""
    from sklearn.cluster import DBSCAN

    eps = GROWN * float(np.ptp(points[inside], axis=0).max())
    labels = DBSCAN(eps=eps, min_samples=GROWN_NEIGHBOURS).fit_predict(points)
    found = labels[inside & (labels >= 0)]
    return inside | (labels == np.bincount(found).argmax()) if len(found) else inside
