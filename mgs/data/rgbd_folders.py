"""Folders of robots and scanners with a pose for each image: TUM RGB-D, Open3D, 7-Scenes, RTAB-Map
exports; each reader returns keyframes, in metres."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.lens import Lens
from mgs.data.shots import Shot, Source, Spacing, Track, natural, orthonormal, posed, rigid
from mgs.errors import InputError
from mgs.files import read_json, read_text
from mgs.images import image_size

TUM_DEPTH_UNIT = 1 / 5000  # metres in a step of a TUM RGB-D depth image
LARGEST_NUMBER = 1e15  # numbers beyond it are mistakes, also of times
SYNCHRONOUS = 0.02  # most seconds between a colour and its depth image (TUM's associate.py)
INTERVAL = 0.5  # seconds between images of folders without times: by default all are taken
COLOUR, POSE = ".color", ".pose.txt"  # ends of names of 7-Scenes


def rows(path: Path, least: int) -> list[list[str]]:
    """Words of the lines without comments. Raises InputError for fewer than `least`."""
    lines = read_text(path).splitlines()
    table = [line.split() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if short := [words for words in table if len(words) < least]:
        why = f"{' '.join(short[0])[:60]!r} has fewer than {least} columns"
        raise InputError(f"{path}: {why}; correct the line")
    return table


def numbers(path: Path, words: list[str]) -> list[float]:
    """Words as finite numbers. Raises InputError."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [np.nan]
    if not (np.abs(values) < LARGEST_NUMBER).all():
        raise InputError(f"{path}: {' '.join(words)[:60]!r} are not all numbers; correct the line")
    return values


def poses(path: Path) -> list[list[float]]:
    """Lines (time, x, y, z, qx, qy, qz, qw, ...) of a trajectory. Raises InputError if none is."""
    samples = [numbers(path, words) for words in rows(path, 8)]
    if not samples:
        raise InputError(f"{path}: lists no poses; record or export it again")
    return samples


def calibration(folder: Path) -> tuple[np.ndarray, Lens | None]:
    """K [3,3] and lens by camera_intrinsic.json (Open3D), else camera-intrinsics.txt (3x3, of
    3DMatch, also in the folder above), else calibration.txt (fx fy cx cy and k1 k2 p1 p2 k3). All
    count pixel centres as whole numbers."""
    path = folder / "camera_intrinsic.json"
    if path.is_file():
        record: Any = read_json(path)
        try:
            K = np.array(record["intrinsic_matrix"], np.float64).reshape(3, 3).T.copy()
        except (TypeError, KeyError, ValueError, OverflowError):
            raise InputError(f"{path}: has no intrinsic_matrix of 9 numbers; correct it") from None
        K[:2, 2] += 0.5
        return K, None
    for place in (folder, folder.resolve().parent):
        if (path := place / "camera-intrinsics.txt").is_file():
            K = _matrix(path, 3)
            K[:2, 2] += 0.5
            return K, None
    path = folder / "calibration.txt"
    if not path.is_file():
        raise InputError(
            f"{folder}: has no calibration; write fx fy cx cy into its calibration.txt "
            "(525 525 319.5 239.5 is the default of a Kinect)"
        )
    values = numbers(path, [word for words in rows(path, 1) for word in words])
    if len(values) not in (4, 8, 9):
        cure = "give fx fy cx cy, or fx fy cx cy k1 k2 p1 p2 k3"
        raise InputError(f"{path}: has {len(values)} numbers; {cure}")
    fx, fy, cx, cy, *distortion = values
    K = np.array([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]])
    return K, opencv_lens(str(path), K, distortion)


def _matrix(path: Path, size: int) -> np.ndarray:
    """Square matrix of a file that has nothing else. Raises InputError."""
    values = numbers(path, [word for words in rows(path, 1) for word in words])
    if len(values) != size * size:
        cure = f"give a {size}x{size} matrix"
        raise InputError(f"{path}: has {len(values)} numbers; {cure}")
    return np.reshape(values, (size, size))


def is_tum(folder: Path) -> bool:
    """Whether a folder is as those of the TUM RGB-D benchmark."""
    return (folder / "rgb.txt").is_file() and (folder / "groundtruth.txt").is_file()


