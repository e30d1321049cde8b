"""What does the size of lambda do to whole runs? `python benchmarks/small_lambda.py OUT.json STUDY`

On the ring and the hemisphere of three rocks, as `mgs reproduce --preset quick` has them: four
seeds and eight choices, by the exact information and by the squared gradient of one loss per image,
each with lambdas that are small for its entries and, for the second, with the lambda of 1e-6 that
lies far above them (`paper`); beside them even spacing and `directional-i`. The cells are those of
a study in the folder STUDY, so what is there already is not made again.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mgs import runtime
from mgs.files import write_json
from mgs.policy import from_file as policy_file
from mgs.provenance import command_line, versions
from mgs.study.reproduce import PRESETS, Rock, Run
from mgs.study.statistics import area
from mgs.study.sweep import run_cells

ROCKS = (Rock("pebbles", 1, 1), Rock("strata", 1, 2), Rock("low-sun", 1, 3))
POOLS = ("ring", "hemisphere")
OWN = [
    f"benchmarks/policies.py:{name}"
    for name in ("exact_one_lam", "paper_small_lam", "paper_scaled")
]
POLICIES = ("d-optimal", "paper", *OWN, "uniform", "directional-i")


def main(out: Path, study: Path) -> None:
    """Run what is missing, write."""
    runtime.start()
    named = [policy_file.absolute(policy) for policy in POLICIES]
    runs = [
        Run(rock, PRESETS["quick"].rocks, policy, pool=pool)
        for rock in ROCKS
        for pool in POOLS
        for policy in named
    ]
    cells = {cell.name: cell for run in runs for cell in run.cells()}

    def report(name: str, done: int, total: int) -> None:
        print(f"{done} of {total}: {name}", flush=True)

    found = run_cells(study, list(cells.values()), report, workers=2)
    records = []
    for run in runs:
        curves = found[run.name]
        record = {"rock": run.rock.name, "pool": run.pool, "policy": run.label}
        for key in ("test_psnr", "test_psnr_mask"):
            record |= {key: curves[key][-1], f"{key}_area": area(curves["images"], curves[key])}
        records.append(record)
    write_json(out, {"command": command_line(), "versions": versions(), "records": records})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
