"""Relative poses of a flight's cameras from their depth images: GICP, loops, pose graph. Poses are
[4,4] camera-to-world, metres; a step is the next camera's in the axes of the one before."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mgs.camera import Camera
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.survey.depth_sensor import depth_noise, filter_depth
from mgs.survey.fusion import usable_depth

GRID = 0.007  # cell of the grid of a frame's points, over the cameras' distance: 3 cm at 4 m
MATCH = 4.0  # largest distance between matched points, grid cells
NEIGHBOURS = 40  # neighbours from which the covariance of a point is computed
# Neighbourhood of `usable_depth`, pixels. On silhouettes the sensor reports "flying pixels", which
# move with the camera and pull every measured motion towards zero: with them, the error of a step
# was twenty times larger.
EDGE = 5
RANGE = 1.6  # largest depth used, over the lower quartile of the frame's depths
CLOSURE_GAP = 5  # fewest steps between two frames that close a loop
CLOSURE_RANGE = 1.5  # distance of frames that may close a loop, median steps, beside CLOSURE_DRIFT
CLOSURE_DRIFT = 0.02  # drift of registered poses over the way flown
CLOSURE_OVERLAP = 0.5  # least share of a frame's points that must match for a loop
DRIFT_SCALE, DRIFT_YAW = 0.01, np.radians(0.3)  # bias of a step: relative error, and yaw, radians
# Random errors of each step, standard deviations per axis: of the translation over the step's
# length, and of the rotation, radians. Visual-inertial odometry drifts by about one per cent of the
# way (Delmerico and Scaramuzza, ICRA 2018, table III).
DRIFT_SHAKE, DRIFT_TURN = 0.01, np.radians(0.2)
TRUST = 5.0  # largest accepted difference from odometry, in its standard deviations


@dataclass(frozen=True)
class Edge:
    """A measured relative pose, an edge of the pose graph."""

    i: int  # frame numbers
    j: int
    relative: np.ndarray  # [4,4] pose of camera j in the axes of camera i, metres
    overlap: float  # share of the points of frame j that match frame i
    registered: bool = True  # False if `relative` is odometry's


def registration_cloud(frame: Frame, depth: np.ndarray, grid: float) -> tuple[Any, Any]:
    """Points of a frame's depth image [H,W], in the axes of its camera, filtered and averaged on a
    grid. grid: metres. Returns small_gicp's cloud with covariances, and its search tree. Raises
    InputError if fewer than 100 pixels are left."""
    import small_gicp

    z = usable_depth(filter_depth(depth, depth_noise(depth)), EDGE)
    if (z > 0).any():
        z = np.where(z < RANGE * np.quantile(z[z > 0], 0.25), z, 0.0)
    own = Camera(frame.camera.K, frame.camera.width, frame.camera.height, np.eye(4))
    points = own.unproject(z)[z > 0]
    if len(points) < 100:
        why = f"frame {frame.name} has only {len(points)} depth returns, so it cannot be registered"
        raise InputError(f"survey: {why}; remove it")
    return small_gicp.preprocess_points(
        points, downsampling_resolution=grid, num_neighbors=NEIGHBOURS, num_threads=1
    )


def register(
    clouds: list, i: int, j: int, guess: np.ndarray, grid: float, reaches: tuple[float, ...]
) -> Edge:
    """Align frame j with frame i by GICP (Segal et al. 2009, small_gicp), from the relative pose
    `guess`. clouds: `registration_cloud` of all frames. reaches: factors on MATCH; one run each,
    from the result of the run before."""
    import small_gicp

    (target, tree), (source, _) = clouds[i], clouds[j]
    for reach in reaches:
        result = small_gicp.align(
            target,
            source,
            tree,
            guess,
            max_correspondence_distance=reach * MATCH * grid,
            num_threads=1,
            max_iterations=60,
        )
        guess = result.T_target_source
    points = source.points()[:, :3] @ guess[:3, :3].T + guess[:3, 3]
    distance = cKDTree(target.points()[:, :3]).query(points)[0]
    return Edge(i, j, guess, float((distance < 2 * grid).mean()))


def loop_candidates(poses: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of frames that may see the same place again: no neighbours in the flight, close
    together by their estimated poses [F,4,4], and looking within 30 degrees of the same way."""
    position, axis = poses[:, :3, 3], poses[:, :3, 2]
    step = float(np.median(np.linalg.norm(np.diff(position, axis=0), axis=1)))
    distance = np.linalg.norm(position[:, None] - position[None], axis=-1)
    apart = np.abs(np.subtract.outer(np.arange(len(poses)), np.arange(len(poses))))
    reach = CLOSURE_RANGE * step + CLOSURE_DRIFT * step * apart
    close = (distance < reach) & (apart >= CLOSURE_GAP) & (axis @ axis.T > np.cos(np.radians(30)))
    return [(int(i), int(j)) for i, j in np.argwhere(close) if i < j]


