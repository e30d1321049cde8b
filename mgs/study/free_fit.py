"""A fit as in 3D Gaussian splatting (Kerbl et al. 2023): the row of Table I for a model that is not
held to a surface.

The same: free means, SH degree 3, Adam with their learning rates, no prior, and 15,000 steps at the
paper's size. Different: the fit starts on the prior's surface, adds and removes no Gaussians, and
minimises the squared error instead of L1 and SSIM. All rates fall to a tenth.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import load_dataset, target_of
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.memory import IMAGE_BYTES, Deferred, kept_within
from mgs.prior.build import load_prior
from mgs.prior.initial import initial_gaussians
from mgs.report.evaluation import evaluate_model
from mgs.study.case import in_new_process, peak_megabytes, test_views_of

PASSES = 150
"""Passes over all images: 15,000 steps for the 100 images of the paper."""

DEGREE = 3
"""Degree of the spherical harmonics."""

RATES = {"colour": 2.5e-3, "scale": 5e-3, "rotation": 1e-3, "opacity": 5e-2}
"""Learning rates of Kerbl et al."""

MEAN_RATE = 1.6e-4
"""Learning rate of means, over the radius of the camera positions."""


def time_free_fit(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """Fit to all images in a new process; returns as `time_policy`, without a choice."""
    return in_new_process(_free_fit, out, root / dataset, root / prior, settings["seed"])


def _free_fit(dataset: Path, prior: Path, seed: int) -> dict[str, Any]:
    data, known = load_dataset(dataset), load_prior(prior)
    frames = list(data.frames)
    began = time.perf_counter()
    positions = np.array([frame.camera.position for frame in frames])
    radius = float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
    rates = RATES | {"mean": MEAN_RATE * radius}
    train = TrainSettings(
        means="free", optimiser="adam", passes=PASSES, tolerance=0, rates=rates, seed=seed
    )
    start = initial_gaussians(known, frames)[0].with_degree(DEGREE)
    kept = kept_within(IMAGE_BYTES, lambda i: target_of(frames[i]), lambda target: target.nbytes)
    targets = Deferred(range(len(frames)), kept)
    model = fit(start, [frame.camera for frame in frames], targets, train).gaussians
    seconds, peak = time.perf_counter() - began, peak_megabytes()
    tests = test_views_of(data).frames
    metrics = evaluate_model(model, frames, [frame.name for frame in frames], test_frames=tests)
    found = {key: metrics[key] for key in ("images", "test", "all", "held_out")}
    return found | {"seconds": seconds, "choice_seconds": None, "peak_megabytes": peak}
