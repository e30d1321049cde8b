"""A fit as in 3D Gaussian splatting (Kerbl et al. 2023): a row of Table I for a model that is not
held to a surface.

As theirs: means that move freely, SH degree 3, Adam and its learning rates, no prior, and at the
paper's size 15,000 steps. Not
as theirs: it starts on the prior's surface, in the colours of all images, adds and removes no
Gaussians, and lowers the squared error, as all fits here do, instead of L1 and SSIM.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import Frame, load_dataset, target_of
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.memory import IMAGE_BYTES, Deferred, kept_within
from mgs.prior.build import load_prior
from mgs.prior.initial import initial_gaussians
from mgs.study.sweep import cell_folder
from mgs.study.tasks import dataset_of, in_own_process, peak_megabytes

PASSES = 150
"""Over all images: 15,000 steps for the 100 images of the paper."""

DEGREE = 3
"""Of the spherical harmonics."""

RATES = {"colour": 2.5e-3, "scale": 5e-3, "rotation": 1e-3, "opacity": 5e-2}
"""Learning rates of Kerbl et al.; they hold those of all but the means constant, here all fall to a
tenth."""

MEAN_RATE = 1.6e-4
"""The same for means, over the radius of the cameras' positions."""


def time_free_fit(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """A fit to all images of a dataset. Returns and raises what `mgs.study.tasks.time_policy` does;
    no choice is made."""
    return in_own_process(
        _free_fit,
        out,
        dataset_of(root, dataset),
        cell_folder(root, prior) / "prior",
        settings["seed"],
    )


def _free_fit(dataset: Path, prior: Path, seed: int) -> dict[str, Any]:
    from mgs.report.evaluation import evaluate

    data, known = load_dataset(dataset), load_prior(prior)
    frames, tests = list(data.frames), data.test_views()
    began = time.perf_counter()
    positions = np.array([frame.camera.position for frame in frames])
    radius = float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
    rates = RATES | {"mean": MEAN_RATE * radius}
    train = TrainSettings(
        means="free", optimiser="adam", passes=PASSES, tolerance=0, rates=rates, seed=seed
    )
    start = initial_gaussians(known, frames)[0].with_degree(DEGREE)
    kept = kept_within(IMAGE_BYTES, lambda i: target_of(frames[i]), lambda target: target.nbytes)
    model = fit(
        start, [frame.camera for frame in frames], Deferred(range(len(frames)), kept), train
    ).gaussians
    seconds, peak = time.perf_counter() - began, peak_megabytes()
    test_frames: tuple[Frame, ...] = tests.frames if tests else ()
    metrics = evaluate(model, frames, [frame.name for frame in frames], test_frames=test_frames)
    found = {key: metrics[key] for key in ("images", "test", "all", "held_out")}
    return found | {"seconds": seconds, "choice_seconds": None, "peak_megabytes": peak}
