"""Surfaces from photographs without depth: of triangulated points, the visual hull, or both."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from mgs.data.clouds import read_cloud
from mgs.data.dataset import Dataset
from mgs.data.frames import Frame, has_masks
from mgs.data.meshes import Mesh
from mgs.data.structure import CLOUD
from mgs.errors import InputError, Notice
from mgs.prior.hull import visual_hull
from mgs.prior.points import segment_points, spacing_of
from mgs.prior.segmentation import NoSurface, Plane, SegmentedCloud
from mgs.prior.settings import PriorSettings
from mgs.prior.surface import Surface, closed_poisson, intersection, poisson_mesh, shell
from mgs.progress import report
from mgs.survey.fusion import LEAST_OVERLAP, looking_at_one, voxel_means

SOURCES = ("depth", "mesh", "points", "hull", "random")  # sources of a prior
LEAST_PHOTOGRAPHS = 8  # fewest photographs without depth for a surface
GAP = 4.0  # distance from every point, in spacings, beyond which the hull replaces the points
# Cells of 0.75 spacings: larger ones lose detail, smaller ones gain nothing (measured).
CELL_OF_SPACING = 0.5  # cloud spacing passed to the Poisson reconstruction, over the real one
# Faces beyond it only close the surface and are not sampled; a hull or ground plane needs none.
BEYOND_POINTS = 0.15  # distance from every point, over the extent of the points
ONE_SIDED = 0.5  # least length of the mean normal of points seen from one side


def choose_source(dataset: Dataset, source: str | None = None, points: Path | None = None) -> str:
    """Source of a dataset's prior: the one asked for, else the first of depth, points, hull and
    random. points: file of a given cloud. Raises InputError if there is no source, or not the one
    asked for."""
    has = {
        "depth": all(frame.depth_path for frame in dataset.frames),
        "points": points is not None or (dataset.root / CLOUD).is_file(),
        "hull": has_masks(dataset.frames),
        "random": True,
    }
    there = [name for name, is_there in has.items() if is_there]
    if source is None:
        source = "points" if points is not None else there[0]
    if source in there:
        return source
    if source not in (None, *SOURCES):
        raise InputError(f"source {source!r}: is unknown; choose one of {', '.join(SOURCES)}")
    lacks = {
        "depth": "frames without depth images",
        "points": f"no points ({CLOUD})",
        "hull": "no masks",
    }
    lack = lacks.get(source, "no mesh of its own")
    ways = {
        "depth": "import data with depth",
        "hull": "import with `masks`, then take the source hull",
        "points": "give `points`",
        "mesh": "give `mesh`",
    }
    cures = [f"take the source {name}" for name in there if name != "random"]
    cures += [way for name, way in ways.items() if name not in there]
    raise InputError(f"{dataset.root}: has {lack}; {', or '.join(cures)}")


def check_enough(photographs: int, where: str = "prior") -> None:
    """Raise InputError for under LEAST_PHOTOGRAPHS. where: their folder or use, for the message."""
    if photographs < LEAST_PHOTOGRAPHS:
        cure = f"take at least {LEAST_PHOTOGRAPHS}, from all sides"
        raise InputError(f"{where}: too few photographs without depth, {photographs}; {cure}")


def check_photographs(frames: Sequence[Frame], whole: str | None) -> None:
    """Raise InputError as `check_enough`. whole: what to do with a whole scene, such as a room or a
    survey from the air, whose cameras do not look at one thing: for InputError; None: it may be
    one."""
    check_enough(len(frames))
    if whole is None:
        return
    inside = looking_at_one(frames)
    if np.mean(inside) < LEAST_OVERLAP:
        raise InputError(
            f"prior: the photographs are not of one object: of {len(frames)} cameras only "
            f"{sum(inside)} have in their image what all look at; walk around the object, or check "
            f"the poses; a whole scene {whole}"
        )


def check_masks(frames: Sequence[Frame]) -> None:
    """Raise InputError if there are masks, and all are black."""
    if has_masks(frames) and not any(frame.mask().any() for frame in frames):
        raise InputError("prior: the masks are black in every frame; white is the object")


def surface_of(
    dataset: Dataset, source: str, settings: PriorSettings, points: Path | None = None
) -> Surface:
    """Surface of the source "points" or "hull". points: file of the cloud, by default the dataset's
    own. With masks, the hull bounds the surface of the points and closes it. Without, points that
    Poisson does not close get a `shell`, and a word. Raises InputError as `visual_hull`,
    `read_cloud` and `segment_points`, and NoSurface if the hull has no part of the surface."""
    if source == "hull":
        settings.refuse_shaping("a hull is carved from masks")
        return visual_hull(dataset.frames)
    cloud = read_cloud(points or dataset.root / CLOUD).upright(dataset.world)
    segmented = segment_points(cloud, dataset, settings)
    hull = visual_hull(dataset.frames) if has_masks(dataset.frames) else None
    report("Poisson mesh")
    spacing = spacing_of(segmented.rock_points)
    depth: int | None = None
    try:
        mesh, depth = _closed(segmented, hull, spacing, settings)
    except InputError as error:
        if hull is not None:
            cloud_points = segmented.cloud.points
            inside = cKDTree(segmented.rock_points).query(cloud_points)[0] == 0
            raise NoSurface(str(error), cloud_points, inside) from None
        why = "the points give no closed surface, so the prior is what is near them"
        warnings.warn(Notice(f"{why}; more photographs or masks make it exact"), stacklevel=2)
        mesh = shell(segmented.rock_points, spacing, segmented.plane)
    numbers = {
        "points": len(cloud.points),
        "points_kept": len(segmented.cloud.points),
        "clusters": segmented.clusters,
        "cluster_size": len(segmented.rock_points),
        "cloud_spacing": spacing,
    }
    numbers |= {} if depth is None else {"poisson_depth": depth}
    numbers |= {} if hull is None else hull.numbers
    return Surface(mesh, spacing, numbers, segmented)


def _closed(
    segmented: SegmentedCloud, hull: Surface | None, spacing: float, settings: PriorSettings
) -> tuple[Mesh, int]:
    """Closed mesh of the object's points, and the octree depth: bounded by the hull, or cut at the
    ground, or closed behind points seen from one side, with far faces marked as not seen."""
    points, normals = segmented.rock_points, segmented.rock_normals
    cell = CELL_OF_SPACING * spacing
    if segmented.plane is not None:
        return poisson_mesh(points, normals, cell, segmented.plane, settings.poisson_depth)
    if hull is not None:
        body, body_normals = _thinned(hull.mesh, spacing)
        gap = cKDTree(points).query(body)[0] > GAP * spacing
        points = np.concatenate([points, body[gap]])
        normals = np.concatenate([normals, body_normals[gap]])
        mesh, depth = closed_poisson(points, normals, cell, settings.poisson_depth)
        return intersection(mesh, hull.mesh), depth
    try:
        mesh, depth = closed_poisson(points, normals, cell, settings.poisson_depth)
    except InputError:
        back = _back_of(points, normals, spacing)
        if back is None:
            raise
        mesh, depth = poisson_mesh(points, normals, cell, back, settings.poisson_depth)
    reach = BEYOND_POINTS * float(np.ptp(points, axis=0).max())
    seen = cKDTree(points).query(mesh.vertices[mesh.faces].mean(1))[0] < reach
    return Mesh(mesh.vertices, mesh.faces, seen), depth


def _back_of(points: np.ndarray, normals: np.ndarray, spacing: float) -> Plane | None:
    """Plane behind points [N,3] seen from one side, such as a building's front: mirroring the sheet
    in it closes the surface. None if the normals [N,3] face all sides."""
    towards = normals.mean(0)
    if np.linalg.norm(towards) < ONE_SIDED:
        return None
    axis = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]
    axis = axis * np.sign(axis @ towards)
    return Plane(axis, float((points @ axis).min()) - spacing, 0.0, spacing)


def _thinned(mesh: Mesh, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a mesh about `spacing` apart, and their unit normals, [M,3]."""
    points, index = voxel_means(mesh.vertices, spacing)
    sums = [np.bincount(index, column, len(points)) for column in mesh.vertex_normals.T]
    normals = np.stack(sums, 1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    valid = length[:, 0] > 1e-6
    return points[valid], (normals / np.maximum(length, 1e-12))[valid]
