"""What the demo takes, stage by stage, in two versions of mgs. `python benchmarks/demo_time.py
OUT.json WORK OLD NEW`

OLD, NEW: folders of two checkouts (`git worktree add`), with the packages of this environment. Each
does `mgs demo` in an empty folder below WORK, in turn, ROUNDS times; seconds are those of its own
headings. The versions do not do the same: the old one has three policies, no test views, and fits
colours alone. Let nothing else run.
"""

from __future__ import annotations

import itertools
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from versions import commit
from whole_runs import PROGRAM

from mgs import runtime
from mgs.files import write_json
from mgs.provenance import command_line, versions

ROUNDS = 2
HEADING = re.compile(r"^(\d)/5 (?:next best views: ([\w-]+))?.*\s(\d+) s\b|done in (\d+) s")
STAGES = {
    "1": "dataset",
    "2": "prior",
    "3": "run and its measure",
    "4": "maps of information",
    "5": "report",
}
"""What the demo does below its numbered headings."""


def stages(checkout: Path, out: Path) -> list[tuple[str, float]]:
    """Run the demo of a checkout in an empty folder; the stages by their headings, and seconds of
    each."""
    shutil.rmtree(out, ignore_errors=True)
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve()), "COLUMNS": "160"}
    command = [sys.executable, "-P", "-c", PROGRAM, "demo", str(out)]
    said = subprocess.run(
        command, env=environment, stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    marks: list[tuple[str, float]] = []
    for line in said.splitlines():
        if found := HEADING.search(line):
            policy = f": {found[2]}" if found[2] else ""
            marks.append((STAGES.get(found[1], "end") + policy, float(found[3] or found[4])))
    return [(name, after - before) for (name, before), (_, after) in itertools.pairwise(marks)]


def main(out: Path, work: Path, old: Path, new: Path) -> None:
    """Measure, write after every run."""
    runtime.start()
    records: list[dict[str, Any]] = []
    for turn in range(ROUNDS):
        for version, checkout in (("old", old), ("new", new)):
            found = stages(checkout, work / version)
            records.append({"version": version, "round": turn, "stages": found})
            print(records[-1], flush=True)
            made = {
                "command": command_line(),
                "machine": runtime.processor(),
                "versions": versions(),
            }
            write_json(out, made | {"old": commit(old), "new": commit(new), "records": records})


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
