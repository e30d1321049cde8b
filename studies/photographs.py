"""PSNR against CPU seconds of `mgs fit` on datasets of photographs, beside other programs."""

from __future__ import annotations

import csv
import math
import shlex
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.files import reading
from mgs.run.nbv import resume_nbv, start_fit
from studies.case import judge
from studies.output import Content, Panel, draw_panels, table, write_table
from studies.sweep import Cell, Report, run_cells
from studies.verdict import Row

NAME = "photographs"

PASSES = {"quick": (5, 15, 30), "full": (5, 15, 30, 60)}
"""Passes of the fits, by scale."""

NUMBERS = ("cpu_seconds", "psnr", "seconds", "ssim")
"""Columns that are read from the CSV of another program."""

COLUMNS: dict[str, Content] = {
    "dataset": "dataset",
    "program": "program",
    "passes": "passes",
    "seconds": "seconds:.0f",
    "CPU seconds": "cpu_seconds:.0f",
    "PSNR (dB)": "psnr:.2f",
    "SSIM": "ssim:.4f",
    "PSNR, masks (dB)": "psnr_mask:.2f",
}


def measure(root: Path, out: Path, dataset: str, gaussians: Any, passes: int) -> dict[str, Any]:
    """Task: time a fit from the images to the model, once, and judge it on the test views."""
    wall, cpu = time.perf_counter(), time.process_time()
    run = start_fit(dataset, out / "run", gaussians=gaussians, train={"passes": passes}, force=True)
    model = resume_nbv(run).state.gaussians
    seconds = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    metrics = judge(model, load_dataset(dataset))
    shutil.rmtree(out / "run")
    found = {key: metrics[key] for key in ("psnr", "ssim", "psnr_mask") if key in metrics}
    return seconds | found | {"gaussians": len(model)}


def parse_count(text: str) -> int | str:
    """Number of Gaussians of an option, or auto. Raises InputError for anything else."""
    if text == "auto":
        return text
    if not text.isdecimal() or int(text) < 1:
        raise InputError(f"--gaussians {text!r}: expected a positive whole number, or auto")
    return int(text)


def read_peer(file: Path, datasets: Sequence[str]) -> list[Row]:
    """Read the rows of another program, which is named as its file.

    The file is a CSV with the columns `cpu_seconds` and `psnr`, dB on the test views. The others of
    NUMBERS are optional, and `dataset`, one of these names: by default the first. Raises InputError
    for other contents.
    """
    with reading(file):
        lines = list(
            csv.DictReader(file.read_text(encoding="utf-8", errors="replace").splitlines())
        )
    try:
        numbers = [{k: float(v) for k, v in line.items() if k in NUMBERS} for line in lines]
        found = [row[key] for row in numbers for key in NUMBERS[:2]]
        if not found or not all(0 < number < math.inf for number in found):
            raise ValueError
    except (KeyError, TypeError, ValueError):
        columns = "a column `cpu_seconds` and one `psnr`, positive numbers"
        raise InputError(f"{file}: needs {columns}, one row or more; correct it") from None
    about = [
        {"dataset": line.get("dataset") or datasets[0], "program": file.stem} for line in lines
    ]
    if unknown := [row["dataset"] for row in about if row["dataset"] not in datasets]:
        known = ", ".join(datasets)
        raise InputError(f"{file}: dataset {unknown[0]} is not charted; choose of {known}")
    return [names | row for names, row in zip(about, numbers, strict=True)]


def chart_photographs(
    out: Path,
    preset: str,
    datasets: Sequence[Path],
    gaussians: Sequence[int | str],
    peers: Sequence[Path],
    report: Report,
) -> list[Row]:
    """Time fits of PASSES of each dataset with each number of Gaussians, and write photographs.csv,
    .json, .md and .png. Returns the rows.

    datasets: of different names. peers: files of other programs (`read_peer`).
    """
    names = [dataset.absolute().name for dataset in datasets]
    asked = [
        (dataset, count, passes)
        for dataset in datasets
        for count in gaussians
        for passes in PASSES[preset]
    ]
    cells = [
        Cell(
            f"{NAME}/{dataset.absolute().name}/{count}-{passes}",
            f"{__name__}:measure",
            {"dataset": str(dataset.resolve()), "gaussians": count, "passes": passes},
            alone=True,
        )
        for dataset, count, passes in asked
    ]
    found = run_cells(out, cells, report)
    rows: list[Row] = []
    for (dataset, count, passes), cell in zip(asked, cells, strict=True):
        result = found[cell.name]
        words = ["mgs", "fit", str(dataset), "--gaussians", str(count), "--passes", str(passes)]
        program = f"mgs, {result['gaussians']:,} Gaussians"
        about = {"dataset": dataset.absolute().name, "program": program, "passes": passes}
        rows.append(about | result | {"command": shlex.join([*words, "--out", "RUN"])})
    rows += [row for file in peers for row in read_peer(file, names)]
    words = ["python", "-m", "studies.photographs", str(out), "--scale", preset]
    words += [word for dataset in datasets for word in ("--dataset", str(dataset))]
    words += [word for count in gaussians for word in ("--gaussians", str(count))]
    words += [word for file in peers for word in ("--peer", str(file))]
    write_table(out, NAME, rows, table(COLUMNS, rows), shlex.join(words), preset=preset)
    panels = [
        Panel(
            "cpu_seconds",
            "psnr",
            "CPU seconds",
            "PSNR on the test views (dB)",
            by="program",
            log=True,
            only=(("dataset", name),),
            title=name,
        )
        for name in names
    ]
    draw_panels(out / f"{NAME}.png", panels, rows)
    return rows


if __name__ == "__main__":
    from studies.commands import start

    start("photographs")
