"""Things that several commands print."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


def print_table(console: Console, rows: Sequence[Sequence[str]]) -> None:
    """Print the table, for 80 columns; names that do not fit beside the numbers stand below, by the number of their row."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    short = ["images", *(f"{name}\n{views}" for views in ("all", "new", "rock") for name in ("PSNR", "SSIM")), "cover"]
    names = [row[0] for row in rows]

    def table(heading: str, first: Sequence[str]) -> Table:
        made = Table(
            box=box.SIMPLE_HEAD,
            pad_edge=False,
            caption="dB and %; new: views never trained on; rock: those, inside its mask",
        )
        made.add_column(heading, no_wrap=True)
        for heading in short:
            made.add_column(heading, justify="right", no_wrap=True)
        for name, row in zip(first, rows, strict=True):
            made.add_row(Text(name), *row[1:])
        return made

    whole = table("policy", names)
    if console.measure(whole, options=console.options.update(max_width=1 << 16)).maximum <= console.width:
        console.print(whole)
        return
    numbers = [str(number) for number in range(1, len(rows) + 1)]
    console.print(table("run", numbers))
    for number, name in zip(numbers, names, strict=True):
        console.print(Text(f"{number}: {name}"), soft_wrap=True)


def parse_up(text: str) -> tuple[float, float, float] | None:
    """The unit vector of an option like 0,0,1; None for auto. Raises InputError for anything else."""
    from mgs.data.up import unit_up
    from mgs.errors import InputError

    if text == "auto":
        return None
    try:
        return unit_up([float(part) for part in text.split(",")])
    except (ValueError, InputError):
        raise InputError(f"--up {text!r}: expected auto, or three numbers X,Y,Z that are not all zero, as in 0,0,1") from None
