"""`mgs diagnose`: maps of what a run knows and what it does not."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def diagnose(
    run: Annotated[Path, typer.Argument(help="Folder that `mgs nbv` wrote.")],
    views: Annotated[
        str | None, typer.Option(help="Frames by name, as in kf_0003,kf_0010; a few held-out ones by default.")
    ] = None,
) -> None:
    """Map the Fisher information and the posterior uncertainty of a run, per view and per Gaussian.

    Writes RUN/diagnostics: one multi-channel EXR per view (R G B A Z, fisher.colour, fisher.scale, fisher.rotation,
    fisher.opacity, information, uncertainty, unobserved), a PNG preview of each, and information.ply, coloured by information.
    """
    from rich.progress import Progress

    from mgs import runtime
    from mgs.errors import InputError
    from mgs.report.diagnostics import diagnose_run

    wanted = None if views is None else [name.strip() for name in views.split(",") if name.strip()]
    if wanted == []:
        raise InputError(f"--views {views!r}: names no frame; give some, as in kf_0003,kf_0010, or leave it out")
    runtime.start()
    with Progress(transient=True) as bar:
        task = bar.add_task("mapping", total=None)
        written = diagnose_run(run, wanted, progress=lambda done, total: bar.update(task, completed=done, total=total))
    for path in written:
        typer.echo(f"wrote {path}")
