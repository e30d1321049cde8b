"""Things that several commands print."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from rich.console import Console


GROUPS = {"test": "test", "all": "all", "held_out": "new"}
"""What a set of views is called in the headings of the printed table."""

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
"""Columns of the printed table with and without test views: as many as fit into a line of 80
characters."""


def print_table(console: Console, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the rows of `mgs.report.tables.table_numbers` as a table, for 80 columns.

    Names that do not fit beside the numbers stand below, by the number of their row.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from mgs.report.tables import has_held_out, table_cell

    tested, new = any("test.psnr" in row for row in rows), has_held_out(rows)
    keys = (
        "images",
        *(key for key in SHOWN[tested] if new or not key.startswith("held_out.")),
        "coverage",
    )
    names = [row["policy"] for row in rows]

    def table(heading: str, first: Sequence[str]) -> Table:
        caption = "n: images; dB and %; new: views never trained on; rock: inside its mask"
        caption = caption if new else "n: images; dB, %; own: trained on; rock: in its mask"
        made = Table(box=box.SIMPLE_HEAD, pad_edge=False, caption=caption)
        made.add_column(heading, no_wrap=True)
        for key in keys:
            made.add_column(_heading(key, new), justify="right", no_wrap=True)
        for name, row in zip(first, rows, strict=True):
            made.add_row(Text(name), *(table_cell(key, row.get(key)) for key in keys))
        return made

    whole = table("policy", names)
    if (
        console.measure(whole, options=console.options.update(max_width=1 << 16)).maximum
        <= console.width
    ):
        console.print(whole)
        return
    numbers = [str(number) for number in range(1, len(rows) + 1)]
    console.print(table("run", numbers))
    for number, name in zip(numbers, names, strict=True):
        console.print(Text(f"{number}: {name}"), soft_wrap=True)


def _heading(key: str, new: bool) -> str:
    """A column's heading: the metric, and below it the set of views, and `rock` where the metric is
    inside its mask. new: whether there are views that were not trained on; otherwise all are the
    runs' own."""
    views, _, metric = key.partition(".")
    if not metric:
        return {"coverage": "cover", "images": "n"}.get(
            key, key
        )  # short, so that the table fits 80 columns
    name, _, mask = metric.partition("_")
    group = GROUPS[views] if new or views != "all" else "own"
    return f"{name.upper()}\n{group}" + ("\nrock" if mask else "")


@contextmanager
def cells_bar(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """Context manager: a bar of the cells of a study, and the function (name, done, total) that
    moves it."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda name, done, total: bar.update(
            task, description=name, completed=done, total=total
        )


def parse_up(text: str) -> tuple[float, float, float] | None:
    """The unit vector of an option like 0,0,1; None for auto. Raises InputError for anything
    else."""
    from mgs.data.up import unit_up
    from mgs.errors import InputError

    if text == "auto":
        return None
    try:
        return unit_up([float(part) for part in text.split(",")])
    except (ValueError, InputError):
        raise InputError(
            f"--up {text!r}: expected auto, or three numbers X,Y,Z that are not all zero, as in 0,0,1"
        ) from None


def parse_gaussians(text: str | None) -> int | Literal["auto"] | None:
    """The number of an option --gaussians, or auto. Raises InputError for anything else."""
    from mgs.errors import InputError

    if text is None:
        return None
    if text == "auto":
        return "auto"
    try:
        return int(text)
    except ValueError:
        raise InputError(f"--gaussians {text!r}: expected a whole number, or auto") from None
