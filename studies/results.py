"""Table I, set-ups, survey, oracle and flights: their cells, and the tables and figures of them.

A result is a row of RESULTS; its cells are datasets, priors and runs. Cells that several results
need are done once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mgs.errors import InputError
from mgs.files import write_csv
from mgs.reports.evaluation import evaluate_run
from mgs.reports.writing import report
from mgs.run import policy_file
from mgs.run.inputs import file_digest
from studies import certificate, flights, setups
from studies.case import Rock
from studies.output import table, write_table
from studies.setups import ORACLE, POLICIES, SURVEYED, Found, cells_of
from studies.statistics import MOST_ROCKS
from studies.sweep import Cell, Report, cell_folder, found, run_cells
from studies.table1 import FRESH, ReproduceSize, Run, figure_runs, table_runs
from studies.verdict import Row

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


def _known(root: Path, cells: Iterable[Cell]) -> Found:
    """Results of the cells that are done."""
    results = {cell.name: found(root, cell) for cell in cells}
    return {name: result for name, result in results.items() if result is not None}


def table_rows(results: Found, size: ReproduceSize) -> Rows:
    """Table I: a row for each run that is done."""
    rows = []
    for label, run in table_runs(size).items():
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
    """Inputs of a result: the study's folder `root`, the cells and the results of those that are
    done, the size, the number of rocks, and the command."""

    root: Path
    cells: Sequence[Cell]
    results: Found
    size: ReproduceSize
    count: int
    command: str

    @property
    def out(self) -> Path:
        """Folder for the files."""
        return self.root / "results"


def write_table1(work: Work) -> list[Path]:
    """table1.csv, .json and .md of the runs that are done; where all are, the figures too."""
    rows = table_rows(work.results, work.size)
    done = {row["row"] for row in rows}
    left = [label for label in table_runs(work.size) if label not in done]
    text = table_text(rows, left)
    written = write_table(work.out, "table1", rows, text, work.command, left=left)
    return written if left else [*written, *_write_figures(work)]


def _write_figures(work: Work) -> list[Path]:
    """Report on some runs of Table I, as `mgs report` draws it."""
    runs = [cell_folder(work.root, run.name) / "run" for run in figure_runs(work.size)]
    for run in runs:
        evaluate_run(run)  # draws; the metrics are there already
    return report(runs, work.out / "figures")


def write_setups(work: Work) -> list[Path]:
    """setups.csv, .json, .md and .png; leads.csv; where it is done, the oracle and foretold.csv."""
    return _write_setups(work, "setups", _oracle_cells(work.size, work.count))


def write_survey(work: Work) -> list[Path]:
    """survey.csv, .json, .md and .png, and survey-leads.csv: as `write_setups`."""
    return _write_setups(work, "survey", work.cells)


def _write_setups(work: Work, name: str, cells: Sequence[Cell]) -> list[Path]:
    prefix = "" if name == "setups" else f"{name}-"
    known = _known(work.root, cells)
    done = [cell for cell in cells if cell.name in known]
    rows, predicted = setups.rows_of(known, done), setups.foretold_of(known, done)
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
    rows = flights.rows_of(work.results, work.cells)
    flights.draw(work.out / "flights.png", rows)
    text = flights.text_of(rows)
    written = write_table(work.out, "flights", rows, text, work.command, rocks=work.count)
    return [*written, work.out / "flights.png"]


def write_certificate(work: Work) -> list[Path]:
    """certificate.csv, .json, .md and .png, and certificate-curve.csv and -losses.csv."""
    rows = certificate.rows_of(work.results, work.cells)
    losses = certificate.losses_of(work.results, work.cells)
    curve = certificate.curve_of(work.results, work.cells)
    certificate.draw(work.out / "certificate.png", curve)
    text = certificate.text_of(rows, losses)
    written = write_table(work.out, "certificate", rows, text, work.command, rocks=work.count)
    more = [("curve", curve), ("losses", losses)]
    written += [write_csv(work.out / f"certificate-{name}.csv", of) for name, of in more]
    return [*written, work.out / "certificate.png"]


def _runs_cells(runs: Iterable[Run]) -> list[Cell]:
    return [cell for run in runs for cell in run.cells()]


def _setup_cells(size: ReproduceSize, count: int) -> list[Cell]:
    return cells_of(size.setups, size.some_rocks(count), size.policies)


def _survey_cells(size: ReproduceSize, count: int) -> list[Cell]:
    return cells_of(size.setups, size.some_rocks(count), size.policies, SURVEYED)


def _oracle_cells(size: ReproduceSize, count: int) -> list[Cell]:
    """Set-ups, and the oracle in each on the same rocks."""
    rocks = size.some_rocks(count)
    return _setup_cells(size, count) + cells_of(size.setups, rocks, (ORACLE,))


def _flight_cells(size: ReproduceSize, count: int) -> list[Cell]:
    return flights.cells_of(size.flights, size.some_rocks(count))


def _certificate_cells(size: ReproduceSize, count: int) -> list[Cell]:
    return certificate.cells_of(size.setups, size.some_rocks(count))


@dataclass(frozen=True)
class Result:
    """A study of this module.

    cells(size, rocks): the cells that it needs. write(work): writes it and returns the files.
    rocks: attribute of the size with its default number of rocks; None: it has the one of Table I.
    """

    cells: Callable[[ReproduceSize, int], list[Cell]]
    write: Callable[[Work], list[Path]]
    rocks: str | None = None

    def count(self, size: ReproduceSize) -> int:
        """Default number of rocks."""
        return getattr(size, self.rocks) if self.rocks else 1


RESULTS = {
    "table1": Result(lambda size, _: _runs_cells(table_runs(size).values()), write_table1),
    "setups": Result(_setup_cells, write_setups, "setup_rocks"),
    "flights": Result(_flight_cells, write_flights, "setup_rocks"),
    "certificate": Result(_certificate_cells, write_certificate, "setup_rocks"),
    "survey": Result(_survey_cells, write_survey, "setup_rocks"),
    "oracle": Result(_oracle_cells, write_setups, "oracle_rocks"),
}


def rocks_of(name: str, size: ReproduceSize, asked: int | None) -> int:
    """Number of rocks of a result, asked for or default. Raises InputError if out of range."""
    if asked is None:
        return RESULTS[name].count(size)
    most = len(size.meshes or FRESH)
    if not 1 <= asked <= most:
        raise InputError(f"--rocks {asked}: {name} can have 1 to {most}")
    return asked


NAMESAKE = "there is one of this name already; leave it out, or rename its file"


def with_options(
    size: ReproduceSize, policies: Sequence[str], meshes: Sequence[Path], batch: int
) -> ReproduceSize:
    """Size with the options --policy, --mesh and --batch.

    Raises InputError if a policy is unknown or already compared, two policies or meshes have the
    same name, or a mesh cannot be read or is one too many.
    """
    labels = list(POLICIES)
    for policy in policies:
        if policy in POLICIES:
            raise InputError(f"--policy {policy}: is compared anyway; leave it out")
        if policy_file.label(policy) in labels:
            raise InputError(f"--policy {policy}: {NAMESAKE}")
        labels.append(policy_file.label(policy))
        policy_file.policy_of(policy)
    size = replace(size, own_policies=tuple(policy_file.absolute(policy) for policy in policies))
    if batch > 1:
        size = replace(size, table=replace(size.table, batch=batch))
    return _with_meshes(size, meshes) if meshes else size


def _with_meshes(size: ReproduceSize, meshes: Sequence[Path]) -> ReproduceSize:
    if len(meshes) > MOST_ROCKS:
        raise InputError(
            f"--mesh: {len(meshes)} files; differences are tested over {MOST_ROCKS} rocks at most, "
            "leave some out"
        )
    rocks: list[Rock] = []
    for k, mesh in enumerate(meshes):
        if mesh.stem in [rock.scene for rock in rocks]:
            raise InputError(f"--mesh {mesh}: {NAMESAKE}")
        rocks.append(Rock(mesh.stem, 0, k, mesh.resolve(), file_digest(mesh)))
    count = len(rocks)
    return replace(size, meshes=tuple(rocks), setup_rocks=count, oracle_rocks=count)


def make(
    out: Path,
    name: str,
    scale: str,
    size: ReproduceSize,
    count: int,
    report: Report,
    workers: int = 1,
    scheduler: str | None = None,
) -> list[Path]:
    """Do the cells of a result over so many rocks and write it into OUT/results; returns the files.
    Table I is written anew before each cell, from the runs that are done."""
    result = RESULTS[name]
    command = f"python -m studies.{name} OUT --scale {scale}"
    command += f" --rocks {count}" if result.count(size) > 1 else ""
    command += "".join(f" --policy {_from_here(policy)}" for policy in size.own_policies)
    command += "".join(f" --mesh {rock.mesh.name}" for rock in size.meshes if rock.mesh)
    command += f" --batch {size.table.batch}" if size.table.batch > 1 else ""
    cells = result.cells(size, count)
    timed = [cell for cell in cells if cell.alone]

    def tell(cell: str, done: int, total: int) -> None:
        if name == "table1" and (so_far := _known(out, timed)):
            write_table1(Work(out, cells, so_far, size, count, command))
        report(cell, done, total)

    results = run_cells(out, cells, tell, workers=workers, scheduler=scheduler)
    return result.write(Work(out, cells, results, size, count, command))


def _from_here(policy: str) -> str:
    """A policy, its file as a path from the current folder where it lies below it."""
    path, here = Path(policy), Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else path.name