def read_tum(folder: Path, _: object, spacing: Spacing, *__: object) -> Source:
    """Keyframes of rgb.txt, depth.txt and groundtruth.txt, whose poses are interpolated."""
    files: dict[str, list[tuple[float, Path]]] = {}
    for kind in ("rgb", "depth"):
        path = folder / f"{kind}.txt"
        lines = rows(path, 2) if kind == "rgb" or path.is_file() else []
        files[kind] = [(numbers(path, words[:1])[0], folder / words[1]) for words in lines]
    path = folder / "groundtruth.txt"
    track = Track.of([(row[0], _pose(path, row[1:8])) for row in poses(path)])
    images = {time: image for time, image in sorted(files["rgb"]) if image.is_file()}
    left_out = Counter({"whose file is missing": len(files["rgb"]) - len(images)})
    there = posed(images, track.at, left_out)
    if not there:
        raise InputError(f"{folder}: no image has a pose at its time; check groundtruth.txt")
    K, lens = calibration(folder)
    times = np.array([time for time, _ in files["depth"]])
    shots: list[Shot] = []
    for k in spacing.choose(there):
        time, pose = there[k]
        near = int(np.argmin(np.abs(times - time))) if len(times) else -1
        depth = files["depth"][near][1] if near >= 0 else None
        if depth is not None and abs(times[near] - time) > SYNCHRONOUS:
            depth = None
        name, unit = f"kf_{len(shots):04d}", TUM_DEPTH_UNIT
        shots.append(keyframe(name, K, lens, pose, time - there[0][0], images[time], depth, unit))
    return Source("TUM RGB-D", shots, left_out, unit="m")


def is_open3d(folder: Path) -> bool:
    """Whether a folder has the trajectory and images of an Open3D recording."""
    return (folder / "trajectory.log").is_file() and (folder / "color").is_dir()


def read_open3d(folder: Path, _: object, spacing: Spacing, *__: object) -> Source:
    """Keyframes of color/, depth/ (mm) and trajectory.log (camera-to-world), in the order of the
    numbers in their names."""
    path = folder / "trajectory.log"
    words = [word for line in rows(path, 3) for word in line]
    values = numbers(path, words)
    if not len(values) or len(values) % 19:
        cure = "record it again"
        raise InputError(f"{path}: needs three numbers and a 4x4 matrix for each image; {cure}")
    matrices = [*np.array(values).reshape(-1, 19)[:, 3:].reshape(-1, 4, 4)]
    images, depths = (
        sorted((path for path in (folder / name).glob("*") if path.is_file()), key=natural)
        for name in ("color", "depth")
    )
    for name, files in (("color", images), ("depth", depths)):
        if len(files) != len(matrices) and (files or name == "color"):
            why = f"has {len(matrices)} poses for {len(files)} images in {name}"
            raise InputError(f"{path}: {why}; make them equal")
    if unnumbered := [path for path in images if not re.search(r"\d", path.name)]:
        cure = "rename it"
        raise InputError(f"{unnumbered[0]}: its name has no number, which gives its pose; {cure}")
    return Source("Open3D", _untimed(folder, spacing, matrices, images, depths), unit="m")


def is_seven_scenes(folder: Path) -> bool:
    """Whether a folder is a sequence of 7-Scenes or 3DMatch."""
    return any(folder.glob(f"*{POSE}"))


def read_seven_scenes(folder: Path, _: object, spacing: Spacing, *__: object) -> Source:
    """Keyframes of NAME.color.png (or .jpg), NAME.depth.png (mm) and NAME.pose.txt, a matrix
    camera-to-world, in the order of the numbers in their names."""
    left_out, poses, images = Counter[str](), list[np.ndarray](), list[Path]()
    for image in sorted(folder.glob(f"*{COLOUR}.*"), key=natural):
        path = image.with_name(f"{image.stem.removesuffix(COLOUR)}{POSE}")
        text = read_text(path).lower() if path.is_file() else "nan"
        if "inf" in text or "nan" in text:
            left_out["without a pose"] += 1
            continue
        images.append(image)
        poses.append(_matrix(path, 4))
    if not images:
        why = f"no image NAME{COLOUR}.png or .jpg with a pose in NAME{POSE}"
        raise InputError(f"{folder}: has {why}; restore them")
    depths = [path.with_name(f"{path.stem.removesuffix(COLOUR)}.depth.png") for path in images]
    shots = _untimed(folder, spacing, poses, images, depths)
    return Source("7-Scenes", shots, +left_out, unit="m")


def _untimed(
    folder: Path,
    spacing: Spacing,
    matrices: Sequence[np.ndarray],
    images: Sequence[Path],
    depths: Sequence[Path],
) -> list[Shot]:
    """Keyframes of images at poses camera-to-world, INTERVAL apart. depths: in mm, or none."""
    K, lens = calibration(folder)
    times = (INTERVAL * np.arange(len(images))).tolist()
    poses, mended = zip(*map(orthonormal, matrices), strict=True)
    shots: list[Shot] = []
    for k in spacing.choose(list(zip(times, poses, strict=True))):
        name, depth = images[k].stem.removesuffix(COLOUR), depths[k] if depths else None
        shot = keyframe(name, K, lens, poses[k], times[k], images[k], depth)
        shots.append(replace(shot, mended=mended[k]))
    return shots


