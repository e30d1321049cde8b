"""Every study of the pages, one after another: `python -m studies.all OUT` (`make results`).

Studies of a scale share a folder of OUT, so a dataset is made once, and a rerun continues. What
docs/results shows of a study is replaced when the study is done; pages take their tables from there
when the site is built. With --quick, the studies of many rocks run for one, and their rows are
compared with those of docs/results.
"""

import shutil
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from math import inf, isnan
from pathlib import Path

from studies.frame.output import read_rows
from studies.frame.statistics import Row

RESULTS = Path(__file__).parent.parent / "docs/results"

LOOSER = "scale and rotation four times as free"

STAGES = {
    "fits-training": ("fits", "--training", "--variant", "loss=squared", "--variant", LOOSER),
    "fits": ("fits", "--rocks", "8"),
    "certificate": ("certificate", "--rocks", "8"),
    "setups": ("setups", "--rocks", "8"),
    "curves": ("curves", "--rocks", "8"),
    "pools": ("pools", "--rocks", "8"),
    "henge": ("pools", "--scene", "henge"),
    "oracle": ("oracle", "--rocks", "1"),
    "paper": ("paper", "--rocks", "8"),
    "ring": ("ring", "--rocks", "6"),
    "table1": ("table1",),
    "couplings": ("couplings", "--rocks", "6"),
    "flights": ("flights", "--rocks", "8"),
    "survey": ("survey", "--rocks", "8"),
    "parsimony": ("parsimony", "--rocks", "8"),
    "chart": ("chart",),
    "link": ("link", "--rocks", "6"),
    "stress": ("stress", "--rocks", "8"),
    "table1-paper": ("table1", "--scale", "paper", "--batch", "5"),
}
"""Studies and their arguments by folder of docs/results. Three need programs or data of others and
are run by hand: `studies.rate`, `studies.blender` and `studies.photographs`."""

QUICK = {
    name: (*arguments[: arguments.index("--rocks") + 1], "1")
    for name, arguments in STAGES.items()
    if "--rocks" in arguments and name not in ("curves", "oracle", "ring")
}
"""Each study with --rocks, for the first; curves and ring repeat others with other numbers of
images, and oracle has one rock anyway."""

ENOUGH = 0.05
"""Largest difference of a number, in its unit. Processors of another type round differently: with 8
lanes (znver3) a PSNR is up to 0.03 dB from that of the rows, made with 16 (znver4)."""


def run(out: Path, quick: bool) -> int:
    """Run the stages; return the exit code of the first that fails, or of the comparison."""
    code = 0
    for name, (study, *arguments) in (QUICK if quick else STAGES).items():
        folder = out / ("paper" if "paper" in arguments else "quick")
        command = [sys.executable, "-m", f"studies.{study}", str(folder), *arguments]
        print(f"python -m studies.{study} {folder} {' '.join(arguments)}", flush=True)
        if failed := subprocess.run(command, check=False).returncode:
            return failed
        if not quick:
            for path in sorted((RESULTS / name).iterdir()):
                shutil.copyfile(folder / path.name, path)  # only files that docs/results has
            continue
        rows, usual = compared(folder / f"{study}.csv", RESULTS / name / f"{study}.csv")
        pairs = [difference(*pair) for pair in zip(rows, usual, strict=False)]
        largest, where = max(pairs, default=(inf, "every row"))
        print(f"{len(rows)} of {len(usual)} rows, largest difference {largest:.2g} {where}")
        code |= len(rows) != len(usual) or largest > ENOUGH
    return code


def compared(path: Path, usual: Path) -> tuple[list[Row], list[Row]]:
    """Rows of a file, and those of another that are of the same rocks."""
    rows = read_rows(path)
    rocks = {row["rock"] for row in rows}
    return rows, [row for row in read_rows(usual) if row["rock"] in rocks]


def difference(row: Row, usual: Row) -> tuple[float, str]:
    """Largest difference of two rows' numbers, without seconds, and its column with the row's
    words. Infinite where words differ, or a number is missing."""
    origin, largest, column = ("command", "commit", "seconds"), 0.0, ""
    for key in sorted((row.keys() | usual.keys()).difference(origin)):
        one, other = row.get(key), usual.get(key)
        if one == other:
            continue
        apart = inf
        if isinstance(one, int | float) and isinstance(other, int | float):
            apart = abs(one - other)
        if not apart <= largest:
            largest, column = inf if isnan(apart) else apart, key
    words = " ".join(row[key] for key in row if key not in origin and isinstance(row[key], str))
    return largest, f"in {column} of {words}" if column else ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return its exit code."""
    parser = ArgumentParser(prog="python -m studies.all", description=__doc__)
    parser.add_argument("out", type=Path, help="Folder of all studies; run again to continue.")
    parser.add_argument("--quick", action="store_true", help="One rock, compared; half an hour.")
    options = parser.parse_args(arguments)
    return run(options.out, options.quick)


if __name__ == "__main__":
    sys.exit(main())
