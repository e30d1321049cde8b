"""The survey: a noisy RGB-D camera and drifting odometry on the dataset's orbit, registered into a consistent trajectory.

Registration (GICP) of consecutive frames, loop closure where the orbit returns, pose graph optimisation. The first pose is the
origin and is taken as known; every other pose is estimated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.dataset import Dataset, Frame, load_dataset, write_transforms
from mgs.errors import InputError
from mgs.files import copy_file
from mgs.images import write_exr
from mgs.seeds import generator
from mgs.survey.depth_sensor import depth_noise, filter_depth, noisy_depth
from mgs.survey.fusion import focus, usable_depth

DRIFT_SCALE, DRIFT_YAW = 0.01, np.radians(0.3)
"""Odometry: scale error of every step, and heading error per step about the vertical, both constant over a flight (a bias)."""

DRIFT_SHAKE, DRIFT_TURN = 0.01, np.radians(0.2)
"""Odometry: standard deviation of each step's translation over its length, and of its rotation per axis. Visual-inertial
odometry drifts by about one per cent of the way flown (Delmerico and Scaramuzza, ICRA 2018, table III)."""

GRID, MATCH, NEIGHBOURS = 0.007, 4.0, 40
"""Registration: grid over the distance of the cameras from what they look at (3 cm at 4 m); largest distance of matched points
in grid cells; points per covariance."""

EDGE, RANGE = 5, 1.6
"""Registration leaves out pixels whose EDGE x EDGE neighbourhood spans two surfaces, and depths beyond RANGE lower quartiles.
What is bound to the sensor instead of the world pulls every motion towards zero: with the flying pixels of silhouettes left
in, the error of a step was twenty times larger."""

TRUST = 5.0
"""A registration that departs from odometry by more than this many of odometry's standard deviations has slid or failed; the
edge then keeps what odometry said."""

CLOSURE_GAP = 5
"""Frames fewer than this apart along the flight are neighbours, not a loop."""

CLOSURE_RANGE = 1.5
"""A loop is tried between frames whose estimated positions are within this many median steps plus the drift expected so far."""

CLOSURE_OVERLAP = 0.5
"""Share of a frame's points that must match for a loop to be accepted."""


@dataclass(frozen=True)
class SurveySettings:
    """sensor: factor on the sensor's noise; drift: factor on the odometry's; exact_poses: no odometry, poses as flown."""

    sensor: float = 1.0
    drift: float = 1.0
    exact_poses: bool = False
    seed: int = 0


@dataclass(frozen=True)
class Edge:
    """Measured pose of frame j's camera in frame i's: relative [4,4]; overlap: share of points matched; registered: False
    where registration failed and odometry stands in."""

    i: int
    j: int
    relative: np.ndarray
    overlap: float
    registered: bool = True


@dataclass(frozen=True)
class Survey:
    """Camera-to-world poses [F,4,4] per stage: truth, odometry, registered (before loop closure), optimised (after);
    depths: what the sensor measured [F] of [H,W] metres; edges: consecutive registrations; loops: accepted closures."""

    truth: np.ndarray
    odometry: np.ndarray
    registered: np.ndarray
    optimised: np.ndarray
    depths: list[np.ndarray]
    edges: list[Edge]
    loops: list[Edge]


def fly(dataset: Dataset, settings: SurveySettings, on_stage: Callable[[str, int, int], None] | None = None) -> Survey:
    """Survey a dataset with depth. on_stage(name, done, total) reports progress.

    Raises InputError: no depth, fewer than three frames, registration that fails (too few returns or too little overlap).
    """
    tell = on_stage or (lambda stage, done, total: None)
    frames = dataset.frames
    if len(frames) < 3:
        raise InputError(f"{dataset.root}: {len(frames)} frames are too few for a survey; at least 3 are needed")
    if not (0 <= settings.sensor < np.inf and 0 <= settings.drift < np.inf):
        raise InputError("survey: --sensor-noise and --drift are factors of 0 or more; correct them")
    depths = []
    for k, frame in enumerate(frames):
        tell("depth", k, len(frames))
        depths.append(
            noisy_depth(frame.depth(), frame.camera, generator(settings.seed, f"survey/{frame.name}"), settings.sensor)
        )
    truth = np.stack([frame.camera.camera_to_world for frame in frames])
    if settings.exact_poses:
        return Survey(truth, truth, truth, truth, depths, [], [])
    steps = drifting_odometry(truth, settings.drift, generator(settings.seed, "survey/odometry"))
    odometry = chain(truth[0], steps)
    grid = GRID * focus(frames).distance
    clouds = [_registration_cloud(frame, depth, grid) for frame, depth in zip(frames, depths, strict=True)]
    edges = []
    for k in range(len(frames) - 1):
        tell("registration", k, len(frames) - 1)
        edge = _register(clouds, k, k + 1, steps[k], grid, (1.0,))
        trusted = _agrees(edge.relative, steps[k], settings.drift, grid)
        edges.append(edge if trusted else replace(edge, relative=steps[k], registered=False))
    registered = chain(truth[0], np.stack([edge.relative for edge in edges]))
    loops = []
    candidates = loop_candidates(registered)
    for k, (i, j) in enumerate(candidates):
        tell("loop closure", k, len(candidates))
        edge = _register(clouds, i, j, np.linalg.inv(registered[i]) @ registered[j], grid, (4.0, 2.0, 1.0))
        if edge.overlap >= CLOSURE_OVERLAP:
            loops.append(edge)
    optimised = optimise(registered, steps, edges, loops, settings.drift, grid)
    return Survey(truth, odometry, registered, optimised, depths, edges, loops)


