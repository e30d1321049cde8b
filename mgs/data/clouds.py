"""Triangulated point clouds and their PLY files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from plyfile import PlyData

from mgs.camera import Camera
from mgs.data.frames import in_image
from mgs.data.world import World
from mgs.errors import InputError
from mgs.files import parsing, reading, write_columns

FIELDS = ("x", "y", "z", "nx", "ny", "nz", "track", "error")
NEAREST_SHARE = 0.25  # share of cameras with a point in view taken to have seen it, nearest first


@dataclass(frozen=True)
class SparseCloud:
    """Triangulated points in the world. None: unknown."""

    points: np.ndarray  # [N,3]
    views: np.ndarray | None = None  # [N,3] unit, mean direction to its cameras, or normal
    track: np.ndarray | None = None  # [N] number of images that saw it
    error: np.ndarray | None = None  # [N] mean reprojection error, pixels

    def upright(self, world: World) -> "SparseCloud":
        """The same cloud, of the files of a dataset, in its upright world (`World.enter`)."""
        views = None if self.views is None else world.enter(self.views)
        return replace(self, points=world.enter(towards(self.points, world.origin)), views=views)

    def scaled(self, factor: float) -> "SparseCloud":
        """The same cloud with coordinates multiplied by `factor`."""
        return replace(self, points=self.points * factor)


def towards(points: np.ndarray, origin: Sequence[float]) -> np.ndarray:
    """Points [N,3] in a dataset whose `origin` was subtracted from the data that was imported: less
    that origin if they are in the place of that data, else as they are."""
    centre = points.mean(0)
    return points - origin if np.linalg.norm(centre - origin) < np.linalg.norm(centre) else points


def write_cloud(path: str | Path, cloud: SparseCloud) -> None:
    """Write a binary PLY, float32, atomically: x y z, and if known nx ny nz (views), track, error.
    Raises InputError if it cannot be written."""
    columns = {name: cloud.points[:, k] for k, name in enumerate("xyz")}
    if cloud.views is not None:
        columns |= {name: cloud.views[:, k] for k, name in enumerate(("nx", "ny", "nz"))}
    extra = {"track": cloud.track, "error": cloud.error}
    columns |= {name: value for name, value in extra.items() if value is not None}
    write_columns(path, {"vertex": {name: (value, "f4") for name, value in columns.items()}})


def read_cloud(path: str | Path) -> SparseCloud:
    """Read the vertices of any PLY file, with nx ny nz, track and error if present. Of points in
    the same place the first is kept, since some programs write a vertex for each corner of each
    face. Raises InputError if the file is missing, damaged, not finite, or has fewer than two
    distinct points."""
    path = Path(path)
    with reading(path, "point cloud; give a PLY file"), path.open("rb") as file:
        file.read(1)
    with parsing(path, "cloud", "give a PLY file with x y z, or import again"):
        data = PlyData.read(str(path))["vertex"].data
        names = [name for name in FIELDS if name in (data.dtype.names or ())]
        values = {name: np.asarray(data[name], np.float64) for name in names}
        points = np.stack([values[name] for name in "xyz"], 1)
        views = None
        if {"nx", "ny", "nz"} <= set(names):
            views = np.stack([values[name] for name in ("nx", "ny", "nz")], 1)
    first = np.sort(np.unique(points, axis=0, return_index=True)[1])
    points = points[first]
    views, track, error_px = (
        None if column is None else column[first]
        for column in (views, values.get("track"), values.get("error"))
    )
    parts = [column for column in (points, views, track, error_px) if column is not None]
    if len(points) < 2 or not all(np.isfinite(column).all() for column in parts):
        wrong = "has values that are not finite, or fewer than two different points"
        raise InputError(f"{path}: {wrong}; make it again")
    if views is not None and not np.linalg.norm(views, axis=1).all():
        views = None  # some programs write zeros for normals
    return SparseCloud(points, views, track, error_px)


def views_of(cloud: SparseCloud, cameras: Sequence[Camera]) -> np.ndarray:
    """Views of the cloud [N,3], or an estimate: the mean unit direction to the nearest cameras
    that have the point in their image, or to the nearest camera if none has."""
    if cloud.views is not None:
        return cloud.views
    offset = np.stack([camera.position for camera in cameras])[None] - cloud.points[:, None]
    distance = np.linalg.norm(offset, axis=2)
    outside = ~np.stack([in_image(camera, *camera.project(cloud.points)) for camera in cameras], 1)
    far = np.where(outside, distance + distance.max(), distance)
    order = np.argsort(far, axis=1, kind="stable")
    taken = np.maximum(1, np.ceil(NEAREST_SHARE * (~outside).sum(1)))
    nearest = np.argsort(order, axis=1, kind="stable") < taken[:, None]
    mean = (offset / np.maximum(distance, 1e-30)[..., None] * nearest[..., None]).sum(1)
    return mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
