"""Policies compared over the number of images taken: see `studies.setups`."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

from studies import setups
from studies.frame.case import ROCKS
from studies.frame.output import Panel, draw_panels, table, with_interval, write_table
from studies.frame.program import WORKERS, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell

COUNTS = (6, 8, 12, 20)
"""Numbers of images, seeds among them, of 36 candidates."""

DRAWS = 3
"""Runs of `random`, averaged."""

SOME = {name: setups.SETUPS[name] for name in ("hemisphere", "mixed distances")}

ANGLE = setups.BASELINES[2]
"""The pose with the largest angle to those taken."""

POLICIES = (setups.LEADER, "cover", ANGLE, setups.RANDOM)


def cells_of(size: setups.SetupSize) -> list[Cell]:
    """Cells of every number of images: each is a run of its own, since a plan is for a number."""
    cells: list[Cell] = []
    for count in COUNTS:
        for cell in setups.cells_of(replace(size, images=count, draws=DRAWS), POLICIES, SOME):
            about = dict(cell.about) | {"images": count} if cell.about else cell.about
            cells.append(replace(cell, about=about))
    return cells


def rows_of(work: Work) -> list[Row]:
    """A row for each number of images, rock, set-up and policy, as `setups.rows_of`."""
    rows: list[Row] = []
    for count in COUNTS:
        cells = [cell for cell in work.cells if cell.about and cell.about["images"] == count]
        rows += [{"images": count} | row for row in setups.rows_of(work.results, cells)]
    return rows


def tables(rows: Sequence[Row]) -> str:
    """Leads of the default over the other policies, means over scenes with 95 % intervals: a line
    for each set-up and policy, a column for each number of images."""
    columns = {"set-up": "setup", f"{setups.LEADER} over": "policy"}
    columns |= {f"{count} images (dB)": str(count) for count in COUNTS}
    lines = {
        pair: dict(zip(("setup", "policy"), pair, strict=True))
        for pair in product(SOME, _others(rows))
    }
    for count in COUNTS:
        some = [row for row in rows if row["images"] == count]
        for lead in setups.leads_of(some, setups.LEADER, "test"):
            if (pair := (lead["setup"], lead["policy"])) in lines:
                lines[pair][str(count)] = with_interval(lead, "lead")
    return table(columns, lines.values())


def _others(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["policy"] for row in rows if row["policy"] != setups.LEADER))


def write(work: Work) -> list[Path]:
    """Write curves.csv, curves.json, curves.md and curves.png."""
    rows = rows_of(work)
    axes = "images", "test_gain", "images taken", "PSNR over random views (dB)", "policy"
    panels = [Panel(*axes, only=(("setup", name),), title=name) for name in SOME]
    path = work.out / "curves.png"
    draw_panels(path, panels, [row for row in rows if row["policy"] != setups.RANDOM])
    return [*write_table(work, "curves", rows, tables(rows)), path]


STUDY = replace(
    setups.STUDY,
    name="curves",
    about="Compare policies as `setups` does, for several numbers of images.",
    cells=cells_of,
    write=write,
    options=ROCKS | WORKERS,
)

if __name__ == "__main__":
    study_of("curves")()
