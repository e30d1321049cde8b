"""The survey: a flight along the dataset's orbit with a noisy depth camera and drifting odometry,
whose first pose is known and whose others are registered. Poses are [4,4] camera-to-world,
metres."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from mgs.data.dataset import Dataset
from mgs.errors import InputError
from mgs.seeds import generator
from mgs.survey.depth_sensor import SIGMA_FROM_MAD, noisy_depth
from mgs.survey.fusion import focus
from mgs.survey.registration import (
    CLOSURE_OVERLAP,
    GRID,
    Edge,
    agrees,
    chain,
    drifting_odometry,
    loop_candidates,
    optimise,
    register,
    registration_cloud,
)
from mgs.synth.scene_file import MOST_ERROR

STAGES = {  # estimated trajectories of a `Survey`, as they are made: field -> label
    "odometry": "odometry alone",
    "registered": "registered, before loop closure",
    "optimised": "after loop closure",
}


@dataclass(frozen=True)
class SurveySettings:
    """Settings of a survey. Raises InputError if a factor is not from 0 to MOST_ERROR."""

    sensor: float = 1.0  # factor on the depth camera's noise; 0 is exact
    drift: float = 1.0  # factor on the errors of odometry
    exact_poses: bool = False  # use the true poses
    seed: int = 0  # root seed

    def __post_init__(self) -> None:
        if not (0 <= self.sensor <= MOST_ERROR and 0 <= self.drift <= MOST_ERROR):
            raise InputError(
                f"survey: sensor_noise {self.sensor:g} and drift {self.drift:g} are factors "
                f"of 0 or more, at most {MOST_ERROR:g}; correct them"
            )


@dataclass(frozen=True)
class Survey:
    """Result of a flight of F frames."""

    truth: np.ndarray  # [F,4,4] poses as flown
    odometry: np.ndarray  # [F,4,4] estimates (STAGES)
    registered: np.ndarray
    optimised: np.ndarray
    depths: list[np.ndarray]  # F measured depth images [H,W], metres, 0 = no return
    edges: list[Edge]  # the F - 1 registrations of consecutive frames
    loops: list[Edge]  # accepted loop closures


def fly(
    dataset: Dataset,
    settings: SurveySettings,
    on_stage: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Survey:
    """Survey a dataset that has depth images. on_stage: called (name, done, total). Raises
    InputError if there are fewer than three frames, or one has no depth image or too few returns to
    be registered."""
    frames = dataset.frames
    if len(frames) < 3:
        raise InputError(
            f"{dataset.root}: {len(frames)} frames are too few for a survey; at least 3 are needed"
        )
    depths = []
    for k, frame in enumerate(frames):
        on_stage("depth", k, len(frames))
        rng = generator(settings.seed, f"survey/{frame.name}")
        depths.append(noisy_depth(frame.depth(), frame.camera, rng, settings.sensor))
    truth = np.stack([frame.camera.camera_to_world for frame in frames])
    if settings.exact_poses:
        return Survey(truth, truth, truth, truth, depths, [], [])
    steps = drifting_odometry(truth, settings.drift, generator(settings.seed, "survey/odometry"))
    odometry = chain(truth[0], steps)
    grid = GRID * focus(frames).distance
    clouds = [
        registration_cloud(frame, depth, grid) for frame, depth in zip(frames, depths, strict=True)
    ]
    edges = []
    for k in range(len(frames) - 1):
        on_stage("registration", k, len(frames) - 1)
        edge = register(clouds, k, k + 1, steps[k], grid, (1.0,))
        # A result far from odometry has slid along a smooth surface, or failed.
        trusted = agrees(edge.relative, steps[k], settings.drift, grid)
        edges.append(edge if trusted else replace(edge, relative=steps[k], registered=False))
    registered = chain(truth[0], np.stack([edge.relative for edge in edges]))
    loops = []
    candidates = loop_candidates(registered)
    for k, (i, j) in enumerate(candidates):
        on_stage("loop closure", k, len(candidates))
        guess = np.linalg.inv(registered[i]) @ registered[j]
        edge = register(clouds, i, j, guess, grid, (4.0, 2.0, 1.0))
        if edge.overlap >= CLOSURE_OVERLAP:
            loops.append(edge)
    optimised = optimise(registered, steps, edges, loops, settings.drift, grid)
    return Survey(truth, odometry, registered, optimised, depths, edges, loops)


def trajectory_error(poses: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Absolute trajectory error (Sturm et al. 2012) of poses [F,4,4] against true ones [F,4,4].
    ate_rms, ate_max: distance of the positions, metres; rotation_rms: degrees."""
    offset = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    turn = np.einsum("fki,fkj->fij", poses[:, :3, :3], truth[:, :3, :3])
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    return {
        "ate_rms": float(np.sqrt(np.mean(offset**2))),
        "ate_max": float(offset.max()),
        "rotation_rms": float(np.sqrt(np.mean(angle**2))),
    }


def survey_numbers(dataset: Dataset, survey: Survey, settings: SurveySettings) -> dict[str, Any]:
    """Contents of survey.json, lengths in metres. path_length: of the flight; depth_error_on_rock:
    robust standard deviation of the depth error in the rock's masks; returns_lost: share of pixels
    with true depth and no measured one; steps_by_odometry: number of failed registrations; loops:
    [i, j, overlap] each; error: `trajectory_error` of each of the STAGES."""
    error, returns, possible = [], 0, 0
    for frame, depth in zip(dataset.frames, survey.depths, strict=True):
        true = frame.depth()
        error.append((depth - true)[(depth > 0) & frame.mask()])
        returns += int((depth > 0).sum())
        possible += int((true > 0).sum())
    return {
        "frames": len(dataset.frames),
        "settings": asdict(settings),
        "path_length": float(np.linalg.norm(np.diff(survey.truth[:, :3, 3], axis=0), axis=1).sum()),
        "depth_error_on_rock": SIGMA_FROM_MAD * float(np.median(np.abs(np.concatenate(error)))),
        "returns_lost": 1 - returns / max(possible, 1),
        "steps_by_odometry": sum(not edge.registered for edge in survey.edges),
        "loops": [[edge.i, edge.j, edge.overlap] for edge in survey.loops],
        "error": {name: trajectory_error(getattr(survey, name), survey.truth) for name in STAGES},
    }
