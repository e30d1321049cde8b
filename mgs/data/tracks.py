"""Poses measured over time, and the choice of keyframes among the images of a recording."""

import re
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from mgs.errors import InputError

LONG = 3.0  # time between two samples over the median, beyond which poses are not interpolated
STILL = 0.01  # change of a pose, metres and radians, below which it is interpolated over any time
NEARLY_RIGID = 1e-2  # largest error of an entry of a rotation that was rounded, which is mended
# Note about poses that are NEARLY_RIGID, after their number.
ROUNDED = "rotations are not quite rotations, as they were rounded; they are made orthonormal"
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
    def of(cls, samples: Sequence[tuple[float, np.ndarray]]) -> "Track":
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
    def parse(cls, text: str) -> "Spacing":
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
