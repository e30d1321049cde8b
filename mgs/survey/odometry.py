"""Drifting odometry: a drone's estimate of its camera's motion from frame to frame.

Poses are [4,4] camera-to-world, metres. A step is the pose of the next camera in the axes of the
one before.
"""

from __future__ import annotations

import numpy as np

DRIFT_SCALE, DRIFT_YAW = 0.01, np.radians(0.3)
"""Bias of every step: relative error of translations, and yaw about the vertical, radians."""

DRIFT_SHAKE, DRIFT_TURN = 0.01, np.radians(0.2)
"""Random errors of each step, standard deviations per axis: of the translation over the step's
length, and of the rotation, radians. Visual-inertial odometry drifts by about one per cent of the
way (Delmerico and Scaramuzza, ICRA 2018, table III)."""

TRUST = 5.0
"""Largest accepted difference from odometry, in its standard deviations."""


def drifting_odometry(truth: np.ndarray, drift: float, rng: np.random.Generator) -> np.ndarray:
    """Steps [F-1,4,4] that odometry reports for a flight along poses `truth` [F,4,4].

    drift: factor on all errors; 0 gives the true steps.
    """
    from scipy.spatial.transform import Rotation

    steps = np.linalg.inv(truth[:-1]) @ truth[1:]
    measured = steps.copy()
    vertical = truth[1:, 2, :3]  # the world's +Z in the axes of the later camera
    turn = DRIFT_YAW * vertical + DRIFT_TURN * rng.standard_normal((len(steps), 3))
    measured[:, :3, :3] = steps[:, :3, :3] @ Rotation.from_rotvec(drift * turn).as_matrix()
    length = np.linalg.norm(steps[:, :3, 3], axis=1, keepdims=True)
    shake = DRIFT_SHAKE * length * rng.standard_normal((len(steps), 3))
    measured[:, :3, 3] = (1 + drift * DRIFT_SCALE) * steps[:, :3, 3] + drift * shake
    return measured


def chain(first: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Poses [F,4,4] from the first pose [4,4] and the steps [F-1,4,4]."""
    poses = [first]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def step_deviation(step: np.ndarray, drift: float) -> tuple[float, float]:
    """Standard deviations of odometry in one step [4,4]: rotation, radians, and translation,
    metres.

    Biases count as if they were standard deviations.
    """
    length = float(np.linalg.norm(step[:3, 3]))
    return drift * (DRIFT_YAW + DRIFT_TURN), drift * (DRIFT_SCALE + DRIFT_SHAKE) * length


def agrees(measured: np.ndarray, odometry: np.ndarray, drift: float, grid: float) -> bool:
    """Whether a measured step [4,4] is within TRUST standard deviations of odometry's [4,4].

    The limits are widened by the error of a measurement: half a degree, and one cell of the
    registration's grid, `grid` metres.
    """
    difference = np.linalg.inv(odometry) @ measured
    turn = np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1))
    turn_deviation, shift_deviation = step_deviation(odometry, drift)
    turn_limit = TRUST * turn_deviation + np.radians(0.5)
    shift_limit = TRUST * shift_deviation + grid
    return bool(np.linalg.norm(difference[:3, 3]) < shift_limit and turn < turn_limit)
