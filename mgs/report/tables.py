"""The table that compares runs: as numbers, as text, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mgs.report.runs import evaluated_runs

COLUMNS = {
    "policy": "policy",
    "images": "images",
    "all.psnr": "PSNR, all (dB)",
    "all.ssim": "SSIM, all",
    "held_out.psnr": "PSNR, held out (dB)",
    "held_out.ssim": "SSIM, held out",
    "held_out.psnr_mask": "PSNR, held out, rock only (dB)",
    "held_out.ssim_mask": "SSIM, held out, rock only",
    "coverage": "coverage (%)",
}
"""Columns of the table: the key of the number in a row of `table_numbers` -> the heading."""


def table_numbers(folders: Sequence[str | Path]) -> list[dict[str, Any]]:
    """One row for each run, as numbers.

    policy: the run's label (`evaluated_runs`); images: how many the model was trained on; coverage: of the surface, per cent;
    all.NAME and held_out.NAME: the means in metrics.json, PSNR in dB, None if there is no view to average.
    Raises InputError as `evaluated_runs`.
    """
    rows = []
    for label, run in evaluated_runs(folders).items():
        metrics = run.metrics or {}
        row = {"policy": label, "images": metrics["images"]}
        row |= {f"{views}.{name}": metrics[views][name] for views in ("all", "held_out") for name in metrics[views]}
        rows.append(row | {"coverage": 100 * run.steps[-1]["coverage"]})
    return rows


def table_rows(folders: Sequence[str | Path]) -> list[list[str]]:
    """One row of text for each run, with the cells in the order of COLUMNS. Raises InputError as `evaluated_runs`."""
    return [[table_cell(column, row.get(column)) for column in COLUMNS] for row in table_numbers(folders)]


def table_cell(column: str, value: Any) -> str:
    """A number of the table as text, with two decimals, of an SSIM four; a dash for None. column: a key of COLUMNS."""
    if value is None:
        return "–"
    return f"{value:.4f}" if "ssim" in column else f"{value:.2f}" if isinstance(value, float) else str(value)


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """The rows of `table_rows` as a Markdown table, with the numbers aligned to the right."""
    heading = "| " + " | ".join(COLUMNS.values()) + " |\n|" + " --- |" + " ---: |" * (len(COLUMNS) - 1) + "\n"
    return heading + "".join("| " + " | ".join(row) + " |\n" for row in rows)
