"""The folder of a survey: itself a dataset, with estimated poses and measured depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.clouds import SparseCloud, write_cloud
from mgs.data.dataset import Dataset, load_dataset, write_transforms
from mgs.files import copy_file, write_json
from mgs.images import write_exr
from mgs.survey import figure
from mgs.survey.flight import Survey, SurveySettings, survey_numbers
from mgs.survey.fusion import fuse_frames


def save_survey(
    out: Path, dataset: Dataset, survey: Survey, settings: SurveySettings
) -> dict[str, Any]:
    """Write a survey into the folder `out`: the dataset of `write_survey`, cloud.ply, survey.json
    and survey.png. Returns the contents of survey.json.

    Raises InputError as `fuse_frames`, and if a file cannot be written.
    """
    numbers = survey_numbers(dataset, survey, settings)
    cloud = fuse_frames(write_survey(out, dataset, survey).frames)
    numbers["points"] = len(cloud.points)
    write_cloud(out / "cloud.ply", SparseCloud(cloud.points, cloud.views))
    figure.draw_survey(out / "survey.png", dataset, survey, cloud, numbers)
    write_json(out / "survey.json", numbers)
    return numbers


def write_survey(out: Path, dataset: Dataset, survey: Survey) -> Dataset:
    """Write a survey of a dataset as a dataset into the folder `out`, and load it.

    Images, masks and the true rock (rock.glb) are copied, except images of on-demand frames; depth
    is measured and poses are estimated. Raises InputError if a file cannot be read or written.
    """
    frames = []
    for frame, pose, depth in zip(dataset.frames, survey.optimised, survey.depths, strict=True):
        # Files are named after their frame, since only frames are sure to have different names.
        paths: dict[str, Any] = {}
        fields = {"images": "image_path", "masks": "mask_path", "rock": "rock_path"}
        for kind, field in fields.items():
            path = getattr(frame, field)
            paths[field] = path and out / kind / f"{frame.name}{path.suffix}"
            if path and not (frame.on_demand and kind == "images"):
                copy_file(path, paths[field])
        measured = out / "depth" / f"{frame.name}.exr"
        write_exr(measured, {"Z": depth})
        camera = replace(frame.camera, world_to_camera=np.linalg.inv(pose))
        frames.append(replace(frame, camera=camera, depth_path=measured, **paths))
    truth = dataset.root / "rock.glb"
    if truth.is_file():
        copy_file(truth, out / "rock.glb")
    write_transforms(out, frames)
    return load_dataset(out)
