"""Refine the poses of views about a model that was fitted to them: Gauss-Newton steps of their
motions from the poses that came with the images (rotation vector, then translation, in the camera's
axes). They lower

    1/2 sum of w (rendered - target)^2  +  1/2 sum of lam motion^2,   lam = (sigma / tau)^2

with the weights w of the pixels. `mgs.learning.refine_poses` lets steps and fits take turns.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from mgs.camera import Camera
from mgs.fit.objective import Objective, Photo, View
from mgs.fit.settings import PoseNoise
from mgs.gaussians import Gaussians
from mgs.splat.projection import camera_array, moved
from mgs.splat.recording import frozen

ROUNDS = 6  # steps of the poses. A chosen constant.
# Settings of the fit before each: of a fixed number of Gaussians, by the loss of the steps. Chosen
# constants.
ROUND = {"passes": 3, "tolerance": 0.0, "density": "fixed", "loss": "squared"}
# Pixels of an image that count as independent, whatever its size: errors of a model are alike over
# large parts of it, and pull at its pose together. With more, exact poses move. A chosen constant.
INDEPENDENT = 50
LEAST = 1e-3  # least factor of `motion_std`. A chosen constant.


def tau(noise: PoseNoise, cameras: Sequence[Camera], centre: np.ndarray) -> np.ndarray:
    """Standard deviation of each motion [V,6], radians and metres. centre: of the object [3]."""
    distances = np.linalg.norm([camera.position - centre for camera in cameras], axis=1)
    turn = np.full((len(cameras), 3), np.radians(noise.degrees))
    return np.hstack([turn, np.outer(noise.distance * distances, np.ones(3))])


def motion_std(given: Sequence[Camera], cameras: Sequence[Camera], most: np.ndarray) -> np.ndarray:
    """Standard deviation [V,6] of motions as found: `most` [V,6] times the root mean square of
    motion / most, up to 1, of the turn of each view and of its shift. Under it in place of `most`,
    views that the images hardly pull come to rest where they were."""
    motions = [motion_between(*pair) for pair in zip(given, cameras, strict=True)] / most
    factors = np.sqrt(np.mean(motions.reshape(-1, 2, 3) ** 2, axis=2))
    return most * np.repeat(factors.clip(LEAST, 1), 3, axis=1)


def motion_between(old: Camera, new: Camera) -> np.ndarray:
    """Motion [6] of `mgs.splat.moved` that takes one camera to another."""
    motion = old.world_to_camera @ new.camera_to_world
    return np.r_[Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]]


def displaced(camera: Camera, motion: np.ndarray) -> Camera:
    """Camera after a motion [6], as `mgs.splat.moved`, without Dr.Jit."""
    turn = Rotation.from_rotvec(motion[:3]).as_matrix().T
    pose = np.eye(4)
    pose[:3, :3] = turn @ camera.world_to_camera[:3, :3]
    pose[:3, 3] = turn @ (camera.world_to_camera[:3, 3] - motion[3:])
    return replace(camera, world_to_camera=pose)


def pose_steps(
    goal: Objective, model: Gaussians, given: Sequence[Camera], lam: np.ndarray
) -> list[Camera]:
    """Cameras of all views after one Gauss-Newton step from those of the objective's photos. model:
    TensorXf fields. given: cameras of no motion. lam: of each motion [V,6]."""
    cameras = []
    for photo, old, weight in zip(goal.photos, given, lam, strict=True):
        residual, J = residual_and_jacobian(goal, model, photo)
        slope = J @ residual + weight * motion_between(old, photo.camera)
        step = -np.linalg.solve(J @ J.T + np.diag(weight), slope)
        cameras.append(displaced(photo.camera, step))
    return cameras


def residual_and_jacobian(
    goal: Objective, model: Gaussians, photo: Photo
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted differences to the image [P], and their derivatives by the motion [6,P]."""
    motion, view = mi.Float64([0.0] * 6), goal.view(model, photo)
    rows = []
    for k in range(6):
        # The derivative of the camera's numbers along one of the six.
        dr.enable_grad(motion)
        array = camera_array(moved(photo.camera, motion))
        dr.set_grad(motion, mi.Float64([float(i == k) for i in range(6)]))
        dr.forward_to(array)
        residual, slope = _along(model, view, dr.grad(array))
        dr.disable_grad(motion)
        rows.append(np.array(slope, np.float64))
    return np.array(residual, np.float64), np.array(rows)


@frozen(lambda model, view, tangent: (*model.recorded, *view.recorded_sizes))
def _along(model: Gaussians, view: View, tangent: Any) -> tuple[Any, Any]:
    """Weighted differences to the image, and their derivative along one of its camera's numbers."""
    camera = dr.copy(dr.detach(view.camera))
    dr.enable_grad(camera)
    dr.set_grad(camera, tangent)
    drawn = replace(view, camera=camera).rendered(model).array
    dr.forward_to(drawn)
    weights = view.target.weights
    return (dr.detach(drawn) - view.target.pixels) * weights, dr.grad(drawn) * weights
