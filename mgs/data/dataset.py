"""A dataset folder in nerfstudio style: transforms.json, images/, depth/, masks/, rock/."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera, opencv_from_opengl, opengl_from_opencv
from mgs.data.rock_image import boundary, read_rock_image
from mgs.data.up import PLUS_Z, Up, unit_up
from mgs.errors import InputError
from mgs.files import check_new_folder, check_writable, locked, read_json, write_json
from mgs.images import read_exr, read_mask, read_png

PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
"""Camera models of transforms.json that are a pinhole where their distortion is zero."""

INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")

DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "is_fisheye")

FRAME_INTERVAL = 0.5
"""Seconds between keyframes (paper, section IV-A)."""

TEST_FOLDER = "test"
"""Folder of a dataset that holds its test views, a dataset of its own."""

SURVEY_FOLDER = "survey"
"""Folder of an on-demand dataset that holds its survey, a dataset of its own: depth and masks from
every pose, and no image."""

FILES = {
    "image_path": "file_path",
    "depth_path": "depth_file_path",
    "mask_path": "mask_path",
    "rock_path": "rock_file_path",
}
"""The keys of transforms.json under which the paths of a `Frame` are written."""


@dataclass(frozen=True)
class Frame:
    """One keyframe: its camera, its time in seconds, and the files of its images.

    on_demand: the files exist only once a run has taken the frame. Before that, reading one of them
    raises InputError.
    """

    name: str
    camera: Camera
    timestamp: float
    image_path: Path
    depth_path: Path | None = None
    mask_path: Path | None = None
    rock_path: Path | None = None
    on_demand: bool = False

    def rgb(self) -> np.ndarray:
        """Linear RGB float32 [H,W,3]. Raises InputError where it is missing, damaged or of another
        size."""
        return self._sized(self.image_path, read_png(self._there(self.image_path)))

    def depth(self) -> np.ndarray:
        """z-depth float32 [H,W], metres, 0 = no return. Raises InputError as `rgb`, or where the
        frame has none."""
        if self.depth_path is None:
            raise InputError(
                f"frame {self.name}: has no depth_file_path; this command needs RGB-D frames"
            )
        channels = read_exr(self._there(self.depth_path))
        depth = channels.get("Z", next(iter(channels.values())))
        return np.nan_to_num(self._sized(self.depth_path, depth), nan=0.0, posinf=0.0, neginf=0.0)

    def mask(self) -> np.ndarray:
        """Which pixels count as rock, bool [H,W].

        In the images of `mgs synth-orbit` these are the pixels whose centre shows the rock. Without
        a mask file, they are the pixels with an alpha of at least 0.5 in the rock's image; without
        that too, all of them. Raises InputError as `rgb`.
        """
        if self.mask_path is not None:
            return self._sized(self.mask_path, read_mask(self._there(self.mask_path)))
        if self.rock_path is not None:
            return self.target()[0][..., 3] >= 0.5
        return np.ones((self.camera.height, self.camera.width), bool)

    def target(self) -> tuple[np.ndarray, np.ndarray]:
        """What a model of the rock alone is fitted to and compared with: (rgba, weight).

        rgba: float32 [H,W,4], linear RGB premultiplied by alpha, and alpha, the share of the pixel
        that the rock covers.
        weight: float32 [H,W], 1 for the pixels whose rgba is known and 0 for the others.

        A frame with an image of the rock has a weight of 1 everywhere. A frame with a mask alone
        says of each pixel that it is
        rock or that it is not: alpha is 1 or 0 and colour outside the mask is 0. That is wrong in
        the pixels that the outline of the rock crosses, so the `mgs.data.rock_image.boundary` of
        the mask has a weight of 0. A frame without either shows
        nothing but rock: alpha and weight are 1 everywhere. Raises InputError as `rgb`.
        """
        if self.rock_path is not None:
            rgba = self._sized(self.rock_path, read_rock_image(self._there(self.rock_path)))
            return rgba, np.ones(rgba.shape[:2], np.float32)
        mask = self.mask()
        rgba = np.dstack([self.rgb(), np.ones(mask.shape, np.float32)]) * mask[..., None]
        return rgba, (~boundary(mask)).astype(np.float32)

    def masked_rgb(self) -> np.ndarray:
        """The colour of `target`: linear RGB float32 [H,W,3] of the rock alone in front of
        black."""
        return self.target()[0][..., :3]

    def _there(self, path: Path) -> Path:
        """The path of a file of this frame. Raises InputError where it does not exist because
        nobody has taken the frame."""
        if self.on_demand and not path.exists():
            raise InputError(
                f"{path}: does not exist, since no run has taken frame {self.name} of this on-demand dataset; `mgs nbv` takes "
                f"what it chooses, and what `mgs prior` reads is in the dataset's folder {SURVEY_FOLDER}"
            )
        return path

    def _sized(self, path: Path, pixels: np.ndarray) -> np.ndarray:
        expected = (self.camera.height, self.camera.width)
        if pixels.shape[:2] != expected:
            found = f"{pixels.shape[1]}x{pixels.shape[0]}"
            raise InputError(
                f"{path}: is {found}, but transforms.json says {expected[1]}x{expected[0]}; correct either"
            )
        return pixels


@dataclass(frozen=True)
class Dataset:
    """A folder of keyframes in order of time.

    up: unit vector that points upwards in the world. unit: what a length of 1 is called, "m", or
    "unit" where nobody knows.
    """

    root: Path
    frames: tuple[Frame, ...]
    up: Up = PLUS_Z
    unit: str = "m"

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def on_demand(self) -> bool:
        """Whether images of some frames exist only once a run has taken them."""
        return any(frame.on_demand for frame in self.frames)

    def with_images(self, taken: Collection[str]) -> tuple[Frame, ...]:
        """The frames that have images where those of the names `taken` were taken: all, but of
        those on demand only these."""
        return tuple(frame for frame in self.frames if not frame.on_demand or frame.name in taken)

    def test_views(self) -> Dataset | None:
        """The dataset in the folder `test` of this one: views to judge a model by, which no model
        is trained on.

        None where there is none. Raises InputError as `load_dataset`.
        """
        folder = self.root / TEST_FOLDER
        return load_dataset(folder) if (folder / "transforms.json").is_file() else None

    def survey(self) -> Dataset:
        """What a prior is built of: the dataset in the folder `survey` of an on-demand dataset,
        otherwise this one itself.

        Raises InputError where an on-demand dataset has no survey, and as `load_dataset`.
        """
        if not self.on_demand:
            return self
        folder = self.root / SURVEY_FOLDER
        if not folder.is_dir():
            raise InputError(
                f"{self.root}: has neither images nor a survey to build a prior of; give one with --prior"
            )
        return load_dataset(folder)


def load_dataset(root: str | Path) -> Dataset:
    """Read transforms.json and check that every file it names exists, unless it says `"on_demand":
    true`. Images are read later, by the methods of `Frame`.

    Raises InputError where the folder or a file is missing, intrinsics are missing, images are
    distorted, a pose is not finite or singular, there are no frames, or two frames have the same
    name.
    """
    root = Path(root)
    path = root / "transforms.json"
    if not root.is_dir():
        raise InputError(f"{root}: no such dataset folder; make one with `mgs synth-orbit {root}`")
    data, records = read_records(path)
    frames = [_frame(root, path, data, i, record) for i, record in enumerate(records)]
    for name, count in Counter(frame.name for frame in frames).items():
        if count > 1:  # runs and pictures refer to a frame by its name
            raise InputError(
                f"{path}: lists {count} frames named {name}; remove or rename all but one"
            )
    ordered = tuple(sorted(frames, key=lambda frame: (frame.timestamp, frame.name)))
    return Dataset(
        root,
        ordered,
        unit_up(data["up"]) if data.get("up") else PLUS_Z,
        str(data.get("unit") or "m"),
    )


def load_cameras(path: str | Path) -> list[tuple[str, Camera]]:
    """The (file_path, camera) of every frame of a transforms.json, in the file's order. path: the
    file, or its folder.

    The files that the frames name need not exist. For all else, InputError is raised as by
    `load_dataset`.
    """
    path = Path(path) / "transforms.json" if Path(path).is_dir() else Path(path)
    data, records = read_records(path)
    return [
        (record["file_path"], _camera(path, data, i, record)) for i, record in enumerate(records)
    ]


def read_records(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The contents of a transforms.json, and its list of frames; each is sure to have a file_path
    and a transform_matrix.

    What the matrix holds is not checked. Raises InputError where the file is missing or damaged,
    lists no frames, or has a value that cannot be a path where a path must be.
    """
    data = read_json(path)
    records = data.get("frames") if isinstance(data, dict) else None
    if not records or not isinstance(records, list):
        raise InputError(f"{path}: lists no frames; expected a nerfstudio transforms.json")
    for index, record in enumerate(records):
        if (
            not isinstance(record, dict)
            or not record.get("file_path")
            or "transform_matrix" not in record
        ):
            raise InputError(f"{path}: frame {index} lacks file_path or transform_matrix; add it")
        for key in FILES.values():
            value = record.get(key) or ""
            if not isinstance(value, str) or not value.isprintable():
                raise InputError(
                    f"{path}: frame {index} has a {key} that is no text or cannot be a path; correct it"
                )
    return data, records


