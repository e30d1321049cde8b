"""How far below the prior's surface should Gaussians lie? `python benchmarks/inset.py OUT.json
DATASET...`

Fits Gaussians to 12 views spread evenly in azimuth, as `mgs nbv` does it, from several depths below
the surface, in pixels, and
judges on the test views: PSNR, in the full frame, in the mask and wholly inside the rock; median
error of the depth inside, and its median with the sign, positive where the model lies behind the
true surface. Datasets need exact depth, and test views.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.data.dataset import Dataset, load_dataset, target_of
from mgs.errors import InputError
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.gaussians import Gaussians
from mgs.policy.criteria import regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import build_prior
from mgs.prior.initial import INSET, initial_gaussians, pixel_on
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate, render_view
from mgs.splat import ListCache, groups

VIEWS = 12
SIZES = (2_500, 10_000, 40_000)
INSETS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""In pixels on the rock."""


def bias(model: Gaussians, tests: Dataset) -> float:
    """Median of rendered less true depth over the pixels inside the rock in all test views,
    metres."""
    found = []
    for frame in tests.frames:
        _, alpha, depth = render_view(model, frame.camera)
        true = frame.depth()
        inside = frame.mask() & (alpha > 0.5) & (true > 0)
        found.append((depth - true)[inside])
    return float(np.median(np.concatenate(found)))


def study(root: Path) -> list[dict[str, Any]]:
    """One record for each of SIZES and INSETS."""
    dataset = load_dataset(root)
    tests = dataset.test_views()
    if tests is None:
        raise InputError(
            f"{root}: has no test views; make it with `mgs synth-orbit --test-views 12`"
        )
    lam = {
        kind: float(regularisation(groups(0))[columns][0]) for kind, columns in groups(0).items()
    }
    records = []
    for n in SIZES:
        prior, _ = build_prior(dataset, PriorSettings(gaussians=n))
        taken = seed_views(
            np.array([frame.camera.position for frame in dataset.frames]),
            prior.points.mean(0),
            VIEWS,
        )
        frames = [dataset.frames[i] for i in taken]
        cameras, targets = (
            [frame.camera for frame in frames],
            [target_of(frame) for frame in frames],
        )
        for inset in INSETS:
            start = initial_gaussians(prior, frames, inset)[0]
            model = fit(start, cameras, targets, cache=ListCache(), start=start, lam=lam).gaussians
            found = evaluate(model, tests.frames, ())["all"]
            kept = {
                key: found[key]
                for key in (
                    "psnr",
                    "psnr_mask",
                    "psnr_inside",
                    "ssim_mask",
                    "depth_error",
                    "see_through",
                )
            }
            about = {
                "gaussians": n,
                "inset": inset,
                "spacing": prior.spacing,
                "pixel": pixel_on(prior, cameras),
            }
            records.append(about | {"bias": bias(model, tests)} | kept)
            print(root, records[-1], flush=True)
    return records


def main(out: Path, *roots: Path) -> None:
    """Measure and write; the figure is drawn beside it."""
    runtime.start()
    scenes = [{"dataset": str(root), "records": study(root)} for root in roots]
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(out, made | {"default": INSET, "scenes": scenes})


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