def drifting_odometry(truth: np.ndarray, drift: float, rng: np.random.Generator) -> np.ndarray:
    """Relative poses [F-1,4,4] that drifting odometry reports for camera-to-world poses [F,4,4] (see DRIFT_*)."""
    from scipy.spatial.transform import Rotation

    steps = np.linalg.inv(truth[:-1]) @ truth[1:]
    measured = steps.copy()
    # World +Z in the camera of the later frame: heading drifts about the vertical.
    vertical = truth[1:, 2, :3]
    turn = DRIFT_YAW * vertical + DRIFT_TURN * rng.standard_normal((len(steps), 3))
    measured[:, :3, :3] = steps[:, :3, :3] @ Rotation.from_rotvec(drift * turn).as_matrix()
    length = np.linalg.norm(steps[:, :3, 3], axis=1, keepdims=True)
    shake = DRIFT_SHAKE * length * rng.standard_normal((len(steps), 3))
    measured[:, :3, 3] = (1 + drift * DRIFT_SCALE) * steps[:, :3, 3] + drift * shake
    return measured


def _agrees(measured: np.ndarray, odometry: np.ndarray, drift: float, grid: float) -> bool:
    """Whether a registered step [4,4] is within TRUST standard deviations of odometry's (and a grid cell)."""
    difference = np.linalg.inv(odometry) @ measured
    length = float(np.linalg.norm(odometry[:3, 3]))
    turn = np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1))
    shift_limit = TRUST * drift * (DRIFT_SCALE + DRIFT_SHAKE) * length + grid
    turn_limit = TRUST * drift * (DRIFT_YAW + DRIFT_TURN) + np.radians(0.5)
    return bool(np.linalg.norm(difference[:3, 3]) < shift_limit and turn < turn_limit)


def chain(first: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Camera-to-world poses [F,4,4] from the first [4,4] and relative poses [F-1,4,4]."""
    poses = [first]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def loop_candidates(poses: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of frames, not neighbours in the flight, whose estimated cameras [F,4,4] are close and look the same way."""
    position, axis = poses[:, :3, 3], poses[:, :3, 2]
    step = float(np.median(np.linalg.norm(np.diff(position, axis=0), axis=1)))
    distance = np.linalg.norm(position[:, None] - position[None], axis=-1)
    apart = np.abs(np.subtract.outer(np.arange(len(poses)), np.arange(len(poses))))
    reach = CLOSURE_RANGE * step + 0.02 * step * apart
    close = (distance < reach) & (apart >= CLOSURE_GAP) & (axis @ axis.T > np.cos(np.radians(30)))
    return [(int(i), int(j)) for i, j in np.argwhere(close) if i < j]


def _registration_cloud(frame: Frame, depth: np.ndarray, grid: float) -> tuple[Any, Any]:
    """The frame's points in its own camera, filtered and thinned, with covariances and search tree (small_gicp)."""
    import small_gicp

    z = usable_depth(filter_depth(depth, depth_noise(depth)), EDGE)
    if (z > 0).any():
        z = np.where(z < RANGE * np.quantile(z[z > 0], 0.25), z, 0.0)
    own = Camera(frame.camera.K, frame.camera.width, frame.camera.height, np.eye(4))
    points = own.unproject(z)[z > 0]
    if len(points) < 100:
        raise InputError(f"survey: frame {frame.name} has only {len(points)} depth returns; it cannot be registered")
    return small_gicp.preprocess_points(points, downsampling_resolution=grid, num_neighbors=NEIGHBOURS, num_threads=1)


def _register(clouds: list, i: int, j: int, guess: np.ndarray, grid: float, reaches: tuple[float, ...]) -> Edge:
    """GICP (Segal et al. 2009, small_gicp) of frame j onto frame i, with matches within `reaches` times the usual, in turn."""
    import small_gicp

    (target, tree), (source, _) = clouds[i], clouds[j]
    for reach in reaches:
        result = small_gicp.align(
            target, source, tree, guess, max_correspondence_distance=reach * MATCH * grid, num_threads=1, max_iterations=60
        )
        guess = result.T_target_source
    moved = source.points()[:, :3] @ guess[:3, :3].T + guess[:3, 3]
    from scipy.spatial import cKDTree

    distance = cKDTree(target.points()[:, :3]).query(moved)[0]
    return Edge(i, j, guess, float((distance < 2 * grid).mean()))


def optimise(
    initial: np.ndarray, odometry: np.ndarray, edges: list[Edge], loops: list[Edge], drift: float, grid: float
) -> np.ndarray:
    """Pose graph optimisation (gtsam, Levenberg-Marquardt) of camera-to-world poses [F,4,4]; the first stays where it is.

    Factors: odometry's steps [F-1,4,4] at their own standard deviation; registered steps and loops at a fifth of a grid cell
    and the angle that moves a point 50 cells away by as much (measured: 6 mm and 0.08 degrees at cells of 30 mm). Loops bear
    a Huber loss, so a wrong one is outvoted.
    """
    import gtsam

    if not loops:
        return initial
    # gtsam orders rotation before translation.
    fine = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.2 / 50, 0.2 * grid], 3))
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.345), fine)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(initial[0]), gtsam.noiseModel.Constrained.All(6)))
    for k, pose in enumerate(initial):
        values.insert(k, gtsam.Pose3(pose))
    for k, step in enumerate(odometry):
        shift = drift * (DRIFT_SCALE + DRIFT_SHAKE) * float(np.linalg.norm(step[:3, 3]))
        sigmas = np.repeat([drift * (DRIFT_YAW + DRIFT_TURN), shift], 3)
        coarse = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(sigmas, 1e-4))
        graph.add(gtsam.BetweenFactorPose3(k, k + 1, gtsam.Pose3(step), coarse))
    for edge in [edge for edge in edges if edge.registered] + loops:
        noise = fine if edge.j == edge.i + 1 else robust
        graph.add(gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.relative), noise))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.stack([result.atPose3(k).matrix() for k in range(len(initial))])


