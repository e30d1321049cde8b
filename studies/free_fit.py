"""3D Gaussian splatting (Kerbl et al. 2023): the rows of Table I for a model that no surface holds.

As in the authors' program: round, nearly transparent Gaussians at points, L1 and D-SSIM of sRGB
values, Adam with their learning rates, adaptive density, and a degree of the spherical harmonics
more every 1,000 steps. The points are those of the prior, or random inside the masks.

Different: colours are blended in linear RGB, and density changes at the ends of passes. In fits of
less than 30,000 steps it changes during the first half of the steps.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from mgs.camera import extent_of
from mgs.data.dataset import load_dataset, target_of
from mgs.evaluation import evaluate_model
from mgs.fit.fitting import fit_gaussians
from mgs.fit.settings import TrainSettings, as_3dgs
from mgs.memory import IMAGE_BYTES, Deferred, kept_within
from mgs.prior.build import load_prior
from mgs.prior.initial import round_gaussians
from mgs.prior.scattered import scattered
from mgs.prior.settings import PriorSettings
from studies.case import in_new_process, peak_megabytes, test_views_of

PASSES = 150
"""Passes over all images: 15,000 steps for the 100 images of the paper."""

DEGREE = 3
"""Degree of the spherical harmonics."""


def time_3dgs(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """Fit to all images from the prior's points, in a new process; returns as `time_policy`,
    without a choice. settings: "seed"; "passes", over PASSES, by default 1; "random": whether as
    many random points take the place of the prior's."""
    return in_new_process(_fit, out, root / dataset, root / prior, settings)


def _fit(dataset: Path, prior: Path, settings: dict[str, Any]) -> dict[str, Any]:
    data, seed = load_dataset(dataset), settings["seed"]
    frames, points = list(data.frames), load_prior(prior).points
    if settings.get("random"):
        points = scattered(data, PriorSettings(gaussians=len(points), seed=seed))[1]
    began = time.perf_counter()
    cameras = [frame.camera for frame in frames]
    passes = settings.get("passes", 1) * PASSES
    train = TrainSettings(**as_3dgs(extent_of(cameras)), passes=passes, seed=seed)
    start = round_gaussians(points, frames, linear=False)[0].with_degree(DEGREE)
    start = replace(start, antialiased=train.antialiased)
    kept = kept_within(IMAGE_BYTES, lambda i: target_of(frames[i]), lambda target: target.nbytes)
    targets = Deferred(range(len(frames)), kept)
    model = fit_gaussians(start, cameras, targets, train).gaussians
    seconds, peak = time.perf_counter() - began, peak_megabytes()
    tests = test_views_of(data).frames
    metrics = evaluate_model(model, frames, [frame.name for frame in frames], test_frames=tests)
    found = {key: metrics[key] for key in ("images", "test", "all", "held_out")}
    more = {"seconds": seconds, "choice_seconds": None, "peak_megabytes": peak}
    return found | more | {"gaussians": len(model)}
