"""Which way is up in a world that nobody levelled: the cameras tell it, because people hold them
level."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError

Up = tuple[float, float, float]
"""A unit vector in the world that points upwards."""

PLUS_Z: Up = (0.0, 0.0, 1.0)

LEVEL = 0.1
"""Least second singular value of the cameras' right-hand axes, over the square root of their
number. With less the cameras look the same way, and a direction across all of these axes is not
unique; then the mean of their upward axes is taken."""


def up_of_cameras(cameras: Sequence[Camera]) -> Up:
    """The common up vector of cameras: the direction most nearly at right angles to the right-hand
    axes of all of them.

    A camera that is held level has a horizontal right-hand axis, however steeply it looks down. So
    this direction is the last right singular vector of the stacked axes, on the side of the
    cameras' own upward axes. Raises InputError where these axes cancel, so that there is no such
    side.
    """
    right = np.stack([camera.world_to_camera[0, :3] for camera in cameras])
    upward = -np.stack([camera.world_to_camera[1, :3] for camera in cameras]).mean(0)
    values, axes = np.linalg.svd(right)[1:]
    found = axes[2] if len(cameras) > 2 and values[1] > LEVEL * np.sqrt(len(cameras)) else upward
    if np.linalg.norm(found) < 1e-6 or abs(found @ upward) < 1e-6:
        raise InputError(
            "up: the cameras are held every way round, and have no up in common; give --up X,Y,Z"
        )
    found = found * np.sign(found @ upward) / np.linalg.norm(found)
    return unit_up(found)


def unit_up(vector: Sequence[float] | np.ndarray) -> Up:
    """A vector of length 1 in the direction of the one given. Raises InputError if that is not
    finite or zero, or not of three numbers."""
    try:
        given = np.asarray(vector, np.float64)
    except (TypeError, ValueError):
        given = np.full(3, np.nan)
    length = np.linalg.norm(given)
    if given.shape != (3,) or not np.isfinite(given).all() or length == 0:
        raise InputError(
            "up: must be three finite numbers that are not all zero; correct --up, or `up` of transforms.json"
        )
    x, y, z = (given / length + 0.0).tolist()
    return x, y, z


def upright(up: Up) -> np.ndarray:
    """The rotation [3,3] that turns the direction `up` to +Z by the shortest way; exactly the
    identity for +Z."""
    x, y, z = up
    if (
        z < -1 + 1e-12
    ):  # there is no one shortest way: half a turn about x first, and what is then left
        half_turn = np.diag([1.0, -1.0, -1.0])
        return np.asarray(upright((x, -y, -z)) @ half_turn)
    across = np.array([[x * x, x * y, 0.0], [x * y, y * y, 0.0], [0.0, 0.0, 0.0]]) / (1 + z)
    return np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [x, y, z]]) - across


def angle_between(a: Up, b: Up) -> float:
    """Angle between two directions, degrees."""
    return float(np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1))))
