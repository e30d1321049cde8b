"""Photographs without depth -> the surface of the object: of triangulated points, of the masks'
visual hull, or of both."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mgs.data.clouds import read_cloud
from mgs.data.dataset import Dataset, Frame
from mgs.data.meshes import Mesh
from mgs.data.visibility import has_masks, in_image
from mgs.errors import InputError
from mgs.prior.hull import Hull, visual_hull
from mgs.prior.points import segment_points, spacing_of
from mgs.prior.segmentation import NoSurface, Plane, SegmentedCloud
from mgs.prior.settings import PriorSettings
from mgs.prior.surface import closed_poisson, intersection, poisson_mesh
from mgs.survey.fusion import focus, voxel_means

SOURCES = ("depth", "mesh", "points", "hull")
"""What a prior can be made of."""

CLOUD = "sparse.ply"
"""File of a dataset in which `mgs import` keeps the points that came with the cameras."""

LEAST_PHOTOGRAPHS = 8
"""Fewest photographs without depth that a surface is built of."""

LEAST_OVERLAP = 0.5
"""Least share of the cameras that must have in their image the point that all of them look at."""

GAP = 4.0
"""Where the surface of the hull is farther than this many distances between neighbours from every
point of the cloud, the hull stands in for the points."""

CELL_OF_SPACING = 0.5
"""What the Poisson reconstruction takes for the distance between points, over that of the cloud:
its cells are then 0.75 of it.
Measured: larger cells lose detail, and smaller ones gain nothing."""

BEYOND_POINTS = 0.15
"""A face farther than this from every point, over the extent of the points, closes the surface
where nothing was seen, and is not sampled. With a hull or a ground plane there is no such need."""


ONE_SIDED = 0.5
"""Least length of the mean normal of points that were seen from one side; it is 0 all around an
object, and 1 of a wall."""


@dataclass(frozen=True)
class Surface:
    """A surface that was built of photographs. mesh: closed, in the world. cell: how finely it is
    known, units of the world.
    segmented: the cloud that it was built from, if there is one. numbers: what prior.json holds of
    how it was built."""

    mesh: Mesh
    cell: float
    segmented: SegmentedCloud | None
    numbers: dict[str, Any]


def source_of(dataset: Dataset, asked: str | None = None, points: Path | None = None) -> str:
    """What to build the prior of a dataset from: what was asked for, or by what the dataset holds:
    depth, points, masks.

    points: a given cloud. Raises InputError where there is nothing to build it from, or not what
    was asked for.
    """
    has = {
        "depth": any(frame.depth_path for frame in dataset.frames),
        "points": points is not None or (dataset.root / CLOUD).is_file(),
        "hull": has_masks(dataset.frames),
    }
    if asked is None and points is None:
        asked = next((name for name, there in has.items() if there), None)
    asked = "points" if points is not None and asked is None else asked
    if asked is not None and has.get(asked):
        return asked
    lacks = {"depth": "no depth images", "points": f"no points ({CLOUD})", "hull": "no masks"}
    if asked not in (None, *SOURCES):
        raise InputError(f"--from {asked!r}: is unknown; choose one of {', '.join(SOURCES)}")
    missing = (
        " and ".join(lacks.values()) if asked is None else lacks.get(asked, "no mesh of its own")
    )
    ways = {
        "depth": "import data with depth",
        "hull": "import with --masks DIR for --from hull",
        "points": "give --points CLOUD.ply",
        "mesh": "give --mesh MESH",
    }
    there = [f"take --from {name}" for name, is_there in has.items() if is_there]
    open_ways = there + [way for name, way in ways.items() if not has.get(name)]
    raise InputError(f"{dataset.root}: has {missing}; {', or '.join(open_ways)}")


def check_photographs(frames: Sequence[Frame]) -> None:
    """Raises InputError where photographs without depth cannot show a surface: fewer than
    LEAST_PHOTOGRAPHS, or cameras that do not look at one thing."""
    if len(frames) < LEAST_PHOTOGRAPHS:
        raise InputError(
            f"prior: {len(frames)} photographs without depth are too few; take at least {LEAST_PHOTOGRAPHS}, from all sides"
        )
    point = focus(frames).point[None]
    seen = [bool(in_image(frame.camera, *frame.camera.project(point))[0]) for frame in frames]
    if np.mean(seen) < LEAST_OVERLAP:
        raise InputError(
            f"prior: the photographs do not overlap: of {len(frames)} cameras only {sum(seen)} have in their image what all "
            "look at; walk around the object, or check the poses"
        )


def check_masks(frames: Sequence[Frame]) -> None:
    """Raises InputError where there are masks, and no pixel of any of them is the object."""
    if has_masks(frames) and not any(frame.mask().any() for frame in frames):
        raise InputError("prior: the masks are black in every frame; white is the object")


def surface_of(
    dataset: Dataset,
    source: str,
    settings: PriorSettings,
    tell: Callable[[str], None],
    points: Path | None = None,
) -> Surface:
    """The surface by the source "points" or "hull". points: the cloud's file, if not the dataset's
    own.

    With masks the hull bounds what points give, and closes it where there are none. Raises
    InputError as `check_photographs`, `check_masks`, `visual_hull`, `read_cloud` and
    `segment_points`, and NoSurface where the surface cannot be closed.
    """
    check_photographs(dataset.frames)
    check_masks(dataset.frames)
    if source == "hull":
        settings.refuse_shaping("a hull is carved from masks")
        carved = visual_hull(dataset.frames, tell)
        return Surface(carved.mesh, carved.cell, None, _hull_numbers(carved))
    cloud = read_cloud(points or dataset.root / CLOUD)
    segmented = segment_points(cloud, dataset, settings, tell)
    hull = visual_hull(dataset.frames, tell) if has_masks(dataset.frames) else None
    tell("Poisson mesh")
    spacing = spacing_of(segmented.rock_points)
    try:
        mesh, depth = _closed(segmented, hull, spacing, settings)
    except NoSurface:
        raise
    except InputError as error:
        kept = _same_rows(segmented.cloud.points, segmented.rock_points)
        raise NoSurface(str(error), segmented.cloud.points, kept) from None
    numbers = {
        "points": len(cloud.points),
        "points_kept": len(segmented.cloud.points),
        "clusters": segmented.clusters,
        "cluster_size": len(segmented.rock_points),
        "cloud_spacing": spacing,
        "poisson_depth": depth,
    }
    return Surface(
        mesh, spacing, segmented, numbers | ({} if hull is None else _hull_numbers(hull))
    )


def _closed(
    segmented: SegmentedCloud, hull: Hull | None, spacing: float, settings: PriorSettings
) -> tuple[Mesh, int]:
    """A closed mesh of the object's points, and the depth of the octree: bounded by the hull, or
    cut at the ground, or behind what was seen from one side, and with the faces marked as not seen
    that close it far from every point."""
    points, normals = segmented.rock_points, segmented.rock_normals
    cell = CELL_OF_SPACING * spacing
    if segmented.plane is not None:
        return poisson_mesh(points, normals, cell, segmented.plane, settings.poisson_depth)
    if hull is not None:
        body, body_normals = _thinned(hull.mesh, spacing)
        gap = cKDTree(points).query(body)[0] > GAP * spacing
        points, normals = (
            np.concatenate([points, body[gap]]),
            np.concatenate([normals, body_normals[gap]]),
        )
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
    """A plane behind points [N,3] that were seen from one side, such as those of a building's
    front: their surface is a sheet, which closes where it is mirrored in this plane and cut at it.
    None where the normals [N,3] face all sides."""
    towards = normals.mean(0)
    if np.linalg.norm(towards) < ONE_SIDED:
        return None
    axis = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]
    axis = axis * np.sign(axis @ towards)
    return Plane(axis, float((points @ axis).min()) - spacing, 0.0, spacing)


def _thinned(mesh: Mesh, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a mesh about so far apart, and their unit normals, [M,3]."""
    points, index = voxel_means(mesh.vertices, spacing)
    normals = np.stack(
        [np.bincount(index, mesh.vertex_normals[:, k], len(points)) for k in range(3)], 1
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    kept = length[:, 0] > 1e-6
    return points[kept], (normals / np.maximum(length, 1e-12))[kept]


def _hull_numbers(hull: Hull) -> dict[str, Any]:
    return {
        "hull_cell": hull.cell,
        "hull_fills_masks": float(np.nanmean(hull.agreement)),
        "hull_fills_least": float(np.nanmin(hull.agreement)),
    }


def _same_rows(points: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Which of points [N,3] are rows of `part`, bool [N]."""
    return cKDTree(part).query(points)[0] == 0
