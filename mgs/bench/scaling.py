"""Growth of time and memory with the numbers of Gaussians, pixels and threads, and its fits."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mgs import runtime
from mgs.bench.core import surface_camera, surface_gaussians, time_core
from mgs.plotting import STYLE, new_figure, save_figure

Records = list[dict[str, Any]]

OPERATIONS = {
    "forward_warm": "forward, warm",
    "forward_cold": "forward, cold",
    "gradient_warm": "forward + adjoint",
    "fisher_exact": "exact Fisher",
    "fisher_block": "block Fisher",
}
"""Timed operations: key in a record -> label."""

MEMORY = {"peak_bytes": "peak memory", "list_bytes": "lists of one camera"}
"""Measured memory: key in a record -> label."""

LINES = {
    "forward_warm": ("#0072b2", "o"),
    "forward_cold": ("#56b4e9", "s"),
    "gradient_warm": ("#d55e00", "^"),
    "fisher_exact": ("#009e73", "D"),
    "fisher_block": ("#cc79a7", "v"),
    "peak_bytes": ("#444444", "o"),
    "list_bytes": ("#999999", "s"),
}
"""Colour and marker of each of OPERATIONS and MEMORY."""

NUMBERS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
SIZES = ((160, 120), (320, 240), (640, 480), (1280, 960))


def bench_scaling(
    repeats: int, report: Callable[[str], None], most: int = 1_000_000
) -> dict[str, Any]:
    """Measure four sweeps and fit their growth. most: largest number N of Gaussians.

    - gaussians: N grows, at 640x480.
    - pixels: the image grows, at N = 100,000.
    - both: N and the number of pixels grow together, so the pairs per Gaussian stay the same.
    - threads: one, and all.

    report(what) is called before each point. Returns "repeats"; "points", a record for each point
    with "sweep", "n", "pixels", "threads" and the results of `scaling_point`; and the fits of
    `exponents`.
    """
    threads, base = dr.thread_count(), min(100_000, most)
    numbers = [n for n in NUMBERS if n <= most]
    plan = [("gaussians", n, 640, 480, threads) for n in numbers]
    plan += [("pixels", base, *size, threads) for size in SIZES]
    for n in numbers:
        side = (n / 1e5) ** 0.5
        plan.append(("both", n, round(640 * side), round(480 * side), threads))
    plan += [("threads", base, 640, 480, t) for t in sorted({1, threads})]
    points = []
    for sweep, n, width, height, count in plan:
        report(f"{n:,} Gaussians, {width}x{height}, {count} thread{'' if count == 1 else 's'}")
        where = {"sweep": sweep, "n": n, "pixels": width * height, "threads": count}
        points.append(where | in_new_process(scaling_point, n, width, height, count, repeats))
    return {"repeats": repeats, "points": points} | exponents(points)


def scaling_point(n: int, width: int, height: int, threads: int, repeats: int) -> dict[str, float]:
    """Run `time_core` with this many threads; adds peak_bytes, the most memory that Dr.Jit has held
    in this process."""
    dr.set_thread_count(threads)
    gaussians = surface_gaussians(n)
    seconds = time_core(gaussians, surface_camera(gaussians, width, height), repeats)
    return seconds | {"peak_bytes": float(dr.detail.malloc_watermark(dr.JitBackend.LLVM))}


def in_new_process(call: Callable[..., Any], *arguments: Any) -> Any:
    """Call a picklable function in a new process that has started Dr.Jit, and return its result.

    No memory, recorded kernel or block list is left over from earlier calls.
    """
    spawn = multiprocessing.get_context("spawn")  # Dr.Jit's threads do not survive a fork
    with ProcessPoolExecutor(1, spawn, initializer=runtime.start) as pool:
        return pool.submit(call, *arguments).result()


def exponents(points: Records) -> dict[str, Any]:
    """Fit the records: "exponents" of `scaling_exponents`, and "exponents_from_n", the least N that
    is fitted."""
    return {"exponents": scaling_exponents(points), "exponents_from_n": fitted(points)[0]["n"]}


def sweep_points(points: Records, sweep: str) -> Records:
    """Records of one sweep: "gaussians", "pixels", "both" or "threads"."""
    return [p for p in points if p["sweep"] == sweep]


def fitted(points: Records, sweep: str = "gaussians") -> Records:
    """Records of a sweep over N whose N is within a factor of 100 of the largest.

    With fewer Gaussians most of the time does not depend on their number.
    """
    by_n = sweep_points(points, sweep)
    return [p for p in by_n if 100 * p["n"] >= by_n[-1]["n"]]


def scaling_exponents(points: Records) -> dict[str, dict[str, float]]:
    """Fit y ~ x^exponent: label of OPERATIONS or MEMORY -> x -> exponent.

    N, pixels and threads each grow along their own sweep; threads are left out if there is only one
    number of them. The number of (splat, block) pairs grows in three ways. "pairs alone": N and
    the image grow together, with the same pairs per Gaussian. "pairs, N growing": the work per
    Gaussian gains weight. "pairs, image growing": the work per pair gains weight.
    """
    by_n, by_size = fitted(points), sweep_points(points, "pixels")
    by_threads = sweep_points(points, "threads")
    fits = {
        "N": (by_n, "n"),
        "pixels": (by_size, "pixels"),
        "threads": (by_threads, "threads"),
        "pairs alone": (fitted(points, "both"), "pairs"),
        "pairs, N growing": (by_n, "pairs"),
        "pairs, image growing": (by_size, "pairs"),
    }
    if len(by_threads) < 2:
        del fits["threads"]
    return {
        label: {
            what: exponent([p[key] for p in of], [p[name] for p in of])
            for what, (of, key) in fits.items()
        }
        for name, label in (OPERATIONS | MEMORY).items()
    }


def exponent(x: list[float], y: list[float]) -> float:
    """Least-squares slope of log y against log x."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def scaling_figure(path: str | Path, points: Records) -> None:
    """Draw time (first row) and memory (second row) against N, pixels, threads and pairs as a PNG.

    Axes are logarithmic; legends give the fitted exponents. Raises InputError if the file cannot be
    written.
    """
    import matplotlib

    found, start = scaling_exponents(points), f"{fitted(points)[0]['n']:,}"
    columns = (
        ("n", "Gaussians N", {"gaussians": "N"}, f"exponent, fitted from {start}"),
        ("pixels", "pixels", {"pixels": "pixels"}, "exponent"),
        ("threads", "threads", {"threads": "threads"}, "exponent"),
        (
            "pairs",
            "(splat, block) pairs",
            {"both": "pairs alone", "gaussians": "pairs, N growing"},
            "exponent as N and the image grow together\n"
            f"(solid), as N grows alone (dashed), from {start}",
        ),
    )
    with matplotlib.rc_context(STYLE | {"legend.fontsize": 7, "legend.title_fontsize": 7}):
        figure = new_figure(15, 7)
        rows = figure.subplots(2, len(columns), sharey="row")
        for axes, quantities, unit, scale in (
            (rows[0], OPERATIONS, "time, ms", 1e3),
            (rows[1], MEMORY, "memory, MB", 1e-6),
        ):
            for axis, (key, name, sweeps, title) in zip(axes, columns, strict=True):
                for quantity, label in quantities.items():
                    known = [found[label][x] for x in sweeps.values() if x in found[label]]
                    text = f"{label}: {', '.join(f'{value:z.2f}' for value in known)}"
                    _draw_lines(axis, points, (key, quantity, scale), list(sweeps), text)
                axis.set(xlabel=name)
                axis.legend(title=title, loc="upper left")
                if key == "threads":
                    axis.set_xticks([p["threads"] for p in sweep_points(points, "threads")])
                    axis.xaxis.set_major_formatter("{x:.0f}")
                    axis.xaxis.set_minor_formatter("")
            low, high = axes[0].get_ylim()
            room = (high / low) ** 0.35  # for the legends
            axes[0].set(ylabel=unit, ylim=(low, high * room))
        save_figure(figure, path)


def _draw_lines(
    axis: Any, points: Records, what: tuple[str, str, float], sweeps: list[str], text: str
) -> None:
    """Draw what = (key, quantity, factor), one line for each of at most two sweeps;
    the second is dashed. text: label of the first."""
    key, quantity, scale = what
    colour, marker = LINES[quantity]
    for sweep, dash, label in zip(sweeps, ("-", "--"), (text, None), strict=False):
        chosen = sorted(sweep_points(points, sweep), key=lambda p: p[key])
        x, y = [p[key] for p in chosen], [scale * p[quantity] for p in chosen]
        axis.loglog(x, y, dash + marker, color=colour, label=label)
