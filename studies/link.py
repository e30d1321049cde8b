"""Quality over a slow link: views by the default policy against evenly spaced ones.

Models of several numbers of views are sent in several numbers of bytes, as by `mgs export --bytes
--shared-prior`, to a receiver that has the mesh.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import mgs
from mgs.reports.compacting import compact_run
from mgs.splat_files import load_gaussians
from studies.frame.case import ROCKS, judge
from studies.frame.output import (
    Content,
    Panel,
    draw_panels,
    grouped,
    scene_mean,
    table,
    write_table,
)
from studies.frame.program import WORKERS, Study, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell
from studies.rate import LINK
from studies.setups import SETUPS, SetupSize, case_of, sized

SEEDS = 4

EVEN = "evenly spaced"

POLICIES = {"directional-i": "chosen", "uniform": EVEN}


@dataclass(frozen=True)
class LinkSize(SetupSize):
    """Size of the study. views: of a run, seeds among them. sent: bytes of a file."""

    gaussians: int | None = 5000
    count: int = 6
    views: tuple[int, ...] = (6, 12, 24)
    sent: tuple[int, ...] = (3000, 10_000, 30_000)


SIZES = {"quick": LinkSize(), "paper": replace(LinkSize(), width=320, height=240)}


def cells_of(size: LinkSize) -> list[Cell]:
    """A cell for each rock, policy and number of views, with datasets and priors."""
    cells: list[Cell] = []
    for rock, policy, views in product(size.rocks, POLICIES, size.views):
        case = case_of(rock, SETUPS["hemisphere"], size)
        settings = {"policy": policy, "seeds": SEEDS, "budget": views - SEEDS, "seed": rock.index}
        name, task = f"link/{rock.name}/{policy}-{views}", f"{__name__}:send"
        about, sent = {"views": views, "by": POLICIES[policy]}, list(size.sent)
        cells += case.with_task(name, task, about=about, sent=sent, settings=settings)
    return cells


def send(
    root: Path, out: Path, dataset: str, prior: str, sent: Sequence[int], settings: dict[str, Any]
) -> dict[str, Any]:
    """Task: choose views, fit a model, send it. Returns "rows": "bytes", "seconds", "psnr", dB."""
    run = mgs.run_nbv(root / dataset, out / "run", prior=root / prior, force=True, **settings)
    data, path, rows = mgs.load_dataset(root / dataset), out / "sent.mgs", []
    for size in sent:
        path.write_bytes(compact_run(run, size, shared=True).data)
        psnr = judge(load_gaussians(path, root / prior), data)["psnr"]
        rows.append({"bytes": size, "seconds": 8 * size / LINK, "psnr": psnr})
    return {"rows": rows}


def rows_of(work: Work) -> list[Row]:
    """A row for each model and size. "gain": PSNR over that of the fewest evenly spaced views of
    the same rock in as many bytes, dB."""
    rows = work.rows()
    first = {"views": min(work.size.views), "by": EVEN}
    base = {
        (row["rock"], row["bytes"]): row["psnr"] for row in rows if first.items() <= row.items()
    }
    for row in rows:
        row["gain"] = row["psnr"] - base[row["rock"], row["bytes"]]
        row["which"] = f"{row['views']} {row['by']}"
    return rows


def tables(rows: Sequence[Row]) -> str:
    """Table of each choice of views: mean gain over scenes with 95 % intervals, by bytes."""
    columns: dict[str, Content] = {"views": "which"}
    for size in dict.fromkeys(row["bytes"] for row in rows):
        columns[f"gain in {size:,} bytes (dB)"] = scene_mean("gain", "+.2f", bytes=size)
    return table(columns, grouped(rows, "which"))


def write(work: Work) -> list[Path]:
    """Write link.csv, .json, .md and .png."""
    rows = rows_of(work)
    label = f"PSNR over {min(work.size.views)} {EVEN} views (dB)"
    panel = Panel("seconds", "gain", f"seconds at {LINK // 1000} kbit/s", label, "which", True)
    draw_panels(work.out / "link.png", [panel], rows)
    paths = write_table(work, "link", rows, tables(rows), rocks=len(work.size.rocks))
    return [*paths, work.out / "link.png"]


STUDY = Study("link", __doc__, write, SIZES, cells_of, ROCKS | WORKERS, sized)

if __name__ == "__main__":
    study_of("link")()
