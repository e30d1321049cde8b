"""The table that compares runs: as numbers, as cells of text, as Markdown."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mgs.policy.poses import path_length
from mgs.reports.runs import check_measured
from mgs.run.ending import RunEnd
from mgs.run.folder import Run

SETS = {"test": "test views", "all": "all views", "held_out": "held-out views"}
WHOLE = {"psnr": "PSNR, {} (dB)", "ssim": "SSIM, {}"}
OTHERS = {
    "psnr_corrected": "PSNR, {}, exposure fitted (dB)",
    "psnr_mask": "masked PSNR, {} (dB)",
    "ssim_mask": "masked SSIM, {}",
    "psnr_mask_corrected": "masked PSNR, {}, exposure fitted (dB)",
}
HEADERS = {"policy": "policy", "images": "images"}
HEADERS |= {
    f"{key}.{metric}": heading.format(views)
    for key, views in SETS.items()
    for metric, heading in (WHOLE if key == "all" else WHOLE | OTHERS).items()
}
HEADERS |= {"coverage": "coverage (%)", "path": "path ({unit})", "ended": "ended by"}
"""Columns of the table: key in a row of `comparison_rows` -> heading."""


def comparison_rows(runs: Mapping[str, Run]) -> list[dict[str, Any]]:
    """Numbers of each run, a row each. runs: by label (`mgs.reports.runs.compare_runs`).

    policy: the label; images: number of training images; coverage: per cent. path: length of the
    lines from view to view, in `unit`. test.NAME, all.NAME, held_out.NAME: means in metrics.json,
    PSNR in dB. exposure: True, if the run estimated it. ended: the reason, only if before the
    budget was spent. Raises InputError if a run was not evaluated since its last step."""
    for run in runs.values():
        check_measured(run)
    return [table_row(label, run) for label, run in runs.items()]


def table_row(label: str, run: Run) -> dict[str, Any]:
    """Row of `comparison_rows`; without metrics if they are not of the run's last step."""
    row = metrics_row(label, (run.measured or {}) | {"images": len(run.indices)})
    if run.settings.exposure:
        row["exposure"] = True
    if run.ended and run.ended["reason"] != RunEnd.BUDGET:
        row["ended"] = run.ended["reason"]
    positions = np.array([frame.camera.position for frame in run.taken])
    row |= {"coverage": 100 * run.steps[-1]["coverage"], "path": path_length(positions)}
    return row | {"unit": run.dataset.unit}


def metrics_row(label: str, metrics: Mapping[str, Any]) -> dict[str, Any]:
    row = {"policy": label, "images": metrics["images"]}
    for views in ("test", "all", "held_out"):
        row |= {f"{views}.{name}": value for name, value in metrics.get(views, {}).items()}
    return row


def table_columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Keys of HEADERS of which some row has a value, in order."""
    exposure, masked = any(row.get("exposure") for row in rows), is_masked(rows)
    return [
        key
        for key in HEADERS
        if any(row.get(key) is not None for row in rows)
        and (masked or "mask" not in key)
        and ("corrected" not in key or (exposure and masked == ("mask" in key)))
    ]


def is_masked(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Whether values in masks differ from those of whole images in some row."""
    sets = [f"{views}.psnr" for views in ("test", "held_out")]
    return any(row.get(key) != row.get(f"{key}_mask") for row in rows for key in sets)


def has_held_out(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a run of these rows has views with images that it was not trained on."""
    return any(row.get("held_out.count", 1) for row in rows)


def table_cell(key: str, value: Any) -> str:
    """Format a number as a table cell: SSIM with four decimals, PSNR (dB), coverage (%) and path
    with two, others with five digits; a dash for None. key: its name, as in HEADERS or
    metrics.json."""
    if value is None:
        return "–"
    if not isinstance(value, float):
        return str(value)
    if "ssim" in key:
        return f"{value:.4f}"
    return f"{value:.2f}" if "psnr" in key or key in ("coverage", "path") else f"{value:.5g}"


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    columns = table_columns(rows)
    headings = [table_heading(key, rows) for key in columns]
    return markdown(headings, [[table_cell(key, row.get(key)) for key in columns] for row in rows])


def table_heading(key: str, rows: Sequence[Mapping[str, Any]]) -> str:
    every = "all views" if has_held_out(rows) else "training views"
    return HEADERS[key].replace("{unit}", rows[0]["unit"]).replace("all views", every)


def markdown(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table; all columns but the first are right-aligned."""
    lines = [heading, ["---", *["---:"] * (len(heading) - 1)], *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
