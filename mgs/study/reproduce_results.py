"""Tables and figures of a reproduction, from the results of its cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mgs.files import write_csv
from mgs.report.evaluation import evaluate_run
from mgs.report.writing import write_report
from mgs.study import flights, reproduce, setups
from mgs.study.output import table, write_table
from mgs.study.reproduce import ReproduceSize, Run
from mgs.study.setups import Found
from mgs.study.sweep import Cell, Report, cell_folder, found, run_cells
from mgs.study.verdict import Row

Rows = list[Row]

PAPER_TABLE = (("D-Optimal NBV", 54, 25.97, 0.9654), ("Coverage-Greedy", 50, 26.06, 0.9648))
"""Table I of the paper, on its own rock: method, images, PSNR in dB, SSIM."""

TABLE_COLUMNS = {
    "policy": "row",
    "images": "images",
    "test views (dB)": "test.psnr:.2f",
    "SSIM": "test.ssim:.4f",
    "test views, rock (dB)": "test.psnr_mask:.2f",
    "all views (dB)": "all.psnr:.2f",
    "all SSIM": "all.ssim:.4f",
    "held out (dB)": "held_out.psnr:.2f",
    "a choice (s)": "choice_seconds:.2f",
    "run (s)": "seconds:.0f",
    "memory (MB)": "peak_megabytes:.0f",
}


def known_runs(root: Path, runs: Sequence[Run]) -> dict[str, dict[str, Any]]:
    """Results of the runs that are done."""
    results = {run.name: found(root, run.cells()[-1]) for run in runs}
    return {name: result for name, result in results.items() if result is not None}


def table_rows(results: Found, size: ReproduceSize) -> Rows:
    """Table I: a row for each run that is done."""
    rows = []
    for label, run in reproduce.table_runs(size).items():
        if run.name not in results:
            continue
        numbers = results[run.name]
        row: Row = {"row": label, "images": numbers["images"]}
        for views in ("test", "all", "held_out"):
            for metric in ("psnr", "ssim", "psnr_mask", "ssim_mask"):
                row[f"{views}.{metric}"] = numbers[views][metric]
        row |= {key: numbers[key] for key in ("choice_seconds", "seconds", "peak_megabytes")}
        rows.append(row | {"command": run.command()})
    return rows


def table_text(rows: Rows, left: Sequence[str]) -> str:
    """Table I with the paper's rows, and the mean of the draws of `random`. left: rows to come."""
    shown: Rows = [
        {"row": f"the paper's {name}, on its rock", "images": n, "all.psnr": psnr, "all.ssim": ssim}
        for name, n, psnr, ssim in PAPER_TABLE
    ]
    draws = [row for row in rows if row["row"].startswith("random,")]
    for row in rows:
        if row not in draws:
            shown.append(row)
        elif row is draws[0]:
            numbers = [key for key, value in row.items() if isinstance(value, float)]
            mean = {key: float(np.mean([draw[key] for draw in draws])) for key in numbers}
            shown.append(row | mean | {"row": f"random, mean of {len(draws)}"})
    to_come = f"\nNot done yet: {'; '.join(left)}.\n" if left else ""
    return table(TABLE_COLUMNS, shown) + to_come


@dataclass(frozen=True)
class Work:
    """Inputs of a result: the study's folder `root`, the results of cells, the size, the number of
    rocks, and the command."""

    root: Path
    results: Found
    size: ReproduceSize
    count: int
    command: str

    @property
    def out(self) -> Path:
        """Folder for the files."""
        return self.root / "results"


def write_table1(work: Work) -> list[Path]:
    """table1.csv, .json and .md of the runs that are done."""
    rows = table_rows(work.results, work.size)
    done = {row["row"] for row in rows}
    left = [label for label in reproduce.table_runs(work.size) if label not in done]
    return write_table(work.out, "table1", rows, table_text(rows, left), work.command, left=left)


