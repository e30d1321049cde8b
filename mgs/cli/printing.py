"""Things that several commands print."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


def print_table(console: Console, rows: Sequence[Sequence[str]]) -> None:
    """Print the table to a terminal of 80 columns."""
    from rich import box
    from rich.table import Table

    short = [
        "policy",
        "images",
        *(f"{name}\n{views}" for views in ("all", "new", "rock") for name in ("PSNR", "SSIM")),
        "cover",
    ]
    table = Table(
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        caption="dB and %; new: views never trained on; rock: those, inside its mask",
    )
    for i, heading in enumerate(short):
        # only the name may be broken: a number that is cut is wrong
        table.add_column(heading, justify="right" if i else "left", no_wrap=bool(i), overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)