def optimise(
    initial: np.ndarray,
    odometry: np.ndarray,
    edges: list[Edge],
    loops: list[Edge],
    drift: float,
    grid: float,
) -> np.ndarray:
    """Reconcile relative poses by pose graph optimisation (gtsam, Levenberg-Marquardt): [F,4,4].

    initial: poses [F,4,4], returned unchanged without loops; the first one is fixed. odometry:
    steps [F-1,4,4], with `step_deviation` for the factor `drift`. edges, loops: with standard
    deviations of a fifth of a cell (`grid`, metres), and the angle that moves a point 50 cells away
    by as much (measured: 6 mm and 0.08 degrees with cells of 30 mm). Loops have a Huber loss,
    against wrong ones."""
    import gtsam

    if not loops:
        return initial
    # gtsam's order: rotation, then translation.
    fine = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.2 / 50, 0.2 * grid], 3))
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.345), fine)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    fixed = gtsam.noiseModel.Constrained.All(6)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(initial[0]), fixed))
    for k, pose in enumerate(initial):
        values.insert(k, gtsam.Pose3(pose))
    for k, step in enumerate(odometry):
        sigmas = np.repeat(step_deviation(step, drift), 3)
        coarse = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, 1e-4))
        graph.add(gtsam.BetweenFactorPose3(k, k + 1, gtsam.Pose3(step), coarse))
    for edge in [edge for edge in edges if edge.registered] + loops:
        noise = fine if edge.j == edge.i + 1 else robust
        graph.add(gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.relative), noise))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.stack([result.atPose3(k).matrix() for k in range(len(initial))])


def drifting_odometry(truth: np.ndarray, drift: float, rng: np.random.Generator) -> np.ndarray:
    """Steps [F-1,4,4] that odometry reports for a flight along poses `truth` [F,4,4]. drift: factor
    on all errors; 0 gives the true steps."""
    steps = np.linalg.inv(truth[:-1]) @ truth[1:]
    odometry = steps.copy()
    vertical = truth[1:, 2, :3]  # the world's +Z in the axes of the later camera
    turn = DRIFT_YAW * vertical + DRIFT_TURN * rng.standard_normal((len(steps), 3))
    odometry[:, :3, :3] = steps[:, :3, :3] @ Rotation.from_rotvec(drift * turn).as_matrix()
    length = np.linalg.norm(steps[:, :3, 3], axis=1, keepdims=True)
    shake = DRIFT_SHAKE * length * rng.standard_normal((len(steps), 3))
    odometry[:, :3, 3] = (1 + drift * DRIFT_SCALE) * steps[:, :3, 3] + drift * shake
    return odometry


def chain(first: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Poses [F,4,4] from the first pose [4,4] and the steps [F-1,4,4]."""
    poses = [first]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def step_deviation(step: np.ndarray, drift: float) -> tuple[float, float]:
    """Standard deviations of odometry in one step [4,4]: rotation, radians, and translation,
    metres. Biases count as if they were standard deviations."""
    length = float(np.linalg.norm(step[:3, 3]))
    return drift * (DRIFT_YAW + DRIFT_TURN), drift * (DRIFT_SCALE + DRIFT_SHAKE) * length


def agrees(step: np.ndarray, odometry: np.ndarray, drift: float, grid: float) -> bool:
    """Whether a measured step [4,4] is within TRUST standard deviations of odometry's [4,4]. The
    limits are widened by the error of a measurement: half a degree, and one cell of the
    registration's grid, `grid` metres."""
    difference = np.linalg.inv(odometry) @ step
    turn = np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1))
    turn_deviation, shift_deviation = step_deviation(odometry, drift)
    turn_limit = TRUST * turn_deviation + np.radians(0.5)
    shift_limit = TRUST * shift_deviation + grid
    return bool(np.linalg.norm(difference[:3, 3]) < shift_limit and turn < turn_limit)
