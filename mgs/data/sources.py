"""Data to import: recognition of its format, and the files of nerfstudio and NeRF-synthetic."""

import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.bags import is_bag, read_bag
from mgs.data.clouds import read_cloud
from mgs.data.colmap import check_no_part, models_in, read_colmap
from mgs.data.dataset import finite_number, posed_camera, read_records, timestamp_of, unit_of
from mgs.data.depth_beside import with_scale_of_depth
from mgs.data.lens import Lens
from mgs.data.peers import PEERS, is_peer, read_peer
from mgs.data.phones import PHONES
from mgs.data.photographs import KIND as PHOTOGRAPHS
from mgs.data.photographs import (
    UNREAD,
    VIDEO_SUFFIXES,
    check_alone,
    depth_places,
    photographs_in,
    pictures_of,
    read_photographs,
    sharpest_frames,
)
from mgs.data.rgbd_folders import FOLDERS
from mgs.data.shots import (
    PICTURE_SUFFIXES,
    ROUNDED,
    Shot,
    Source,
    Spacing,
    checked,
    find_image,
    frame_name,
    none_exists,
    orthonormal,
    turned_by_exif,
)
from mgs.data.world import unit_up
from mgs.errors import InputError
from mgs.images import image_size

COEFFICIENTS = (  # keys of transforms.json that COLMAP's camera models name alike
    *(f"k{i}" for i in range(1, 7)),
    *("p1", "p2", "sx1", "sy1", "omega", "k", "k0", "alpha", "beta"),
)

NGP_STEP = "integer_depth_scale"  # instant-ngp's name of a step of depth, that of `depth_path`
SPLITS = ("train_filenames", "val_filenames", "test_filenames")  # nerfstudio's lists of images

Reader = Callable[[Path, Path | None, Spacing, Path, str | None], Source]
"""(path, images, spacing of keyframes, folder to unpack into, topic of poses) -> source. images:
folder of the images, or of a bag their topic."""

# Recordings of robots and cameras of other programs: kind -> (whether a path is one, its reader).
RECORDINGS: dict[str, tuple[Callable[[Path], bool], Reader]] = {
    "ROS bag": (is_bag, read_bag),
    **FOLDERS,
    **PHONES,
    **{kind: (partial(is_peer, kind), partial(read_peer, kind)) for kind in PEERS},
}


KEYFRAMES = "0.5s"  # default spacing of a recording
TRAINING = "transforms_train.json"  # the training split of NeRF-synthetic data


def read_source(
    source: str | Path,
    images: Path | None = None,
    *,
    keyframes: str = KEYFRAMES,
    unpack: Path | None = None,
    pose: str | None = None,
    exclude: Sequence[str] = (),
    test_split: str | None = None,
    unit: float | None = None,
    distance: str | None = None,
    refine_poses: bool = False,
) -> Source:
    """Recognise the format of a source, and read its cameras and file names.

    source: a transforms.json or its folder; a folder with NeRF-synthetic's transforms_train.json;
    a folder with a COLMAP model in itself, sparse/ or sparse/N/; one of RECORDINGS; or a folder of
    photographs alone. images: the image folder, by default SOURCE/images, or that of the names in
    transforms.json; of a bag the topic. test_split: the split of NeRF-synthetic data that is set
    apart as test views. keyframes: `Spacing` of a recording. unpack: folder for the images of a
    bag and the matches of photographs, by default SOURCE.unpacked. pose: topic of a bag's poses.
    exclude: names of images to leave out. unit, distance: as `Source.in_metres` and
    `with_distance`; without, GPS gives metres, else depth beside photographs. refine_poses: refuse
    pictures without poses. Raises InputError if no format is recognised, no image exists, a frame
    is listed twice, a camera model is not supported, photographs cannot be placed, there is no such
    test split, or `pose` is given and the source is no bag."""
    source = Path(source)
    source.exists()  # an OSError of the source itself is not one of a file that it names
    try:
        how = keyframes, unpack, pose, exclude, refine_poses
        result = checked(source, _recognised(source, images, *how))
        if test_split is not None:
            tests = checked(source, _split_apart(source, images, test_split))
            result = result.with_tests(tests)
        elif (source / "transforms_test.json").is_file():
            note = "its test split is left out; --test-split test makes it the test views"
            result = replace(result, notes=(*result.notes, note))
    except OSError as error:
        why = f"a file of it cannot be read ({error.strerror or error})"
        raise InputError(f"{source}: {why}; correct its name") from None
    if count := sum(shot.mended for shot in result.shots):
        result = replace(result, notes=(f"{ROUNDED}: {count}", *result.notes))
    if result.kind != PHOTOGRAPHS:
        result = result.without(exclude)
    result = turned_by_exif(result.fitted()).near_origin()
    given = "GPS" if result.unit == "m" else ""
    if unit is not None:
        result, given = result.in_metres(unit), "--unit"
    if distance is not None:
        result, given = result.with_distance(distance), "--distance"
    return with_scale_of_depth(result, given)


