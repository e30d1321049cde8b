"""Which residual should a fit lower? `python benchmarks/residual.py OUT.json DATASET...`

Quality is measured on sRGB display values, and a fit lowers squared errors of linear ones, for
which the Fisher information is exact. To first order an sRGB error is a linear error times the
slope of the sRGB curve. So each pixel is weighted by that slope
at its target to a power: 0 is the linear residual, 1 the display residual, 1/2 lies between. Other
rows weight a pixel by one over the standard deviation of a camera's noise, whose variance grows
with the signal: constant + signal / electrons. Weights have a root mean square of 1 over the rock,
so that the prior weighs the same. The black background, where weights are largest, is weighted like
the rest or, in the other rows, by 1. Judged on the test views; means over the datasets.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.data.dataset import load_dataset, target_of
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.policy.criteria import lam_by_kind, regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.splat import ListCache, groups

DARKEST = 0.002
"""Linear value below which the weight grows no further."""
READ_NOISE = 0.002
"""Standard deviation of a camera's noise in the dark, linear RGB."""
VIEWS, GAUSSIANS = 12, 10_000

Weight = Callable[[np.ndarray], np.ndarray]


def slope(power: float, linear: np.ndarray) -> np.ndarray:
    """Derivative of the sRGB curve, to a power."""
    linear = np.maximum(linear, DARKEST)
    return (
        np.where(
            linear <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(linear, 0.0031308) ** (1 / 2.4 - 1)
        )
        ** power
    )


def camera(electrons: float, linear: np.ndarray) -> np.ndarray:
    """One over the standard deviation of READ_NOISE and shot noise, for so many electrons at a
    linear value of 1."""
    return 1 / np.sqrt(READ_NOISE**2 + np.maximum(linear, 0) / electrons)


WEIGHTS: dict[str, Weight] = {
    "linear": partial(slope, 0.0),
    "slope of sRGB to the power 0.5": partial(slope, 0.5),
    "slope of sRGB": partial(slope, 1.0),
    "noise of a camera, 10,000 electrons": partial(camera, 1e4),
    "noise of a camera, 1,000 electrons": partial(camera, 1e3),
}


def record(root: Path, name: str, background: str) -> dict[str, Any]:
    """One fit, and PSNR on the test views."""
    dataset, weigh = load_dataset(root), WEIGHTS[name]
    lam = lam_by_kind(regularisation(groups(0)), groups(0))
    prior, _ = build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))
    positions = np.array([frame.camera.position for frame in dataset.frames])
    frames = [dataset.frames[i] for i in seed_views(positions, prior.points.mean(0), VIEWS)]
    start, targets = initial_gaussians(prior, frames)[0], [target_of(frame) for frame in frames]
    for target in targets:
        target[..., 3] *= weigh(target[..., :3].mean(-1))
    rock = [frame.mask() for frame in frames]
    scale = np.sqrt(
        np.mean(np.concatenate([t[..., 3][r] for t, r in zip(targets, rock, strict=True)]) ** 2)
    )
    for frame, target in zip(frames, targets, strict=True):
        target[..., 3] /= scale
        if background == "one":
            target[frame.target()[0][..., 3] == 0, 3] = 1.0
    settings, cameras = TrainSettings(tolerance=0.0), [frame.camera for frame in frames]
    model = fit(
        start, cameras, targets, settings, cache=ListCache(), start=start, lam=lam
    ).gaussians
    means = evaluate(model, [], [], test_frames=dataset.test_views().frames)["test"]
    return {"name": name, "background": background} | {
        k: means[k] for k in ("psnr", "psnr_mask", "psnr_inside")
    }


def main(out: Path, roots: list[Path]) -> None:
    """Fit once for each weight, background and dataset; print, and write the means over the
    datasets."""
    runtime.start()
    records = []
    for name, background in [
        (name, background) for name in WEIGHTS for background in ("as the rest", "one")
    ][1:]:
        each = [record(root, name, background) for root in roots]
        found = {key: [r[key] for r in each] for key in ("psnr", "psnr_mask", "psnr_inside")}
        records.append({"name": name, "background": background, "each": found})
        records[-1] |= {key: float(np.mean(values)) for key, values in found.items()}
        print(records[-1], flush=True)
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(out, made | {"datasets": [root.as_posix() for root in roots], "records": records})


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(root) for root in sys.argv[2:]])
