"""`mgs chart`: speed against accuracy, measured and drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mgs.study.chart.plan import KINDS


def chart(
    out: Annotated[
        Path,
        typer.Argument(help="Folder for everything; the same command again continues or shows it."),
    ] = Path("chart"),
    dataset: Annotated[
        Path | None,
        typer.Option(
            help="A dataset with test views, in place of the one that is rendered; not for `presets`."
        ),
    ] = None,
    preset: Annotated[
        str, typer.Option(help="quick: nine to eleven minutes on two quiet cores. full: hours.")
    ] = "quick",
    only: Annotated[
        str | None, typer.Option(help=f"Some of {','.join(KINDS)}, as fit,core. Default: all.")
    ] = None,
    repeats: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="How often each point is timed; the median counts. Default: quick 2, full 3.",
        ),
    ] = None,
) -> None:
    """Chart speed against accuracy: of fits and runs, of scoring, of the core, and of what is sent;
    and try the presets of `mgs nbv` on other scenes.

    Writes KIND.csv and pictures for each chart, and chart.json; each row names the command that
    makes it again. Points are timed one after another; let nothing else run meanwhile. What was
    interrupted goes on where it stopped when the same command is given again.
    """
    from rich.console import Console

    from mgs.files import check_writable
    from mgs.study.chart.study import chart as measure
    from mgs.study.sweep import names_of

    kinds = names_of(only, KINDS)
    check_writable(out)
    console = Console(highlight=False)

    def report(name: str, done: int, total: int) -> None:
        console.print(
            f"{done + 1}/{total} {name}", style="dim"
        )  # a line and no spinner, whose thread would be timed too

    result = measure(out, preset, kinds, repeats, dataset, report)
    for kind in kinds:
        console.print(
            f"{kind}: {len(result[kind]['rows'])} rows in {out / f'{kind}.csv'}", soft_wrap=True
        )
    for row in result["presets"]["rows"] if "presets" in kinds else []:
        verdict = "holds" if row["holds"] else "fails"
        console.print(
            f"{row['scene']}, {row['preset']}: {row['loss']:.2f} dB below the best of equal time: {verdict}"
        )
