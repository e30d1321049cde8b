"""Points of the object, with normals, from a triangulated cloud: judged one by one, then by masks,
else by ground plane and density clusters (HDBSCAN), and last by their neighbours. And the random
start of photographs whose object has no known surface: points that came with the cameras take the
place of as many random ones."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mgs.data.clouds import SparseCloud, read_cloud, views_of
from mgs.data.dataset import Dataset
from mgs.data.frames import Frame, has_masks, mask_share
from mgs.data.meshes import Mesh
from mgs.data.structure import CLOUD
from mgs.errors import InputError
from mgs.prior.segmentation import NoSurface, Plane, SegmentedCloud, estimate_normals, ground_plane
from mgs.prior.settings import PriorSettings
from mgs.prior.surface import MOST_GAUSSIANS
from mgs.progress import report
from mgs.seeds import derive_seed, generator
from mgs.survey.depth_sensor import SIGMA_FROM_MAD
from mgs.survey.fusion import REACH, Cloud, focus, fuse_frames, of_one_object

LEAST_TRACK = 3  # fewest images that saw a point: two can agree by chance
ERROR_LIMIT = 2.5  # largest reprojection error, robust standard deviations above the median
MASK_SHARE = 0.95  # least `mask_share` of a point
MASK_SLACK = 2  # dilation of the masks for it, pixels, for errors of points and poses
LEAST_POINTS = 100  # fewest points of the object for a surface
CLUSTER_SHARE = 0.02  # HDBSCAN's min_cluster_size over the points; at least CLUSTER_SAMPLES
CLUSTER_SAMPLES = 10  # HDBSCAN's min_samples
JOINED = 4.0  # point spacings between clusters that are one: varying texture splits an object
# A part with few points, as in shade, is no cluster of its own: DBSCAN joins it to the object.
GROWN, GROWN_NEIGHBOURS = 0.15, 4  # eps over the cluster's extent, and min_samples
PLANE_TILT = 45.0  # largest angle between the ground's normal and the vertical, degrees
PLANE_VOXEL = 0.25  # voxel passed to `ground_plane`, over the point spacing
NEIGHBOURS = 16  # neighbours that decide whether a point lies off the surface
OFF_SURFACE = 3.0  # largest distance from the plane of the neighbours, robust standard deviations
ALONE = 5.0  # largest distance to the eighth neighbour, over its median


def spacing_of(points: np.ndarray) -> float:
    """Spacing of a regular grid as dense as points [N,3]: in a random cloud, twice the median
    distance to the nearest neighbour."""
    return 2 * float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))


def reliable(cloud: SparseCloud) -> np.ndarray:
    """Mask [N] of the points that are well triangulated, as far as known."""
    good = np.ones(len(cloud.points), bool)
    if cloud.track is not None:
        good &= cloud.track >= LEAST_TRACK
    if cloud.error is not None:
        middle = np.median(cloud.error)
        sigma = SIGMA_FROM_MAD * np.median(np.abs(cloud.error - middle))
        good &= cloud.error <= middle + ERROR_LIMIT * sigma
    return good if good.sum() >= LEAST_POINTS else np.ones(len(good), bool)


def on_surface(points: np.ndarray) -> np.ndarray:
    """Mask [N] of the points [N,3] that have neighbours and lie near the plane through them."""
    count = min(NEIGHBOURS + 1, len(points))
    distance, index = cKDTree(points).query(points, count)
    around = points[index[:, 1:]]
    middle = around.mean(1)
    across = around - middle[:, None]
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", across, across))[1][..., 0]
    off = np.abs(np.einsum("nk,nk->n", points - middle, normals))
    apart = distance[:, min(8, count - 1)]
    near = off < OFF_SURFACE * SIGMA_FROM_MAD * np.median(off)
    return near & (apart < ALONE * np.median(apart))


def main_cluster(points: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, int]:
    """Points [N,3] of the cluster of largest total weight [N], bool [N], and the number of
    clusters; all points and 0 if no part is denser. HDBSCAN (Campello et al. 2013, scikit-learn).
    Points that it gives to no cluster, because few are around them, belong to the one next to
    them."""
    from sklearn.cluster import HDBSCAN

    least = max(CLUSTER_SAMPLES, int(CLUSTER_SHARE * len(points)))
    if len(points) < 2 * least:
        return np.ones(len(points), bool), 0
    clustering = HDBSCAN(min_cluster_size=least, min_samples=CLUSTER_SAMPLES, copy=True)
    labels = clustering.fit_predict(points)
    if labels.max() < 0:
        return np.ones(len(points), bool), 0
    pairs = labels[cKDTree(points).query_pairs(JOINED * spacing_of(points), output_type="ndarray")]
    pairs = pairs[(pairs >= 0).all(1)]
    count = int(labels.max()) + 1
    touching = coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(count, count))
    pieces, piece = connected_components(touching, directed=False)
    joined = np.where(labels >= 0, piece[labels], -1)
    total = np.bincount(joined[joined >= 0], weight[joined >= 0], pieces)
    main = joined == total.argmax()
    near = cKDTree(points[main]).query(points)[0] < JOINED * spacing_of(points)
    return main | (near & (joined < 0)), int(pieces)


def segment_points(
    sparse: SparseCloud, dataset: Dataset, settings: PriorSettings
) -> SegmentedCloud:
    """The object in a triangulated cloud: the points inside all masks; without masks, what stands
    above the ground; without ground, the densest thing near what the cameras look at. Raises
    NoSurface if too few points are left."""
    report("points")
    frames = dataset.frames
    good = reliable(sparse)
    points, views = sparse.points[good], views_of(sparse, [frame.camera for frame in frames])[good]
    cloud = Cloud(points, views, spacing_of(points), 0.0, len(sparse.points))
    plane, ground, clusters = None, np.zeros(len(points), bool), 0
    if has_masks(frames):
        share, count = mask_share(points, frames, MASK_SLACK)
        inside = (share >= MASK_SHARE) & (count >= LEAST_TRACK)
        where = "inside the masks; give masks and poses that fit, or take the source hull"
    else:
        report("ground plane and clusters")
        plane = _plane_or_none(cloud, frames, settings)
        if plane is not None:
            ground = np.abs(plane.height(points)) <= plane.tolerance
        inside, clusters = _cluster_looked_at(cloud, frames, plane)
        where = "above the ground" if plane else "near what the cameras look at"
        where = f"in one cluster {where}; give masks of the object"
    if inside.sum() >= LEAST_POINTS:
        inside[inside] = on_surface(points[inside])
    if inside.sum() < LEAST_POINTS:
        few = f"only {inside.sum()} of {len(sparse.points)} points lie {where}"
        raise NoSurface(f"{dataset.root}: {few}", points, inside)
    rock = points[inside]
    normals = estimate_normals(rock, views[inside])
    return SegmentedCloud(cloud, plane, ground, rock, normals, 0.0, clusters)


def _plane_or_none(cloud: Cloud, frames: Sequence[Frame], settings: PriorSettings) -> Plane | None:
    """The ground plane, if it is about level and below all cameras; else None."""
    target = focus(frames)
    near = np.linalg.norm(cloud.points - target.point, axis=1) < REACH * target.distance
    fine = PLANE_VOXEL * cloud.voxel
    part = Cloud(cloud.points[near], cloud.views[near], fine, cloud.noise, cloud.pixels)
    try:
        plane = ground_plane(part, frames, derive_seed(settings.seed, "prior/plane"))
    except InputError:
        return None
    above = plane.height(np.stack([frame.camera.position for frame in frames])) > 0
    level = abs(plane.normal[2]) > np.cos(np.radians(PLANE_TILT))
    return plane if above.all() and level else None


def _cluster_looked_at(
    cloud: Cloud, frames: Sequence[Frame], plane: Plane | None
) -> tuple[np.ndarray, int]:
    """Object points without masks, bool [N], and the number of clusters in question. Points weigh
    more the higher above the ground and the nearer to what the cameras look at, since a long low
    rise of the ground has more points than a rock."""
    target = focus(frames)
    away = np.linalg.norm(cloud.points - target.point, axis=1) / target.distance
    height = np.ones(len(away)) if plane is None else plane.height(cloud.points)
    near = (away < REACH) & (height > (0 if plane is None else plane.tolerance))
    weight = height * (1 - np.minimum(away / REACH, 1))
    inside, clusters = main_cluster(cloud.points[near], weight[near])
    if plane is not None and inside.sum() >= LEAST_POINTS:
        inside = _grown(cloud.points[near], inside)
    near[near] = inside
    return near, clusters


def _grown(points: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Whether points [N,3] above the ground are in a cluster [N] bool, or joined to it (GROWN) [N].

    Joined as by DBSCAN, but without a list of all pairs of neighbours."""
    eps = GROWN * float(np.ptp(points[inside], axis=0).max())
    away = cKDTree(points).query(points, GROWN_NEIGHBOURS, distance_upper_bound=eps)[0]
    core, grown = np.isfinite(away[:, -1]), inside.copy()
    new = points[inside & core]
    while len(new):
        rest = np.flatnonzero(~grown)
        near = cKDTree(new).query(points[rest], distance_upper_bound=eps)[0]
        added = rest[np.isfinite(near)]
        grown[added] = True
        new = points[added[core[added]]]
    return grown


