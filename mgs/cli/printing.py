"""Tables that commands print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

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


def print_table(
    console: Console,
    heading: Sequence[str],
    rows: Sequence[Sequence[str] | None],
    title: str | None = None,
) -> None:
    """Print a table of text. A row that is None draws a line between sections."""
    from rich.table import Table
    from rich.text import Text

    table = Table(*heading, title=title)
    for row in rows:
        if row is None:
            table.add_section()
        else:
            table.add_row(*map(Text, row))
    console.print(table)


def fits(console: Console, table: Table) -> bool:
    """Whether a table fits the width of the console without breaking a cell."""
    unlimited = console.options.update(max_width=1 << 16)
    return console.measure(table, options=unlimited).maximum <= console.width


def print_quality(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the rows of `mgs.report.tables.table_numbers` as a table, for 80 columns.

    Names that do not fit beside the numbers are printed below, by the number of their row.
    """
    from rich.text import Text

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
    from rich import box
    from rich.table import Table
    from rich.text import Text

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
