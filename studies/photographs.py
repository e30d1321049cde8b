"""PSNR against CPU seconds of `mgs fit` on datasets of photographs, beside other programs.

Fits are timed one by one: let nothing else run meanwhile.
"""

import math
import shlex
import shutil
import time
from argparse import ArgumentTypeError, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import mgs
from mgs.data.frames import has_masks
from mgs.files import read_csv
from mgs.run.nbv import start_fit
from studies.chart import check_dataset
from studies.frame.case import judge
from studies.frame.output import Content, Panel, draw_panels, table, write_table
from studies.frame.program import Study, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell

NAME = "photographs"

NUMBERS = ("cpu_seconds", "psnr", "seconds", "ssim", "gaussians")
"""Columns that are read from the CSV of another program."""

COLUMNS: dict[str, Content] = {
    "dataset": "dataset",
    "program": "program",
    "passes": "passes",
    "Gaussians": "gaussians:,.0f",
    "CPU seconds": "cpu_seconds:.0f",
    "PSNR (dB)": "psnr:.2f",
    "SSIM": "ssim:.3f",
}


def tables(rows: Sequence[Row]) -> str:
    """Markdown table of the longest fit of each program to each dataset."""
    longest = {(row["dataset"], row["program"]): row for row in rows}
    return table(COLUMNS, [longest[key] for key in sorted(longest)])


def measure(root: Path, out: Path, dataset: str, gaussians: Any, passes: int) -> dict[str, Any]:
    """Task: time a fit from the images to the model, once, and judge it on the test views."""
    wall, cpu = time.perf_counter(), time.process_time()
    run = start_fit(dataset, out / "run", gaussians=gaussians, train={"passes": passes}, force=True)
    model = mgs.resume_nbv(run).state.gaussians
    seconds = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    metrics = judge(model, mgs.load_dataset(dataset))
    shutil.rmtree(out / "run")
    found = {key: metrics[key] for key in ("psnr", "ssim", "psnr_mask") if key in metrics}
    return seconds | found | {"gaussians": len(model)}


def count_of(text: str) -> int | str:
    """Number of Gaussians of an option, or auto. Raises ArgumentTypeError for anything else."""
    if text != "auto" and (not text.isdecimal() or int(text) < 1):
        raise ArgumentTypeError(f"{text!r} is no positive whole number, nor auto")
    return text if text == "auto" else int(text)


def read_peer(file: Path, datasets: Sequence[str]) -> list[Row]:
    """Read the rows of another program, which is named as its file.

    The file is a CSV with the columns `cpu_seconds` and `psnr`, dB on the test views. The others of
    NUMBERS are optional, and `dataset`, one of these names: by default the first. Raises InputError
    for other contents.
    """
    head, *rows = [row for _, row in read_csv(file)] or [[]]
    lines = [dict(zip(head, row, strict=False)) for row in rows]
    try:
        numbers = [{k: float(v) for k, v in line.items() if k in NUMBERS} for line in lines]
        found = [row[key] for row in numbers for key in NUMBERS[:2]]
        if not found or not all(0 < number < math.inf for number in found):
            raise ValueError
    except (KeyError, TypeError, ValueError):
        columns = "a column `cpu_seconds` and one `psnr`, positive numbers"
        raise mgs.InputError(f"{file}: needs {columns}, one row or more; correct it") from None
    about = [
        {"dataset": line.get("dataset") or datasets[0], "program": file.stem} for line in lines
    ]
    if unknown := [row["dataset"] for row in about if row["dataset"] not in datasets]:
        known = ", ".join(datasets)
        raise mgs.InputError(f"{file}: dataset {unknown[0]} is not charted; choose of {known}")
    return [names | row for names, row in zip(about, numbers, strict=True)]


@dataclass(frozen=True)
class Fits:
    """Fits of every number of passes, to every dataset, with every number of Gaussians; photographs
    without masks start from their points. peers: rows of other programs."""

    passes: tuple[int, ...]
    datasets: tuple[Path, ...] = ()
    gaussians: tuple[int | str, ...] = ()
    peers: tuple[Path, ...] = ()

    def each(self) -> Iterator[tuple[Path, int | str, int, Cell]]:
        """Dataset, Gaussians, passes and cell of each fit."""
        for dataset in self.datasets:
            counts = self.gaussians if has_masks(mgs.load_dataset(dataset).frames) else ("auto",)
            for count, passes in product(counts, self.passes):
                name = f"{NAME}/{dataset.absolute().name}/{count}-{passes}"
                how = {"dataset": str(dataset.resolve()), "gaussians": count, "passes": passes}
                yield dataset, count, passes, Cell(name, f"{__name__}:measure", how, alone=True)

    def peer_rows(self) -> list[Row]:
        """Rows of other programs (`read_peer`)."""
        names = [dataset.absolute().name for dataset in self.datasets]
        return [row for file in self.peers for row in read_peer(file, names)]


SIZES = {"quick": Fits((5, 15)), "full": Fits((5, 15, 30, 60))}


def sized(size: Fits, options: Namespace) -> Fits:
    """Fits of the datasets of the options. Raises InputError for those that cannot be charted."""
    for folder in options.dataset:
        check_dataset(folder)
    names = [folder.absolute().name for folder in options.dataset]
    if len(set(names)) < len(names):
        raise mgs.InputError("--dataset: two folders have one name; rename one")
    fits = replace(
        size,
        datasets=tuple(options.dataset),
        gaussians=tuple(options.gaussians or ["auto"]),
        peers=tuple(options.peer),
    )
    fits.peer_rows()  # before hours of fits
    return fits


def write(work: Work) -> list[Path]:
    """Write photographs.csv, .json, .md and .png."""
    rows: list[Row] = []
    for dataset, count, passes, cell in work.size.each():
        result = work.results[cell.name]
        words = ["mgs", "fit", str(dataset), "--gaussians", str(count), "--passes", str(passes)]
        program = "mgs" if len(work.size.gaussians) == 1 else f"mgs, {count} Gaussians"
        about = {"dataset": dataset.absolute().name, "program": program, "passes": passes}
        rows.append(about | result | {"command": shlex.join([*words, "--out", "RUN"])})
    rows += work.size.peer_rows()
    draw(work.out / f"{NAME}.png", rows)
    return [*write_table(work, NAME, rows, tables(rows)), work.out / f"{NAME}.png"]


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw PSNR against CPU seconds, a panel for each dataset."""
    labels = "cpu_seconds", "psnr", "CPU seconds", "PSNR on test views (dB)", "program", True
    panels = [
        Panel(*labels, only=(("dataset", name),), title=name)
        for name in dict.fromkeys(row["dataset"] for row in rows)
    ]
    draw_panels(path, panels, rows)


STUDY = Study(
    NAME,
    __doc__,
    write,
    SIZES,
    lambda size: [cell for *_, cell in size.each()],
    {
        "--dataset": {
            "action": "append",
            "required": True,
            "type": Path,
            "help": "A dataset with test views; repeat for more.",
        },
        "--gaussians": {
            "action": "append",
            "type": count_of,
            "metavar": "N|auto",
            "help": "Number of Gaussians of objects with masks; repeat for more.",
        },
        "--peer": {
            "action": "append",
            "default": [],
            "type": Path,
            "help": "CSV of another program: `cpu_seconds`, `psnr` and, if not of the first "
            "dataset, `dataset`; repeat for more.",
        },
    },
    sized,
)

if __name__ == "__main__":
    study_of(NAME)()
