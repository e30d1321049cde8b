"""Data to import: cameras and files of nerfstudio, NeRF-synthetic, COLMAP, and RECORDINGS."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.bags import is_bag, read_bag
from mgs.data.clouds import SparseCloud, read_cloud
from mgs.data.colmap import is_model, read_model
from mgs.data.dataset import (
    FRAME_INTERVAL,
    PINHOLES,
    finite_number,
    posed_camera,
    read_records,
    timestamp_of,
    unit_of,
)
from mgs.data.metashape import is_metashape, read_metashape
from mgs.data.rgbd_folders import (
    is_open3d,
    is_rtabmap,
    is_tum,
    read_open3d,
    read_rtabmap,
    read_tum,
)
from mgs.data.tracks import Spacing
from mgs.data.up import PLUS_Z, Up, degrees_between, unit_up, up_of_cameras
from mgs.errors import InputError
from mgs.images import image_size

DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
"""Coefficients of the OPENCV camera model, in OpenCV's order."""

LEVELLED = 10.0
"""Angle from +Z, degrees, up to which cameras' common up vector counts as +Z."""

SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".PNG")
"""NeRF-synthetic names images without a suffix."""


@dataclass(frozen=True)
class Shot:
    """One frame to import, with its camera before undistortion, and its files.

    distortion: coefficients in OpenCV's order. timestamp: seconds. depth_unit: metres per step of
    a PNG depth image.
    """

    name: str
    camera: Camera
    distortion: np.ndarray
    timestamp: float
    image: Path
    depth: Path | None = None
    depth_unit: float = 1.0
    mask: Path | None = None
    rock: Path | None = None


@dataclass(frozen=True)
class Source:
    """Data to import.

    shots: frames whose image exists; missing: number of the others. sparse: triangulated points.
    up, unit ("m" or "unit"): None if the source does not say. no_cloud: file of points that the
    source names and that does not exist.
    """

    kind: str
    shots: list[Shot]
    missing: int
    sparse: SparseCloud | None = None
    up: Up | None = None
    unit: str | None = None
    no_cloud: Path | None = None

    def in_metres(self, unit: float) -> Source:
        """Scale cameras and points by `unit` metres. Raises InputError unless it is positive."""
        if not 0 < unit < np.inf:
            raise InputError(f"import: unit {unit} must be a positive number of metres; correct it")
        shots = [replace(shot, camera=shot.camera.scaled(unit)) for shot in self.shots]
        return replace(self, shots=shots, sparse=self.sparse and self.sparse.scaled(unit), unit="m")

    def set_apart(self, every: int) -> tuple[Source, Source]:
        """Split into (training, test): every Nth shot by name, from the first, is a test view.

        Raises InputError if no training shot is left.
        """
        names = sorted(shot.name for shot in self.shots)[::every]
        apart = [shot for shot in self.shots if shot.name in names]
        kept = [shot for shot in self.shots if shot.name not in names]
        if not kept:
            raise InputError(
                f"import: test_every {every} of {len(self.shots)} images leaves none to choose "
                "from; correct it"
            )
        return replace(self, shots=kept), replace(self, shots=apart, sparse=None)

    def up_or_estimate(self) -> tuple[Up, str]:
        """Up vector and the reason for it: given by the source, by the format, or estimated by
        `up_of_cameras`, whose InputError it raises."""
        if self.up is not None:
            return self.up, "as the source says"
        if self.kind == "NeRF-synthetic":
            return PLUS_Z, "the rule of NeRF-synthetic data"
        found = up_of_cameras([shot.camera for shot in self.shots])
        levelled = ("nerfstudio", "ROS bag", "TUM RGB-D", "RTAB-Map")
        if self.kind in levelled and degrees_between(found, PLUS_Z) < LEVELLED:
            return PLUS_Z, f"the cameras' common up vector is within {LEVELLED:.0f} degrees of it"
        return found, "the cameras' common up vector"


Fields = list[dict[str, Any]]
"""Fields of each `Shot`."""