def is_rtabmap(folder: Path) -> bool:
    """Whether a folder is one of `rtabmap-export --images_id --poses_camera --poses_format 11`."""
    return bool([*folder.glob("*_camera_poses.txt")]) and bool([*folder.glob("*_calib")])


def read_rtabmap(folder: Path, _: object, spacing: Spacing, *__: object) -> Source:
    """Keyframes of NAME_rgb, NAME_depth (mm), NAME_calib and NAME_camera_poses.txt, by id."""
    path = min(folder.glob("*_camera_poses.txt"))
    name = path.name.removesuffix("_camera_poses.txt")
    lines = poses(path)
    if any(len(row) < 9 for row in lines):
        raise InputError(f"{path}: has no ids; export with --poses_format 11")
    views = [row for row in sorted(lines) if row[8] >= 0]
    left_out = Counter({"landmark": len(lines) - len(views)})
    there = [(row[0], _pose(path, row[1:8])) for row in views]
    shots: list[Shot] = []
    for k in spacing.choose(there):
        (time, pose), number = there[k], int(views[k][8])
        pictures = [folder / f"{name}_rgb" / f"{number}.{end}" for end in ("jpg", "png")]
        image = next((path for path in pictures if path.is_file()), pictures[0])
        K, lens = _opencv_yaml(folder / f"{name}_calib" / f"{number}.yaml")
        depth = folder / f"{name}_depth" / f"{number}.png"
        shots.append(keyframe(f"{number:06d}", K, lens, pose, time - there[0][0], image, depth))
    return Source("RTAB-Map", shots, +left_out, unit="m")


FOLDERS = {
    "TUM RGB-D": (is_tum, read_tum),
    "Open3D": (is_open3d, read_open3d),
    "7-Scenes": (is_seven_scenes, read_seven_scenes),
    "RTAB-Map": (is_rtabmap, read_rtabmap),
}
"""Kind -> (whether a folder is of it, its reader as of `mgs.data.sources.Reader`)."""


def _opencv_yaml(path: Path) -> tuple[np.ndarray, Lens | None]:
    """K and lens of a camera in a file of OpenCV's FileStorage. It is not read by OpenCV, which
    aborts the process on some damaged files."""
    text, arrays = "\n" + read_text(path), []
    for key in ("camera_matrix", "distortion_coefficients"):
        _, there, rest = text.partition(f"\n{key}:")
        rest, opened, _ = rest.partition("data:")[2].partition("]")
        if not (there and opened):
            raise InputError(f"{path}: has no {key}; export it again")
        words = rest.replace("[", " ").replace(",", " ").split()
        arrays.append(np.array(numbers(path, words)))
    K, D = arrays
    if K.size != 9 or D.size not in (0, 4, 5, 6, 8):
        raise InputError(
            f"{path}: has {K.size} numbers in camera_matrix and {D.size} in "
            "distortion_coefficients, not 9 and 4, 5, 6 or 8; export it again"
        )
    K = K.reshape(3, 3)
    K[:2, 2] += 0.5
    if D.size == 6:  # RTAB-Map's fisheyes: k1 k2 p1 p2 k3 k4
        k1, k2, _, _, k3, k4 = D.tolist()
        values = {"k1": k1, "k2": k2, "k3": k3, "k4": k4}
        return K, Lens.of(str(path), "OPENCV_FISHEYE", K, values)
    return K, opencv_lens(str(path), K, D.tolist())


def opencv_lens(where: str, K: np.ndarray, distortion: Sequence[float]) -> Lens | None:
    """Lens of the coefficients k1 k2 p1 p2 k3 k4 k5 k6 of OpenCV, or the first of them."""
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return Lens.of(where, "FULL_OPENCV", K, dict(zip(names, distortion, strict=False)))


def _pose(path: Path, row: list[float]) -> np.ndarray:
    try:
        return rigid(row[:3], row[3:])
    except ValueError:
        cure = "correct the line"
        raise InputError(f"{path}: has a quaternion whose length is not 1; {cure}") from None


def keyframe(
    name: str,
    K: np.ndarray,
    lens: Lens | None,
    pose: np.ndarray,
    time: float,
    image: Path,
    depth: Path | None,
    unit: float = 1e-3,
    size: tuple[int, int] | None = None,
) -> Shot:
    """Frame at a pose camera-to-world. depth: may be missing; of `unit` metres a step. size: of the
    images that K is for, by default that of the image. Raises InputError for a singular pose."""
    try:
        camera = Camera(K, *(size or image_size(image)), np.linalg.inv(pose))
    except np.linalg.LinAlgError:
        raise InputError(f"{image}: its pose is singular; correct it") from None
    there = depth if depth is not None and depth.is_file() else None
    return Shot(name, camera, lens, float(time), image, there, unit)
