"""The upward direction of a world that nobody levelled, estimated from cameras held level."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError

Up = tuple[float, float, float]
"""Unit vector in the world that points upwards."""

PLUS_Z: Up = (0.0, 0.0, 1.0)

LEVEL = 0.1
"""Least second singular value of the cameras' right-hand axes over the square root of their number.
Below it the cameras look the same way, the direction across their axes is not unique, and the mean
of their upward axes is taken."""


def up_of_cameras(cameras: Sequence[Camera]) -> Up:
    """Common up vector of cameras: the direction most nearly orthogonal to all right-hand axes.

    A level camera has a horizontal right-hand axis, however steeply it looks down. The result is
    the last right singular vector of the stacked axes, on the side of the cameras' upward axes.
    Raises InputError if these cancel.
    """
    right = np.stack([camera.world_to_camera[0, :3] for camera in cameras])
    upward = -np.stack([camera.world_to_camera[1, :3] for camera in cameras]).mean(0)
    values, axes = np.linalg.svd(right)[1:]
    found = axes[2] if len(cameras) > 2 and values[1] > LEVEL * np.sqrt(len(cameras)) else upward
    if np.linalg.norm(found) < 1e-6 or abs(found @ upward) < 1e-6:
        raise InputError(
            "up: the cameras are held every way round, and have no up in common; give `up` as X,Y,Z"
        )
    found = found * np.sign(found @ upward) / np.linalg.norm(found)
    return unit_up(found)


def unit_up(vector: Sequence[float] | np.ndarray) -> Up:
    """The vector scaled to length 1. Raises InputError if it is none."""
    try:
        given = np.asarray(vector, np.float64)
    except (TypeError, ValueError):
        given = np.full(3, np.nan)
    length = np.linalg.norm(given)
    if given.shape != (3,) or not np.isfinite(given).all() or length == 0:
        raise InputError(
            "up: must be three finite numbers that are not all zero; "
            "correct `up`, here or in transforms.json"
        )
    x, y, z = (given / length + 0.0).tolist()
    return x, y, z


def upright(up: Up) -> np.ndarray:
    """Shortest rotation [3,3] that turns `up` to +Z; exactly the identity for +Z."""
    x, y, z = up
    if z < -1 + 1e-12:  # the shortest rotation is not unique: turn by half about x first
        half_turn = np.diag([1.0, -1.0, -1.0])
        return np.asarray(upright((x, -y, -z)) @ half_turn)
    above = 1 + z if z > -0.5 else (x * x + y * y) / (1 - z)  # near -1, 1 + z loses digits
    across = np.array([[x * x, x * y, 0.0], [x * y, y * y, 0.0], [0.0, 0.0, 0.0]]) / above
    return np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [x, y, z]]) - across


def levelled(up: Up) -> np.ndarray:
    """Rotation [3,3] that turns `up` to +Z, and the level part of the world's +Y to +Y.

    The world's +Z takes the place of its +Y if that is less than 45 degrees from the vertical.
    """
    turn = upright(up)
    ahead = turn[:, 2 if abs(up[1]) > np.sqrt(0.5) else 1]
    x, y = ahead[:2] / np.hypot(*ahead[:2])
    return np.array([[y, -x, 0.0], [x, y, 0.0], [0.0, 0.0, 1.0]]) @ turn


def degrees_between(a: Up, b: Up) -> float:
    """Angle between two directions, degrees."""
    return float(np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1))))
