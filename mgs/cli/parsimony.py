"""`mgs parsimony`: how much model a scene needs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def parsimony(
    out: Annotated[
        Path,
        typer.Argument(help="Folder for everything; the same command again continues or shows it."),
    ] = Path("parsimony"),
    preset: Annotated[
        str,
        typer.Option(
            help="quick: six scenes of small images, ten minutes. full: the same of 320x240, half an hour."
        ),
    ] = "quick",
) -> None:
    """Chart quality and cost against the number of Gaussians, what is learned, and the SH degree,
    with the automatic choice marked.

    Renders the scenes, fits each model view by view, and judges it on test views that no model
    sees. Writes parsimony.json, parsimony.csv and parsimony.png. What was interrupted goes on when
    the same command is given again.
    """
    from rich.console import Console

    from mgs import runtime
    from mgs.cli.progress import progress_bar
    from mgs.errors import row_named
    from mgs.files import check_writable, write_csv, write_json
    from mgs.provenance import command_line, versions
    from mgs.study.parsimony import PRESETS, run_study
    from mgs.study.parsimony_figure import draw_parsimony

    size = row_named(PRESETS, preset, "--preset")
    check_writable(out)
    runtime.start()
    console = Console(highlight=False)
    with progress_bar(console=console) as report:
        found = run_study(out, size, report)
    about = {
        "command": command_line(),
        "preset": preset,
        "machine": runtime.processor(),
        "versions": versions(),
    }
    write_json(out / "parsimony.json", about | found)
    write_csv(out / "parsimony.csv", found["rows"])
    draw_parsimony(out / "parsimony.png", found)
    console.print(_table(found["scenes"]))
    console.print(f"wrote {out}: parsimony.json, parsimony.csv, parsimony.png", soft_wrap=True)


def _table(scenes: dict[str, dict[str, Any]]) -> Any:
    """The verdicts, a row for each scene."""
    from rich.table import Table

    table = Table(
        "scene",
        "best fixed, dB",
        "automatic, dB",
        "parameters",
        "smallest fixed within 0.1 dB",
        "holds",
    )
    for scene, one in scenes.items():
        holds = (
            "yes"
            if one["close"] and one["small"]
            else "no: " + ("too many parameters" if one["close"] else "worse")
        )
        numbers = (
            f"{one['best']:.2f}",
            f"{one['auto']:.2f}",
            f"{one['parameters']:,}",
            f"{one['smallest']:,}",
        )
        table.add_row(scene, *numbers, holds)
    return table
