"""Tables that commands print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

if TYPE_CHECKING:
    from mgs.run.state import State

GROUPS = {"test": "test", "all": "all", "held_out": "new"}
"""Sets of views -> their names in the headings of `print_quality`."""

SHOWN = {
    True: (
        "test.psnr",
        "test.ssim",
        "test.psnr_mask",
        "all.psnr",
        "held_out.psnr",
        "held_out.psnr_mask",
    ),
    False: (
        "all.psnr",
        "all.ssim",
        "held_out.psnr",
        "held_out.ssim",
        "held_out.psnr_mask",
        "held_out.ssim_mask",
    ),
}
"""Columns of `print_quality` with and without test views: as many as fit into 80 characters."""


def fits(console: Console, table: Table) -> bool:
    """Whether a table fits the width of the console without breaking a cell."""
    unlimited = console.options.update(max_width=1 << 16)
    return console.measure(table, options=unlimited).maximum <= console.width


def print_quality(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the rows of `mgs.report.tables.comparison_rows` as a table, for 80 columns.

    Names that do not fit beside the numbers are printed below, by the number of their row.
    """
    names = [row["policy"] for row in rows]
    whole = _quality("policy", names, rows)
    if fits(console, whole):
        console.print(whole)
        return
    numbers = [str(number) for number in range(1, len(rows) + 1)]
    console.print(_quality("run", numbers, rows))
    for number, name in zip(numbers, names, strict=True):
        console.print(Text(f"{number}: {name}"), soft_wrap=True)


def _quality(heading: str, first: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> Table:
    """The table of `print_quality`. heading, first: its first column."""
    from mgs.report.tables import has_held_out, table_cell

    tested, new = any("test.psnr" in row for row in rows), has_held_out(rows)
    metrics = [key for key in SHOWN[tested] if new or not key.startswith("held_out.")]
    keys = ["images", *metrics, "coverage"]
    if new:
        caption = "n: images; dB and %; new: views never trained on; rock: inside its mask"
    else:
        caption = "n: images; dB, %; own: trained on; rock: in its mask"
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, caption=caption)
    table.add_column(heading, no_wrap=True)
    for key in keys:
        table.add_column(_heading(key, new), justify="right", no_wrap=True)
    for name, row in zip(first, rows, strict=True):
        table.add_row(Text(name), *(table_cell(key, row.get(key)) for key in keys))
    return table


def _heading(key: str, new: bool) -> str:
    """Heading of a column: the metric, and below it the set of views and `rock` for a metric inside
    the mask. new: whether some views were not trained on."""
    views, _, metric = key.partition(".")
    if not metric:
        return {"coverage": "cover", "images": "n"}[key]
    name, _, mask = metric.partition("_")
    group = GROUPS[views] if new or views != "all" else "own"
    return f"{name.upper()}\n{group}" + ("\nrock" if mask else "")


def print_run(out: Path, state: State, metrics: dict[str, Any], console: Console) -> None:
    """Print the steps of a run as a table, then the quality of its model. Names that are too wide
    for the console have a table of their own."""
    from mgs.run.ending import fit_line, why_ended

    columns = ("step", "image", "score", "coverage", "iterations", "loss", "stopped", "seconds")
    rows = []
    for line in state.steps:
        names = [line["name"]] if line["name"] else line["seed_names"]
        score = "" if line["score"] is None else f"{line['score']:.4g}"
        fit = ("", "", "")
        if "loss" in line:
            fit = (str(line["iterations"]), f"{line['loss']:.3g}", line["stop_reason"])
        coverage, seconds = f"{100 * line['coverage']:.2f} %", sum(line["seconds"].values())
        row = (str(line["step"]), "\n".join(names), score, coverage, *fit, f"{seconds:.1f}")
        rows.append(row)

    def table(*shown: int) -> Table:
        headings = (Column(columns[i], no_wrap=i != 1, overflow="fold") for i in shown)
        made = Table(*headings, box=None)
        for row in rows:
            made.add_row(*(Text(row[i]) for i in shown))
        return made

    whole = table(*range(len(columns)))
    if fits(console, whole):
        console.print(whole)
    else:
        console.print(table(0, *range(2, len(columns))))
        console.print(table(0, 1))
    for text in _quality_lines(metrics, any("exposure" in step for step in state.steps)):
        console.print(text)
    last = state.steps[-1] if state.steps else {}
    if "fit" in metrics:
        console.print(fit_line(metrics["fit"], last["stop_reason"]))
    if "ended" in last:
        console.print(f"the run has ended: {why_ended(last['ended'])}", soft_wrap=True)
    console.print(f"wrote {out}", soft_wrap=True)


def _quality_lines(metrics: dict[str, Any], exposure: bool) -> list[str]:
    """Mean quality over each set of views in metrics.json. exposure: whether the run estimated
    it."""
    from mgs.report.tables import table_cell

    every = "all views" if metrics.get("held_out", {}).get("count") else "views trained on"
    sets = {"test": "test views", "all": every, "held_out": "views never trained on"}
    lines = []
    for key, label in sets.items():
        mean = metrics.get(key, {"count": 0})
        if not mean["count"]:
            continue
        cells = {name: table_cell(name, value) for name, value in mean.items()}
        lines.append(
            f"{label} ({mean['count']}): PSNR {cells['psnr']} dB, SSIM {cells['ssim']}; "
            f"inside the rock mask PSNR {cells['psnr_mask']} dB, SSIM {cells['ssim_mask']}"
        )
        if exposure:
            lines.append(
                f"{label}, with a gain per channel fitted to each view itself: "
                f"PSNR {cells['psnr_corrected']} dB; "
                f"inside the rock mask {cells['psnr_mask_corrected']} dB"
            )
    return lines
