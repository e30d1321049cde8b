"""`mgs bench`: time the splatting kernels on this machine, and measure what a fit comes to."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from rich.console import Console
from rich.table import Table

from mgs import runtime
from mgs.cli.options import Force, argument, option
from mgs.errors import InputError
from mgs.files import check_new_file, write_json
from mgs.fit.settings import ALPHA_WEIGHT, TrainSettings
from mgs.provenance import command_line, versions
from mgs.run.settings import validated

KINDS = {
    "chart": ("scaling",),
    "gaussians": ("splat", "scaling"),
    "repeats": ("splat", "scaling"),
    "dataset": ("fit",),
    "alpha_weight": ("fit",),
}
"""Kinds that accept each option."""


def bench(
    kind: Annotated[
        Literal["splat", "scaling", "fit"],
        argument(
            "splat: time, compared with Mitsuba's own integrator, volprim_rf_basic. "
            "scaling: time, as the numbers of Gaussians, pixels and threads grow. "
            "fit: accuracy and convergence of the fit of a dataset."
        ),
    ],
    json: Annotated[Path | None, option("Write all measurements to this file.")] = None,
    chart: Annotated[Path | None, option("scaling only: draw the chart to this PNG.")] = None,
    gaussians: Annotated[
        int | None,
        option("splat: number of Gaussians [100000]; scaling: the largest [1000000].", min=1000),
    ] = None,
    repeats: Annotated[
        int | None,
        option("splat, scaling: calls of each operation; the median counts. Default: 9.", min=3),
    ] = None,
    dataset: Annotated[
        Path | None, option("fit only: the dataset, with depth. Default: demo/dataset.")
    ] = None,
    alpha_weight: Annotated[
        float | None,
        option(f"fit only: as of `mgs nbv`. Default: {ALPHA_WEIGHT}; 0 fits colours alone."),
    ] = None,
    force: Force = False,
) -> None:
    """Time rendering, gradients and Fisher information, or measure the fit of a dataset.

    The timed scene is a rock of surface Gaussians in an image of 640x480 pixels. Let nothing else
    run on the machine meanwhile. The JSON file also holds the command line, the machine and the
    versions.
    """
    given = locals()
    for name, kinds in KINDS.items():
        if given[name] is not None and kind not in kinds:
            raise InputError(
                f"--{name.replace('_', '-')}: is for {' and '.join(kinds)}, not for {kind}; "
                "leave it out"
            )
    repeats = repeats or 9
    if kind == "scaling" and gaussians is not None and gaussians < 3000:
        raise InputError(
            f"--gaussians {gaussians}: scaling fits the growth with N, from 1000 up; "
            "give at least 3000"
        )
    for target in (json, chart):
        if target is not None:
            check_new_file(target, force)  # before minutes of measuring
    runtime.start()
    console = Console()

    def report(what: str) -> None:  # no spinner: its thread would be timed too
        console.print(f"timing {what}", style="dim")

    result: dict[str, Any]
    if kind == "splat":
        from mgs.bench import core

        result = core.bench_splat(gaussians or 100_000, 640, 480, repeats, report)
        _print_splat(console, result)
        _print_figures(console, result["figures"], core.TARGETS)
    elif kind == "fit":
        from mgs.bench import fit

        asked = {"alpha_weight": ALPHA_WEIGHT if alpha_weight is None else alpha_weight}
        weight = validated(TrainSettings, asked).alpha_weight
        result = fit.bench_fit(dataset or Path("demo/dataset"), report, weight)
        _print_figures(console, result["figures"], fit.TARGETS)
        tau = result["ranking_tau_half"]
        console.print(f"Kendall's tau of the ranking with that of half the passes: {tau:.3f}")
    else:
        from mgs.bench import scaling

        result = scaling.bench_scaling(repeats, report, gaussians or 1_000_000)
        _print_scaling(console, result)
        if chart:
            scaling.scaling_figure(chart, result["points"])
            console.print(f"wrote {chart}")
    result |= {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    if json:
        write_json(json, result)
        console.print(f"wrote {json}")


def _print_scaling(console: Console, result: dict[str, Any]) -> None:
    """Print the exponents, a row for each quantity."""
    rows = result["exponents"]
    title = f"fits against N start at {result['exponents_from_n']:,}"
    table = Table("exponent of", *next(iter(rows.values())), title=title)
    for name, row in rows.items():
        table.add_row(name, *(f"{value:z.2f}" for value in row.values()))
    console.print(table)


def _print_splat(console: Console, result: dict[str, Any]) -> None:
    """Print the time of each operation, the share of peak arithmetic and the memory."""
    scene = result["scene"]
    size = f"{scene['gaussians']:,} Gaussians, {scene['width']}x{scene['height']}"
    title = f"{size}, {result['pairs']:,} (splat, block) pairs"
    seconds = Table("operation", "milliseconds", title=title)
    for name, value in result["seconds"].items():
        seconds.add_row(name.replace("_", " "), f"{1e3 * value:.1f}")
    console.print(seconds)
    shares = ", ".join(f"{name} {share:.0%}" for name, share in result["share_of_peak"].items())
    console.print(
        f"peak arithmetic measured {result['peak_gflops_measured']:.0f} Gflop/s, "
        f"share used: {shares}; peak memory {result['peak_memory_megabytes']:.0f} MB"
    )


def _print_figures(
    console: Console, figures: dict[str, float | None], targets: dict[str, tuple[str, float]]
) -> None:
    """Print each figure beside its target; None if it was not measured."""
    table = Table("figure", "measured", "asked for")
    for name, (bound, target) in targets.items():
        value = figures[name]
        measured = "not measured" if value is None else f"{value:.3g}"
        table.add_row(name.replace("_", " "), measured, f"{bound} {target:.3g}")
    console.print(table)
