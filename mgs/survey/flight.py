"""The survey: a flight along the dataset's orbit with a noisy depth camera and drifting odometry,
whose first pose is known and whose others are registered; and the folder of a survey, itself
a dataset, with estimated poses and measured depth. Poses are [4,4] camera-to-world, metres."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.clouds import SparseCloud, write_cloud
from mgs.data.dataset import TEST_FOLDER, Dataset, load_dataset, write_transforms
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.files import copy_file, write_json
from mgs.images import write_exr
from mgs.plotting import drawing
from mgs.progress import report
from mgs.seeds import generator
from mgs.survey.depth_sensor import SIGMA_FROM_MAD, noisy_depth
from mgs.survey.fusion import Cloud, focus, fuse_frames
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


def fly(dataset: Dataset, settings: SurveySettings) -> Survey:
    """Survey a dataset that has depth images. Raises InputError if there are fewer than three
    frames, or one has no depth image or too few returns to be registered."""
    frames = dataset.frames
    if len(frames) < 3:
        cure = "at least 3 are needed"
        raise InputError(f"{dataset.root}: {len(frames)} frames are too few for a survey; {cure}")
    depths = []
    for k, frame in enumerate(frames):
        report("depth", k, len(frames))
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
        report("registration", k, len(frames) - 1)
        edge = register(clouds, k, k + 1, steps[k], grid, (1.0,))
        # A result far from odometry has slid along a smooth surface, or failed.
        trusted = agrees(edge.relative, steps[k], settings.drift, grid)
        edges.append(edge if trusted else replace(edge, relative=steps[k], registered=False))
    registered = chain(truth[0], np.stack([edge.relative for edge in edges]))
    loops = []
    candidates = loop_candidates(registered)
    for k, (i, j) in enumerate(candidates):
        report("loop closure", k, len(candidates))
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


COLOURS = {"odometry": "#d1495b", "registered": "#edae49", "optimised": "#00798c"}  # of STAGES


def save_survey(
    out: Path, dataset: Dataset, survey: Survey, settings: SurveySettings
) -> dict[str, Any]:
    """Write a survey into the folder `out`: the dataset of `write_survey`, cloud.ply, survey.json
    and survey.png. Returns the contents of survey.json. Raises InputError as `fuse_frames`, and if
    a file cannot be written."""
    numbers = survey_numbers(dataset, survey, settings)
    cloud = fuse_frames(write_survey(out, dataset, survey).frames)
    numbers["points"] = len(cloud.points)
    leave = dataset.world.leave
    write_cloud(out / "cloud.ply", SparseCloud(leave(cloud.points), leave(cloud.views)))
    draw_survey(out / "survey.png", dataset, survey, cloud, numbers)
    write_json(out / "survey.json", numbers)
    return numbers


def write_survey(out: Path, dataset: Dataset, survey: Survey) -> Dataset:
    """Write a survey of a dataset as a dataset into the folder `out`, and load it. Images, masks,
    the true rock (rock.glb) and the test views, whose poses are exact, are copied, except images of
    on-demand frames; depth is measured and poses are estimated. Raises InputError if a file cannot
    be read or written."""
    frames = []
    for frame, pose, depth in zip(dataset.frames, survey.optimised, survey.depths, strict=True):
        path = out / "depth" / f"{frame.name}.exr"
        write_exr(path, {"Z": depth})
        camera = replace(frame.camera, world_to_camera=np.linalg.inv(pose))
        frames.append(replace(_copied(out, frame), camera=camera, depth_path=path))
    truth = dataset.root / "rock.glb"
    if truth.is_file():
        copy_file(truth, out / "rock.glb")
    if tests := dataset.test_views():
        folder = out / TEST_FOLDER
        copied = [replace(_copied(folder, frame), depth_path=None) for frame in tests.frames]
        write_transforms(folder, copied, dataset.world)
    write_transforms(out, frames, dataset.world)
    return load_dataset(out)


def _copied(out: Path, frame: Frame) -> Frame:
    """A frame with its image, masks and rock copied into folders of `out`."""
    # Files are named after their frame, since only frames are sure to have different names.
    paths: dict[str, Any] = {}
    for kind, field in (("images", "image_path"), ("masks", "mask_path"), ("rock", "rock_path")):
        path = getattr(frame, field)
        paths[field] = path and out / kind / f"{frame.name}{path.suffix}"
        if path and not (frame.on_demand and kind == "images"):
            copy_file(path, paths[field])
    return replace(frame, **paths)


def draw_survey(
    path: str | Path, dataset: Dataset, survey: Survey, cloud: Cloud, numbers: dict[str, Any]
) -> None:
    """Write the figure of a survey as a PNG, atomically. cloud: fused from the survey; numbers:
    from `survey_numbers`. Raises InputError if it cannot be written."""
    around = survey.truth[:, :3, 3].mean(0)
    reach = float(np.abs(survey.truth[:, :3, 3] - around).max())
    points = cloud.points[np.argsort(cloud.points[:, 2])]
    stride = max(1, len(points) // 120_000)
    with drawing(path, 8, 7, dpi=150) as figure:
        axes = figure.subplots(2, 2).ravel()
        _trajectories(axes[0], survey)
        _errors(axes[1], survey, numbers)
        _depth_error(axes[2], dataset, survey, numbers)
        x, y, z = points[::stride].T
        axes[3].scatter(x, y, c=z, s=0.4, cmap="viridis", linewidths=0, rasterized=True)
        axes[3].set(xlim=(around[0] - reach, around[0] + reach), xlabel="x, m", aspect="equal")
        axes[3].set(ylim=(around[1] - reach, around[1] + reach), ylabel="y, m")
        axes[3].set_title(f"{len(cloud.points):,} points from above, by height")


def _trajectories(axis, survey: Survey) -> None:
    axis.plot(*survey.truth[:, :2, 3].T, color="0.6", lw=5, label="truth", solid_capstyle="round")
    for name, colour in COLOURS.items():
        x, y = getattr(survey, name)[:, :2, 3].T
        axis.plot(x, y, ".-", color=colour, lw=1.2, ms=4, label=STAGES[name])
    for k, loop in enumerate(survey.loops):
        ends = survey.optimised[[loop.i, loop.j], :2, 3]
        axis.plot(*ends.T, color="k", lw=1.5, label="loop closures" if k == 0 else None)
    axis.plot(*survey.truth[0, :2, 3], "k^", ms=8, label="start")
    axis.set(aspect="equal", title="trajectory from above", xlabel="x, m", ylabel="y, m")
    axis.legend(fontsize=8, loc="center")


def _errors(axis, survey: Survey, numbers: dict[str, Any]) -> None:
    """Position error of every frame but the first, whose pose is known, log scale."""
    for name, colour in COLOURS.items():
        offset = np.linalg.norm(getattr(survey, name)[:, :3, 3] - survey.truth[:, :3, 3], axis=1)
        label = f"{STAGES[name]}: rms {1e3 * numbers['error'][name]['ate_rms']:.0f} mm"
        error = 1e3 * np.maximum(offset[1:], 1e-4)
        axis.semilogy(np.arange(1, len(offset)), error, color=colour, label=label)
    axis.set(title="position error against truth", xlabel="frame", ylabel="mm")
    axis.margins(y=0.25)
    axis.legend(fontsize=8, loc="lower right")


def _depth_error(axis, dataset: Dataset, survey: Survey, numbers: dict[str, Any]) -> None:
    depth, true = survey.depths[0], dataset.frames[0].depth()
    error = np.where((depth > 0) & (true > 0), 1e3 * (depth - true), np.nan)
    limit = max(3e3 * numbers["depth_error_on_rock"], 1.0)
    axis.set_facecolor("0.85")
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    picture = axis.imshow(error, cmap="RdBu", vmin=-limit, vmax=limit, interpolation="nearest")
    axis.figure.colorbar(picture, ax=axis, shrink=0.7, label="mm; blue: too far")
    loss = f"{numbers['returns_lost']:.0%} of all returns lost"
    axis.set(title=f"depth error of frame 0; grey: no return\n{loss}", xticks=[], yticks=[])
