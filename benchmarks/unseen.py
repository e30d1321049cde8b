"""What would it save, and cost, to leave out of a fit's images what they do not see?

`python benchmarks/unseen.py OUT.json WORK DATASET:N:BUDGET ...`

In any one image half of the Gaussians lie behind others. A fit measures the exact information of
each image at its start and every tenth pass, as the metric of its steps (`mgs.fit.optimisers`);
here that also says which Gaussians the image tells
anything about, and the steps that follow leave out the others: those of which no entry of the
information is above a limit.

For every dataset, runs with a prior of N Gaussians, four seeds and BUDGET further views, evenly
spread, so that all runs take the same, for each of LIMITS; None draws all, as `mgs nbv` does. Told
is the share of the Gaussians that eight images see of the last model, the seconds of all fits, and
how good the model is on the test views. A run is made anew each time, since its seconds count; let
nothing else run.
"""

from __future__ import annotations

import shutil
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.camera import Camera
from mgs.data.dataset import load_dataset
from mgs.files import write_json
from mgs.fit import objective
from mgs.fit.settings import COLOURS_ALONE
from mgs.gaussians import Gaussians
from mgs.memory import padded
from mgs.prior.build import build_prior, save_prior
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.run.nbv import run_nbv
from mgs.splat import fisher

UNSEEN = (0.5 / 255) ** 2
"""(linear RGB / unit of a parameter)^2. Where all entries of a Gaussian are below it, a parameter
that is changed by a unit
changes the image by less than half a step of 8 bits: so much is the root of the summed squares over
all pixels."""

LIMITS = (None, 0.0, 1e-6, UNSEEN, 1e-5, 1e-4, 1e-3)


class LeavingOut:
    """While it is entered, fits leave out what is below a limit."""

    def __init__(self, limit: float) -> None:
        self.limit, self.seen = limit, dict[bytes, Any]()
        self.before = objective.fisher, objective.Objective.lists

    def __enter__(self) -> None:
        import drjit as dr
        import mitsuba as mi

        measured, (fisher, _) = self.seen, self.before

        def and_remembered(model: Gaussians, camera: Camera, **options: Any) -> np.ndarray:
            found = fisher(model, camera, **options)
            measured[camera.key] = mi.Bool(padded((found > self.limit).any(axis=1), bool))
            return found

        def lists(goal: objective.Objective, model: Gaussians, photo: objective.Photo) -> Any:
            splats = objective._project(model, photo.array)
            visible = splats.visible & measured[photo.camera.key]
            dr.eval(visible)
            return goal.cache.get(photo.camera, replace(splats, visible=visible))

        objective.fisher, objective.Objective.lists = and_remembered, lists  # type: ignore[method-assign]

    def __exit__(self, *_: object) -> None:
        objective.fisher, objective.Objective.lists = self.before  # type: ignore[method-assign]


def study(work: Path, root: Path, gaussians: int, budget: int) -> list[dict[str, Any]]:
    """A record for each of LIMITS."""
    prior, dataset, records = work / "prior", load_dataset(root), []
    if not prior.is_dir():
        save_prior(prior, build_prior(dataset, PriorSettings(gaussians=gaussians))[0])
    shutil.rmtree(work / "warm-up", ignore_errors=True)
    given = {"prior": prior, "policy": "uniform", "train": COLOURS_ALONE}
    run_nbv(root, work / "warm-up", budget=1, **given)  # compiles the kernels
    for limit in LIMITS:
        run = work / "run"
        shutil.rmtree(run, ignore_errors=True)
        with nullcontext() if limit is None else LeavingOut(limit):
            state = run_nbv(root, run, budget=budget, evaluate_every=budget, **given)
        least = -1.0 if limit is None else limit
        seen = [
            (fisher(state.gaussians, dataset.frames[i].camera) > least).any(axis=1).mean()
            for i in state.taken[:8]
        ]
        last = state.steps[-1]
        record = {
            "limit": limit,
            "seen": float(np.mean(seen)),
            "fit": sum(step["seconds"]["fit"] for step in state.steps),
        }
        records.append(
            {"gaussians": gaussians}
            | record
            | {key: last[key] for key in ("test_psnr", "test_psnr_mask")}
        )
        print(records[-1], flush=True)
    return records


def main(out: Path, work: Path, datasets: list[str]) -> None:
    """Run, measure and write."""
    runtime.start()
    records = []
    for root, gaussians, budget in (given.rsplit(":", 2) for given in datasets):
        found = study(work / root.replace("/", "-"), Path(root), int(gaussians), int(budget))
        records += [{"dataset": root, "budget": int(budget), **record} for record in found]
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
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
