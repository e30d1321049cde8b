"""Convert a Mitsuba sensor to a `Camera`."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError

_MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])  # x to the left, y up, z forward


def camera_from_sensor(sensor: Any) -> Camera:
    """Camera of a Mitsuba `perspective` sensor; the image is the sensor's crop window.

    `x_fov` is the horizontal field of view of the whole film, whatever the sensor's fov axis. The
    principal point is 0.5 minus the sensor's offset, as a share of the film. Near clip, far clip
    and shutter are ignored (near plane: `mgs.splat.constants.NEAR`). The camera keeps the gradients
    of to_world, x_fov and the principal point, if enabled. Raises InputError for any other sensor,
    and for a pose that is not rigid."""
    params = mi.traverse(sensor)
    if "x_fov" not in params or sensor.needs_aperture_sample():
        cure = "splatting needs a `perspective` sensor"
        raise InputError(f"sensor: {sensor.class_name()} has no pinhole; {cure}")
    width, height = params["film.size"]
    left, top = params["film.crop_offset"]
    names = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
    fov, ppo_x, ppo_y = (params[name] for name in names)
    traced = dr.grad_enabled(params["to_world"].matrix, fov, ppo_x, ppo_y)
    # f = (width / 2) / tan(x_fov / 2); c = (0.5 - offset) times the side of the film.
    focal = 0.5 * width / np.tan(0.5 * np.radians(_number(params["x_fov"])))
    cx = (0.5 - _number(params["principal_point_offset_x"])) * width
    cy = (0.5 - _number(params["principal_point_offset_y"])) * height
    to_world = np.array(params["to_world"].matrix, np.float64).reshape(4, 4)
    if np.linalg.det(to_world[:3, :3]) < 0:
        cure = "take the negative scale out and flip the picture afterwards"
        raise InputError(f"sensor: to_world mirrors the image; {cure}")
    try:
        world_to_camera = np.asarray(np.linalg.inv(to_world @ _MITSUBA_FROM_OPENCV), np.float64)
    except np.linalg.LinAlgError:
        raise InputError("sensor: to_world is singular; its rotation must be orthonormal") from None
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])
    if traced:
        K, world_to_camera = _traced(params["to_world"], fov, ppo_x, ppo_y, width, height)
    film, window = Camera(K, width, height, world_to_camera), map(int, params["film.crop_size"])
    columns, rows = window
    if (columns, rows) == (film.width, film.height):
        return film
    return film.cropped(int(left), int(top), columns, rows)


def _traced(to_world: Any, fov: Any, ppo_x: Any, ppo_y: Any, width: int, height: int) -> Any:
    """K [3,3] and world_to_camera [4,4] of a sensor as TensorXf64, with gradients."""
    matrix, flip = to_world.matrix, np.diag(_MITSUBA_FROM_OPENCV).tolist()
    rows = [mi.Float64(flip[j] * matrix[i, j]) for i in range(4) for j in range(4)]
    # world_to_camera = (to_world diag(-1, -1, 1, 1))^-1.
    inverse = dr.rcp(mi.Matrix4d(*rows))
    focal = 0.5 * width / dr.tan(dr.deg2rad(0.5 * mi.Float64(fov)))
    cx, cy = (0.5 - mi.Float64(ppo_x)) * width, (0.5 - mi.Float64(ppo_y)) * height
    K = [focal, 0, cx, 0, focal, cy, 0, 0, 1]
    pose = [inverse[i, j] for i in range(4) for j in range(4)]
    return tuple(
        mi.TensorXf64(dr.concat([mi.Float64(x) for x in entries]), (size, size))
        for entries, size in ((K, 3), (pose, 4))
    )


def _number(value: Any) -> float:
    return float(np.asarray(value, np.float64).ravel()[0])
