"""Clouds of points that other tools triangulated: what is known of each point, the file that keeps
it, and any PLY file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.files import atomic_path, reading

NEAREST_SHARE = 0.25
"""Of the cameras that have a point in their image, this share, the nearest, are taken for those
that saw it, where the cloud does not say which did."""


@dataclass(frozen=True)
class SparseCloud:
    """Triangulated points of the world.

    points: [N,3]; views: [N,3] unit, the mean direction from each point to the cameras that saw it,
    or its normal; None where
    nothing is known of them. track: [N] number of images that saw each, None where unknown. error:
    [N] mean reprojection error, pixels, None where unknown.
    """

    points: np.ndarray
    views: np.ndarray | None = None
    track: np.ndarray | None = None
    error: np.ndarray | None = None

    def scaled(self, factor: float) -> SparseCloud:
        """The same cloud in other units of length."""
        return SparseCloud(self.points * factor, self.views, self.track, self.error)


def write_cloud(path: str | Path, cloud: SparseCloud) -> None:
    """Write a cloud as a binary PLY: x y z, and nx ny nz (the views), track and error where there
    are such. Atomic."""
    columns = {name: cloud.points[:, k] for k, name in enumerate("xyz")}
    if cloud.views is not None:
        columns |= {name: cloud.views[:, k] for k, name in enumerate(("nx", "ny", "nz"))}
    columns |= {
        name: value
        for name, value in (("track", cloud.track), ("error", cloud.error))
        if value is not None
    }
    table = np.empty(len(cloud.points), [(name, "f4") for name in columns])
    for name, value in columns.items():
        table[name] = value
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(table, "vertex")]).write(str(temporary))


def read_cloud(path: str | Path) -> SparseCloud:
    """Read the points of any PLY file; nx ny nz, track and error are read where it has them. Of
    points in the same place the
    first is kept: some programs write a vertex for each corner of each face.

    Raises InputError if the file is missing, damaged, holds a value that is not finite, or has
    fewer than two points.
    """
    path = Path(path)
    with reading(path, "point cloud; give a PLY file"), path.open("rb") as file:
        file.read(1)
    try:
        data = PlyData.read(str(path))["vertex"].data
        names = data.dtype.names or ()
        points = np.stack([np.asarray(data[name], np.float64) for name in "xyz"], 1)
        views = None
        if {"nx", "ny", "nz"} <= set(names):
            views = np.stack([np.asarray(data[name], np.float64) for name in ("nx", "ny", "nz")], 1)
        track, error = (
            np.asarray(data[name], np.float64) if name in names else None
            for name in ("track", "error")
        )
    except (PlyParseError, KeyError, ValueError, TypeError, UnicodeDecodeError) as error_:
        raise InputError(
            f"{path}: not a readable cloud ({error_}); give a PLY file with x y z, or import again"
        ) from None
    first = np.sort(np.unique(points, axis=0, return_index=True)[1])
    points = points[first]
    views, track, error = (None if a is None else a[first] for a in (views, track, error))
    if len(points) < 2 or not all(
        np.isfinite(a).all() for a in (points, views, track, error) if a is not None
    ):
        raise InputError(
            f"{path}: has values that are not finite, or fewer than two different points; make it again"
        )
    if views is not None and not np.linalg.norm(views, axis=1).all():
        views = None  # such as the normals of zeros that some programs write
    return SparseCloud(points, views, track, error)


def views_of(cloud: SparseCloud, cameras: Sequence[Camera]) -> np.ndarray:
    """The cloud's views [N,3]; where it has none, the mean unit direction to the nearest of the
    cameras that have the point in their image, as a guess at those that saw it. Points that no
    camera has in its image look to the nearest camera."""
    if cloud.views is not None:
        return cloud.views
    offset = np.stack([camera.position for camera in cameras])[None] - cloud.points[:, None]
    distance = np.linalg.norm(offset, axis=2)
    behind = ~np.stack([in_image(cloud.points, camera) for camera in cameras], 1)
    order = np.argsort(np.where(behind, distance + distance.max(), distance), axis=1, kind="stable")
    taken = np.maximum(1, np.ceil(NEAREST_SHARE * (~behind).sum(1)))
    chosen = np.argsort(order, axis=1, kind="stable") < taken[:, None]
    mean = (offset / np.maximum(distance, 1e-30)[..., None] * chosen[..., None]).sum(1)
    return mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)


def in_image(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Which points [N,3] lie in front of a camera and in its image, bool [N]."""
    pixels, z = camera.project(points)
    return (z > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
