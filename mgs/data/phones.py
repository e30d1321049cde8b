"""Recordings of phones with poses of ARKit, in metres: 3D Scanner App, Polycam and Record3D; each
reader returns keyframes. The world is +Y up, but that of Record3D turned by the first pose."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np

from mgs.data.agreement import FLIP
from mgs.data.rgbd_folders import INTERVAL, LARGEST_NUMBER, keyframe
from mgs.data.shots import Shot, Source, Spacing, find_image, natural, orthonormal, rigid
from mgs.errors import InputError
from mgs.files import LARGEST, atomic_path, parsing, read_json, read_text

UP = (0.0, 1.0, 0.0)
ARKIT = "cameraPoseARFrame"  # key of a pose of 3D Scanner App
RIM = 15 / 1024  # of undistorted pictures of Polycam, over their width: nerfstudio cuts it off, too
RECORD3D = {"rgb": "metadata.json", "rgbd": "metadata"}  # folder of pictures -> file of poses
UNREADABLE = TypeError, KeyError, ValueError, OverflowError


class Picture(NamedTuple):
    """A picture with its files, of which depth (mm, or EXR) and confidence may be missing."""

    time: float  # seconds
    pose: np.ndarray  # [4,4] camera-to-world, camera axes of OpenGL
    K: np.ndarray
    size: tuple[int, int] | None  # of images that K is for; None: of this one
    image: Path
    depth: Path | None = None
    confidence: Path | None = None


def _chosen(pictures: Sequence[Picture], spacing: Spacing) -> list[Picture]:
    return [pictures[k] for k in spacing.choose([(one.time, one.pose) for one in pictures])]


def _shots(pictures: Sequence[Picture], rim: float = 0.0) -> list[Shot]:
    """Frames of pictures. rim: what is cut off on each side, over the width."""
    shots = list[Shot]()
    for time, pose, K, size, image, depth, confidence in pictures:
        pose, time = orthonormal(pose @ FLIP)[0], time - pictures[0].time
        shot = keyframe(image.stem, K, None, pose, time, image, depth, size=size)
        pixels = int(np.ceil(rim * shot.camera.width))
        shots.append(replace(shot, confidence=confidence, rim=pixels))
    return shots


def is_scanner(folder: Path) -> bool:
    """Whether a folder is "All Data" of the iOS program 3D Scanner App."""
    first = min(folder.glob("frame_*.json"), default=None)
    return first is not None and ARKIT in read_text(first)


def read_scanner(folder: Path, _: object, spacing: Spacing, *__: object) -> Source:
    """Keyframes of the frame_N.json that have a frame_N.jpg, with depth_N.png (mm) and conf_N.png.
    Matrices are row-major."""
    pictures = list[Picture]()
    for path in sorted(folder.glob("frame_*.json"), key=natural):
        if (image := path.with_suffix(".jpg")).is_file():  # most frames have none
            record: Any = read_json(path)
            try:
                K, pose = (np.array(record[key], np.float64) for key in ("intrinsics", ARKIT))
                time = float(record.get("time", INTERVAL * len(pictures)))
                if not abs(time) < LARGEST_NUMBER:
                    raise ValueError
                K, pose = K.reshape(3, 3), pose.reshape(4, 4)
            except UNREADABLE:
                why = f"has no {ARKIT} of 16 numbers, intrinsics of 9 and time"
                raise InputError(f"{path}: {why}; export it again") from None
            ends = (f"{kind}{image.stem.removeprefix('frame')}.png" for kind in ("depth", "conf"))
            pictures.append(Picture(time, pose, K, None, image, *map(folder.joinpath, ends)))
    if not pictures:
        raise InputError(f"{folder}: has no frame_N.jpg beside frame_N.json; export All Data")
    return Source("3D Scanner App", _shots(_chosen(pictures, spacing)), up=UP, unit="m")


def is_polycam(folder: Path) -> bool:
    """Whether a folder is the raw data of a capture by Polycam."""
    first = min(folder.glob("keyframes/*cameras/*.json"), default=None)
    return first is not None and "t_23" in read_text(first)


def read_polycam(folder: Path, _: object, spacing: Spacing, *__: object) -> Source:
    """Keyframes of keyframes/cameras with their images, depth (mm) and confidence, named by their
    time in microseconds. Where both are there, the pictures and cameras are the corrected ones,
    without their rim. A camera has the first three rows of its pose as t_RC."""
    root, pictures, left_out = folder / "keyframes", list[Picture](), Counter[str]()
    both = all((root / f"corrected_{name}").is_dir() for name in ("images", "cameras"))
    corrected = "corrected_" if both else ""
    for path in sorted((root / f"{corrected}cameras").glob("*.json"), key=natural):
        image = find_image(root / f"{corrected}images", path.stem)
        if image is None:
            left_out["whose file is missing"] += 1
            continue
        one: Any = read_json(path)
        try:
            K = np.array([[one["fx"], 0, one["cx"]], [0, one["fy"], one["cy"]], [0, 0, 1]], float)
            rows = [[one[f"t_{row}{column}"] for column in range(4)] for row in range(3)]
            pose, time = np.array([*rows, [0, 0, 0, 1]], float), 1e-6 * int(path.stem)
            size = (int(one["width"]), int(one["height"])) if "width" in one else None
        except UNREADABLE:
            why = "has no fx, fy, cx, cy and t_00 to t_23, or no time as its name"
            raise InputError(f"{path}: {why}; export it again") from None
        files = (root / f"{kind}/{path.stem}.png" for kind in ("depth", "confidence"))
        pictures.append(Picture(time, pose, K, size, image, *files))
    if not pictures:
        raise InputError(f"{root}: has no picture of a camera; export the raw data again")
    shots = _shots(_chosen(pictures, spacing), RIM if corrected else 0)
    return Source("Polycam", shots, left_out, up=UP, unit="m")


def is_record3d(path: Path) -> bool:
    """Whether a path is an .r3d file of Record3D, or a folder out of one or of "EXR + RGB"."""
    if path.suffix.lower() == ".r3d" and path.is_file():
        return True
    names = [path / name for folder, name in RECORD3D.items() if (path / folder).is_dir()]
    return any(name.is_file() and '"poses"' in read_text(name) for name in names)


def read_record3d(path: Path, _: object, spacing: Spacing, unpack: Path, *__: object) -> Source:
    """Keyframes of metadata, where a pose is a quaternion x y z w and a position, and rgbd/N.jpg;
    or of metadata.json, rgb/N.jpg and depth/N.exr (m). K is column-major."""
    folder = "rgb" if (path / "rgb").is_dir() else "rgbd"
    record: Any = read_json(_unpacked(path, [RECORD3D[folder]], unpack)[0])
    try:
        K = np.array(record["K"], float).reshape(3, 3).T
        size, fps = (int(record["w"]), int(record["h"])), float(record["fps"])
        rows = np.array(record["poses"], float).reshape(-1, 7)
        poses = [rigid(row[4:], row[:4]) for row in rows.tolist()]
        if not 1 / LARGEST_NUMBER < fps < LARGEST_NUMBER:
            raise ValueError
    except UNREADABLE:
        why = "has no K, w, h, fps and poses of 7 numbers with a quaternion of length 1"
        raise InputError(f"{path}: its metadata {why}; export it again") from None
    if not len(rows) or (len(rows) > 1 and np.ptp(rows, axis=0).max() == 0):
        cure = "import its pictures as photographs"
        raise InputError(f"{path}: has no poses that move, as of the front camera; {cure}")
    every = [
        Picture(k / fps, pose, K, size, Path(f"{k}.jpg"), path / f"depth/{k}.exr")
        for k, pose in enumerate(poses)
    ]
    chosen = _chosen(every, spacing)
    images = _unpacked(path, [f"{folder}/{one.image}" for one in chosen], unpack)
    there = [one._replace(image=image) for one, image in zip(chosen, images, strict=True)]
    there = [one for one in there if one.image.is_file()]
    if not there:
        raise InputError(f"{path}: none of its pictures is there, as {folder}/0.jpg; export again")
    left_out = +Counter({"whose file is missing": len(chosen) - len(there)})
    note = "depth is left out: it is compressed by LZFSE; export EXR + RGB to have it"
    return Source("Record3D", _shots(there), left_out, (note,) * (folder == "rgbd"), unit="m")


PHONES: dict[str, tuple[Callable[[Path], bool], Callable[..., Source]]] = {
    "3D Scanner App": (is_scanner, read_scanner),
    "Polycam": (is_polycam, read_polycam),
    "Record3D": (is_record3d, read_record3d),
}
"""Kind -> (whether a path is of it, its reader as of `mgs.data.sources.Reader`)."""


def _unpacked(path: Path, names: Sequence[str], folder: Path) -> list[Path]:
    """Files of these names in a folder `path`, or in a zip, of which those that it has are unpacked
    into `folder`. Raises InputError for a damaged zip, and for files larger than LARGEST."""
    if path.is_dir():
        return [path / name for name in names]
    files = [folder / Path(name).name for name in names]
    with parsing(path, "zip", "export it again"), ZipFile(path) as archive:
        infos = {info.filename: info for info in archive.infolist()}
        for info, file in zip(map(infos.get, names), files, strict=True):
            if info is None:
                continue
            if info.file_size > LARGEST or info.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
                raise ValueError(f"{info.filename} has {info.file_size:,} bytes")
            with atomic_path(file) as temporary, archive.open(info) as member:
                temporary.write_bytes(member.read(info.file_size))  # no more, whatever it holds
    return files
