"""`mgs eval`: quality of the model of a run, and its renders beside the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def evaluate(
    run: Annotated[Path, typer.Argument(help="Folder that `mgs nbv` wrote.")],
    pictures: Annotated[
        bool,
        typer.Option(
            help="Write truth, render and difference of every view, side by side, to RUN/renders."
        ),
    ] = True,
    convergence: Annotated[
        bool,
        typer.Option(
            "--convergence",
            help="Measure how much lower the last fit's objective could get (Newton decrease).",
        ),
    ] = False,
) -> None:
    """Measure the model on the test views, on all views, and on the views never trained on; write
    RUN/metrics.json, and renders beside truth.

    Metrics and pictures of this very model and dataset are kept, and not made again. The truth is
    the rock on black. PSNR and SSIM are over the full frame, and over the pixels of the rock only.
    metrics.json also has the errors of alpha and depth, where the dataset has their truth.
    """
    from functools import partial

    from rich.console import Console

    from mgs import runtime
    from mgs.cli.printing import print_quality
    from mgs.cli.progress import progress_bar
    from mgs.report.evaluation import evaluate_run
    from mgs.report.runs import Comparison, read_run
    from mgs.report.tables import comparison_rows
    from mgs.run.ending import fit_line
    from mgs.run.folder import open_run

    runtime.start()
    said: list[str] = []
    opened = open_run(run)
    with progress_bar() as bar:
        progress = partial(bar, "rendering and comparing")
        metrics = evaluate_run(
            opened, pictures=pictures, convergence=convergence, progress=progress, say=said.append
        )
    rows = comparison_rows(Comparison({opened.label: read_run(run)}, opened.dataset))
    print_quality(Console(), rows)
    if "fit" in metrics:
        said.insert(0, fit_line(metrics["fit"], opened.state.steps[-1]["stop_reason"]))
    typer.echo("\n".join(said))