GAUSSIANS = 10_000  # fewest Gaussians where no number is given
PIXELS = 100  # of all images, in the masks, per Gaussian where no number is given. Chosen
# Most random points per point that came with the cameras where no number is given and these are
# many: they hide what is behind them, and a fit splits Gaussians where more are needed. A chosen
# constant.
MOST_RANDOM = 0.1
MOST_FUSED = 100  # about the most depth images that points of a whole scene come from; chosen
FAR = 10.0  # radius of the random background, over that of the ball that the cameras look at
DRAWS = 64  # draws per Gaussian after which too few lie inside the masks


def has_points(dataset: Dataset) -> bool:
    """Whether a whole scene has points to start from: those that came with the cameras, or depth
    images of cameras that do not look at one thing."""
    frames = dataset.frames
    with_depth = all(frame.depth_path for frame in frames)
    return (dataset.root / CLOUD).is_file() or (with_depth and not of_one_object(frames))


def scattered(
    dataset: Dataset, settings: PriorSettings, shown: Sequence[Frame] | None = None
) -> tuple[Mesh, np.ndarray, np.ndarray, float, dict[str, Any]]:
    """Mesh, points [N,3], unit normals [N,3], spacing and items of prior.json of a random start.

    shown: the frames whose masks are read, by default all. Points fill the ball that all cameras
    see, about the point they look at, inside these masks if each has one. Otherwise half of them
    lie outside, evenly in the logarithm of their distance, as background. Well triangulated points
    of the dataset's cloud, in the masks, come first. The mesh is the ball; normals point outwards,
    those of the cloud to its cameras. Raises InputError if the settings shape a surface, or the
    masks share no point of the ball."""
    import trimesh  # here, because it takes 0.2 s and no other prior needs it

    shown = dataset.frames if shown is None else shown
    settings.refuse_shaping("a random start has no surface")
    gaussians, rng = settings.gaussians, generator(settings.seed, "prior/random")
    pixels = sum(int(frame.mask().sum()) for frame in shown)
    count = min(max(pixels // PIXELS, GAUSSIANS), MOST_GAUSSIANS)
    count = gaussians if isinstance(gaussians, int) else count
    masked = has_masks(shown)
    # Without random points, nothing is as far away as a sky, and near points take its place.
    most = count if masked else round(count / (1 + MOST_RANDOM))
    cloud, views_of_cloud = _triangulated(dataset, shown, most, rng)
    if len(cloud) and not isinstance(gaussians, int):
        count = min(count, max(round((1 + MOST_RANDOM) * len(cloud)), GAUSSIANS))
    middle = focus(dataset.frames).point
    cameras = [frame.camera for frame in dataset.frames]
    tangents = [min(one.width / one.K[0, 0], one.height / one.K[1, 1]) / 2 for one in cameras]
    away = np.linalg.norm([one.position - middle for one in cameras], axis=1)
    radius = float(np.median(away * np.sin(np.arctan(tangents))))
    parts, tries = [cloud], 0
    while sum(map(len, parts)) < count and tries < DRAWS * count:
        directions = rng.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        distance = rng.random(count) ** (1 / 3)
        if not masked:
            distance = np.where(rng.random(count) < 0.5, distance, FAR ** rng.random(count))
        points = middle + radius * distance[:, None] * directions
        share, views = mask_share(points, shown)
        parts.append(points[(views > 0) & (share >= MASK_SHARE)])
        tries += count
    points = np.concatenate(parts)[:count]
    if len(points) < count and len(cloud) and not masked:
        count = len(points)  # few places near what the cameras look at are in a picture
    if len(points) < count:
        raise InputError(
            f"{dataset.root}: only {len(points)} of {tries} random points lie inside all masks; "
            "poses and masks do not fit, correct or remove frames"
        )
    outwards = points - middle
    normals = outwards / np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-9)
    normals[: len(cloud)] = views_of_cloud
    spacing = float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))
    ball = trimesh.creation.icosphere(3, radius)
    mesh = Mesh(ball.vertices + middle, ball.faces, np.ones(len(ball.faces), bool))
    numbers: dict[str, Any] = {"n": count, "triangulated": len(cloud), "spacing": spacing}
    numbers |= {"radius": radius, "depth_tolerance": 2 * radius, "backed": 0}
    numbers |= {"settings": asdict(settings)}
    return mesh, points, normals, spacing, numbers


def _triangulated(
    dataset: Dataset, shown: Sequence[Frame], most: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Reliable points [N,3] of the dataset's cloud, else of its depth, at most `most`, that lie in
    some of the frames shown and in all their masks, and unit directions to their cameras [N,3];
    none unless `has_points`."""
    if not has_points(dataset):
        return np.zeros((0, 3)), np.zeros((0, 3))
    if (dataset.root / CLOUD).is_file():
        cloud = read_cloud(dataset.root / CLOUD).upright(dataset.world)
    else:
        fused = fuse_frames(dataset.frames[:: -(-len(dataset) // MOST_FUSED)], np.inf)
        cloud = SparseCloud(fused.points, fused.views)
    share, count = mask_share(cloud.points, shown)
    indices = np.flatnonzero(reliable(cloud) & (count > 0) & (share >= MASK_SHARE))
    indices = np.sort(rng.permutation(indices)[:most])
    views = views_of(cloud, [frame.camera for frame in dataset.frames])
    return cloud.points[indices], views[indices]
