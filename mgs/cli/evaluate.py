"""`mgs eval`: how good the model of a run is, and its renders beside the truth."""

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
) -> None:
    """Measure the model on the test views, on all views, and on the views never trained on; write
    RUN/metrics.json, and renders beside truth.

    What is there already of this very model and dataset is kept, and not measured or drawn again.
    The truth is the rock on black. PSNR and SSIM are over the full frame, and over the pixels of
    the rock only. metrics.json also has the errors of alpha and depth, where the dataset has their
    truth.
    """
    from rich.console import Console
    from rich.progress import Progress

    from mgs import runtime
    from mgs.cli.printing import print_table
    from mgs.report.evaluation import evaluate_run
    from mgs.report.tables import table_numbers

    runtime.start()
    said: list[str] = []
    with Progress(transient=True) as bar:
        task = bar.add_task("rendering and comparing", total=None)
        evaluate_run(
            run,
            pictures=pictures,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
            say=said.append,
        )
    print_table(Console(), table_numbers([run]))
    typer.echo("\n".join(said))