Reader = Callable[[Path, Path | None, Spacing, Path], tuple[Fields, str | None]]
"""(path, images, spacing of keyframes, folder to unpack into) -> shots, and unit of length. images:
folder of the images, or of a bag their topic."""

RECORDINGS: dict[str, tuple[Callable[[Path], bool], Reader]] = {
    "ROS bag": (
        is_bag,
        lambda path, images, spacing, unpack: (
            read_bag(path, unpack, str(images) if images else None, spacing), "m"
        ),
    ),
    "TUM RGB-D": (is_tum, lambda path, _, spacing, __: (read_tum(path, spacing), "m")),
    "Open3D": (is_open3d, lambda path, _, spacing, __: (read_open3d(path, spacing), "m")),
    "RTAB-Map": (is_rtabmap, lambda path, _, spacing, __: (read_rtabmap(path, spacing), "m")),
    "Metashape": (
        is_metashape,
        lambda path, images, *_: read_metashape(path, images or path.parent / "images"),
    ),
}  # fmt: skip
"""Recordings of robots: kind -> (whether a path is one, its reader)."""


def read_source(
    source: str | Path,
    images: Path | None = None,
    split: str = "train",
    *,
    keyframes: str = "0.5s",
    unpack: Path | None = None,
) -> Source:
    """Recognise the format of a source, and read its cameras and file names.

    source: a transforms.json or its folder; a folder with NeRF-synthetic's transforms_SPLIT.json;
    a folder with a COLMAP model in itself, sparse/ or sparse/0/; or one of RECORDINGS. images: the
    image folder of COLMAP or Metashape, by default SOURCE/images; of a bag the topic. split: train,
    val or test. keyframes: `Spacing` of a recording. unpack: folder for the images of a bag, by
    default SOURCE.unpacked. Raises InputError if no format is recognised, no image exists, a frame
    is listed twice, or a camera model is not supported.
    """
    source = Path(source)
    source.exists()  # an OSError of the source itself is not one of a file that it names
    try:
        result = _recognised(source, images, split, keyframes, unpack)
    except OSError as error:
        raise InputError(
            f"{source}: a file of it cannot be read ({error.strerror or error}); correct its name"
        ) from None
    if not result.shots:
        raise InputError(
            f"{source}: none of the {result.missing} images it lists exists; "
            "restore them or give `images`"
        )
    for name, count in Counter(shot.name for shot in result.shots).items():
        if count > 1:
            raise InputError(f"{source}: lists {name} more than once; remove the duplicate frames")
    return result


def _recognised(
    source: Path, images: Path | None, split: str, keyframes: str, unpack: Path | None
) -> Source:
    """`read_source` without checks of the shots. Raises OSError for names that are too long."""
    if not source.exists():
        raise InputError(
            f"{source}: no such file or folder; "
            "give a transforms.json, its folder, or a COLMAP folder"
        )
    path = source if source.is_file() else source / "transforms.json"
    split_path = source / f"transforms_{split}.json"
    folders = (source / "sparse/0", source / "sparse", source)
    recording = next((kind for kind, (fits, _) in RECORDINGS.items() if fits(source)), None)
    if recording is not None:
        folder = unpack or source.with_name(f"{source.name}.unpacked")
        reader = RECORDINGS[recording][1]
        fields, unit = reader(source, images, Spacing.parse(keyframes), folder)
        shots = [Shot(**each) for each in fields if each["image"].is_file()]
        return Source(recording, shots, len(fields) - len(shots), unit=unit)
    if path.is_file() or split_path.is_file():
        return _read_transforms(path if path.is_file() else split_path)
    if model := next((folder for folder in folders if is_model(folder)), None):
        return _read_colmap(model, images if images is not None else source / "images")
    raise InputError(
        f"{source}: holds no transforms.json, transforms_{split}.json or COLMAP model "
        "(cameras, images and points3D, .bin or .txt, in sparse/0, sparse or the folder "
        f"itself), and is no {', '.join(RECORDINGS)}"
    )


