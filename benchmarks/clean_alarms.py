"""How often do the detectors cry out in runs in which nothing is wrong? `python
benchmarks/clean_alarms.py OUT.json STUDY`

STUDY: a folder of `mgs reproduce` with curves and pools: none of its runs has a fault, and no limit
was chosen by them. Of each sign of `mgs.run.detectors`: in how many runs, and on how many rocks, it
goes beyond its limit at any step, and the largest
value over the limit. Of each pool: how many of its runs raise an alarm. `saturated` does not count
there: it says that a view taught little, which is true of a view from far away, and no fault.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mgs.files import write_json
from mgs.provenance import command_line, versions
from mgs.run.detectors import DETECTORS


def runs(study: Path) -> Iterator[dict[str, Any]]:
    """Rock, pool, policy, and the largest value of each sign over its limit, of every run of a
    study."""
    for path in sorted(study.glob("cells/run/*/*/*/run/steps.jsonl")):
        rock, pool, run = path.parts[-5:-2]
        steps = [json.loads(line) for line in path.read_text().splitlines()]
        signs = [step["signs"] for step in steps if "signs" in step]
        most = {
            name: max((s[name] / row.limit for s in signs if name in s), default=0.0)
            for name, row in DETECTORS.items()
        }
        yield {"rock": rock, "pool": pool.rsplit("-", 2)[0], "run": run, "signs": most}


def main(out: Path, study: Path) -> None:
    """Read, count, write."""
    found = list(runs(study))
    signs = {}
    for name in DETECTORS:
        beyond = [run for run in found if run["signs"][name] > 1]
        largest = max(run["signs"][name] for run in found)
        signs[name] = {
            "runs": len(beyond),
            "rocks": len({run["rock"] for run in beyond}),
            "largest": largest,
        }
    pools = {}
    for pool in dict.fromkeys(run["pool"] for run in found):
        inside = [run for run in found if run["pool"] == pool]
        alarms = [
            run
            for run in inside
            if any(value > 1 for name, value in run["signs"].items() if name != "saturated")
        ]
        pools[pool] = {"runs": len(inside), "alarms": len(alarms)}
    made = {
        "command": command_line(),
        "versions": versions(),
        "runs": len(found),
        "signs": signs,
        "pools": pools,
    }
    write_json(out, made | {"rocks": len({run["rock"] for run in found})})
    print(json.dumps(made, indent=1))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
