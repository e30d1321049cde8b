"""COLMAP sparse models, text or binary, read by pycolmap."""

from __future__ import annotations

import struct
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.clouds import SparseCloud
from mgs.errors import InputError
from mgs.files import parsing, reading

OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of OpenCV's rational distortion model, in its order."""

MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": OPENCV_ORDER,
}
"""COLMAP camera model -> its distortion coefficients, the last entries of its parameters."""


RECORDS = {
    "cameras.bin": (24, False, "", 0),
    "images.bin": (64, True, "<Q", 24),
    "points3D.bin": (43, False, "<Q", 8),
    "frames.bin": (64, False, "<I", 16),
    "rigs.bin": (4, False, "", 0),
}
"""Binary file -> bytes of a record, whether a name follows, format of the count of the list that
follows ("": none of this kind), and bytes of each of its items (COLMAP's output formats)."""


def _is_whole(path: Path) -> bool:
    """Whether a binary file is as long as its counts say. pycolmap does not end if it is not."""
    with reading(path):
        data = path.read_bytes()
    fixed, named, items, size = RECORDS[path.name]
    try:
        (count,), place = struct.unpack_from("<Q", data), 8
        for _ in range(count):
            start, place = place, place + fixed
            place = data.index(b"\0", place) + 1 if named else place
            if items:
                (number,) = struct.unpack_from(items, data, place)
                place += struct.calcsize(items) + size * number
            elif path.name == "cameras.bin":
                place += 8 * _parameters(*struct.unpack_from("<i", data, start + 4))
            else:
                place += _bytes_of_sensors(data, place)
            if place > len(data):
                return False
    except (struct.error, ValueError, OverflowError, IndexError):
        return False
    return True


@cache
def _parameters(model: int) -> int:
    """Number of parameters of a camera model. Raises ValueError if there is no such model."""
    from pycolmap import Camera, CameraModelId

    known = {int(each): each for each in CameraModelId.__members__.values() if int(each) >= 0}
    if model not in known:
        raise ValueError(model)
    return len(Camera.create_from_model_id(1, known[model], 1.0, 1, 1).params)


def _bytes_of_sensors(data: bytes, place: int) -> int:
    """Bytes of the sensors of a rig. Raises IndexError beyond the data."""
    (sensors,) = struct.unpack_from("<I", data, place)
    end = place + (12 if sensors else 4)
    for _ in range(1, sensors):
        end += 65 if data[end + 8] else 9
    return end - place


def is_model(folder: Path) -> bool:
    """Whether a folder holds the three files of a model."""
    return any(
        all((folder / f"{name}.{kind}").is_file() for name in ("cameras", "images", "points3D"))
        for kind in ("bin", "txt")
    )


def read_model(model: Path) -> tuple[list[tuple[str, Camera, np.ndarray]], SparseCloud | None]:
    """Images of a model, sorted by name, and its points: ([(name, camera, distortion)], cloud).

    distortion: eight coefficients in OPENCV_ORDER. Raises InputError if the model is damaged or a
    lens is not supported.
    """
    import pycolmap

    for file in RECORDS:
        if (model / file).is_file() and not _is_whole(model / file):
            raise InputError(f"{model / file}: is damaged or cut off; export the model again")
    with parsing(model, "COLMAP model", "export it again"):
        reconstruction = pycolmap.Reconstruction(model)
        return _images(model, reconstruction), _cloud(reconstruction)


def _images(model: Path, reconstruction: Any) -> list[tuple[str, Camera, np.ndarray]]:
    """Images of a model as in `read_model`."""
    images = []
    for image in sorted(reconstruction.images.values(), key=lambda image: image.name):
        lens = image.camera
        keys = MODELS.get(lens.model_name)
        if keys is None:
            raise InputError(
                f"{model}: camera model {lens.model_name} is not supported; "
                "run COLMAP's image_undistorter first"
            )
        pose, world = np.eye(4), image.cam_from_world()
        if not np.linalg.norm(world.rotation.quat) > 0.5:  # pycolmap normalises all but 0
            raise InputError(f"{model}: image {image.name!r}: its quaternion is 0; export it again")
        pose[:3] = world.matrix()
        try:
            camera = Camera(lens.calibration_matrix(), lens.width, lens.height, pose)
        except InputError as error:
            raise InputError(f"{model}: image {image.name!r}: {error}") from None
        values = dict(zip(keys, lens.params[len(lens.params) - len(keys) :], strict=True))
        distortion = np.array([values.get(key, 0.0) for key in OPENCV_ORDER])
        images.append((image.name, camera, distortion))
    return images


def _cloud(reconstruction: Any) -> SparseCloud | None:
    """Triangulated points that some image saw. COLMAP writes -1 for an unknown error."""
    centres = {
        image.image_id: image.projection_center() for image in reconstruction.images.values()
    }
    points, views, tracks, errors = [], [], [], []
    for point in reconstruction.points3D.values():
        seen = {element.image_id for element in point.track.elements}
        if seen:
            rays = np.stack([centres[image] for image in seen]) - point.xyz
            points.append(point.xyz)
            views.append((rays / np.linalg.norm(rays, axis=1, keepdims=True)).mean(0))
            tracks.append(float(len(seen)))
            errors.append(point.error)
    if not points:
        return None
    directions, error = np.stack(views), np.array(errors)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    known = error if (error >= 0).all() else None
    return SparseCloud(np.stack(points), directions, np.array(tracks), known)
