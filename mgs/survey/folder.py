"""The folder that a survey is written to: itself a dataset, with estimated poses and measured
depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.clouds import SparseCloud, write_cloud
from mgs.data.dataset import Dataset, Frame, load_dataset, write_transforms
from mgs.files import copy_file, write_json
from mgs.images import write_exr
from mgs.survey import figure
from mgs.survey.flight import Survey, SurveySettings, survey_numbers
from mgs.survey.fusion import fuse_frames


def save_survey(
    out: Path, dataset: Dataset, survey: Survey, settings: SurveySettings
) -> dict[str, Any]:
    """Write everything that a survey gave into the folder `out`, and return what survey.json holds.

    That is the dataset of `write_survey`, its fused cloud cloud.ply, the numbers survey.json and
    the picture survey.png. Raises InputError as `fuse_frames`, and if a file cannot be written.
    """
    numbers = survey_numbers(dataset, survey, settings)
    cloud = fuse_frames(write_survey(out, dataset, survey).frames)
    numbers["points"] = len(cloud.points)
    write_cloud(out / "cloud.ply", SparseCloud(cloud.points, cloud.views))
    figure.draw_survey(out / "survey.png", dataset, survey, cloud, numbers)
    write_json(out / "survey.json", numbers)
    return numbers


def write_survey(out: Path, dataset: Dataset, survey: Survey) -> Dataset:
    """Write a survey of a dataset as another dataset, into the folder `out`, and load it.

    It has the images (the rock's too) and masks of the dataset surveyed, the depth images that were
    measured, the poses that were estimated, and the true rock (rock.glb) if there is one. Where the
    dataset surveyed is on demand, as the survey of an on-demand dataset is, no image is copied.
    Raises InputError if a file cannot be read or written.
    """
    frames = []
    for frame, pose, depth in zip(dataset.frames, survey.optimised, survey.depths, strict=True):
        estimated = replace(frame.camera, world_to_camera=np.linalg.inv(pose))
        # Files are named after their frame: only frames are sure to have different names.
        image = out / "images" / f"{frame.name}{frame.image_path.suffix}"
        mask = frame.mask_path and out / "masks" / f"{frame.name}{frame.mask_path.suffix}"
        rock = frame.rock_path and out / "rock" / f"{frame.name}{frame.rock_path.suffix}"
        measured = out / "depth" / f"{frame.name}.exr"
        if not frame.on_demand:
            copy_file(frame.image_path, image)
        if mask and frame.mask_path:
            copy_file(frame.mask_path, mask)
        if rock and frame.rock_path:
            copy_file(frame.rock_path, rock)
        write_exr(measured, {"Z": depth})
        frames.append(
            Frame(
                frame.name, estimated, frame.timestamp, image, measured, mask, rock, frame.on_demand
            )
        )
    truth = dataset.root / "rock.glb"
    if truth.is_file():
        copy_file(truth, out / "rock.glb")
    write_transforms(out, frames)
    return load_dataset(out)
