"""How well do runs predict their errors? `python benchmarks/uncertainty.py OUT.json RUN...`

Collects what `mgs diagnose RUN --calibrate` finds in several finished runs, and makes it where it
is not there yet.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mgs import runtime
from mgs.files import read_json, write_json
from mgs.provenance import command_line, versions
from mgs.report.predicted_error import calibrate_run


def main(out: Path, *runs: Path) -> None:
    """Measure and write."""
    runtime.start()
    records = []
    for run in runs:
        made = run / "diagnostics/uncertainty.json"
        if not made.is_file():
            calibrate_run(run)
        records.append(read_json(made))
        print(run, flush=True)
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
    main(*map(Path, sys.argv[1:]))
