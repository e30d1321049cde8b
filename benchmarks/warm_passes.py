"""How many passes should later fits have? `python benchmarks/warm_passes.py OUT.json WORK
DATASET:N:BUDGET`

For every dataset, runs with a prior of N Gaussians, four seeds and BUDGET further views, evenly
spread, so that all runs take the same. Their fits after the first have as many passes as PASSES
says. The model is measured on the test views after each fit; seconds are those of every stage but
the measuring. The runs are kept in WORK; one that has ended is not made again. Let nothing else
run.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mgs import runtime
from mgs.data.dataset import load_dataset
from mgs.files import write_json
from mgs.fit.settings import COLOURS_ALONE
from mgs.prior.build import build_prior, save_prior
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.run.nbv import resume_nbv, run_nbv

PASSES = (10, 5, 3, 2, 1)
"""Of the fits after the first, `warm_passes` of `mgs.run.settings.NbvSettings`."""


def study(work: Path, root: Path, gaussians: int, budget: int) -> list[dict[str, Any]]:
    """A record for each of PASSES."""
    prior, records = work / "prior", []
    if not prior.is_dir():
        save_prior(prior, build_prior(load_dataset(root), PriorSettings(gaussians=gaussians))[0])
    for passes in PASSES:
        run = work / f"{passes}-passes"
        given = {
            "policy": "uniform",
            "budget": budget,
            "warm_passes": passes,
            "evaluate_every": 1,
            "train": COLOURS_ALONE,
        }
        state = (
            resume_nbv(run)
            if (run / "config.json").is_file()
            else run_nbv(root, run, prior=prior, **given)
        )
        seconds = {
            key: sum(step["seconds"].get(key, 0) for step in state.steps)
            for key in state.steps[-1]["seconds"]
        }
        del seconds["evaluate"]
        curves = {
            key: [step[key] for step in state.steps]
            for key in ("images", "test_psnr", "test_psnr_mask")
        }
        records.append({"gaussians": gaussians, "passes": passes, "seconds": seconds, **curves})
        print(
            f"{root}, {passes} passes: {sum(seconds.values()):.0f} s, {curves['test_psnr'][-1]:.2f} dB",
            flush=True,
        )
    return records


def main(out: Path, work: Path, datasets: list[str]) -> None:
    """Run, measure and write."""
    runtime.start()
    records = []
    for root, gaussians, budget in (given.rsplit(":", 2) for given in datasets):
        folder = work / root.replace("/", "-")
        records += [
            {"dataset": root, **record}
            for record in study(folder, Path(root), int(gaussians), int(budget))
        ]
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
