"""COLMAP sparse models, text or binary, read by pycolmap."""

import codecs
import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path, PureWindowsPath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.agreement import observed
from mgs.data.dataset import FRAME_INTERVAL
from mgs.data.lens import Lens, parameter_names
from mgs.data.shots import Shot, Source, find_image, frame_name, natural
from mgs.data.structure import cloud_of
from mgs.errors import InputError
from mgs.files import parsing, reading

# Binary file -> bytes of a record, whether a name follows, format of the count of the list that
# follows ("": none of this kind), and bytes of each of its items (COLMAP's output formats).
RECORDS = {
    "cameras.bin": (24, False, "", 0),
    "images.bin": (64, True, "<Q", 24),
    "points3D.bin": (43, False, "<Q", 8),
    "frames.bin": (64, False, "<I", 16),
    "rigs.bin": (4, False, "", 0),
}

COMPARED = 20  # about the number of pictures whose points are compared with their poses


def _is_whole(path: Path) -> bool:
    """Whether a binary file is as long as its counts say. pycolmap does not end if it is not."""
    with reading(path):
        data = path.read_bytes()
    fixed, has_name, items, size = RECORDS[path.name]
    try:
        (count,), place = struct.unpack_from("<Q", data), 8
        for _ in range(count):
            start, place = place, place + fixed
            place = data.index(b"\0", place) + 1 if has_name else place
            if items:
                (number,) = struct.unpack_from(items, data, place)
                place += struct.calcsize(items) + size * number
            elif path.name == "cameras.bin":
                place += 8 * _parameters(*struct.unpack_from("<i", data, start + 4))
            else:  # the sensors of a rig, the first without a pose
                (sensors,) = struct.unpack_from("<I", data, place)
                place += 12 if sensors else 4
                for _ in range(1, sensors):
                    place += 65 if data[place + 8] else 9
            if place > len(data):
                return False
    except (struct.error, ValueError, OverflowError, LookupError):
        return False
    return True


def is_whole_model(folder: Path) -> bool:
    """Whether a folder holds all binary files of a model, none of which is cut off."""
    return all((folder / name).is_file() and _is_whole(folder / name) for name in RECORDS)


@cache
def _parameters(model: int) -> int:
    """Number of parameters of a camera model. Raises KeyError if there is no such model."""
    from pycolmap import CameraModelId

    names = {int(each): name for name, each in CameraModelId.__members__.items() if int(each) >= 0}
    return len(parameter_names(names[model]))


def models_in(source: Path) -> list[Path]:
    """Folders of COLMAP models: those of sparse/0, sparse/1 and so on; else sparse, or the folder
    itself."""
    parts = sorted(source.glob("sparse/*/"), key=natural)
    folders = [folder for folder in parts if _is_model(folder)]
    return folders or [folder for folder in (source / "sparse", source) if _is_model(folder)][:1]


def _is_model(folder: Path) -> bool:
    return any(not _missing(folder, kind) for kind in ("bin", "txt"))


def _missing(folder: Path, kind: str) -> list[str]:
    """Names of the files of a model that a folder lacks."""
    names = (f"{name}.{kind}" for name in ("cameras", "images", "points3D"))
    return [name for name in names if not (folder / name).is_file()]


def check_no_part(source: Path) -> None:
    """Raise InputError where a folder in which `models_in` finds none holds part of a model. Texts
    of these names count in `sparse`."""
    places = [*source.glob("sparse/*/"), source / "sparse", source]
    for folder, kind in ((place, kind) for place in places for kind in ("bin", "txt")):
        missing = _missing(folder, kind)
        if len(missing) < 3 and (kind == "bin" or folder != source):
            why = f"a COLMAP model without {' and '.join(missing)}"
            raise InputError(f"{folder}: {why}; restore it, or move it away to place photographs")


def read_colmap(source: Path, models: list[Path], images: Path) -> Source:
    """The largest of the models in a folder: images sorted by name, and points. images: folder of
    the images. Raises InputError if the model is damaged, its text has lost lines, or a lens is not
    supported."""
    sizes = {model: image_count(model) for model in models}
    model = max(models, key=lambda one: sizes[one])
    notes = []
    if len(models) > 1:
        others = ", ".join(f"{one.name}: {sizes[one]}" for one in models if one != model)
        notes.append(
            f"took the largest model, {model.name}, of {sizes[model]} images; {source.name} has "
            f"others ({others}), each in a world of its own"
        )
    reconstruction, names = _opened(model)
    files = {}
    for number, name in names.items():
        spellings = name, PureWindowsPath(name).as_posix()
        found = (find_image(images, one, [""]) for one in spellings)
        files[number] = name, next(filter(None, found), images / name)
    result = source_of(reconstruction, files, f"{model}: image")
    placed = {shot.image for shot in result.shots}
    kinds = {(path.parent, path.suffix) for path in placed if path.suffix and path.is_file()}
    beside = {path for folder, suffix in kinds for path in folder.glob(f"*{suffix}")} - placed
    masks = {mask for one in placed | beside for mask in (one.name, f"{one.stem}_mask")}
    left_out = Counter({"that the model does not place": sum(p.stem not in masks for p in beside)})
    return replace(result, notes=tuple(notes), left_out=left_out)