def _camera(path: Path, data: dict[str, Any], index: int, record: dict[str, Any]) -> Camera:
    where = f"{path}: frame {index}"
    both = data | record
    if (both.get("camera_model") or "OPENCV") not in PINHOLES or any(
        both.get(key) not in (None, 0) for key in DISTORTION
    ):
        raise InputError(
            f"{where} is distorted, or not of a pinhole camera; undistort the images with `mgs import`"
        )
    missing = [key for key in INTRINSICS if both.get(key) is None]
    if missing:
        raise InputError(
            f"{where} lacks {missing[0]}; correct the intrinsics (`mgs import` reads files with camera_angle_x)"
        )
    try:
        fl_x, fl_y, cx, cy, w, h = (both[key] for key in INTRINSICS)
        K = np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]], np.float64)
        width, height = int(w or 0), int(h or 0)
        pose = np.array(record["transform_matrix"], np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"{where} has no usable intrinsics or pose; fl_x fl_y cx cy w h and a 4x4 matrix are needed"
        ) from None
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise InputError(
            f"{where} has a transform_matrix that is not a finite 4x4 matrix; correct the pose"
        )
    try:
        return Camera(K, width, height, opencv_from_opengl(pose))
    except np.linalg.LinAlgError:
        raise InputError(f"{where} has a singular transform_matrix; correct the pose") from None
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _frame(
    root: Path, path: Path, data: dict[str, Any], index: int, record: dict[str, Any]
) -> Frame:
    where = f"{path}: frame {index}"
    camera, on_demand = _camera(path, data, index, record), data.get("on_demand") is True
    try:
        timestamp = float(record.get("timestamp", FRAME_INTERVAL * index))
    except (TypeError, ValueError, OverflowError):
        timestamp = math.nan
    if not math.isfinite(timestamp):
        raise InputError(f"{where} has a timestamp that is no finite number; give seconds")

    def file(key: str) -> Path | None:
        if not record.get(key):
            return None
        target = root / record[key]
        if not on_demand and not target.is_file():
            raise InputError(
                f"{where}: {key} {record[key]} does not exist in {root}; restore it or remove the frame"
            )
        return target

    paths: dict[str, Any] = {field: file(key) for field, key in FILES.items()}
    return Frame(Path(record["file_path"]).stem, camera, timestamp, **paths, on_demand=on_demand)


