"""What wrong poses cost, and what their refinement wins back (`mgs fit --refine-poses`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mgs import runtime
from mgs.data.dataset import load_dataset
from mgs.evaluation import psnr_measure
from mgs.fit.poses import displaced
from mgs.fit.settings import PoseNoise
from mgs.learning import refine_poses
from mgs.prior.build import load_prior
from mgs.scene import Scene
from mgs.seeds import generator
from mgs.splat import ListCache
from studies.frame.output import table, write_table
from studies.frame.program import Options, Study, Work, study_of

VIEWS = 12
"""Views that are fitted, spread evenly."""

DEGREES, CENTIMETRES = 0.25, 0.25
"""Noise of a pose: of the turn about each axis of the camera, and of the position along it."""


def measured(folder: Path) -> dict[str, str | float]:
    """PSNR over the test views, dB, of fits to exact and to noisy poses, as given and refined.

    folder: a dataset with its prior in prior/. Test views keep their exact poses. Raises InputError
    as `load_dataset`.
    """
    data, prior = load_dataset(folder), load_prior(folder / "prior")
    rng, std = (
        generator(0, f"poses/{folder.name}"),
        [np.radians(DEGREES)] * 3 + [0.01 * CENTIMETRES] * 3,
    )
    whole = Scene(data, prior)
    exact = tuple(data.frames[i] for i in whole.seeds(VIEWS))
    noisy = tuple(replace(f, camera=displaced(f.camera, rng.normal(0, std))) for f in exact)
    measure = psnr_measure(data, ListCache())
    row: dict[str, str | float] = {"rock": folder.name}
    for name, frames in (("exact", exact), ("noisy", noisy)):
        scene = Scene(replace(data, frames=frames), prior, whole.settings)
        for how in ("given", "refined"):
            if how == "refined":
                frames = refine_poses(scene, PoseNoise())
            model = scene.fitted(scene.start(frames), frames).gaussians
            row[f"{name}, {how}"] = measure(model, [])["test_psnr"]
    return row


def write(work: Work) -> list[Path]:
    """Write OUT/poses.csv, poses.json and poses.md, which is printed."""
    runtime.start()
    rows = [measured(folder) for folder in work.options.dataset]
    columns = {name: name if name == "rock" else f"{name}:.2f" for name in rows[0]}
    return write_table(work, "poses", rows, table(columns, rows))


OPTIONS: Options = {
    "out": {"type": Path, "help": "Folder for the table."},
    "dataset": {"nargs": "+", "type": Path, "help": "Folders of datasets with a prior."},
}
STUDY = Study("poses", __doc__, write, options=OPTIONS)

if __name__ == "__main__":
    study_of("poses")()
