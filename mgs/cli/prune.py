"""`mgs prune`: a smaller model of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mgs.policy.criteria import PRUNE_NOISE


def prune(
    run: Annotated[Path, typer.Argument(help="Folder that `mgs nbv` wrote.")],
    noise: Annotated[
        float,
        typer.Option(help="Allowed change of the training images: rms of a pixel, linear RGB."),
    ] = PRUNE_NOISE,
) -> None:
    """Leave out the Gaussians of a run without which its images hardly change; write
    RUN/gaussians_pruned.ply.

    The change by the removal of each Gaussian is known exactly; the change by the removal of all of
    them together is measured, and stays within --noise. Nothing is fitted again, and the run itself
    stays as it is.
    """
    from rich.console import Console

    from mgs import runtime
    from mgs.cli.progress import progress_bar
    from mgs.report.pruning import PRUNED, prune_run

    runtime.start()
    with progress_bar() as bar:
        found = prune_run(run, noise, bar)
    share = 1 - found.after / found.before
    lines = [
        f"{found.before:,} Gaussians, {found.after:,} stay: {share:.0%} are left out",
        f"rms change of a pixel value: predicted {found.predicted:.2g}, "
        f"measured {found.actual:.2g}, allowed {noise:.2g}",
    ]
    if found.psnr:
        before, after = found.psnr
        lines.append(
            f"PSNR on the {found.views} views: {before:.2f} dB before, {after:.2f} dB after"
        )
    for line in [*lines, f"wrote {run / PRUNED}"]:
        Console(highlight=False).print(line, soft_wrap=True)
