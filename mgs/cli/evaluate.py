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
    from functools import partial

    from rich.console import Console

    from mgs import runtime
    from mgs.cli.printing import print_quality
    from mgs.cli.progress import progress_bar
    from mgs.report.evaluation import evaluate_run
    from mgs.report.tables import table_numbers

    runtime.start()
    said: list[str] = []
    with progress_bar() as bar:
        evaluate_run(
            run,
            pictures=pictures,
            progress=partial(bar, "rendering and comparing"),
            say=said.append,
        )
    print_quality(Console(), table_numbers([run]))
    typer.echo("\n".join(said))
