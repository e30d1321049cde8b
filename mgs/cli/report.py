"""`mgs report`: figures and a table that compare runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs on one dataset, each measured with `mgs eval`.")],
    out: Annotated[
        Path, typer.Option(help="Folder for the figures and the table; files of an earlier report are replaced.")
    ] = Path("report"),
) -> None:
    """Compare runs: orbit, information gain, coverage, PSNR against images, one held-out view, and the table.

    Draws from the files of the runs alone.
    """
    from rich.console import Console

    from mgs.cli.printing import print_table
    from mgs.files import check_writable
    from mgs.report.tables import table_rows
    from mgs.report.writing import write_report

    check_writable(out / "table.md")  # known before the figures are drawn
    written = write_report(out, runs)
    print_table(Console(), table_rows(runs))
    for path in written:
        typer.echo(f"wrote {path}")
