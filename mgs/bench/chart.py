"""The chart of `mgs bench scaling`: time and memory on logarithmic axes, with fitted exponents. Nothing is measured here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
    """Draw the records as a PNG: time (first row) and memory (second row) against N, pixels, threads and pairs.

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
        for axes, quantities, unit, scale in ((rows[0], OPERATIONS, "time, ms", 1e3), (rows[1], MEMORY, "memory, MB", 1e-6)):
            for axis, (key, name, sweeps, title) in zip(axes, columns, strict=True):
                for quantity, label in quantities.items():
                    against = [exponents[label][of] for of in sweeps.values() if of in exponents[label]]
                    text = ": ".join([label, ", ".join(f"{value:z.2f}" for value in against)])
                    _draw_lines(axis, points, (key, quantity, scale), sweeps, text)
                axis.set(xlabel=name)
                axis.legend(title=title, loc="upper left")
                if key == "threads":
                    axis.set_xticks([p["threads"] for p in sweep_points(points, "threads")])
                    axis.xaxis.set_major_formatter("{x:.0f}")
                    axis.xaxis.set_minor_formatter("")
            low, high = axes[0].get_ylim()
            axes[0].set(ylabel=unit, ylim=(low, high * (high / low) ** 0.35))  # room for the legends
        save_figure(figure, path)


def _draw_lines(axis: Any, points: Records, what: tuple[str, str, float], sweeps: dict[str, str], text: str) -> None:
    """Draw one quantity against one key of the records, a line for each of at most two sweeps; the second is dashed.

    what: (key, quantity, factor from the quantity's unit to the axis's); sweeps: by name; text: what the legend says.
    """
    key, quantity, scale = what
    colour, marker = LINES[quantity]
    for sweep, dash, label in zip(sweeps, ("-", "--"), (text, None), strict=False):
        chosen = sorted(sweep_points(points, sweep), key=lambda p: p[key])
        axis.loglog([p[key] for p in chosen], [scale * p[quantity] for p in chosen], dash + marker, color=colour, label=label)
