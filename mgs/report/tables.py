"""The table that compares runs: as numbers, as text, as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.policy.poses import path_length
from mgs.report.runs import dataset_of, evaluated_runs
from mgs.run.ending import RunEnd

COLUMNS = {
    "policy": "policy",
    "images": "images",
    "test.psnr": "PSNR, test views (dB)",
    "test.ssim": "SSIM, test views",
    "test.psnr_mask": "PSNR, test views, rock only (dB)",
    "test.ssim_mask": "SSIM, test views, rock only",
    "test.psnr_mask_corrected": "PSNR, test views, rock only, exposure fitted to each view (dB)",
    "all.psnr": "PSNR, all (dB)",
    "all.ssim": "SSIM, all",
    "held_out.psnr": "PSNR, held out (dB)",
    "held_out.ssim": "SSIM, held out",
    "held_out.psnr_mask": "PSNR, held out, rock only (dB)",
    "held_out.ssim_mask": "SSIM, held out, rock only",
    "held_out.psnr_mask_corrected": "PSNR, held out, rock only, exposure fitted to each view (dB)",
    "coverage": "coverage (%)",
    "path": "path ({unit})",
    "ended": "ended by",
}
"""Columns of the table: the key of the number in a row of `table_numbers` -> the heading. Those of
the test views stand first, because they are the same for every run; where no run was measured on
test views, they are left out, and where no run has views held out, those of them; where no run
estimated the exposure of images, those with an exposure that was fitted; where all runs spent their
budget, why they ended. Rows that older versions wrote have no path (`table_columns`)."""


def table_numbers(folders: Sequence[str | Path]) -> list[dict[str, Any]]:
    """One row for each run, as numbers.

    policy: the run's label (`evaluated_runs`); images: how many the model was trained on; coverage:
    of the surface, per cent;
    path: from view to view in straight lines, from the first seed on; unit: of its length, metres
    where it is "m";
    test.NAME (where the dataset has test views), all.NAME and held_out.NAME: the means in
    metrics.json, PSNR in dB, None if there is no view to average. A run that estimated the exposure
    of images has "exposure": True, and one that ended before its budget was spent has "ended": the
    reason (`mgs.run.ending.RunEnd`). Raises InputError as `evaluated_runs` and `dataset_of`.
    """
    rows, runs = [], evaluated_runs(folders)
    dataset = dataset_of(list(runs.values()))
    for label, run in runs.items():
        metrics = run.metrics or {}
        row = {"policy": label, "images": metrics["images"]}
        sets = [views for views in ("test", "all", "held_out") if views in metrics]
        row |= {
            f"{views}.{name}": metrics[views][name] for views in sets for name in metrics[views]
        }
        row |= {"exposure": True} if run.settings.get("exposure") else {}
        row |= (
            {"ended": run.ended["reason"]}
            if run.ended and run.ended["reason"] != RunEnd.BUDGET
            else {}
        )
        path = path_length(
            np.array([dataset.frames[i].camera.position for i in run.seeds + run.chosen])
        )
        rows.append(
            row | {"coverage": 100 * run.steps[-1]["coverage"], "path": path, "unit": dataset.unit}
        )
    return rows


def table_columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The keys of COLUMNS, in order, that say something of these rows of `table_numbers`."""
    exposure, tests = (
        any(row.get("exposure") for row in rows),
        any("test.psnr" in row for row in rows),
    )
    shown = [
        key
        for key in COLUMNS
        if (exposure or "corrected" not in key) and (tests or not key.startswith("test."))
    ]
    if not has_held_out(rows):
        shown = [key for key in shown if not key.startswith("held_out.")]
    return [key for key in shown if key not in ("path", "ended") or any(key in row for row in rows)]


def has_held_out(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a run of these rows has views with images that it was not trained on. Rows of older
    versions have no count."""
    return any(row.get("held_out.count", 1) for row in rows)


def table_cell(column: str, value: Any) -> str:
    """A number of the table as text, with two decimals, of an SSIM four; a dash for None. column: a
    key of COLUMNS."""
    if value is None:
        return "–"
    return (
        f"{value:.4f}"
        if "ssim" in column
        else f"{value:.2f}"
        if isinstance(value, float)
        else str(value)
    )


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows of `table_numbers` as a Markdown table, with the numbers aligned to the right."""
    columns = table_columns(rows)
    every = ", all" if has_held_out(rows) else ", views trained on"
    headings = [
        COLUMNS[key].replace("{unit}", rows[0].get("unit", "m")).replace(", all", every)
        for key in columns
    ]
    return markdown(headings, [[table_cell(key, row.get(key)) for key in columns] for row in rows])


def markdown(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; all columns but the first are right-aligned."""
    lines = [heading, ["---", *["---:"] * (len(heading) - 1)], *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
