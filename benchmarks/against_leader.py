"""By how much is `directional-i` ahead of policies, in whole runs?

    python benchmarks/against_leader.py OUT.json STUDY ROCKS POLICY...

What `mgs reproduce STUDY --only pools --preset quick --rocks ROCKS --policy POLICY` compares,
without the other policies: on every pool of so many rocks a run of each POLICY (a name, or
FILE.py:FUNCTION) and one of `directional-i`, of this version. The cells are those of the study in
the folder STUDY, so what is there already is not made again. OUT.json has a row for each pool and
policy, as `pools.json` of a study; it is written once all runs are done.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mgs import runtime
from mgs.files import write_json
from mgs.policy import from_file as policy_file
from mgs.provenance import command_line, versions
from mgs.study.reproduce import LEADER, POOLS, PRESETS, Run, rocks
from mgs.study.reproduce_results import MEASURES, Found, Rows, by_policy, flat, paired
from mgs.study.statistics import area
from mgs.study.sweep import run_cells


def rows(found: Found, runs: list[Run]) -> Rows:
    """By how much the leader's last model and the area under its curve are ahead of each policy's,
    pool by pool, with the 95 % interval over the rocks."""
    result: Rows = []
    for pool in POOLS:
        inside = [run for run in runs if run.pool == pool]
        for policy in dict.fromkeys(run.label for run in inside if run.label != LEADER):
            row = {"pool": pool, "policy": policy, "rocks": len({run.rock.index for run in inside})}
            for key in MEASURES:
                last = by_policy((run, found[run.name][key][-1]) for run in inside)
                areas = by_policy(
                    (run, area(found[run.name]["images"], found[run.name][key])) for run in inside
                )
                row |= flat(f"{key}_led", paired(last[LEADER], last[policy]))
                row |= flat(f"{key}_area_led", paired(areas[LEADER], areas[policy]))
            result.append(row)
    return result


def main(out: Path, study: Path, count: int, names: list[str]) -> None:
    """Run what is missing, compare, write."""
    runtime.start()
    preset, policies = PRESETS["quick"], [LEADER, *map(policy_file.absolute, names)]
    runs = [
        Run(rock, preset.rocks, policy, pool=pool)
        for rock in rocks(preset, count)
        for pool in POOLS
        for policy in policies
    ]
    cells = {cell.name: cell for run in runs for cell in run.cells()}
    found = run_cells(
        study,
        list(cells.values()),
        lambda name, done, total: print(f"{done} of {total}: {name}", flush=True),
    )
    made = {"command": command_line(), "versions": versions()}
    write_json(out, made | {"rocks": count, "rows": rows(found, runs)})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
