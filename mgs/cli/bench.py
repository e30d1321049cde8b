"""`mgs bench`: time the splatting kernels on this machine, and measure what a fit comes to."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from mgs.fit.settings import ALPHA_WEIGHT, TrainSettings
from mgs.run.settings import validated


class Kind(StrEnum):
    """What to measure."""

    splat = "splat"
    scaling = "scaling"
    roofline = "roofline"
    fit = "fit"


OF = {
    "--chart": (Kind.scaling, Kind.roofline),
    "--gaussians": (Kind.splat, Kind.scaling, Kind.roofline),
    "--repeats": (Kind.splat, Kind.scaling, Kind.roofline),
    "--dataset": (Kind.fit,),
    "--alpha-weight": (Kind.fit,),
}
"""What the options are for."""


def bench(
    kind: Annotated[
        Kind,
        typer.Argument(
            help="splat: compared with Mitsuba's own integrator, volprim_rf_basic. scaling: as the numbers of Gaussians, "
            "pixels and threads grow. roofline: each kernel against the limits of the machine. fit: accuracy and "
            "convergence of the fit of a dataset."
        ),
    ],
    json: Annotated[
        Path | None, typer.Option(help="Write everything that is measured to this file.")
    ] = None,
    chart: Annotated[
        Path | None, typer.Option(help="scaling and roofline: draw the chart to this PNG.")
    ] = None,
    gaussians: Annotated[
        int | None,
        typer.Option(
            min=1000,
            help="splat, roofline: number of Gaussians [100000]; scaling: the largest number [1000000].",
        ),
    ] = None,
    repeats: Annotated[
        int | None,
        typer.Option(
            min=3,
            help="Number of calls of each operation; the median counts, in a roofline the fastest. Default: 9.",
        ),
    ] = None,
    dataset: Annotated[
        Path | None, typer.Option(help="fit only: the dataset, with depth. Default: demo/dataset.")
    ] = None,
    alpha_weight: Annotated[
        float | None,
        typer.Option(
            help=f"fit only: as of `mgs nbv`. Default: {ALPHA_WEIGHT}; 0 fits colours alone."
        ),
    ] = None,
) -> None:
    """Time rendering, gradients and Fisher information on Gaussians of a rock in an image of
    640x480 pixels; or, `fit`, measure how accurate the fit of a dataset is and how near its end it
    stops.

    Let nothing else run on the machine meanwhile. The JSON file also holds the command line, the
    machine and the versions.
    """
    from rich.console import Console

    from mgs import runtime
    from mgs.errors import InputError
    from mgs.files import check_writable, write_json
    from mgs.provenance import command_line, versions

    given: dict[str, Any] = {
        "--chart": chart,
        "--gaussians": gaussians,
        "--repeats": repeats,
        "--dataset": dataset,
    }
    given["--alpha-weight"] = alpha_weight
    for option, value in given.items():
        if value is not None and kind not in OF[option]:
            raise InputError(
                f"{option}: is for {' and '.join(OF[option])}, not for {kind.value}; leave it out"
            )
    repeats = repeats or 9
    if kind is Kind.scaling and gaussians is not None and gaussians < 3000:
        raise InputError(
            f"--gaussians {gaussians}: scaling fits the growth with N, from 1000 up; give at least 3000"
        )
    for target in (json, chart):
        if target is not None:  # before minutes of measuring, not after them
            check_writable(target)
            if target.is_dir():
                raise InputError(f"{target}: is a folder; name a file to write")
    runtime.start()
    from mgs.bench.chart import roofline_figure, scaling_figure
    from mgs.bench.core import TARGETS as SPLAT_TARGETS
    from mgs.bench.core import bench_scaling, bench_splat
    from mgs.bench.fit import TARGETS as FIT_TARGETS
    from mgs.bench.fit import bench_fit
    from mgs.bench.growth import growth
    from mgs.bench.roofline import bench_roofline

    console = Console()

    def report(what: str) -> None:
        console.print(
            f"timing {what}", style="dim"
        )  # a line and no spinner, whose thread would be timed too

    result: dict[str, Any]
    if kind is Kind.splat:
        result = bench_splat(gaussians or 100_000, 640, 480, repeats, report)
        _print_splat(console, result)
        _print_figures(console, result["figures"], SPLAT_TARGETS)
    elif kind is Kind.fit:
        asked = {"alpha_weight": ALPHA_WEIGHT if alpha_weight is None else alpha_weight}
        weight = validated(TrainSettings, asked).alpha_weight
        result = bench_fit(dataset or Path("demo/dataset"), report, weight)
        _print_figures(console, result["figures"], FIT_TARGETS)
        console.print(
            f"Kendall's tau of the ranking with that of half the passes: {result['ranking_tau_half']:.3f}"
        )
    elif kind is Kind.roofline:
        result = bench_roofline(gaussians or 100_000, 640, 480, repeats, report)
        _print_roofline(console, result)
        if chart:
            roofline_figure(chart, result)
            console.print(f"wrote {chart}")
    else:
        points = bench_scaling(repeats, report, gaussians or 1_000_000)
        result = {"repeats": repeats, "points": points} | growth(points)
        _print_scaling(console, result)
        if chart:
            scaling_figure(chart, points)
            console.print(f"wrote {chart}")
    result |= {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    if json:
        write_json(json, result)
        console.print(f"wrote {json}")


def _print_scaling(console: Any, result: dict[str, Any]) -> None:
    """Print the exponents, a row for each quantity and a column for each thing that grows, and the
    linear fits of time."""
    from rich.table import Table

    rows = result["exponents"]
    table = Table(
        "exponent of",
        *next(iter(rows.values())),
        title=f"fits against N start at {result['exponents_from_n']:,}",
    )
    for name, row in rows.items():
        table.add_row(name, *(f"{value:z.2f}" for value in row.values()))
    linear = result["linear_growth"]
    costs = Table("time of", *next(iter(linear.values())), title="linear fit to all points")
    for name, row in linear.items():
        *values, deviation = row.values()
        costs.add_row(name, *(f"{value:.1f}" for value in values), f"{deviation:.0%}")
    console.print(table, costs)


def _print_roofline(console: Any, result: dict[str, Any]) -> None:
    """Print the limits of the machine, the work of each kernel, and where it stands."""
    from rich.table import Column, Table

    def table(*numbers: str, last: str = "") -> Table:
        columns = [Column(name, justify="right", no_wrap=True) for name in numbers]
        return Table("kernel", *columns, *([last] if last else []))

    limits, rows = result["limits"], result["kernels"]
    bandwidths = ", ".join(
        f"{name} {value / 1e9:.0f}" for name, value in limits["bandwidth"].items()
    )
    console.print(
        f"FMA {limits['flops'] / 1e9:.0f} Gflop/s, in double {limits['flops64'] / 1e9:.0f}; divisions "
        f"{limits['divisions'] / 1e9:.1f} billion a second, in double {limits['divisions64'] / 1e9:.1f}; addresses "
        f"{limits['addresses'] / 1e9:.2f} billion a second; GB/s: {bandwidths}"
    )
    work = table(
        "operations", "divisions", "instructions", "bytes", "state", "addresses", last="for each"
    )
    for row in rows:
        each = row["each"]
        counts = [
            each[a] + each[b] for a, b in (("flops", "flops64"), ("divisions", "divisions64"))
        ]
        counts += [each[key] for key in ("instructions", "bytes", "state_bytes", "addresses")]
        work.add_row(row["name"], *(f"{count:,.0f}" for count in counts), row["unit"])
    share = table(*rows[0]["shares"])
    share.title = "share of the time that each limit takes alone"
    time = table("ms", "Gflop/s", "busy lanes", last="bound by")
    for row in rows:
        share.add_row(row["name"], *(f"{value:.0%}" for value in row["shares"].values()))
        numbers = (
            f"{1e3 * row['seconds']:.2f}",
            f"{row['gflops']:.1f}",
            f"{row['lanes_active']:.0%}",
        )
        time.add_row(row["name"], *numbers, row["verdict"])
    console.print(work, share, time)


def _print_splat(console: Any, result: dict[str, Any]) -> None:
    """Print the time of each operation, and what share of the machine's arithmetic they use."""
    from rich.table import Table

    scene = result["scene"]
    title = f"{scene['gaussians']:,} Gaussians, {scene['width']}x{scene['height']}, {result['pairs']:,} (splat, block) pairs"
    seconds = Table("operation", "milliseconds", title=title)
    for name, value in result["seconds"].items():
        seconds.add_row(name.replace("_", " "), f"{1e3 * value:.1f}")
    console.print(seconds)
    console.print(
        f"peak arithmetic measured {result['peak_gflops_measured']:.0f} Gflop/s, share used: "
        + ", ".join(f"{k} {v:.0%}" for k, v in result["share_of_peak"].items())
        + f"; peak memory {result['peak_memory_megabytes']:.0f} MB"
    )


def _print_figures(
    console: Any, figures: dict[str, float | None], targets: dict[str, tuple[str, float]]
) -> None:
    """Print each figure beside what is asked for; None is a goal that no attempt reached."""
    from rich.table import Table

    table = Table("figure", "measured", "asked for")
    for name, (bound, target) in targets.items():
        value = figures[name]
        measured = "not reached" if value is None else f"{value:.3g}"
        table.add_row(name.replace("_", " "), measured, f"{bound} {target:.3g}")
    console.print(table)