def _recognised(
    source: Path,
    images: Path | None,
    keyframes: str,
    unpack: Path | None,
    pose: str | None,
    exclude: Sequence[str],
    refine_poses: bool,
) -> Source:
    """`read_source` without checks of the shots. Raises OSError for names that are too long."""
    if not source.exists():
        cure = "give a transforms.json, its folder, or a COLMAP folder"
        raise InputError(f"{source}: no such file or folder; {cure}")
    if source.suffix.lower() in PICTURE_SUFFIXES and source.is_file():
        raise InputError(f"{source}: is one picture; give the folder of all photographs")
    if source.suffix.lower() in UNREAD and source.is_file():
        raise InputError(f"{source}: is HEIC or raw; convert all photographs to JPEG")
    path = source if source.is_file() else source / "transforms.json"
    folder = unpack or Path(f"{os.path.abspath(source)}.unpacked")
    spacing = Spacing.parse(keyframes)
    recording = next((kind for kind, (fits, _) in RECORDINGS.items() if fits(source)), None)
    if pose is not None and recording != "ROS bag":
        raise InputError(f"{source}: is no ROS bag, so it has no topic {pose}; leave out --pose")
    if recording is not None:
        reader = RECORDINGS[recording][1]
        return reader(source, images, spacing, folder, pose)
    video = source.suffix.lower() in VIDEO_SUFFIXES and source.is_file()
    if keyframes != KEYFRAMES and not video:
        cure = "leave out --keyframes"
        raise InputError(f"{source}: is no recording or video, and all images are taken; {cure}")
    if images is not None and not images.is_dir():
        raise InputError(f"{images}: no such folder; give the folder of the images")
    if video:
        _check_given(source, refine_poses)
        frames = folder / "frames"
        paths = sharpest_frames(source, frames, spacing)
        return read_photographs(frames, paths, folder / "matches", exclude)
    if source.is_file() and source.suffix.lower() != ".json":
        cure = "give a transforms.json, a video or a folder; unpack an archive"
        raise InputError(f"{source}: is no file that can be imported; {cure}")
    if poses := next((one for one in (path, source / TRAINING) if one.is_file()), None):
        return _read_transforms(poses, images)
    if models := models_in(source):
        return read_colmap(source, models, images if images is not None else source / "images")
    check_no_part(source)
    if paths := photographs_in(images or source):
        _check_given(source, refine_poses)
        root = pictures_of(images or source)
        if folder.resolve().is_relative_to(root.resolve()):
            why = "the output would lie among its photographs, and its pictures be taken for some"
            raise InputError(f"{root}: {why}; write it to a place outside")
        check_alone(images or source)
        places = depth_places(source, images)
        return read_photographs(images or source, paths, folder / "matches", exclude, places)
    raise InputError(
        f"{source}: holds no photographs (PNG, JPEG, TIFF, WebP), transforms.json, "
        f"{TRAINING} or COLMAP model (cameras, images and points3D, .bin or .txt, in "
        f"sparse/0, sparse or the folder itself), and is no {', '.join(RECORDINGS)}"
    )


def _check_given(source: Path, refine_poses: bool) -> None:
    """Raise InputError where poses are to be refined of a source that has none."""
    if refine_poses:
        why = "its pictures come without poses; the ones found fit their points already"
        raise InputError(f"{source}: {why}; leave out --refine-poses")


def _split_apart(source: Path, images: Path | None, test_split: str) -> Source:
    """The split of NeRF-synthetic data that becomes test views."""
    path = source / f"transforms_{test_split}.json"
    if path.name == TRAINING or not path.is_file():
        fault = "is the training split" if path.name == TRAINING else f"there is no {path}"
        raise InputError(f"--test-split {test_split}: {fault}; give another, or --test-every N")
    return _read_transforms(path, images)


def _named(folder: Path, images: Path | None, name: str) -> Path | None:
    """File that transforms.json names: in its folder, there by the end of a path that begins
    elsewhere, or by its end in the folder of the images. Names written on Windows have
    backslashes."""
    parts = PureWindowsPath(name).parts
    ends = ["/".join(parts[k:]) for k in range(len(parts))]
    if images is not None:
        return next((image for end in ends if (image := find_image(images, end))), None)
    path = folder / name
    if not path.exists() and "\\" in name:
        path = folder / PureWindowsPath(name).as_posix()
    inner = [end for end in ends[1:-1] if ".." not in end.split("/")]
    places = [path, *(folder / end for end in inner)]
    return next((image for one in places if (image := find_image(one.parent, one.name))), None)