def find_image(folder: Path, name: str) -> Path | None:
    """The file of this name in a folder, with one of SUFFIXES, or None."""
    paths = (folder / f"{name}{suffix}" for suffix in SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def _frame_name(path: str) -> str:
    """Flat name of an image path: images/left/0001.png -> left_0001."""
    parts = Path(path).with_suffix("").parts
    return "_".join(part for part in parts if part not in (".", "..", "/", "images"))


def _read_transforms(path: Path) -> Source:
    """Read a transforms.json of nerfstudio or NeRF-synthetic (camera_angle_x, no suffixes)."""
    data, records = read_records(path)
    model = data.get("camera_model", "OPENCV")
    if model not in PINHOLES:
        raise InputError(
            f"{path}: camera model {model} is not supported; "
            "undistort the images to OPENCV or PINHOLE first"
        )
    key = "depth_unit_scale_factor"
    scale = finite_number(str(path), key, data.get(key, 1e-3))
    shots, missing = [], 0
    for index, record in enumerate(records):
        image = find_image(path.parent, record["file_path"])
        if image is None:
            missing += 1
            continue
        keys = ("depth_file_path", "mask_path", "rock_file_path")
        depth, mask, rock = (path.parent / record[key] if record.get(key) else None for key in keys)
        where = f"{path}: frame {index}"
        camera, distortion = record_camera(where, {**data, **record}, image)
        time = timestamp_of(where, index, record)
        unit = 1.0 if depth is None or depth.suffix.lower() == ".exr" else scale
        name = _frame_name(record["file_path"])
        shots.append(Shot(name, camera, distortion, time, image, depth, unit, mask, rock))
    kind = "NeRF-synthetic" if "camera_angle_x" in data and "fl_x" not in data else "nerfstudio"
    cloud = path.parent / str(data["ply_file_path"]) if data.get("ply_file_path") else None
    no_cloud = cloud if cloud is not None and not cloud.is_file() else None
    sparse = read_cloud(cloud) if cloud is not None and no_cloud is None else None
    up = unit_up(data["up"]) if data.get("up") else None
    length = unit_of(path, data) or ("m" if any(shot.depth for shot in shots) else None)
    return Source(kind, shots, missing, sparse, up, length, no_cloud)


def record_camera(where: str, record: dict[str, Any], image: Path) -> tuple[Camera, np.ndarray]:
    """Camera and distortion of a frame; missing intrinsics follow from the image."""
    try:
        if "w" in record and "h" in record:
            width, height = float(record["w"]), float(record["h"])
        else:
            width, height = image_size(image)
        if "fl_x" in record:
            fl_x = float(record["fl_x"])
        else:
            fl_x = width / 2 / math.tan(float(record["camera_angle_x"]) / 2)
        defaults = {"fl_y": fl_x, "cx": width / 2, "cy": height / 2}
        fl_y, cx, cy = (float(record.get(key, value)) for key, value in defaults.items())
        K = np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]])
        distortion = np.array([float(record.get(key, 0)) for key in DISTORTION_KEYS])
        pose = np.array(record["transform_matrix"], np.float64)
    except (KeyError, TypeError, ValueError, ArithmeticError):
        raise InputError(
            f"{where} has no usable intrinsics or pose; give fl_x (or camera_angle_x) and a matrix"
        ) from None
    if record.get("k4"):
        raise InputError(
            f"{where} has k4, which the OPENCV model lacks; undistort the images first"
        )
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if not np.isfinite(distortion).all():
        raise InputError(f"{where} has a distortion that is not finite; correct it")
    return posed_camera(where, K, width, height, pose), distortion


def _read_colmap(model: Path, images: Path) -> Source:
    listed, cloud = read_model(model)
    shots = [
        Shot(_frame_name(name), camera, distortion, FRAME_INTERVAL * index, images / name)
        for index, (name, camera, distortion) in enumerate(listed)
        if (images / name).is_file()
    ]
    return Source("COLMAP", shots, len(listed) - len(shots), cloud)
