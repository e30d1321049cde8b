"""`mgs bench`: time the splatting kernels on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rich.table import Table

from mgs import runtime
from mgs.cli.options import Force, option
from mgs.cli.terminal import Terminal
from mgs.files import check_new_file, write_json
from mgs.provenance import command_line, versions


def bench(
    json: Annotated[Path | None, option("Write all measurements to this file.")] = None,
    gaussians: Annotated[int, option("Number of Gaussians.", min=1000)] = 100_000,
    repeats: Annotated[int, option("Calls of each operation; the median counts.", min=3)] = 9,
    force: Force = False,
) -> None:
    """Time rendering, gradients and Fisher information, and Mitsuba's own integrator,
    volprim_rf_basic.

    The timed scene is a rock of surface Gaussians in an image of 640x480 pixels. Let nothing else
    run on the machine meanwhile. The JSON file also holds the command line, the machine and the
    versions.
    """
    if json is not None:
        check_new_file(json, force)  # before minutes of measuring
    runtime.start()
    from mgs.bench import bench_splat

    console = Terminal()

    def report(what: str) -> None:  # no spinner: its thread would be timed too
        console.print(f"timing {what}", style="dim")

    result = bench_splat(gaussians, 640, 480, repeats, report)
    seconds = Table("operation", "milliseconds", title=f"{gaussians:,} Gaussians, 640x480")
    for name, value in result["seconds"].items():
        seconds.add_row(name.replace("_", " "), f"{1e3 * value:.1f}")
    ratios = Table("ratio", "measured")
    for name, value in result["ratios"].items():
        ratios.add_row(name.replace("_", " "), f"{value:.3g}")
    console.print(seconds, ratios, f"peak memory {result['peak_memory_megabytes']:.0f} MB")
    if json is not None:
        made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
        write_json(json, result | made)
        console.print(f"wrote {json}")
