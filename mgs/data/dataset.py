"""A dataset folder in nerfstudio style: transforms.json, images/, depth/, masks/, rock/."""

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera, opencv_from_opengl, opengl_from_opencv
from mgs.data.frames import SURVEY_FOLDER, Frame, as_asked, as_captured
from mgs.data.world import PLUS_Z, UPRIGHT, Vector, World, unit_up
from mgs.errors import InputError
from mgs.files import THERE, check_new_folder, read_json, remove_leftovers, write_json
from mgs.memory import padded
from mgs.notebook import html, thumbnails

PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")  # those without distortion
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "is_fisheye")
FRAME_INTERVAL = 0.5  # seconds between keyframes (paper, section IV-A)
TEST_FOLDER = "test"  # subfolder with the test views, itself a dataset
FILES = {  # path fields of `Frame` -> their keys in transforms.json
    "image_path": "file_path",
    "depth_path": "depth_file_path",
    "mask_path": "mask_path",
    "rock_path": "rock_file_path",
}


@dataclass(frozen=True, repr=False)
class Dataset:
    """A folder of keyframes in order of time.

    Cameras are in a world with +Z up. world: that of the files, which may stand otherwise."""

    root: Path
    frames: tuple[Frame, ...]
    world: World = UPRIGHT

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        camera = self.frames[0].camera
        return f"Dataset({self.root}: {len(self)} frames, {camera.width}x{camera.height})"

    def _repr_html_(self) -> str:
        return html(repr(self), thumbnails([frame.image_path for frame in self.frames]))

    @property
    def unit(self) -> str:
        """Name of the unit of length: "m", or "unit" if it is unknown."""
        return self.world.unit

    @property
    def on_demand(self) -> bool:
        """Whether images of some frames exist only after a run has taken them."""
        return any(frame.on_demand for frame in self.frames)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of all frames as asked for: a live capture does not change them."""
        return [as_asked(frame).camera for frame in self.frames]

    def with_images(self, taken: Collection[str]) -> tuple[Frame, ...]:
        """All frames, except on-demand ones whose names are not in `taken`."""
        return tuple(frame for frame in self.frames if not frame.on_demand or frame.name in taken)

    def test_views(self) -> "Dataset | None":
        """Load the test views, on which no model is trained, or None. Raises InputError as
        `load_dataset`."""
        folder = self.root / TEST_FOLDER
        there = (folder / "transforms.json").is_file()
        return load_dataset(folder, up=self.world.up) if there else None

    def survey(self) -> "Dataset":
        """Dataset to build the prior from: the survey of an on-demand dataset, else this one.
        Raises InputError if an on-demand dataset has no survey, and as `load_dataset`."""
        if not self.on_demand:
            return self
        folder = self.root / SURVEY_FOLDER
        if not folder.is_dir():
            cure = "give one with `prior`"
            raise InputError(f"{self.root}: has neither images nor a survey for a prior; {cure}")
        return load_dataset(folder, up=self.world.up)


def load_dataset(
    root: str | Path, *, to_capture: bool = False, up: Vector | None = None
) -> Dataset:
    """Load the dataset in the folder `root`: the frames of its transforms.json (docs/data.md).

    Checks that image files exist, unless the dataset is on demand. Pixels are read later, by the
    methods of `Frame`. to_capture: frames without an image are on demand, too. up: vector that
    points upwards in the files, by default as transforms.json says, else +Z; cameras are turned so
    that it is +Z. Raises InputError if the folder or a file is missing, intrinsics are missing,
    images are distorted, a pose is not finite or singular, there are no frames, or two frames have
    the same name."""
    root = Path(root)
    path = root / "transforms.json"
    with suppress(PermissionError):  # of a folder that cannot be searched: `read_records` says why
        if not path.exists():
            fault = "holds no transforms.json" if root.is_dir() else "no such dataset folder"
            cure = "make a dataset with `mgs import` or `mgs synth-orbit`"
            raise InputError(f"{root}: {fault}; {cure}")
    data, records = read_records(path)
    upward = up or data.get("up") or PLUS_Z
    world = World(unit_up(upward), unit_of(path, data) or "m", _origin_of(path, data))
    frames = list[Frame]()
    for index, record in enumerate(records):
        where = f"{path}: frame {index}"
        camera = world.enter(_camera(where, data | record))
        on_demand = data.get("on_demand") is True
        on_demand |= to_capture and not (root / record["file_path"]).is_file()
        paths: dict[str, Any] = {}
        for field, key in FILES.items():
            paths[field] = root / record[key] if record.get(key) else None
            if paths[field] and not on_demand and not paths[field].is_file():
                cure = "restore it or remove the frame"
                raise InputError(f"{where}: {key} {record[key]} does not exist; {cure}")
        name, time = Path(record["file_path"]).stem, timestamp_of(where, index, record)
        frame = Frame(name, camera, time, **paths, on_demand=on_demand)
        frames.append(as_captured(frame, world))
    for name, count in Counter(frame.name for frame in frames).items():
        if count > 1:  # runs and pictures refer to a frame by its name
            cure = "remove or rename all but one"
            raise InputError(f"{path}: lists {count} frames named {name}; {cure}")
    ordered = tuple(sorted(frames, key=lambda frame: (frame.timestamp, frame.name)))
    return Dataset(root, ordered, world)


def load_cameras(path: str | Path, like: Camera | None = None) -> list[tuple[str, Camera]]:
    """Read (file_path, camera) of every frame of a transforms.json, in its order and world. path:
    the file, or its folder. like: a camera whose intrinsics are used if the file has none. Raises
    InputError as `load_dataset`, except that image files need not exist."""
    path = Path(path) / "transforms.json" if Path(path).is_dir() else Path(path)
    data, records = read_records(path)
    if like is not None and not any(key in data | records[0] for key in INTRINSICS):
        data = intrinsics(like) | data
    cameras = [_camera(f"{path}: frame {i}", data | one) for i, one in enumerate(records)]
    return [(one["file_path"], camera) for one, camera in zip(records, cameras, strict=True)]


def read_records(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Contents of a transforms.json, and its frames, each with file_path and transform_matrix.
    Matrices are not checked. Raises InputError if the file is missing or damaged, lists no frames,
    or has a path that is not printable text."""
    data = read_json(path)
    records = data.get("frames") if isinstance(data, dict) else None
    if not records or not isinstance(records, list):
        raise InputError(f"{path}: lists no frames; expected a nerfstudio transforms.json")
    for index, record in enumerate(records):
        whole = isinstance(record, dict) and "transform_matrix" in record
        if not whole or not record.get("file_path"):
            raise InputError(f"{path}: frame {index} lacks file_path or transform_matrix; add it")
        for key in FILES.values():
            value = record.get(key) or ""
            if not isinstance(value, str) or not value.isprintable():
                why = f"frame {index} has a {key} that is no text or cannot be a path"
                raise InputError(f"{path}: {why}; correct it")
    return data, records


