"""The folder of a survey: itself a dataset, with estimated poses and measured depth; its figure."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.clouds import SparseCloud, write_cloud
from mgs.data.dataset import TEST_FOLDER, Dataset, load_dataset, write_transforms
from mgs.data.frames import Frame
from mgs.files import copy_file, write_json
from mgs.images import write_exr
from mgs.plotting import drawing
from mgs.survey.flight import STAGES, Survey, SurveySettings, survey_numbers
from mgs.survey.fusion import Cloud, fuse_frames

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
    with drawing(path, 17, 4.4, dpi=100) as figure:
        axes = figure.subplots(1, 4, gridspec_kw={"width_ratios": [1.1, 1, 1, 1.1]})
        _trajectories(axes[0], survey)
        _errors(axes[1], survey, numbers)
        _depth_error(axes[2], dataset, survey, numbers)
        x, y, z = points[::stride].T
        axes[3].scatter(x, y, c=z, s=0.4, cmap="viridis", linewidths=0, rasterized=True)
        axes[3].set(xlim=(around[0] - reach, around[0] + reach), xlabel="x, m", aspect="equal")
        axes[3].set(ylim=(around[1] - reach, around[1] + reach), ylabel="y, m")
        axes[3].set_title(f"fused cloud from above: {len(cloud.points):,} points")


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