def _intrinsics(camera: Camera) -> dict[str, float]:
    K = camera.K
    return {
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "w": camera.width,
        "h": camera.height,
    }


def write_transforms(
    root: str | Path, frames: list[Frame] | tuple[Frame, ...], up: Up = PLUS_Z, unit: str = "m"
) -> None:
    """Write transforms.json into the folder `root`; the paths in it are relative to that folder.
    up, unit: as `Dataset`.

    The intrinsics of the first frame are written once, for the whole file; a frame with other
    intrinsics has its own. Either
    all frames are on demand or none. Write this file after all others: a folder that has it counts
    as a finished dataset.
    """
    root = Path(root)
    header: dict[str, Any] = {"camera_model": "OPENCV", **_intrinsics(frames[0].camera)}
    world = (
        {"up": list(up), "unit": unit} if (up, unit) != (PLUS_Z, "m") else {}
    )  # what is left out is +Z and metres
    demand = {"on_demand": True} if frames[0].on_demand else {}
    records = []
    for frame in frames:
        paths = {key: getattr(frame, field) for field, key in FILES.items()}
        record: dict[str, Any] = {
            key: path.relative_to(root).as_posix()
            for key, path in paths.items()
            if path is not None
        }
        record["transform_matrix"] = opengl_from_opencv(frame.camera.world_to_camera).tolist()
        record["timestamp"] = frame.timestamp
        own = _intrinsics(frame.camera)
        record |= {key: value for key, value in own.items() if value != header[key]}
        records.append(record)
    write_json(root / "transforms.json", header | world | demand | {"frames": records})


def resumes(out: Path, record: str, asked: dict[str, Any]) -> bool:
    """Whether `out` holds an unfinished dataset that is to be continued; False where `out` is empty
    or does not exist.

    An unfinished dataset has no transforms.json yet, but the JSON file `record`, which must agree
    with `asked` in every key of it. Temporary files that a killed process left are removed. Raises
    InputError where `out` holds anything else, where another process works on it, or where it
    cannot be written.
    """
    check_writable(out)
    begun = out / record
    if begun.is_file() and not (out / "transforms.json").exists():
        told = read_json(begun)
        if not isinstance(told, dict) or any(
            told.get(key) != value for key, value in asked.items()
        ):
            raise InputError(
                f"{out}: holds an unfinished dataset of other settings or sources; choose a new folder or delete it"
            )
        with locked(out):
            for left in out.rglob(".*.part*"):
                left.unlink()
        return True
    for left in out.glob(
        f".{begun.stem}.*.part{begun.suffix}"
    ):  # of a process that was killed while it wrote the record
        left.unlink()
    check_new_folder(out)
    return False


def target_of(frame: Frame, with_alpha: bool = False) -> np.ndarray:
    """What a frame is fitted to: [H,W,4], the colour and the weight of `Frame.target`, or [H,W,5],
    alpha after them. Raises
    InputError where the mask is empty: a fit to black would hide the rock."""
    if not frame.mask().any():
        raise InputError(
            f"{frame.mask_path}: the rock mask of frame {frame.name} is empty; correct it, or remove the frame"
        )
    rgba, weight = frame.target()
    return np.dstack([rgba[..., :3], weight, *([rgba[..., 3]] if with_alpha else [])])
