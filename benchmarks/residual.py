"""Which residual should a fit lower, of linear or of display values? `python benchmarks/residual.py DATASET OUT.json`

Quality is measured on sRGB display values, and a fit lowers squared errors of linear ones, for which the Fisher information is
exact. To first order an sRGB error is a linear error times the slope of the sRGB curve. So each pixel is weighted by that slope
at its target to a power: 0 is the linear residual, 1 the display residual, 1/2 lies between. Weights have a root mean square of
1 over the rock, so that the prior weighs the same. The black background, where the curve is steepest, is weighted like the rest
or, in the other rows, by 1. Judged on the test views.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.active.criteria import regularisation
from mgs.active.fitting import fit
from mgs.active.pose_policies import seed_views
from mgs.active.settings import TrainSettings
from mgs.data.dataset import load_dataset, target_of
from mgs.files import write_json
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.splat import ListCache, groups

POWERS = (0.0, 0.5, 1.0)
DARKEST = 0.002
"""Linear value below which the weight grows no further."""
VIEWS, GAUSSIANS = 12, 10_000


def slope(linear: np.ndarray) -> np.ndarray:
    """Derivative of the sRGB curve."""
    return np.where(linear <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(linear, 0.0031308) ** (1 / 2.4 - 1))


def main(root: Path, out: Path) -> None:
    """Fit once for each power and background; print and write the means over the test views."""
    runtime.start()
    tests = load_dataset(root).test_views().frames
    dataset, lam, cache = load_dataset(root), regularisation(groups(0)), ListCache()
    by_kind = {kind: float(lam[columns][0]) for kind, columns in groups(0).items()}
    prior, _ = build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))
    positions = np.array([frame.camera.position for frame in dataset.frames])
    frames = [dataset.frames[i] for i in seed_views(positions, prior.points.mean(0), VIEWS)]
    start = initial_gaussians(prior, frames)[0]
    records: list[dict[str, Any]] = []
    for power, background in [(power, background) for power in POWERS for background in ("as the rest", "one")][1:]:
        targets = []
        for frame in frames:
            target = target_of(frame)
            weight = slope(np.maximum(target[..., :3].mean(-1), DARKEST)) ** power
            targets.append(np.dstack([target[..., :3], target[..., 3] * weight]))
        rock = [frame.mask() for frame in frames]
        scale = np.sqrt(np.mean(np.concatenate([t[..., 3][r] for t, r in zip(targets, rock, strict=True)]) ** 2))
        for target, frame in zip(targets, frames, strict=True):
            target[..., 3] /= scale
            if background == "one":
                target[frame.target()[0][..., 3] == 0, 3] = 1.0
        cameras = [frame.camera for frame in frames]
        found = fit(start, cameras, targets, TrainSettings(tolerance=0.0), cache=cache, start=start, lam=by_kind).gaussians
        means = evaluate(found, [], [], test_frames=tests)["test"]
        records.append({"power": power, "background": background} | {k: means[k] for k in ("psnr", "psnr_mask", "psnr_inside")})
        print(records[-1], flush=True)
    write_json(out, {"command": command_line(), "machine": runtime.processor(), "versions": versions(), "records": records})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
