"""The scaling charts: log-log, with fitted exponents. Read records only, measure nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from mgs.bench.core import exponent
from mgs.plotting import STYLE, new_figure, save_figure

OPERATIONS = {
    "forward_warm": ("forward, warm", "#0072b2", "o"),
    "forward_cold": ("forward, cold", "#56b4e9", "s"),
    "gradient_warm": ("forward + adjoint", "#d55e00", "^"),
    "fisher_exact": ("exact Fisher", "#009e73", "D"),
    "fisher_block": ("block Fisher", "#cc79a7", "v"),
}

MEMORY = {
    "peak_bytes": ("peak memory", "#444444", "o"),
    "list_bytes": ("lists of one camera", "#999999", "s"),
}


def _sweep(points: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    return [p for p in points if p["sweep"] == name]


def fitted(points: list[dict[str, Any]], sweep: str = "gaussians") -> list[dict[str, Any]]:
    """The points of a sweep that exponents are fitted to: the last two decades of N. Below, other things take the time."""
    by_n = _sweep(points, sweep)
    return [p for p in by_n if 100 * p["n"] >= by_n[-1]["n"]]


def scaling_exponents(points: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Fitted growth of each operation's time, and of memory, in N, pixels, threads and (splat, block) pairs.

    Pairs grow alone where N and the image grow together. Where N grows by itself they grow more slowly than N, so that the
    work per Gaussian gains weight; where the image does, the work per pair: a fit each.
    """
    by_n, by_size, by_threads = fitted(points), _sweep(points, "pixels"), _sweep(points, "threads")
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
        label: {what: exponent([p[key] for p in of], [p[name] for p in of]) for what, (of, key) in fits.items()}
        for name, (label, *_) in (OPERATIONS | MEMORY).items()
    }


def linear_growth(points: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Each operation's time as constant + cost per (splat, block) pair + cost per Gaussian, none negative, and the largest
    relative deviation of a measured point from that: least squares of the relative errors, all points on most threads.

    A Gaussian that is seen has at least one pair, so time that fits is bounded by constant + (both costs) x pairs.
    """
    most = max(p["threads"] for p in points)
    chosen = [p for p in points if p["threads"] == most]
    terms = np.array([[1.0, p["pairs"], p["n"]] for p in chosen])
    found = {}
    for name, (label, _, _) in OPERATIONS.items():
        seconds = np.array([p[name] for p in chosen])
        costs, _ = nnls(terms / seconds[:, None], np.ones(len(seconds)))
        values = costs[0] * 1e3, costs[1] * 1e9, costs[2] * 1e9, np.abs(terms @ costs / seconds - 1).max()
        found[label] = dict(zip(("constant, ms", "ns per pair", "ns per Gaussian", "worst deviation"), values, strict=True))
    return found


def scaling_figure(path: str | Path, points: list[dict[str, Any]]) -> None:
    """Time (first row) and memory (second) against N, pixels, threads and pairs, with exponents."""
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
                for quantity, (label, *style) in quantities.items():
                    against = [exponents[label][of] for of in sweeps.values() if of in exponents[label]]
                    text = ": ".join([label, ", ".join(f"{value:z.2f}" for value in against)])
                    _lines(axis, points, (key, quantity, scale), sweeps, style, text)
                axis.set(xlabel=name)
                axis.legend(title=title, loc="upper left")
                if key == "threads":
                    axis.set_xticks([p["threads"] for p in _sweep(points, "threads")])
                    axis.xaxis.set_major_formatter("{x:.0f}")
                    axis.xaxis.set_minor_formatter("")
            low, high = axes[0].get_ylim()
            axes[0].set(ylabel=unit, ylim=(low, high * (high / low) ** 0.35))  # room for the legends
        save_figure(figure, path)


def _lines(axis: Any, points: Any, what: tuple[str, str, float], sweeps: dict[str, str], style: list[str], text: str) -> None:
    """One quantity against one key, a line for each sweep, the second dashed. what: key, quantity, its scale."""
    key, quantity, scale = what
    colour, marker = style
    for sweep, dash, label in zip(sweeps, ("-", "--"), (text, None), strict=False):
        chosen = sorted(_sweep(points, sweep), key=lambda p: p[key])
        axis.loglog([p[key] for p in chosen], [scale * p[quantity] for p in chosen], dash + marker, color=colour, label=label)
