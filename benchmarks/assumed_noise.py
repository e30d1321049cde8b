"""What the assumed noise of a pixel does to a whole run. `python benchmarks/assumed_noise.py
OUT.json DATASET:PRIOR...`

The noise sigma_e is assumed to be 0.02. It says how strongly a fit holds parameters to the prior,
and how much information a score takes a pixel for. Runs of `d-optimal`, four seeds and eight views,
in which the fit, the score or both assume another noise; and what can be measured of it while a run
goes on: by how much an image differs from the model that has not seen it yet (`residual` of
steps.jsonl). PSNR over the test views. Records that are in OUT.json are not made again.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.data.dataset import load_dataset
from mgs.files import write_json
from mgs.policy.criteria import PIXEL_NOISE
from mgs.prior.build import load_prior
from mgs.provenance import command_line, versions
from mgs.run.loop import Loop
from mgs.run.operations import operations_of, psnr_measure
from mgs.run.settings import NbvSettings
from mgs.splat import ListCache
from mgs.study.material import test_views_of

NOISES = (0.005, 0.01, 0.04, 0.08)
SEEDS, BUDGET = 4, 8
ASSUMED = [("as it is", PIXEL_NOISE, PIXEL_NOISE)]
ASSUMED += [("in the fit", noise, PIXEL_NOISE) for noise in NOISES]
ASSUMED += [("in the score", PIXEL_NOISE, noise) for noise in NOISES]
ASSUMED += [("in both", noise, noise) for noise in NOISES]
"""Where another noise is assumed; that of the fit, that of the score."""


def record(dataset_path: Path, prior_path: Path, of_fit: float, of_score: float) -> dict[str, Any]:
    """One run: PSNR of its last model, full frame and inside the mask, and the median of its
    residuals."""
    dataset, prior = load_dataset(dataset_path), load_prior(prior_path)
    settings = NbvSettings(
        dataset=dataset_path, prior=prior_path, seeds=SEEDS, budget=BUDGET, pixel_noise=of_fit
    )
    scored = settings.model_copy(update={"pixel_noise": of_score})
    stations = operations_of(dataset, prior, settings)
    with tempfile.TemporaryDirectory() as folder:
        loop = Loop(Path(folder), scored, dataset, stations, lambda stage, done, total: None)
        state = loop.first()
        while "ended" not in state.steps[-1]:
            state = loop.next(state)
    found = psnr_measure(test_views_of(dataset), ListCache())(state.gaussians, [])
    residuals = [step["residual"] for step in state.steps if "residual" in step]
    return {
        "taken": state.taken,
        "psnr": found["psnr"],
        "psnr_mask": found["psnr_mask"],
        "residual": float(np.median(residuals)),
    }


def main(out: Path, given: list[str]) -> None:
    """Make what is missing, write after every record."""
    runtime.start()
    records = json.loads(out.read_text())["records"] if out.is_file() else []
    for dataset, prior in (pair.split(":") for pair in given):
        for where, of_fit, of_score in ASSUMED:
            known = {"dataset": dataset, "where": where, "fit": of_fit, "score": of_score}
            if any(all(r[key] == value for key, value in known.items()) for r in records):
                continue
            records.append(known | record(Path(dataset), Path(prior), of_fit, of_score))
            print(records[-1], flush=True)
            made = {
                "command": command_line(),
                "machine": runtime.processor(),
                "versions": versions(),
            }
            write_json(out, made | {"records": records})


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