def source_of(
    reconstruction: Any, files: Mapping[int, tuple[str, Path]], where: str, kind: str = "COLMAP"
) -> Source:
    """Images, sorted by name, and points of a reconstruction of pycolmap. files: name and path of
    each image by its number. where: start of messages about an image. Raises InputError if a lens
    is not supported."""
    shots = []
    placed = [image for image in reconstruction.images.values() if image.has_pose]
    ordered = sorted(placed, key=lambda image: files[image.image_id])
    for index, image in enumerate(ordered):
        name, path = files[image.image_id]
        camera, lens = _camera(f"{where} {name!r}", image)
        shots.append(Shot(frame_name(name), camera, lens, FRAME_INTERVAL * index, path))
    some = ordered[:: max(1, len(ordered) // COMPARED)]
    fit = observed([_observed(image, reconstruction) for image in some])
    return Source(kind, shots, sparse=cloud_of(reconstruction), fit=fit)


def _observed(image: Any, reconstruction: Any) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Camera of an image without distortion, and points [N,3] with the pixels [N,2] of which they
    were triangulated."""
    marks = image.get_observation_points2D()
    points = [reconstruction.points3D[mark.point3D_id].xyz for mark in marks]
    rays = image.camera.cam_from_img(np.reshape([mark.xy for mark in marks], (-1, 2)))
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().matrix()
    K = np.diag([image.camera.mean_focal_length()] * 2 + [1.0])
    size = image.camera.width, image.camera.height
    return Camera(K, *size, pose), np.reshape(points, (-1, 3)), K[0, 0] * np.reshape(rays, (-1, 2))


def image_count(model: Path) -> int:
    """Number of images that a model places."""
    path = model / "images.bin"
    if not path.is_file():
        return len(_names_in_text(model / "images.txt"))
    with reading(path), path.open("rb") as file:
        return int.from_bytes(file.read(8), "little")


def _opened(model: Path) -> tuple[Any, dict[int, str]]:
    """The reconstruction of pycolmap, and the names of its images by their numbers."""
    import PIL.Image  # noqa: F401  # after pycolmap, writing a PNG would crash in its zlib
    import pycolmap

    for file in RECORDS:
        if (model / file).is_file() and not _is_whole(model / file):
            raise InputError(f"{model / file}: is damaged or cut off; export the model again")
    with parsing(model, "COLMAP model", "export it again"), TemporaryDirectory() as scratch:
        texts = [path for path in model.glob("*.txt") if path.is_file()]
        has_mark = any(_has_mark(path) for path in texts)  # pycolmap takes the mark for a word
        for path in texts if has_mark else ():
            text = path.read_bytes().removeprefix(codecs.BOM_UTF8)
            Path(scratch, path.name).write_bytes(text)
        reconstruction = pycolmap.Reconstruction(scratch if has_mark else model)
        names = {number: image.name for number, image in reconstruction.images.items()}
    if (model / "images.bin").is_file():
        return reconstruction, names
    every_name = _names_in_text(model / "images.txt")  # pycolmap ends names at a space
    if set(every_name) != set(names):
        raise InputError(
            f"{model / 'images.txt'}: lists {len(every_name)} images, of which {len(names)} can be "
            "read; the file is cut off or damaged, export it again"
        )
    return reconstruction, every_name


def _has_mark(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8


def _names_in_text(path: Path) -> dict[int, str]:
    """Names of the images in an images.txt by their numbers. Each has two lines, the second for its
    points. Raises InputError where these lines are missing."""
    with reading(path):
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    names, points = dict[int, str](), False
    for line in lines:
        words = line.split(maxsplit=9)
        if points and (len(line.split()) % 3 or not all(map(_is_number, line.split()[-3:]))):
            what = f"{path}: has no line of points after that of image {list(names.values())[-1]!r}"
            raise InputError(f"{what}; each image has two lines, and the second may be empty")
        if points or not words or words[0].startswith("#"):
            points = False
            continue
        if len(words) < 10 or not words[0].isdecimal():
            raise InputError(f"{path}: {line[:60]!r} is no line of an image; export it again")
        names[int(words[0])] = words[9].rstrip()
        points = True
    return names


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _camera(where: str, image: Any) -> tuple[Camera, Lens | None]:
    lens = image.camera
    pose, world = np.eye(4), image.cam_from_world()
    if not np.linalg.norm(world.rotation.quat) > 0.5:  # pycolmap normalises all but 0
        raise InputError(f"{where}: its quaternion is 0; export it again")
    pose[:3] = world.matrix()
    names = [name.strip() for name in lens.params_info.split(",")]
    values = dict(zip(names, lens.params, strict=True))
    intrinsic = ("f", "fx", "fy", "cx", "cy")
    rest = {name: value for name, value in values.items() if name not in intrinsic}
    K = np.eye(3) if "w" in names else lens.calibration_matrix()
    distortion = Lens.of(where, lens.model_name, K, rest)
    try:
        return Camera(K, lens.width, lens.height, pose), distortion
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
