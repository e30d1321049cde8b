"""Does alpha in the fit change which policy is better? `python benchmarks/alpha_policies.py
OUT.json WORK DATASET:PRIOR...`

Runs of four seeds and eight choices by POLICIES, once with colours alone and once with the default
weight of alpha, PSNR of the last model on the test views. WORK keeps the runs; the same command
goes on where it was interrupted.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mgs import runtime
from mgs.files import write_json
from mgs.fit.settings import ALPHA_WEIGHT
from mgs.provenance import command_line, versions
from mgs.run.nbv import resume_nbv, run_nbv

POLICIES = ("d-optimal", "directional-i", "uniform", "random")
BUDGET = 8


def main(out: Path, work: Path, *rocks: str) -> None:
    """Run, measure, write."""
    runtime.start()
    records: list[dict[str, Any]] = []
    for rock in rocks:
        dataset, _, prior = rock.partition(":")
        for policy in POLICIES:
            for weight in (0.0, ALPHA_WEIGHT):
                run = work / f"{dataset.replace('/', '-')}-{policy}-{weight:g}"
                given = {
                    "policy": policy,
                    "budget": BUDGET,
                    "evaluate_every": BUDGET,
                    "train": {"alpha_weight": weight},
                }
                begun = (run / "config.json").is_file()
                state = resume_nbv(run) if begun else run_nbv(dataset, run, prior=prior, **given)
                found = {key: state.steps[-1][key] for key in ("test_psnr", "test_psnr_mask")}
                records.append({"rock": rock, "policy": policy, "alpha_weight": weight} | found)
                print(records[-1], flush=True)
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
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