def write_figures(work: Work) -> list[Path]:
    """Report on some runs of Table I, as `mgs report` draws it."""
    needed = reproduce.figure_runs(work.size)
    runs = [cell_folder(work.root, run.name) / "run" for run in needed]
    for run in runs:
        evaluate_run(run)  # draws; the metrics are there already
    return write_report(work.out / "figures", runs)


def write_setups(work: Work) -> list[Path]:
    """setups.csv, .json, .md and .png; leads.csv; where it is done, the oracle and foretold.csv."""
    return _write_setups(work, "setups", reproduce.oracle_cells(work.size, work.count))


def write_survey(work: Work) -> list[Path]:
    """survey.csv, .json, .md and .png, and survey-leads.csv: as `write_setups`."""
    return _write_setups(work, "survey", reproduce.survey_cells(work.size, work.count))


def _write_setups(work: Work, name: str, cells: Sequence[Cell]) -> list[Path]:
    rocks, prefix = work.size.some_rocks(work.count), "" if name == "setups" else f"{name}-"
    known = dict(work.results)
    for cell in cells:
        if cell.name not in known and (result := found(work.root, cell)) is not None:
            known[cell.name] = result
    done = [cell for cell in cells if cell.name in known]
    rows, predicted = setups.rows_of(known, done, rocks), setups.foretold_of(known, done, rocks)
    leads = [lead for key in setups.MEASURES for lead in setups.leads_of(rows, setups.LEADER, key)]
    files = [work.out / f"{prefix}leads.csv", work.out / f"{name}.png"]
    write_csv(files[0], leads)
    setups.draw(files[1], rows)
    text = setups.text_of(rows, leads, predicted)
    written = write_table(work.out, name, rows, text, work.command, rocks=work.count) + files
    if predicted:
        write_csv(work.out / "foretold.csv", predicted)
        written.append(work.out / "foretold.csv")
    return written


def write_flights(work: Work) -> list[Path]:
    """flights.csv, .json, .md and .png."""
    rocks = work.size.some_rocks(work.count)
    cells = reproduce.flight_cells(work.size, work.count)
    rows = flights.rows_of(work.results, cells, rocks)
    flights.draw(work.out / "flights.png", rows)
    text = flights.text_of(rows)
    written = write_table(work.out, "flights", rows, text, work.command, rocks=work.count)
    return [*written, work.out / "flights.png"]


WRITERS: dict[str, Callable[[Work], list[Path]]] = {
    "table1": write_table1,
    "figures": write_figures,
    "setups": write_setups,
    "flights": write_flights,
    "survey": write_survey,
    "oracle": write_setups,
}
"""Writers of results, which return the files written."""


def make(
    out: Path,
    name: str,
    preset: str,
    size: ReproduceSize,
    count: int,
    report: Report,
    workers: int = 1,
    scheduler: str | None = None,
) -> list[Path]:
    """Do the cells of a result over so many rocks and write it into OUT/results; returns the files.
    Table I is written anew before each cell, from the runs that are done."""
    result = reproduce.RESULTS[name]
    command = f"mgs reproduce --scale {preset} --only {name}"
    command += f" --rocks {count}" if result.count(size) > 1 else ""
    if name in ("setups", "survey", "oracle"):
        command += "".join(f" --policy {_from_here(policy)}" for policy in size.own_policies)
    if result.rocks:
        command += "".join(f" --mesh {rock.mesh.name}" for rock in size.meshes if rock.mesh)
    elif size.table.batch > 1:
        command += f" --batch {size.table.batch}"

    runs = list(reproduce.table_runs(size).values())

    def tell(cell: str, done: int, total: int) -> None:
        if name == "table1" and (so_far := known_runs(out, runs)):
            write_table1(Work(out, so_far, size, count, command))
        report(f"{name} {cell}", done, total)

    cells = result.cells(size, count)
    results = run_cells(out, cells, tell, workers=workers, scheduler=scheduler)
    return WRITERS[name](Work(out, results, size, count, command))


def _from_here(policy: str) -> str:
    """A policy, its file as a path from the current folder where it lies below it."""
    path, here = Path(policy), Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else path.name
