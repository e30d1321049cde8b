"""Worlds of files, and the upright one in which mgs works: what is read is turned so that +Z is up,
what leaves is turned back, and between the two nothing names an upward direction."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError

Thing = TypeVar("Thing", Camera, np.ndarray)

Vector = tuple[float, float, float]

PLUS_Z: Vector = (0.0, 0.0, 1.0)

# Below it cameras look one way, and the mean of their upward axes is taken.
LEVEL = 0.1  # least second singular value of right-hand axes over the root of their number
# Of pictures on their side: least residual of horizontal right-hand axes, largest one of horizontal
# upward axes over it, least second singular value of these, least mean right-hand axis along up.
TILTED, RATHER, AROUND, ALONG = 0.1, 0.5, 0.3, 0.5
# Of cameras that survey from above in lines there and back.
ONE_WAY, CANCELLED = 0.9, 0.5  # least mean viewing direction, largest mean upward axis, lengths


@dataclass(frozen=True)
class World:
    """World of the files of a dataset."""

    up: Vector = PLUS_Z  # unit vector that points upwards in it
    unit: str = "m"  # name of its unit of length, "m", or "unit" if unknown
    origin: Vector = (0.0, 0.0, 0.0)  # position of its origin in the data that was imported

    @cached_property
    def turn(self) -> np.ndarray:
        """Rotation [3,3] from this world to the upright one."""
        return levelled(self.up)

    def enter(self, thing: Thing) -> Thing:
        """Turn a camera, or points or directions [N,3], upright."""
        return self._turned(thing, self.turn)

    def leave(self, thing: Thing) -> Thing:
        """Turn a camera, or points or directions [N,3], back into this world."""
        return self._turned(thing, self.turn.T)

    def whole(self, camera: Camera) -> Camera:
        """Upright camera counted from the origin of the imported data, to be written in `home`."""
        return camera.seen_from(self.enter(np.negative(self.origin)))

    @property
    def home(self) -> "World":
        """This world without an origin that was moved."""
        return World(self.up, self.unit)

    def _turned(self, thing: Thing, turn: np.ndarray) -> Thing:
        if self.up == PLUS_Z:
            return thing
        return thing.turned(turn) if isinstance(thing, Camera) else thing @ turn.T


UPRIGHT = World()  # a world with +Z up, in metres: nothing is turned


def up_of_cameras(cameras: Sequence[Camera]) -> Vector:
    """Common up vector of cameras: the direction most nearly orthogonal to all right-hand axes.

    A level camera has a horizontal right-hand axis, however steeply it looks down. The result is
    the last right singular vector of the stacked axes, on the side of the cameras' upward axes.
    Cameras that look one way, but are held every way round, look down. Pictures that lie on their
    side, as of a phone without EXIF, have horizontal upward axes instead, and look down as most do.
    Raises InputError if the upward axes of others cancel."""
    forward = np.stack([camera.world_to_camera[2, :3] for camera in cameras]).mean(0)
    right = np.stack([camera.world_to_camera[0, :3] for camera in cameras])
    upward = -np.stack([camera.world_to_camera[1, :3] for camera in cameras]).mean(0)
    if np.linalg.norm(forward) > ONE_WAY and np.linalg.norm(upward) < CANCELLED:
        return unit_up(-forward)
    values, axes = np.linalg.svd(right)[1:]
    if len(cameras) > 2 and (side := _side_up(cameras)) is not None:
        return unit_up(-side * np.sign(side @ forward))
    common = axes[2] if len(cameras) > 2 and values[1] > LEVEL * np.sqrt(len(cameras)) else upward
    if np.linalg.norm(common) < 1e-6 or abs(common @ upward) < 1e-6:
        why = "the cameras are held every way round, and have no up in common"
        raise InputError(f"up: {why}; give `up` as X,Y,Z")
    return unit_up(common * np.sign(common @ upward) / np.linalg.norm(common))


def _side_up(cameras: Sequence[Camera]) -> np.ndarray | None:
    """Vertical of pictures that lie on their side, [3] of either sign, or None if they do not."""
    right, down = (np.stack([camera.world_to_camera[k, :3] for camera in cameras]) for k in (0, 1))
    tilted = np.linalg.svd(right)[1][2] / np.sqrt(len(cameras))
    values, axes = np.linalg.svd(down)[1:]
    _, around, least = values / np.sqrt(len(cameras))
    rather = tilted > TILTED and least < RATHER * tilted and around > AROUND
    return axes[2] if rather and abs(right.mean(0) @ axes[2]) > ALONG else None


def unit_up(vector: Sequence[float] | np.ndarray) -> Vector:
    """The vector scaled to length 1. Raises InputError if it is none."""
    try:
        values = np.asarray(vector, np.float64)
    except (TypeError, ValueError):
        values = np.full(3, np.nan)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(values)
    if values.shape != (3,) or not np.isfinite(length) or length == 0:
        cure = "correct `up`, here or in transforms.json"
        raise InputError(f"up: must be three finite numbers that are not all zero; {cure}")
    x, y, z = (values / length + 0.0).tolist()
    return x, y, z


def levelled(up: Vector) -> np.ndarray:
    """Rotation [3,3] that turns `up` to +Z, and the level part of the world's +Y to +Y. The world's
    +Z takes the place of its +Y if that is less than 45 degrees from the vertical."""
    z = np.array(up)
    y = np.eye(3)[2 if abs(up[1]) > np.sqrt(0.5) else 1]
    y = y - (y @ z) * z
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z])


def degrees_between(a: Vector, b: Vector) -> float:
    """Angle between two directions, degrees."""
    return float(np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1))))