def trajectory_error(poses: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Absolute trajectory error of camera-to-world poses [F,4,4] against the truth (Sturm et al. 2012), first pose shared.

    ate_rms, ate_max: metres; rotation_rms: degrees; aligned_rms: metres, after the best rigid alignment (Umeyama 1991).
    """
    offset = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    turn = np.einsum("fki,fkj->fij", poses[:, :3, :3], truth[:, :3, :3])
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    a, b = poses[:, :3, 3] - poses[:, :3, 3].mean(0), truth[:, :3, 3] - truth[:, :3, 3].mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    aligned = np.linalg.norm(a @ rotation - b, axis=1)
    return {
        "ate_rms": float(np.sqrt(np.mean(offset**2))),
        "ate_max": float(offset.max()),
        "rotation_rms": float(np.sqrt(np.mean(angle**2))),
        "aligned_rms": float(np.sqrt(np.mean(aligned**2))),
    }


def survey_numbers(dataset: Dataset, survey: Survey, settings: SurveySettings) -> dict[str, Any]:
    """What survey.json holds: settings, registration, loops, trajectory error per stage, depth error of the sensor."""
    error = [
        (measured - frame.depth())[(measured > 0) & frame.mask()]
        for frame, measured in zip(dataset.frames, survey.depths, strict=True)
    ]
    returns = sum(int((depth > 0).sum()) for depth in survey.depths)
    possible = sum(int((frame.depth() > 0).sum()) for frame in dataset.frames)
    return {
        "frames": len(dataset.frames),
        "settings": asdict(settings),
        "path_length": float(np.linalg.norm(np.diff(survey.truth[:, :3, 3], axis=0), axis=1).sum()),
        "depth_error_on_rock": 1.4826 * float(np.median(np.abs(np.concatenate(error)))),
        "returns_lost": 1 - returns / max(possible, 1),
        "steps_by_odometry": sum(not edge.registered for edge in survey.edges),
        "registration_overlap": [edge.overlap for edge in survey.edges],
        "loops": [[edge.i, edge.j, edge.overlap] for edge in survey.loops],
        "error": {
            name: trajectory_error(getattr(survey, name), survey.truth) for name in ("odometry", "registered", "optimised")
        },
    }


def write_survey(out: Path, dataset: Dataset, survey: Survey) -> Dataset:
    """Write the survey as a dataset folder: estimated poses, measured depth, all else as flown."""
    frames = []
    for frame, pose, depth in zip(dataset.frames, survey.optimised, survey.depths, strict=True):
        estimated = replace(frame.camera, world_to_camera=np.linalg.inv(pose))
        # Frames have names of their own; their files may share one, in different folders.
        image = out / "images" / f"{frame.name}{frame.image_path.suffix}"
        mask = frame.mask_path and out / "masks" / f"{frame.name}{frame.mask_path.suffix}"
        rock = frame.rock_path and out / "rock" / f"{frame.name}{frame.rock_path.suffix}"
        measured = out / "depth" / f"{frame.name}.exr"
        copy_file(frame.image_path, image)
        if mask and frame.mask_path:
            copy_file(frame.mask_path, mask)
        if rock and frame.rock_path:
            copy_file(frame.rock_path, rock)
        write_exr(measured, {"Z": depth})
        frames.append(Frame(frame.name, estimated, frame.timestamp, image, measured, mask, rock))
    truth = dataset.root / "rock.glb"
    if truth.is_file():
        copy_file(truth, out / "rock.glb")
    write_transforms(out, frames)
    return load_dataset(out)
