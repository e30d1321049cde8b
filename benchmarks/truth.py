"""What the truth gives, and what the fit: `python benchmarks/truth.py OUT.json DATASET...`

The same fit is given three truths of its images, and judged on the test views against the first
two:

- alpha: the rock alone, rendered with a fractional alpha, in front of black (what a dataset of `mgs
synth-orbit` holds);
- mask: the whole image, cut out by a mask that is 0 or 1, all pixels of which count;
- outline left out: the same, with no weight in the pixels that the outline crosses (what data with
masks alone are fitted to).
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.colour import srgb_from_linear
from mgs.data.dataset import Frame, load_dataset, target_of
from mgs.errors import InputError
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.metrics import psnr
from mgs.policy.criteria import regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.splat import ListCache, as_drjit, groups, render

VIEWS, GAUSSIANS = 12, 10_000


def target(frame: Frame, truth: str) -> np.ndarray:
    """[H,W,4], colour and weight of the frame's pixels."""
    if truth == "alpha":
        return target_of(frame)
    of_mask = target_of(replace(frame, rock_path=None))
    if truth == "mask":
        of_mask[..., 3] = 1
    return of_mask


def study(root: Path) -> list[dict[str, Any]]:
    """One record for each truth that is fitted: PSNR against both that are whole, full frame and
    inside the mask."""
    dataset, lam = load_dataset(root), regularisation(groups(0))
    tests = dataset.test_views()
    if tests is None:
        raise InputError(
            f"{root}: has no test views; make it with `mgs synth-orbit --test-views 12`"
        )
    by_kind = {kind: float(lam[columns][0]) for kind, columns in groups(0).items()}
    prior, _ = build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))
    taken = seed_views(
        np.array([frame.camera.position for frame in dataset.frames]), prior.points.mean(0), VIEWS
    )
    frames = [dataset.frames[i] for i in taken]
    start, cameras = initial_gaussians(prior, frames)[0], [frame.camera for frame in frames]
    records = []
    for fitted in ("alpha", "mask", "outline left out"):
        targets = [target(frame, fitted) for frame in frames]
        model = as_drjit(
            fit(start, cameras, targets, cache=ListCache(), start=start, lam=by_kind).gaussians
        )
        drawn = [
            srgb_from_linear(np.asarray(render(model, frame.camera).rgb)) for frame in tests.frames
        ]
        record: dict[str, Any] = {"dataset": str(root), "fitted": fitted}
        for judge in ("alpha", "mask"):
            true = [srgb_from_linear(target(frame, judge)[..., :3]) for frame in tests.frames]
            pairs = list(zip(tests.frames, drawn, true, strict=True))
            record[judge] = float(np.mean([psnr(image, truth) for _, image, truth in pairs]))
            record[f"{judge}, inside"] = float(
                np.mean([psnr(image, truth, frame.mask()) for frame, image, truth in pairs])
            )
        records.append(record)
        print(record, flush=True)
    return records


def main(out: Path, roots: list[Path]) -> None:
    """Measure and write."""
    runtime.start()
    records = [record for root in roots for record in study(root)]
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
    main(Path(sys.argv[1]), [Path(root) for root in sys.argv[2:]])
