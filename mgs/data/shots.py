"""Frames to import, as the readers of all formats return them. For recordings: poses measured over
time, and the choice of keyframes."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PureWindowsPath

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from mgs.camera import Camera
from mgs.data.agreement import Agreement, DepthScale
from mgs.data.clouds import SparseCloud
from mgs.data.lens import Lens, fitted
from mgs.data.world import PLUS_Z, Vector, degrees_between, up_of_cameras
from mgs.errors import InputError
from mgs.images import exif_orientation, image_size

LEVELLED = 10.0  # angle from +Z, degrees, up to which an estimated up counts as +Z
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
# Of a name without a suffix, as in NeRF-synthetic data: PNG first, which has alpha and is a mask.
SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".tif", ".tiff", ".webp")
PHOTOGRAPH = ("", ".jpg", ".jpeg", ".JPG", ".JPEG", *SUFFIXES)  # a cut-out as PNG may lie beside it
SCALES = 1e-9, 1e9  # least and most metres per unit of length
FAR = 1000.0  # distance from the origin over the cameras' extent, beyond which the origin is moved
HELD = {  # EXIF orientation -> axes of the camera of the turned picture, in those of the stored one
    3: [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    6: [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    8: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}


@dataclass(frozen=True)
class Shot:
    """One frame to import, with its camera before undistortion, and its files."""

    name: str
    camera: Camera
    lens: Lens | None  # None for a pinhole
    timestamp: float  # seconds
    image: Path
    depth: Path | None = None
    depth_unit: float = 1.0  # metres per step of a depth image of whole numbers
    mask: Path | None = None
    rock: Path | None = None
    float_unit: float = 1.0  # metres in one of floating-point numbers
    turned: bool = False  # its files are turned by their EXIF orientation
    mended: bool = False  # its rotation was NEARLY_RIGID
    depth_factor: float = 1.0  # by which its depth is multiplied, to fit its camera
    confidence: Path | None = None  # image, 0 where depth is none
    rim: int = 0  # pixels cut off on each side

    @property
    def files(self) -> list[Path]:
        """Files that an import of it reads."""
        paths = self.image, self.depth, self.mask, self.rock, self.confidence
        return [path for path in paths if path]


@dataclass(frozen=True)
class Source:
    """Data to import."""

    kind: str
    shots: list[Shot]
    left_out: Counter[str] = field(default_factory=Counter)  # listed images not imported, by reason
    notes: tuple[str, ...] = ()  # lines for the user
    sparse: SparseCloud | None = None  # triangulated points
    up: Vector | None = None  # None: the source does not say
    unit: str | None = None  # "m" or "unit", None as for up
    no_cloud: Path | None = None  # file of points that is named and does not exist
    tests: frozenset[str] = frozenset()  # names of the shots that the source sets apart
    fit: Agreement | None = None  # of poses and points
    origin: Vector = (0.0, 0.0, 0.0)  # what was subtracted from all positions
    place: str = ""  # latitude, longitude and altitude of 0, if known; +Y is north
    depth_scale: DepthScale | None = None  # of photographs without poses, by depth beside them

    def in_metres(self, unit: float) -> Source:
        """Scale cameras and points by `unit` metres. Raises InputError unless it is in SCALES."""
        if not SCALES[0] <= unit <= SCALES[1]:
            form = "a number of metres, {:g} to {:g}; correct it".format(*SCALES)
            raise InputError(f"import: unit {unit} must be {form}")
        shots = [replace(shot, camera=shot.camera.scaled(unit)) for shot in self.shots]
        sparse, (x, y, z) = self.sparse and self.sparse.scaled(unit), self.origin
        origin = x * unit, y * unit, z * unit
        depth = self.depth_scale and replace(
            self.depth_scale, metres=self.depth_scale.metres / unit
        )
        scaled = replace(self, shots=shots, sparse=sparse, unit="m", depth_scale=depth)
        return replace(scaled, origin=origin, place="")

    def with_distance(self, text: str) -> Source:
        """Scale to metres by a known distance between two cameras: A,B,METRES, with the names of
        their images. Raises InputError for another text, unknown names, cameras in one place, and
        a distance that is none of theirs in SCALES."""
        words = [word.strip() for word in text.split(",")]
        eyes = {shot.name: shot.camera.position for shot in self.shots}
        names = [self._name(word) for word in words[:2]]
        try:
            metres = float(words[2])
        except (IndexError, ValueError):
            metres = np.nan
        if len(words) != 3 or not 0 < metres < np.inf:
            raise InputError(f"import: distance {text!r}: expected A,B,METRES, as in a.jpg,b.jpg,2")
        if lacking := [name for name in names if name not in eyes]:
            raise InputError(f"import: distance {text!r}: no camera of {lacking[0]}; correct it")
        apart = float(np.linalg.norm(eyes[names[0]] - eyes[names[1]]))
        if apart == 0:
            raise InputError(f"import: distance {text!r}: its cameras are in one place; correct it")
        low, high = (apart * scale for scale in SCALES)
        if not low <= metres <= high:
            form = f"METRES from {low:.3g} to {high:.3g} between these cameras"
            raise InputError(f"import: distance {text!r}: expected {form}; correct it")
        return self.in_metres(metres / apart)

    def _name(self, image: str) -> str:
        """Name of the shot of an image, which is given by its name or its whole path."""
        paths = {str(shot.image): shot.name for shot in self.shots}
        return paths.get(image) or frame_name(image)

    def fitted(self) -> Source:
        """Source whose cameras are `mgs.data.lens.fitted` to their images."""
        shots, count = list[Shot](), 0
        for shot in self.shots:
            camera, lens = fitted(shot.camera, shot.lens, shot.image)
            count += camera is not shot.camera
            shots.append(replace(shot, camera=camera, lens=lens))
        note = f"cameras scaled to smaller images: {count}"
        return replace(self, shots=shots, notes=(*self.notes, note)) if count else self

    def near_origin(self) -> Source:
        """Move the origin to the cameras, in whole units, if they are FAR from it."""
        eyes = np.stack([shot.camera.position for shot in self.shots])
        centre = np.round(eyes.mean(0))
        extent = max(float(np.linalg.norm(eyes - eyes.mean(0), axis=1).max()), 1.0)
        if np.abs(centre).max() < FAR * extent:
            return self
        shots = [replace(shot, camera=shot.camera.seen_from(centre)) for shot in self.shots]
        x, y, z = centre.tolist()
        sparse = self.sparse and replace(self.sparse, points=self.sparse.points - centre)
        return replace(self, shots=shots, sparse=sparse, origin=(x, y, z), place="")

    def without(self, names: Sequence[str]) -> Source:
        """Source without the shots of these images. Raises InputError for an unknown name."""
        out = {self._name(name) for name in names}
        if unknown := out - {shot.name for shot in self.shots}:
            raise InputError(f"import: exclude {min(unknown)!r}: is no image of the source")
        shots = [shot for shot in self.shots if shot.name not in out]
        if not shots:
            raise InputError("import: exclude leaves no image; leave out fewer")
        counted = self.left_out + Counter({"excluded": len(out)})
        return replace(self, shots=shots, left_out=counted)

    def with_tests(self, other: Source) -> Source:
        """Source with the shots of another of the same world, which become its test views."""
        return replace(
            self,
            shots=[*self.shots, *other.shots],
            left_out=self.left_out + other.left_out,
            notes=(*self.notes, *other.notes),
            tests=frozenset(shot.name for shot in other.shots),
        )

    def set_apart(self, every: int | None) -> tuple[Source, Source | None]:
        """Split into (training, test): the shots that the source sets apart, or every Nth by name,
        from the first. Raises InputError if no training shot is left."""
        names = set(self.tests)
        if every is not None:
            names = set(sorted(shot.name for shot in self.shots)[::every])
        apart = [shot for shot in self.shots if shot.name in names]
        others = [shot for shot in self.shots if shot.name not in names]
        if not others:
            why = f"{len(apart)} test views of {len(self.shots)} images leave none to choose from"
            raise InputError(f"import: {why}; correct test_every, or test_filenames")
        if not apart:
            return self, None
        return replace(self, shots=others), replace(self, shots=apart, sparse=None)

    def up_or_estimate(self) -> tuple[Vector, str]:
        """Up vector and the reason for it: given by the source, by the format, or estimated by
        `up_of_cameras`, whose InputError it raises."""
        if self.up is not None:
            return self.up, "as GPS says" if self.place else "as the source says"
        if self.kind == "NeRF-synthetic":
            return PLUS_Z, "the rule of NeRF-synthetic data"
        estimate = up_of_cameras([_as_held(shot) for shot in self.shots])
        levelled = ("nerfstudio", "ROS bag", "TUM RGB-D", "RTAB-Map")
        if self.kind in levelled and degrees_between(estimate, PLUS_Z) < LEVELLED:
            return PLUS_Z, f"as the cameras were held, to within {LEVELLED:.0f} degrees"
        return estimate, "as the cameras were held"


def _as_held(shot: Shot) -> Camera:
    """Camera of a shot in the axes of its picture as EXIF turns it, also where the file is taken as
    it is stored."""
    turn = HELD.get(1 if shot.turned else exif_orientation(shot.image))
    if turn is None:
        return shot.camera
    pose = np.eye(4)
    pose[:3, :3] = turn
    return replace(shot.camera, world_to_camera=pose @ shot.camera.world_to_camera)


def frame_name(path: str) -> str:
    """Flat name of an image path, which is no path: images/left/0001.png -> left_0001. An absolute
    one only loses its suffix: what it has in common with others is for `checked` to remove."""
    text = path.replace("\\", "/")
    parts = list(Path(text.lstrip("/")).parts)
    if parts and Path(parts[-1]).suffix.lower() in PICTURE_SUFFIXES:
        parts[-1] = Path(parts[-1]).stem
    absolute = text.startswith("/") or PureWindowsPath(path).drive
    return "/".join(parts) if absolute else _flat(parts)


def _flat(parts: Sequence[str]) -> str:
    return "_".join(part for part in parts if part not in (".", "..", "images"))


def find_image(folder: Path, name: str, suffixes: Sequence[str] = SUFFIXES) -> Path | None:
    """The file of this name in a folder, with the first suffix that exists, or None. A suffix of
    the name may be in capitals or not, which other systems do not tell apart."""
    paths = [folder / f"{name}{suffix}" for suffix in suffixes]
    if suffix := Path(name).suffix:
        paths.append((folder / name).with_suffix(suffix.swapcase()))
    return next((path for path in paths if path.is_file()), None)


def none_exists(path: Path, count: int, example: str = "") -> InputError:
    """The error where none of the images that a file lists exists."""
    why = f"none of the {count} images it lists exists" + (f", as {example}" if example else "")
    return InputError(f"{path}: {why}; restore them, or give their folder as `images`")


def checked(path: Path, source: Source) -> Source:
    """Source without the shots whose image does not exist. Frames of absolute paths are named by
    what these do not have in common. Raises InputError if no shot is left, if a name is listed
    twice, or cannot be that of a file."""
    there = [shot for shot in source.shots if shot.image.is_file()]
    left_out = source.left_out + Counter({"whose file is missing": len(source.shots) - len(there)})
    if not there:
        count = source.left_out.total() + len(source.shots)
        raise none_exists(path, count, *(str(shot.image) for shot in source.shots[:1]))
    absolute = {shot.name: Path(shot.name) for shot in there if "/" in shot.name}
    above = [path.parent.parent for path in absolute.values()]
    common = len(Path(os.path.commonpath(above)).parts) if above else 0
    names = {name: _flat(path.parts[common:]) for name, path in absolute.items()}
    there = [replace(shot, name=names.get(shot.name, shot.name)) for shot in there]
    tests = frozenset(names.get(name, name) for name in source.tests)
    for name, count in Counter(shot.name for shot in there).items():
        if count > 1:
            cure = "remove duplicate frames, or rename images that differ in the ending alone"
            raise InputError(f"{path}: lists {name} more than once; {cure}")
        if not name or name != Path(name).name or not name.isprintable():
            raise InputError(f"{path}: {name!r} cannot be the name of a file; rename the image")
    return replace(source, shots=there, left_out=+left_out, tests=tests)


def turned_by_exif(source: Source) -> Source:
    """Source whose pictures are turned by their EXIF orientation if its cameras are for such ones.
    Some programs ignore the orientation and others apply it. Pictures of unequal sides that lie on
    their side show which by the size of their cameras. Where none does, the pictures are taken as
    they are stored, and a note says so."""
    if any(shot.turned for shot in source.shots):
        return source
    tags = [exif_orientation(shot.image) for shot in source.shots]
    fits = set()
    for shot, tag in zip(source.shots, tags, strict=True):
        if tag >= 5 and (size := image_size(shot.image))[0] != size[1]:
            fits.add((shot.camera.width, shot.camera.height) == size[::-1])
    if fits == {True}:
        return replace(source, shots=[replace(shot, turned=True) for shot in source.shots])
    if not fits and (count := sum(tag > 1 for tag in tags)):
        note = (
            f"pictures that EXIF turns are taken as stored: {count}; their sizes do not show "
            "whether the poses are of turned ones"
        )
        return replace(source, notes=(*source.notes, note))
    return source


def natural(path: Path) -> list[tuple[int, int, str]]:
    """Key to sort paths by, with the numbers in their names as numbers: 2 before 10."""
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]


LONG = 3.0  # time between two samples over the median, beyond which poses are not interpolated
STILL = 0.01  # change of a pose, metres and radians, below which it is interpolated over any time
NEARLY_RIGID = 1e-2  # largest error of an entry of a rotation that was rounded, which is mended
# Note about poses that are NEARLY_RIGID, before their number.
ROUNDED = "rotations that were rounded, and are made orthonormal"
WITHOUT_POSE = "without a pose at its time"  # reason to leave an image out


def posed(
    times: Collection[float], pose_at: Callable[[float], np.ndarray | None], left_out: Counter[str]
) -> list[tuple[float, np.ndarray]]:
    """(time, pose) of the times that have a pose; the others are counted in `left_out`."""
    samples = [(time, pose) for time in times if (pose := pose_at(time)) is not None]
    left_out[WITHOUT_POSE] += len(times) - len(samples)
    return samples


def orthonormal(pose: np.ndarray) -> tuple[np.ndarray, bool]:
    """Pose with the rotation nearest to its own, if that is NEARLY_RIGID, and whether it changed by
    more than the rounding of float32."""
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        return pose, False
    left, _, right = np.linalg.svd(pose[:3, :3])
    error = np.abs(left @ right - pose[:3, :3]).max()
    if not 1e-5 < error < NEARLY_RIGID:
        return pose, False
    mended = pose.copy()
    mended[:3, :3] = left @ right
    return mended, True


def rigid(translation: Sequence[float], quaternion: Sequence[float]) -> np.ndarray:
    """Matrix [4,4] of a translation and a quaternion (x, y, z, w). Raises ValueError where its
    length is far from 1."""
    if not 1e-3 < float(np.linalg.norm(quaternion)) < 1e3:
        raise ValueError("the length of a quaternion is not 1")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = translation
    return pose


@dataclass(frozen=True)
class Track:
    """Rigid transforms [T,4,4] measured at times [T], seconds, in rising order."""

    times: np.ndarray
    transforms: np.ndarray

    @classmethod
    def of(cls, samples: Sequence[tuple[float, np.ndarray]]) -> Track:
        """Track of (time, transform); of samples of the same time the last counts."""
        by_time = dict(samples)
        times = sorted(by_time)
        return cls(np.array(times), np.stack([by_time[time] for time in times]))

    @cached_property
    def gaps(self) -> np.ndarray:
        """Whether the poses between two samples are unknown [T-1]: the time between them is LONG
        times the median, and the pose changed."""
        steps = np.diff(self.times)
        shift = np.linalg.norm(np.diff(self.transforms[:, :3, 3], axis=0), axis=1)
        turns = Rotation.from_matrix(self.transforms[:, :3, :3])
        turn = (turns[:-1].inv() * turns[1:]).magnitude()
        still = (shift < STILL) & (turn < STILL)
        return np.asarray((steps > LONG * np.median(steps)) & ~still)

    @cached_property
    def _turns(self) -> Slerp:
        return Slerp(self.times, Rotation.from_matrix(self.transforms[:, :3, :3]))

    def at(self, time: float) -> np.ndarray | None:
        """Interpolated transform [4,4]; None before the first and after the last sample, and in
        `gaps`. A single sample holds at all times."""
        if len(self.times) == 1:
            return self.transforms[0]
        if not self.times[0] <= time <= self.times[-1]:
            return None
        before = min(int(np.searchsorted(self.times, time, "right")) - 1, len(self.times) - 2)
        if self.gaps[before] and time not in self.times[before : before + 2]:
            return None
        pose = np.eye(4)
        pose[:3, :3] = self._turns(time).as_matrix()
        pose[:3, 3] = [
            np.interp(time, self.times, self.transforms[:, axis, 3]) for axis in range(3)
        ]
        return pose


@dataclass(frozen=True)
class Spacing:
    """Least distance between keyframes, in seconds or metres."""

    least: float
    metres: bool = False

    @classmethod
    def parse(cls, text: str) -> Spacing:
        """Spacing of a text as 0.5s or 0.2m. Raises InputError for anything else."""
        match = re.fullmatch(r"(\d+\.?\d*|\.\d+)(s|m)", text.strip())
        if not match:
            raise InputError(f"keyframes {text!r}: expected seconds or metres, as 0.5s or 0.2m")
        return cls(float(match[1]), match[2] == "m")

    def choose(self, shots: Sequence[tuple[float, np.ndarray]]) -> list[int]:
        """Indices of the keyframes among (time, camera-to-world) in order of time: the first, and
        each that is far enough from the keyframe before."""
        indices: list[int] = []
        for k, (time, pose) in enumerate(shots):
            if indices:
                last_time, last = shots[indices[-1]]
                distance = float(np.linalg.norm(pose[:3, 3] - last[:3, 3]))
                if (distance if self.metres else time - last_time) < self.least - 1e-6:
                    continue
            indices.append(k)
        return indices
