"""Does alpha as a channel help where data are wrong? `python benchmarks/alpha_faults.py OUT.json
NAME=DATASET...`

Fits of 10,000 Gaussians to 12 views spread evenly in azimuth, with alpha as a fourth channel of a
pixel and without: on data as they are, with the small faults of `mgs stress` in images, poses,
masks or prior, and with masks of zeros and ones in place of fractional alphas. Judged on the test
views, which no fault touches.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.data.dataset import Dataset, load_dataset, target_of
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.policy.criteria import lam_by_kind, regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import Prior, build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.run.operations import psnr_measure
from mgs.seeds import generator
from mgs.splat import ListCache, groups
from mgs.study.stress.faults import IMAGE_FAULTS, PRIOR_FAULTS, Captured, captured

VIEWS, GAUSSIANS, WEIGHTS = 12, 10_000, (0.0, 0.1)
FAULTS = {"none": 0.0, "masks of zeros and ones": 0.0} | {
    name: sizes[0]
    for table in (IMAGE_FAULTS, PRIOR_FAULTS)
    for name, (_, sizes) in table.items()
    if name != "missing depth"
}
"""By name: the size of the fault, the smallest one of `mgs stress`. Missing depth changes the
colours of a start alone."""


def spoiled(fault: str, frames: Sequence[Captured], prior: Prior) -> tuple[list[Captured], Prior]:
    """The frames and the prior with a fault."""
    rng, size = generator(0, f"alpha_faults/{fault}"), FAULTS[fault]
    if fault in PRIOR_FAULTS:
        return list(frames), PRIOR_FAULTS[fault][0](prior, size, rng)
    if fault == "none":
        return list(frames), prior
    change = IMAGE_FAULTS[fault][0] if fault in IMAGE_FAULTS else jagged
    return [change(frame, size, rng) for frame in frames], prior


def jagged(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """The frame with its rock cut out of the image by the dataset's own mask."""
    alpha = frame.rock.astype(np.float32)[..., None]
    return replace(
        frame, rgba=np.concatenate([frame.pixels * alpha, alpha], axis=-1, dtype=np.float32)
    )


def fitted(frames: Sequence[Captured], prior: Prior, weight: float) -> Any:
    """The Gaussians that `mgs nbv` would fit to all these frames at once."""
    start = initial_gaussians(prior, frames)[0]
    lam = lam_by_kind(regularisation(groups(0)), groups(0))
    cameras, targets = (
        [frame.camera for frame in frames],
        [target_of(frame, True) for frame in frames],
    )
    settings = TrainSettings(alpha_weight=weight, tolerance=0.0)
    return fit(start, cameras, targets, settings, cache=ListCache(), start=start, lam=lam).gaussians


def study(dataset: Dataset) -> list[dict[str, Any]]:
    """A record for each fault and weight."""
    prior, _ = build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))
    positions = np.array([frame.camera.position for frame in dataset.frames])
    frames = [
        captured(dataset.frames[i]) for i in seed_views(positions, prior.points.mean(0), VIEWS)
    ]
    measured, records = psnr_measure(dataset.test_views(), ListCache()), []
    for fault, size in FAULTS.items():
        given = spoiled(fault, frames, prior)
        for weight in WEIGHTS:
            quality = measured(fitted(*given, weight), [])
            records.append({"fault": fault, "size": size, "alpha_weight": weight} | quality)
            print(records[-1], flush=True)
    return records


def main(out: Path, *datasets: str) -> None:
    """Measure and write."""
    runtime.start()
    named = {
        name: load_dataset(Path(root))
        for name, _, root in (entry.partition("=") for entry in datasets)
    }
    scenes = {name: study(dataset) for name, dataset in named.items()}
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(out, made | {"scenes": scenes})


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