def _camera(where: str, record: dict[str, Any]) -> Camera:
    distorted = any(record.get(key) not in (None, 0) for key in DISTORTION)
    if distorted or (record.get("camera_model") or "OPENCV") not in PINHOLES:
        cure = "undistort images with `mgs import`"
        raise InputError(f"{where} is distorted, or no pinhole camera; {cure}")
    if absent := [key for key in INTRINSICS if record.get(key) is None]:
        cure = "correct the intrinsics (`mgs import` reads files with camera_angle_x)"
        raise InputError(f"{where} lacks {absent[0]}; {cure}")
    try:
        fl_x, fl_y, cx, cy, w, h = (record[key] for key in INTRINSICS)
        K = np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]], np.float64)
        width, height = float(w or 0), float(h or 0)
        pose = np.array(record["transform_matrix"], np.float64)
    except (TypeError, ValueError, OverflowError):
        cure = "give fl_x fl_y cx cy w h, a 4x4 matrix"
        raise InputError(f"{where} has no usable intrinsics or pose; {cure}") from None
    return posed_camera(where, K, width, height, pose)


def posed_camera(
    where: str, K: np.ndarray, width: float, height: float, pose: np.ndarray
) -> Camera:
    """Camera of a transform_matrix: OpenGL camera-to-world [4,4]. Raises InputError, which begins
    with `where`, if the pose or the intrinsics are bad."""
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        cure = "correct the pose"
        raise InputError(f"{where} has a transform_matrix that is not a finite 4x4 matrix; {cure}")
    try:
        return Camera(K, width, height, opencv_from_opengl(pose))  # type: ignore[arg-type]
    except np.linalg.LinAlgError:
        raise InputError(f"{where} has a singular transform_matrix; correct the pose") from None
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def finite_number(where: str, what: str, value: Any) -> float:
    """A number as float. Raises InputError, which names `what`, for anything else, NaN, infinity,
    and numbers whose squares may overflow."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not abs(number) < 1e100:
        raise InputError(f"{where}: {what} is {value!r}, no finite number; correct it")
    return number


def timestamp_of(where: str, index: int, record: dict[str, Any]) -> float:
    """Time of a frame, seconds. Raises InputError unless it is finite."""
    return finite_number(where, "timestamp", record.get("timestamp", FRAME_INTERVAL * index))


def unit_of(path: Path, data: dict[str, Any]) -> str | None:
    """Name of the unit of length in a transforms.json, None if it has none. Raises InputError
    unless it is a short word."""
    unit = data.get("unit")
    if unit and not (isinstance(unit, str) and re.fullmatch(r"\w{1,16}", unit)):
        raise InputError(f"{path}: its unit is no word of at most 16 letters; correct it")
    return unit or None


def load_origin(path: str | Path) -> Vector:
    """`World.origin` of a transforms.json, or of the folder that holds it. Raises InputError as
    `load_cameras`."""
    path = Path(path) / "transforms.json" if Path(path).is_dir() else Path(path)
    return _origin_of(path, read_records(path)[0])


def _origin_of(path: Path, data: dict[str, Any]) -> Vector:
    origin = data.get("origin", [0.0, 0.0, 0.0])
    if not isinstance(origin, list) or len(origin) != 3:
        raise InputError(f"{path}: its origin is no list of three numbers; correct it")
    x, y, z = (finite_number(str(path), "origin", value) for value in origin)
    return x, y, z


def intrinsics(camera: Camera) -> dict[str, float]:
    K = camera.K
    values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height)
    return dict(zip(INTRINSICS, values, strict=True))


def write_transforms(
    root: str | Path,
    frames: Sequence[Frame],
    world: World = UPRIGHT,
    notes: Mapping[str, str | float] | None = None,
) -> None:
    """Write transforms.json into the folder `root`, with paths relative to it if they are below it.
    world: the one to write them in; the frames have +Z up. notes: more entries. Frames are either
    all on demand or none. Intrinsics equal to those of the first frame are written once. Write this
    file last: its presence marks a complete dataset."""
    root = Path(root)
    header: dict[str, Any] = {"camera_model": "OPENCV", **intrinsics(frames[0].camera)}
    place: dict[str, Any] = {}
    if (world.up, world.unit) != (PLUS_Z, "m"):
        place = {"up": list(world.up), "unit": world.unit}
    place |= {"origin": list(world.origin)} if any(world.origin) else {}
    demand = {"on_demand": True} if frames[0].on_demand else {}
    records = []
    for frame in frames:
        paths = {key: getattr(frame, field) for field, key in FILES.items()}
        record: dict[str, Any] = {
            key: (path.relative_to(root) if path.is_relative_to(root) else path).as_posix()
            for key, path in paths.items()
            if path
        }
        pose = world.leave(frame.camera).world_to_camera
        record["transform_matrix"] = opengl_from_opencv(pose).tolist()
        record["timestamp"] = frame.timestamp
        own = intrinsics(frame.camera)
        record |= {key: value for key, value in own.items() if value != header[key]}
        records.append(record)
    about = header | place | demand | dict(notes or {})
    write_json(root / "transforms.json", about | {"frames": records})


def resumes(out: Path, record: str, settings: dict[str, Any]) -> bool:
    """Whether `out`, whose lock is held, contains a dataset to continue; False if it is empty. Such
    a dataset has the JSON file `record`, which must agree with every item of `settings`. It is
    finished if it has a transforms.json. Temporary files of a killed process are removed. Raises
    InputError if `out` holds anything else."""
    begun = (out / record).is_file()
    remove_leftovers(out, below_it=begun)  # before the record, nothing is written below
    if not begun:
        check_new_folder(out)
        return False
    old = read_json(out / record)
    if not isinstance(old, dict) or any(old.get(key) != settings[key] for key in settings):
        state = "a finished" if (out / "transforms.json").is_file() else "an unfinished"
        raise InputError(f"{out}: {state} dataset of other settings or sources {THERE}")
    return True


def target_of(frame: Frame, with_alpha: bool = False) -> np.ndarray:
    """Target of a fit [H,W,4]: colour and weight of `Frame.target`; [H,W,5] with alpha appended. It
    is `padded`, so that a fit uses its memory in place of a copy. Raises InputError if the mask is
    empty, since a fit to black would remove the rock."""
    if not frame.mask().any():
        cure = f"correct it, or remove frame {frame.name}"
        raise InputError(f"{frame.mask_path}: its rock mask is empty; {cure}")
    rgba, weight = frame.target()
    image = np.dstack([rgba, rgba[..., 3]]) if with_alpha else rgba
    image[..., 3] = weight
    return padded(image)