def _read_transforms(path: Path, images: Path | None) -> Source:
    """Read a transforms.json of nerfstudio or NeRF-synthetic (camera_angle_x, no suffixes)."""
    data, records = read_records(path)
    key = "depth_unit_scale_factor"
    scale = finite_number(str(path), key, data.get(key, 1e-3))
    of_floats = scale if key in data else 1.0
    steps = finite_number(str(path), NGP_STEP, data.get(NGP_STEP) or 0.0)
    if steps > 0 and key not in data:
        scale = steps
    tests, without = _splits(path, data, records)
    left_out, shots, notes, elsewhere = Counter[str](), [], list[str](), Counter[Path]()
    for index, record in enumerate(records):
        image = _named(path.parent, images, record["file_path"])
        if record["file_path"] in without:
            left_out["in no split"] += 1
            continue
        if image is None:
            left_out["whose file is missing"] += 1
            continue
        listed_in = (path.parent / PureWindowsPath(record["file_path"]).as_posix()).parent
        elsewhere[image] += images is None and image.parent != listed_in
        keys = ("depth_file_path", "mask_path", "rock_file_path")
        names = [record.get(key) or "" for key in keys]
        if steps > 0 and not names[0]:
            names[0] = str(record.get("depth_path") or "")
        depth, mask, rock = (
            (_named(path.parent, None, one) or path.parent / one) if one else None for one in names
        )
        where = f"{path}: frame {index}"
        about = {**data, **record}
        camera, lens, mended = record_camera(where, about, image)
        time, name = timestamp_of(where, index, record), frame_name(record["file_path"])
        files = image, depth, scale, mask, rock
        shots.append(Shot(name, camera, lens, time, *files, of_floats, mended=mended))
    if not shots and left_out["whose file is missing"]:
        raise none_exists(path, len(records), records[0]["file_path"])
    if twice := next((image for image, count in elsewhere.items() if count > 1), None):
        why = f"{twice} has the end of several of its paths"
        raise InputError(f"{path}: {why}; give the folder of its images as `images`")
    if count := elsewhere.total():
        where = f"{path.parent} by the ends of their paths, which begin elsewhere"
        notes.append(f"images found in {where}: {count}, as {next(iter(+elsewhere))}")
    listed = {frame_name(record["file_path"]) for record in records}
    if unknown := {frame_name(name) for name in tests} - listed:
        notes.append(f"test views that are no frame: {len(unknown)}, as {min(unknown)}")
    cloud = path.parent / str(data["ply_file_path"]) if data.get("ply_file_path") else None
    no_cloud = cloud if cloud is not None and not cloud.is_file() else None
    return Source(
        "NeRF-synthetic" if "camera_angle_x" in data and "fl_x" not in data else "nerfstudio",
        shots,
        left_out,
        tuple(notes),
        sparse=read_cloud(cloud) if cloud is not None and no_cloud is None else None,
        up=unit_up(data["up"]) if data.get("up") else None,
        unit=unit_of(path, data) or ("m" if any(shot.depth for shot in shots) else None),
        no_cloud=no_cloud,
        tests=frozenset(frame_name(name) for name in tests),
    )


def _splits(
    path: Path, data: dict[str, Any], records: list[dict[str, Any]]
) -> tuple[set[str], set[str]]:
    """file_path of the test images, and of those in no split: nerfstudio's SPLITS, whose training
    images are by default the others. Raises InputError unless they are lists of text."""
    listed = []
    for key in SPLITS:
        names = data.get(key) or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: {key} is no list of file names; correct it")
        listed.append(set(names))
    train, val, test = listed
    tests = (test | val) - train
    named = {frame_name(name) for name in train | tests}
    every = {record["file_path"] for record in records}
    return tests, {name for name in every if frame_name(name) not in named} if train else set()


def record_camera(
    where: str, record: dict[str, Any], image: Path
) -> tuple[Camera, Lens | None, bool]:
    """Camera and lens of a frame, and whether its rotation was NEARLY_RIGID. Missing intrinsics
    follow from the image."""
    record = {key: value for key, value in record.items() if value is not None}
    model = record.get("camera_model", "OPENCV")
    try:
        if "w" in record and "h" in record:
            width, height = float(record["w"]), float(record["h"])
        else:
            width, height = image_size(image)
        fl_x = _focal(record, "x", width)
        fl_y = _focal(record, "y", height) if {"fl_y", "camera_angle_y"} & set(record) else fl_x
        cx, cy = float(record.get("cx", width / 2)), float(record.get("cy", height / 2))
        K = np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]])
        values = {key: float(record[key]) for key in COEFFICIENTS if key in record}
        pose = np.array(record["transform_matrix"], np.float64)
    except (KeyError, TypeError, ValueError, ArithmeticError):
        cure = "give fl_x (or camera_angle_x) and a matrix"
        raise InputError(f"{where} has no usable intrinsics or pose; {cure}") from None
    if record.get("is_fisheye") and "FISHEYE" not in str(model):
        model = "OPENCV_FISHEYE"
    if values.get("k4") and model in ("OPENCV", "PINHOLE"):
        cure = "undistort the images first, or give camera_model FULL_OPENCV or OPENCV_FISHEYE"
        raise InputError(f"{where} has k4, which the OPENCV model lacks; {cure}")
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    pose, mended = orthonormal(pose)
    lens = Lens.of(where, str(model), K, values)
    return posed_camera(where, K, width, height, pose), lens, mended


def _focal(record: dict[str, Any], axis: str, side: float) -> float:
    """Focal length along an axis: fl_x, or by camera_angle_x and the side of the image."""
    if f"fl_{axis}" in record:
        return float(record[f"fl_{axis}"])
    return side / 2 / math.tan(float(record[f"camera_angle_{axis}"]) / 2)
