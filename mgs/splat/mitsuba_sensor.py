"""Convert a Mitsuba sensor to a `Camera`."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError

_MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Mitsuba's camera has x to the image's left and y up, OpenCV's x to the right and y down."""


def camera_from_sensor(sensor: Any) -> Camera:
    """Camera of a Mitsuba `perspective` sensor; the image is the sensor's crop window.

    `x_fov` is the horizontal field of view of the whole film, whatever the sensor's fov axis. The
    principal point is 0.5 minus the sensor's offset, as a share of the film. Near clip, far clip
    and shutter are ignored (near plane: `mgs.splat.constants.NEAR`). Raises InputError for any
    other sensor, and for a pose that is not rigid.
    """
    params = mi.traverse(sensor)
    if "x_fov" not in params or sensor.needs_aperture_sample():
        raise InputError(
            f"sensor: {sensor.class_name()} has no pinhole; splatting needs a `perspective` sensor"
        )
    width, height = params["film.size"]
    left, top = params["film.crop_offset"]
    focal = 0.5 * width / np.tan(0.5 * np.radians(_number(params["x_fov"])))
    cx = (0.5 - _number(params["principal_point_offset_x"])) * width
    cy = (0.5 - _number(params["principal_point_offset_y"])) * height
    to_world = np.array(params["to_world"].matrix, np.float64).reshape(4, 4)
    if np.linalg.det(to_world[:3, :3]) < 0:
        raise InputError(
            "sensor: to_world mirrors the image; "
            "take the negative scale out and flip the picture afterwards"
        )
    try:
        world_to_camera = np.asarray(np.linalg.inv(to_world @ _MITSUBA_FROM_OPENCV), np.float64)
    except np.linalg.LinAlgError:
        raise InputError("sensor: to_world is singular; its rotation must be orthonormal") from None
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])
    film, window = Camera(K, width, height, world_to_camera), map(int, params["film.crop_size"])
    columns, rows = window
    if (columns, rows) == (film.width, film.height):
        return film
    return film.cropped(int(left), int(top), columns, rows)


def _number(value: Any) -> float:
    """Value of a Mitsuba Float with one entry."""
    return float(np.asarray(value, np.float64).ravel()[0])
