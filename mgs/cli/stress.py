"""`mgs stress`: where the methods fail, by experiments with verdicts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def stress(
    out: Annotated[
        Path,
        typer.Argument(help="Folder for everything; the same command again does what is left."),
    ] = Path("out/stress"),
    preset: Annotated[
        str,
        typer.Option(
            help="quick: about 8 minutes on two cores with --workers 2. full: more rocks, larger images, more runs; hours."
        ),
    ] = "quick",
    workers: Annotated[int, typer.Option(min=1, help="Processes that do cells side by side.")] = 1,
    only: Annotated[
        str | None, typer.Option(help="Names of experiments, separated by commas. Default: all.")
    ] = None,
) -> None:
    """Try to make the methods fail: experiments with a hypothesis each, and a verdict that follows
    from the numbers by a rule.

    Writes stability.csv (all numbers), verdicts.json, stability.md (the verdicts as a table) and a
    picture of each experiment. An interrupted run goes on where it stopped when the same command is
    given again.
    """
    from rich.console import Console

    from mgs import runtime
    from mgs.cli.progress import progress_bar
    from mgs.errors import row_named
    from mgs.files import check_writable
    from mgs.provenance import command_line

    runtime.start()
    from mgs.study.stress.lab import PRESETS
    from mgs.study.stress.registry import EXPERIMENTS, run_stress
    from mgs.study.stress.verdict import effect
    from mgs.study.sweep import names_of

    size, names = row_named(PRESETS, preset, "--preset"), names_of(only, EXPERIMENTS)
    console = Console(highlight=False)
    check_writable(out)
    with progress_bar(console=console) as report:
        verdicts = run_stress(out, size, names, command_line(), report, workers)
    for experiment in verdicts["experiments"]:
        console.print(
            f"[bold]{experiment['name']}[/bold]: {experiment['question']}", soft_wrap=True
        )
        for claim in experiment["claims"]:
            console.print(
                f"  {claim['verdict']:8} {claim['hypothesis']} {effect(claim)}, {claim['runs']} runs",
                soft_wrap=True,
            )
    console.print(
        f"wrote {out}: verdicts.json, stability.csv, stability.md and a picture of each experiment",
        soft_wrap=True,
    )
