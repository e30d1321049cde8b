"""`mgs report`: compare runs by figures and a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    runs: Annotated[list[Path], typer.Argument(help="Run folders, all of one dataset, each measured by `mgs eval`.")],
    out: Annotated[
        Path, typer.Option(help="Folder for the figures and the table. Files of an earlier report are replaced.")
    ] = Path("report"),
) -> None:
    """Compare runs: draw the orbit, information gain, coverage, PSNR against images and one test view, and make a table.

    Where the dataset has no test views, a view is drawn that the fewest runs were trained on, and PSNR is over all views.

    Everything is taken from the files of the runs; nothing is computed anew.
    """
    from rich.console import Console

    from mgs.cli.printing import print_table
    from mgs.files import check_writable
    from mgs.report.tables import table_numbers
    from mgs.report.writing import write_report

    check_writable(out / "table.md")  # before the figures are drawn, not after it
    written = write_report(out, runs)
    print_table(Console(), table_numbers(runs))
    for path in written:
        typer.echo(f"wrote {path}")
