"""PSNR against seconds of `mgs fit` on a dataset of photographs, beside other programs."""

from __future__ import annotations

import csv
import math
import shlex
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.files import reading
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.run.nbv import resume_nbv, start_fit
from mgs.study.case import judge
from mgs.study.output import Content, group_styles, logarithmic, table, write_table
from mgs.study.sweep import Cell, Report, run_cells
from mgs.study.verdict import Row

NAME = "photographs"

PASSES = {"quick": (5, 15, 30), "full": (5, 15, 30, 60)}
"""Passes of the fits, by scale."""

NUMBERS = ("seconds", "cpu_seconds", "psnr", "ssim")
"""Columns that are read from the CSV of another program."""

COLUMNS: dict[str, Content] = {
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


def read_peer(file: Path) -> list[Row]:
    """Read the rows of another program, which is named as its file.

    The file is a CSV with the columns `seconds` and `psnr`, dB on the test views. The others of
    NUMBERS are optional. Raises InputError for other contents.
    """
    with reading(file):
        lines = list(
            csv.DictReader(file.read_text(encoding="utf-8", errors="replace").splitlines())
        )
    try:
        numbers = [{k: float(v) for k, v in line.items() if k in NUMBERS} for line in lines]
        found = [row[key] for row in numbers for key in ("seconds", "psnr")]
        if not found or not all(0 < number < math.inf for number in found):
            raise ValueError
    except (KeyError, TypeError, ValueError):
        columns = "a column `seconds` and one `psnr`, positive numbers"
        raise InputError(f"{file}: needs {columns}, one row or more; correct it") from None
    return [{"program": file.stem} | row for row in numbers]


def chart_photographs(
    out: Path,
    preset: str,
    dataset: Path,
    gaussians: Sequence[int | str],
    peers: Sequence[Path],
    report: Report,
) -> list[Row]:
    """Time fits of PASSES with each number of Gaussians, and write photographs.csv, .json, .md and
    .png, with the rows of other programs (`read_peer`). Returns the rows."""
    given, others = str(dataset.resolve()), [row for file in peers for row in read_peer(file)]
    asked = [(count, passes) for count in gaussians for passes in PASSES[preset]]
    cells = [
        Cell(
            f"{NAME}/{count}-{passes}",
            f"{__name__}:measure",
            {"dataset": given, "gaussians": count, "passes": passes},
            alone=True,
        )
        for count, passes in asked
    ]
    found = run_cells(out, cells, report)
    rows: list[Row] = []
    for (count, passes), cell in zip(asked, cells, strict=True):
        result = found[cell.name]
        words = ["mgs", "fit", str(dataset), "--gaussians", str(count), "--passes", str(passes)]
        about = {"program": f"mgs, {result['gaussians']:,} Gaussians", "passes": passes}
        rows.append(about | result | {"command": shlex.join([*words, "--out", "RUN"])})
    words = ["mgs", "chart", str(out), "--only", NAME, "--scale", preset, "--dataset", str(dataset)]
    words += [word for count in gaussians for word in ("--gaussians", str(count))]
    words += [word for file in peers for word in ("--peer", str(file))]
    text = table(COLUMNS, rows + others)
    write_table(out, NAME, rows + others, text, shlex.join(words), preset=preset)
    draw(out / f"{NAME}.png", rows + others, dataset.absolute().name)
    return rows


def draw(path: Path, rows: Sequence[Mapping[str, Any]], dataset: str) -> None:
    """Draw seconds against PSNR, a line for each program. dataset: its name, for the title.

    Raises InputError as `save_figure`.
    """
    import matplotlib

    names = list(dict.fromkeys(row["program"] for row in rows))
    with matplotlib.rc_context(STYLE):
        figure = new_figure(5.4, 4.0)
        axes = figure.subplots()
        for name, look in zip(names, group_styles(names), strict=True):
            of = sorted((row["seconds"], row["psnr"]) for row in rows if row["program"] == name)
            axes.plot(*zip(*of, strict=True), markersize=5, **look)
        logarithmic(axes)
        axes.set(xlabel="seconds", ylabel="PSNR on the test views (dB)")
        axes.set_title(f"What a second buys: fits of {dataset}")
        axes.legend(loc="lower right", fontsize=9)
        save_figure(figure, path)
