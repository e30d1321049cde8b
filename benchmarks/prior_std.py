"""How tight should the prior on the parameters be? `python benchmarks/prior_std.py DATASET
OUT.json`

Fits 10,000 Gaussians to 12 views spread evenly in azimuth, with the prior's standard deviations tau
times several factors, and
judges on the other views of the orbit and on the test views: PSNR, in the full frame and inside the
rock; share of the rock's pixels whose expected depth is more than 3 spacings too deep, or whose
opacity is below 0.9; and the share of Gaussians that are needles, more than 4 times as long as
broad. The dataset needs exact depth, and test views.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.data.dataset import load_dataset, target_of
from mgs.errors import InputError
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.settings import PASSES, TrainSettings
from mgs.gaussians import Gaussians
from mgs.policy.criteria import PRIOR_STD, regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.splat import ListCache, groups

GAUSSIANS, VIEWS = 10_000, 12
CASES = (
    (1.0, tuple(PRIOR_STD), PASSES),
    (4.0, ("scale", "rotation"), PASSES),
    (2.0, ("scale", "rotation"), PASSES),
    (0.5, ("scale", "rotation"), PASSES),
    (2.0, ("scale",), PASSES),
    (2.0, ("rotation",), PASSES),
    (0.5, ("rotation",), PASSES),
    (0.25, ("opacity",), PASSES),
    (0.25, ("colour",), PASSES),
    (1.0, tuple(PRIOR_STD), 4 * PASSES),
    (4.0, ("scale", "rotation"), 4 * PASSES),
)
"""A factor of tau, the kinds of parameter that it is for, and the passes of the fit."""
NEEDLE = 4.0
"""Longest over middle standard deviation."""


def needles(model: Gaussians) -> float:
    """Share of Gaussians that are longer than NEEDLE times their breadth."""
    _, middle, longest = np.sort(np.exp(model.log_scales), axis=1).T
    return float((longest > NEEDLE * middle).mean())


def study(root: Path) -> list[dict[str, Any]]:
    """One record for each of CASES."""
    dataset, cache = load_dataset(root), ListCache()
    prior, _ = build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))
    taken = seed_views(
        np.array([frame.camera.position for frame in dataset.frames]), prior.points.mean(0), VIEWS
    )
    frames = [dataset.frames[i] for i in taken]
    tests = dataset.test_views()
    if tests is None:
        raise InputError(
            f"{root}: has no test views; make it with `mgs synth-orbit --test-views 12`"
        )
    start, names = initial_gaussians(prior, frames)[0], [frame.name for frame in frames]
    records = []
    for factor, kinds, passes in CASES:
        std = {kind: tau * (factor if kind in kinds else 1) for kind, tau in PRIOR_STD.items()}
        lam = {
            kind: float(regularisation(groups(0), prior_std=std)[columns][0])
            for kind, columns in groups(0).items()
        }
        train = TrainSettings(passes=passes, tolerance=0.0)
        cameras, targets = (
            [frame.camera for frame in frames],
            [target_of(frame) for frame in frames],
        )
        model = fit(start, cameras, targets, train, cache=cache, start=start, lam=lam).gaussians
        found = evaluate(model, dataset.frames, names, spacing=prior.spacing)["held_out"]
        kept = {key: found[key] for key in ("psnr", "psnr_inside", "too_deep_3", "see_through")}
        found = evaluate(model, tests.frames, ())["all"]
        kept |= {f"test_{key}": found[key] for key in ("psnr", "psnr_inside")}
        records.append(
            {"factor": factor, "kinds": kinds, "passes": passes, "needles": needles(model), **kept}
        )
        print(records[-1], flush=True)
    return records


def main(root: Path, out: Path) -> None:
    """Measure and write."""
    runtime.start()
    records = study(root)
    write_json(
        out,
        {
            "command": command_line(),
            "machine": runtime.processor(),
            "versions": versions(),
            "records": records,
        },
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
