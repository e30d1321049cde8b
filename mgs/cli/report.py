"""`mgs report`: compare runs by figures and a table, or by one HTML page."""

from functools import partial
from pathlib import Path
from typing import Literal

from mgs import runtime
from mgs.cli.printing import print_quality
from mgs.cli.progress import progress_bar
from mgs.cli.terminal import Terminal, echo
from mgs.errors import InputError
from mgs.files import check_new_file, folder_locked


def report(
    runs: list[Path],
    out: Path | None = None,
    figures: Literal["png", "pdf", "svg"] | None = None,
    html: Path | None = None,
    force: bool = False,
) -> None:
    """Compare runs: draw the orbit, information gain, coverage, PSNR against images and one test
    view, and make a table.

    If the dataset has no test views, PSNR is over all views, and the view drawn is one that the
    fewest runs were trained on. Figures need runs that are finished and measured by `mgs eval`.

    The page of --html takes unfinished runs, too, and draws the model that the run folder holds.

    - runs: Run folders, or folders of them; all of one dataset.
    - out: Folder for the figures and the table. Default: report; with --html none.
    - figures: Format of the figures. Default: png.
    - html: Interactive HTML page to write; one file that opens without a network.
    """
    if figures and html is not None and out is None:
        raise InputError(f"--figures {figures}: --html alone writes no figures; give --out, too")
    if html is not None:
        check_new_file(html, force)
    runtime.start()
    if out is not None or html is None:
        _write_figures(runs, out or Path("report"), figures or "png", force)
    if html is not None:
        from mgs.reports.page import write_page

        with progress_bar() as bar:
            size = write_page(html, runs, progress=partial(bar, "drawing"))
        echo(f"wrote {html} ({size / 1e6:.1f} MB)")


def _write_figures(runs: list[Path], out: Path, kind: str, force: bool) -> None:
    from mgs.reports.runs import compare_runs
    from mgs.reports.tables import comparison_rows
    from mgs.reports.writing import report as compared_in
    from mgs.reports.writing import report_files
    from mgs.run.ending import why_ended

    for name in report_files(kind):
        check_new_file(out / name, force)
    by_label = compare_runs(runs)
    with folder_locked(out):
        files = compared_in(list(by_label.values()), out, kind)
    rows = comparison_rows(by_label)
    print_quality(Terminal(), rows)
    for row, run in zip(rows, by_label.values(), strict=True):
        if run.settings.budget:
            path = f"a path of {row['path']:.2f} {row['unit']}"
            echo(f"{row['policy']}: {path}; the run has ended: {why_ended(run.ended or {})}")
    for file in files:
        echo(f"wrote {file}")
    choices = any(run.settings.budget for run in by_label.values())
    if choices and not any(file.stem == "psnr" for file in files):
        echo("PSNR against images is left out: make all runs with evaluate_every to have it")
