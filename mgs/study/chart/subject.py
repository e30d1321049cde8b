"""The data that the charts measure on: cells that make datasets and priors, and how good a model is
on the test views."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mgs.data.dataset import Dataset
from mgs.gaussians import Gaussians
from mgs.study.material import made_dataset, made_prior, test_views_of

QUALITIES = ("psnr", "ssim", "psnr_mask", "ssim_mask")
"""What is reported of the test views; `mgs.metrics`."""

SPP = 8
"""Samples per pixel of the data, denoised: those of the preset `quick` of `mgs synth-orbit`."""


def make_dataset(
    root: Path, out: Path, scene: str, width: int, height: int, frames: int, test_views: int
) -> dict[str, Any]:
    """Render a scene into the folder `data` of the cell, as `mgs synth-orbit` does."""
    from mgs.synth.rendering import RenderPreset

    made_dataset(
        out / "data", scene, RenderPreset(width, height, frames, SPP), test_views=test_views
    )
    return {"frames": frames, "test_views": test_views}


def make_prior(root: Path, out: Path, dataset: str, density: float) -> dict[str, Any]:
    """Build a prior of so many samples per pixel into the folder `prior` of the cell; tells its
    number of Gaussians."""
    prior = made_prior(out / "prior", root / dataset, density=density)
    return {"gaussians": len(prior.points) + prior.backed, "spacing": prior.spacing}


def quality(gaussians: Gaussians, dataset: Dataset) -> dict[str, float]:
    """Mean of QUALITIES over the test views. Raises InputError as `test_views_of`."""
    from mgs.report.evaluation import evaluate

    means = evaluate(gaussians, (), (), test_frames=test_views_of(dataset).frames)["test"]
    return {name: means[name] for name in QUALITIES}
