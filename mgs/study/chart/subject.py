"""The data that the charts measure on: cells that make datasets and priors, and how good a model is on the test views."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from mgs.data.dataset import Dataset, load_dataset
from mgs.errors import InputError
from mgs.gaussians import Gaussians

QUALITIES = ("psnr", "ssim", "psnr_mask", "ssim_mask")
"""What is reported of the test views; `mgs.metrics`."""

SPP = 8
"""Samples per pixel of the data, denoised: those of the preset `quick` of `mgs synth-orbit`."""


def make_dataset(root: Path, out: Path, scene: str, width: int, height: int, frames: int, test_views: int) -> dict[str, Any]:
    """Render a scene into the folder `data` of the cell, as `mgs synth-orbit` does."""
    from mgs.synth.rendering import Preset, synthesise

    folder = out / "data"
    if not (folder / "transforms.json").is_file():
        synthesise(folder, scene, Preset(width, height, frames, SPP), test_views=test_views)
    return {"frames": frames, "test_views": test_views}


def make_prior(root: Path, out: Path, dataset: str, density: float) -> dict[str, Any]:
    """Build a prior of so many samples per pixel into the folder `prior` of the cell; tells its number of Gaussians."""
    from mgs.prior.build import build_prior, save_prior
    from mgs.prior.settings import PriorSettings

    shutil.rmtree(out / "prior", ignore_errors=True)  # what an interrupted call left
    prior, _ = build_prior(load_dataset(root / dataset), PriorSettings(density=density))
    save_prior(out / "prior", prior)
    return {"gaussians": len(prior.points) + prior.backed, "spacing": prior.spacing}


def test_views_of(dataset: Dataset) -> Dataset:
    """Its test views. Raises InputError where it has none."""
    tests = dataset.test_views()
    if tests is None:
        raise InputError(f"{dataset.root}: has no test views, by which the charts judge; make them with `--test-views`")
    return tests


def quality(gaussians: Gaussians, dataset: Dataset) -> dict[str, float]:
    """Mean of QUALITIES over the test views. Raises InputError as `test_views_of`."""
    from mgs.report.evaluation import evaluate

    means = evaluate(gaussians, (), (), test_frames=test_views_of(dataset).frames)["test"]
    return {name: means[name] for name in QUALITIES}
