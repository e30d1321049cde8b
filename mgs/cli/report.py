"""`mgs report`: compare runs by figures and a table, or by one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    runs: Annotated[list[Path], typer.Argument(help="Run folders, all of one dataset.")],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the figures and the table. Files of an earlier report are replaced.",
            show_default="report; with --html none",
        ),
    ] = None,
    figures: Annotated[
        str | None,
        typer.Option(
            metavar="png|pdf|svg", help="What the figures are written as.", show_default="png"
        ),
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            "--html",
            help="One page with everything, interactive; it opens from the disk and loads nothing.",
        ),
    ] = None,
) -> None:
    """Compare runs: draw the orbit, information gain, coverage, PSNR against images and one test
    view, and make a table.

    Where the dataset has no test views, a view is drawn that the fewest runs were trained on, and
    PSNR is over all views.

    The figures are taken from the files of runs that are finished and measured by `mgs eval`;
    nothing is computed anew.

    The page of --html is made of what is there, also of an unfinished run: for its pictures, the
    model that the run folder holds is drawn.
    """
    from mgs.errors import InputError
    from mgs.files import check_writable
    from mgs.plotting import FORMATS

    if figures not in (None, *FORMATS):
        raise InputError(f"--figures {figures}: unknown; choose one of {', '.join(FORMATS)}")
    if figures and html is not None and out is None:
        raise InputError(f"--figures {figures}: --html alone writes no figures; give --out, too")
    if html is not None and check_writable(html).is_dir():
        raise InputError(f"--html {html}: is a folder; name a file to write")
    if out is not None or html is None:
        _write_figures(runs, out or Path("report"), figures or "png")
    if html is not None:
        _write_page(runs, html)


def _write_figures(runs: list[Path], out: Path, kind: str) -> None:
    """Write the figures and the table, print the table, and say what was left out."""
    from rich.console import Console

    from mgs.cli.printing import print_quality
    from mgs.files import check_writable
    from mgs.report.runs import compare_runs
    from mgs.report.tables import comparison_rows
    from mgs.report.writing import write_report
    from mgs.run.ending import why_ended

    check_writable(out / "table.md")  # before the figures are drawn, not after it
    compared = compare_runs(runs)
    written = write_report(out, compared, kind)
    rows = comparison_rows(compared)
    print_quality(Console(), rows)
    for row, run in zip(rows, compared.runs.values(), strict=True):
        if run.ended:
            length = f"{row['path']:.2f} {row['unit']}"
            typer.echo(
                f"{row['policy']}: a path of {length}; the run has ended: {why_ended(run.ended)}"
            )
    for path in written:
        typer.echo(f"wrote {path}")
    if not any(path.stem == "psnr" for path in written):
        typer.echo(
            "PSNR against images is left out: it needs that all runs were made with --evaluate-every"
        )


def _write_page(runs: list[Path], html: Path) -> None:
    """Write the page, with a progress bar, and print its size."""
    from functools import partial

    from mgs import runtime
    from mgs.cli.progress import progress_bar
    from mgs.report.page import write_page

    runtime.start()
    with progress_bar() as bar:
        size = write_page(html, runs, progress=partial(bar, "drawing"))
    typer.echo(f"wrote {html} ({size / 1e6:.1f} MB)")
