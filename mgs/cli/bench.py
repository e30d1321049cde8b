"""`mgs bench`: timings on this machine, as ratios against a peer in the same run."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer


class Kind(StrEnum):
    """What to measure."""

    splat = "splat"
    scaling = "scaling"


def bench(
    kind: Annotated[
        Kind, typer.Argument(help="splat: against Mitsuba's volprim_rf_basic; scaling: against N, pixels, threads.")
    ],
    json: Annotated[Path | None, typer.Option(help="Write everything measured to this file.")] = None,
    chart: Annotated[Path | None, typer.Option(help="scaling only: write the log-log charts to this PNG.")] = None,
    gaussians: Annotated[
        int | None, typer.Option(min=1000, help="splat: how many [100000]; scaling: the most [1000000].")
    ] = None,
    repeats: Annotated[int, typer.Option(min=3, help="Runs that each median is of.")] = 9,
) -> None:
    """Time the splat core on 100,000 Gaussians of a rock at 640x480 (splat), or its growth up to a million (scaling).

    Nothing else should run on the machine meanwhile. The command line, machine and versions are written beside the numbers.
    """
    from rich.console import Console

    from mgs import runtime
    from mgs.errors import InputError
    from mgs.files import check_writable, write_json
    from mgs.provenance import versions

    if kind is Kind.scaling and gaussians is not None and gaussians < 3000:
        raise InputError(f"--gaussians {gaussians}: scaling fits the growth with N, from 1000 up; give at least 3000")
    for target in (json, chart):
        if target is not None:  # known before the minutes of measuring
            check_writable(target)
            if target.is_dir():
                raise InputError(f"{target}: is a folder; name a file to write")
    runtime.start()
    from mgs.bench.core import bench_scaling, bench_splat
    from mgs.provenance import command_line

    console = Console()
    report = lambda what: console.print(f"timing {what}", style="dim")  # noqa: E731  (a spinner's thread would be timed too)
    if kind is Kind.splat:
        result: dict[str, Any] = bench_splat(gaussians or 100_000, 640, 480, repeats, report)
    else:
        result = {"repeats": repeats, "points": bench_scaling(repeats, report, gaussians or 1_000_000)}
    result |= {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    if kind is Kind.splat:
        _print_splat(console, result)
    else:
        from mgs.bench.chart import fitted, linear_growth, scaling_exponents, scaling_figure

        result["exponents"] = scaling_exponents(result["points"])
        result["linear_growth"] = linear_growth(result["points"])
        result["exponents_from_n"] = fitted(result["points"])[0]["n"]
        _print_scaling(console, result)
        if chart:
            scaling_figure(chart, result["points"])
            console.print(f"wrote {chart}")
    if json:
        write_json(json, result)
        console.print(f"wrote {json}")


def _print_scaling(console: Any, result: dict[str, Any]) -> None:
    """Exponents: a row for each quantity, a column for what it grows with; and time as a sum of what grows linearly."""
    from rich.table import Table

    rows = result["exponents"]
    table = Table("exponent of", *next(iter(rows.values())), title=f"fits against N start at {result['exponents_from_n']:,}")
    for name, row in rows.items():
        table.add_row(name, *(f"{value:z.2f}" for value in row.values()))
    linear = result["linear_growth"]
    costs = Table("time of", *next(iter(linear.values())), title="linear fit to all points")
    for name, row in linear.items():
        *values, deviation = row.values()
        costs.add_row(name, *(f"{value:.1f}" for value in values), f"{deviation:.0%}")
    console.print(table, costs)


def _print_splat(console: Any, result: dict[str, Any]) -> None:
    """Seconds, then each figure beside its target."""
    from rich.table import Table

    from mgs.bench.core import TARGETS

    scene = result["scene"]
    title = f"{scene['gaussians']:,} Gaussians, {scene['width']}x{scene['height']}, {result['pairs']:,} (splat, block) pairs"
    seconds = Table("operation", "milliseconds", title=title)
    for name, value in result["seconds"].items():
        seconds.add_row(name.replace("_", " "), f"{1e3 * value:.1f}")
    figures = Table("figure", "measured", "asked for")
    for name, (bound, target) in TARGETS.items():
        figures.add_row(name.replace("_", " "), f"{result['figures'][name]:.2f}", f"{bound} {target:g}")
    console.print(seconds, figures)
    console.print(
        f"peak arithmetic measured {result['peak_gflops_measured']:.0f} Gflop/s, share used: "
        + ", ".join(f"{k} {v:.0%}" for k, v in result["share_of_peak"].items())
        + f"; peak memory {result['peak_memory_megabytes']:.0f} MB"
    )
