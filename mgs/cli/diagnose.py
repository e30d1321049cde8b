"""`mgs diagnose`: maps of what the training views of a run say about its model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def diagnose(
    run: Annotated[Path, typer.Argument(help="Folder that `mgs nbv` wrote.")],
    views: Annotated[
        str | None,
        typer.Option(
            help="Names of frames to draw, as in kf_0003,kf_0010. "
            "Default: a few that were not trained on."
        ),
    ] = None,
    calibrate: Annotated[
        bool,
        typer.Option(
            "--calibrate",
            help="Instead, predict the errors of views that were not seen, and compare.",
        ),
    ] = False,
) -> None:
    """Draw maps of the Fisher information and the uncertainty that a run has about its model, for
    views and for Gaussians.

    Writes into RUN/diagnostics: for each view an EXR with the channels R G B A Z, fisher.colour,
    fisher.scale, fisher.rotation, fisher.opacity, information, uncertainty and unobserved, and a
    PNG that shows them; and information.ply, a point for each Gaussian, coloured by its
    information.

    With --calibrate it writes uncertainty.json and uncertainty.png: how well errors are predicted
    for the test views and for frames never trained on, after a calibration on the run's own views,
    each left out of a fit once; and NAME.errors.exr, true error and predicted standard deviation of
    some views.
    """
    from functools import partial

    from mgs import runtime
    from mgs.cli.progress import progress_bar
    from mgs.errors import InputError
    from mgs.report.diagnostics import diagnose_run

    if calibrate and views is not None:
        raise InputError("--calibrate takes all views that were not seen; leave out --views")
    wanted = None if views is None else [name.strip() for name in views.split(",") if name.strip()]
    if wanted == []:
        raise InputError(
            f"--views {views!r}: names no frame; give some, as in kf_0003,kf_0010, or leave it out"
        )
    runtime.start()
    with progress_bar() as bar:
        if calibrate:
            from mgs.report.predicted_error import calibrate_run

            written = calibrate_run(run, partial(bar, "calibrating"))
        else:
            written = diagnose_run(run, wanted, partial(bar, "mapping"))
    for path in written:
        typer.echo(f"wrote {path}")
