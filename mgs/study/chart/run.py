"""`mgs chart`: cells, tables and figures of every chart."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mgs.data.dataset import load_dataset
from mgs.study.case import test_views_of
from mgs.study.chart import drawing, fits, scoring
from mgs.study.chart.fits import SIZES, Data
from mgs.study.output import Content, table, write_table
from mgs.study.sweep import Cell, Report, Results, run_cells
from mgs.study.verdict import Claim, Row, judged, verdict_table


@dataclass(frozen=True)
class Chart:
    """A chart: cells(data, repeats); rows(data, root, results, seconds of the reference); columns of
    its table, of the rows that `shown` picks; figure; claims about the rows."""

    cells: Callable[[Data, int], list[Cell]]
    rows: Callable[[Data, Path, Results, float], list[Row]]
    columns: Mapping[str, Content]
    draw: Callable[[Path, Sequence[Row]], None]
    shown: Callable[[Sequence[Row]], Sequence[Row]] = lambda rows: rows
    claims: Sequence[Claim] = ()


CHARTS = {
    "fit": Chart(fits.cells, fits.rows, fits.COLUMNS, drawing.fit_figure, fits.shown, fits.CLAIMS),
    "scoring": Chart(scoring.cells, scoring.rows, scoring.COLUMNS, drawing.scoring_figure),
}


def run_chart(
    out: Path,
    preset: str,
    kinds: Sequence[str],
    repeats: int | None,
    dataset: Path | None,
    report: Report,
) -> dict[str, tuple[list[Row], list[Row]]]:
    """Measure some CHARTS, and write KIND.csv, .json, .md and .png of each; returns their rows and
    judged claims.

    preset: of `SIZES`. repeats: by default those of the size. dataset: in place of the rendered
    one (`check_dataset`).
    """
    size = SIZES[preset]
    repeats = repeats or size.repeats
    data = Data(size, dataset.resolve() if dataset else None)
    cells = {cell.name: cell for kind in kinds for cell in CHARTS[kind].cells(data, repeats)}
    found = run_cells(out, list(cells.values()), report)
    units = [result["reference"] for result in found.values() if "reference" in result]
    unit, measured = float(np.median(units)), {}
    for kind in kinds:
        chart = CHARTS[kind]
        words = ["mgs", "chart", str(out), "--only", kind, "--preset", preset]
        words += ["--repeats", str(repeats), *(["--dataset", str(dataset)] if dataset else [])]
        rows = chart.rows(data, out, found, unit)
        claims = [judged(claim, rows) for claim in chart.claims]
        text = table(chart.columns, chart.shown(rows))
        text += f"\n{verdict_table(claims)}" if claims else ""
        more = {"preset": preset, "repeats": repeats, "reference_seconds": unit, "claims": claims}
        write_table(out, kind, rows, text, shlex.join(words), **more)
        chart.draw(out / f"{kind}.png", rows)
        measured[kind] = rows, claims
    return measured


def check_dataset(dataset: Path | None) -> None:
    """Raises InputError for a dataset that cannot be read or has no test views."""
    if dataset is not None:
        test_views_of(load_dataset(dataset))
