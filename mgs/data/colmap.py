"""COLMAP sparse models, text or binary, read by pycolmap."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.clouds import SparseCloud
from mgs.errors import InputError
from mgs.files import reading
from mgs.memory import decoding

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
    "cameras.bin": (24, False, 0),
    "images.bin": (64, True, 24),
    "points3D.bin": (43, False, 8),
}
"""Binary file -> bytes of a record, whether a name follows, and bytes of each item of the list that
follows (COLMAP's output formats); no list: 0."""


def _is_whole(path: Path, fixed: int, named: bool, item: int) -> bool:
    """Whether a binary file is as long as its counts say. pycolmap does not end if it is not."""
    with reading(path):
        data = path.read_bytes()
    try:
        (count,), place = struct.unpack_from("<Q", data), 8
        for _ in range(count):
            place += fixed
            place = data.index(b"\0", place) + 1 if named else place
            if item:
                place += 8 + item * struct.unpack_from("<Q", data, place)[0]
            if place > len(data):
                return False
    except (struct.error, ValueError, OverflowError):
        return False
    return True


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

    for file, layout in RECORDS.items():
        if (model / file).is_file() and not _is_whole(model / file, *layout):
            raise InputError(f"{model / file}: is damaged or cut off; export the model again")
    try:
        with decoding(model):
            reconstruction = pycolmap.Reconstruction(model)
    except InputError:
        raise
    except Exception as error:  # pycolmap raises many types for damaged models
        reason = " ".join(str(error).split())[:120]
        raise InputError(
            f"{model}: not a readable COLMAP model ({reason}); export it again"
        ) from None
    images = []
    for image in sorted(reconstruction.images.values(), key=lambda image: image.name):
        lens = image.camera
        keys = MODELS.get(lens.model_name)
        if keys is None:
            raise InputError(
                f"{model}: camera model {lens.model_name} is not supported; "
                "run COLMAP's image_undistorter first"
            )
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        camera = Camera(lens.calibration_matrix(), lens.width, lens.height, pose)
        values = dict(zip(keys, lens.params[len(lens.params) - len(keys) :], strict=True))
        distortion = np.array([values.get(key, 0.0) for key in OPENCV_ORDER])
        images.append((image.name, camera, distortion))
    return images, _cloud(reconstruction)


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
