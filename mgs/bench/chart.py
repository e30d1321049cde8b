"""The charts of `mgs bench`, on logarithmic axes. Nothing is measured here.

scaling: time and memory, with fitted exponents. roofline: operations a second against operations a
byte, and the limits of the machine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mgs.bench.growth import MEMORY, OPERATIONS, Records, fitted, scaling_exponents, sweep_points
from mgs.plotting import STYLE, new_figure, save_figure

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


def scaling_figure(path: str | Path, points: Records) -> None:
    """Draw the records as a PNG: time (first row) and memory (second row) against N, pixels,
    threads and pairs.

    The file appears complete. Raises InputError if it cannot be written.
    """
    import matplotlib

    exponents, start = scaling_exponents(points), f"{fitted(points)[0]['n']:,}"
    columns = (
        ("n", "Gaussians N", {"gaussians": "N"}, f"exponent, fitted from {start}"),
        ("pixels", "pixels", {"pixels": "pixels"}, "exponent"),
        ("threads", "threads", {"threads": "threads"}, "exponent"),
        (
            "pairs",
            "(splat, block) pairs",
            {"both": "pairs alone", "gaussians": "pairs, N growing"},
            f"exponent as N and the image grow together\n(solid), as N grows alone (dashed), from {start}",
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
                    against = [
                        exponents[label][of] for of in sweeps.values() if of in exponents[label]
                    ]
                    text = ": ".join([label, ", ".join(f"{value:z.2f}" for value in against)])
                    _draw_lines(axis, points, (key, quantity, scale), sweeps, text)
                axis.set(xlabel=name)
                axis.legend(title=title, loc="upper left")
                if key == "threads":
                    axis.set_xticks([p["threads"] for p in sweep_points(points, "threads")])
                    axis.xaxis.set_major_formatter("{x:.0f}")
                    axis.xaxis.set_minor_formatter("")
            low, high = axes[0].get_ylim()
            axes[0].set(
                ylabel=unit, ylim=(low, high * (high / low) ** 0.35)
            )  # room for the legends
        save_figure(figure, path)


def _draw_lines(
    axis: Any, points: Records, what: tuple[str, str, float], sweeps: dict[str, str], text: str
) -> None:
    """Draw one quantity against one key of the records, a line for each of at most two sweeps; the
    second is dashed.

    what: (key, quantity, factor from the quantity's unit to the axis's); sweeps: by name; text:
    what the legend says.
    """
    key, quantity, scale = what
    colour, marker = LINES[quantity]
    for sweep, dash, label in zip(sweeps, ("-", "--"), (text, None), strict=False):
        chosen = sorted(sweep_points(points, sweep), key=lambda p: p[key])
        axis.loglog(
            [p[key] for p in chosen],
            [scale * p[quantity] for p in chosen],
            dash + marker,
            color=colour,
            label=label,
        )


COLOURS = {
    "forward": "#0072b2",
    "jvp": "#56b4e9",
    "adjoint": "#d55e00",
    "exact Fisher": "#009e73",
    "block Fisher": "#cc79a7",
}
"""Colour of the kernels of each operation in the roofline; steps linear in the number of Gaussians
are grey."""

MARKERS = {
    "walk 1": "v",
    "add up": "s",
    "alpha and depth": "<",
    "alpha and depth: walk": "<",
    "alpha and depth: add up": "d",
    "projection": "*",
    "lists tested, and packing": "p",
    "pixels row by row": "h",
    "block lists": "P",
    "sums to gradient": "X",
    "sums to exact Fisher": "D",
    "sums to block Fisher": "^",
}
"""Markers of kernels in the roofline, by the second part of their names or the whole; the others
have a circle."""


def roofline_figure(path: str | Path, result: dict[str, Any]) -> None:
    """Draw what `mgs.bench.roofline.bench_roofline` returns as a PNG. The file appears complete.

    A kernel has two markers. The filled one counts all its bytes, and is to be read against the
    roof of the first cache. The hollow one counts only those of arrays, and is to be read against
    the others. Kernels that compute nothing are not drawn. Raises InputError if the file cannot be
    written.
    """
    import matplotlib

    limits, drawn = result["limits"], [row for row in result["kernels"] if row["gflops"] > 0]
    x = [row[key] for row in drawn for key in ("intensity", "array_intensity")]
    y = [row["gflops"] for row in drawn]
    with matplotlib.rc_context(STYLE | {"legend.fontsize": 8, "lines.markersize": 6}):
        figure = new_figure(10, 6)
        axes = figure.subplots()
        axes.set(
            xscale="log",
            yscale="log",
            xlim=(min(x) / 2, 6 * max(x)),
            ylim=(min(y) / 2, 2e-9 * limits["flops"]),
            xlabel="operations a byte (filled: of arrays and the loop's state; hollow: of arrays alone)",
            ylabel="Gflop/s of all lanes",
        )
        _draw_roofs(axes, limits)
        for row in drawn:
            operation, _, what = row["name"].partition(": ")
            style = {
                "color": COLOURS.get(operation, "#777777"),
                "marker": MARKERS.get(what or operation, "o"),
            }
            both = row["intensity"], row["array_intensity"]
            axes.plot(both, [row["gflops"]] * 2, color=style["color"], linewidth=0.5)
            axes.plot(both[1], row["gflops"], markerfacecolor="white", **style)
            axes.plot(both[0], row["gflops"], linestyle="", label=row["name"], **style)
        figure.legend(loc="outside right upper")
        save_figure(figure, path)


def _draw_roofs(axes: Any, limits: dict[str, Any]) -> None:
    """Draw the limits of a machine into axes whose limits are set: bandwidths up to the rate of
    FMAs, and the latter."""
    (low, high), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    for name, bandwidth in limits["bandwidth"].items():
        ends = np.array([low, limits["flops"] / bandwidth])
        axes.plot(ends, 1e-9 * bandwidth * ends, color="#444444", linewidth=1)
        at = 1.15 * max(low, 1e9 * bottom / bandwidth)
        label = {
            "textcoords": "offset points",
            "rotation": 45,
            "rotation_mode": "anchor",
            "transform_rotates_text": True,
        }
        axes.annotate(
            f"{name} {1e-9 * bandwidth:,.0f} GB/s",
            (at, 1e-9 * bandwidth * at),
            (0, 4),
            fontsize=8,
            **label,
        )
    for name, dash, key in (("FMA", "-", "flops"), ("FMA in double", "--", "flops64")):
        rate = 1e-9 * limits[key]
        axes.axhline(rate, color="#444444", linewidth=1, linestyle=dash)
        label = {"textcoords": "offset points", "ha": "right", "fontsize": 8}
        axes.annotate(f"{name} {rate:,.0f} Gflop/s", (high, rate), (-4, 3), **label)
