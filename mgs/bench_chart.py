"""The scaling chart: log-log, with fitted exponents. Reads records only, measures nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from mgs.bench import exponent
from mgs.figures import STYLE, new_figure, save_figure

OPERATIONS = {
    "forward_warm": ("forward, warm", "#0072b2", "o"),
    "forward_cold": ("forward, cold", "#56b4e9", "s"),
    "gradient_warm": ("forward + adjoint", "#d55e00", "^"),
    "fisher_exact": ("exact Fisher", "#009e73", "D"),
    "fisher_block": ("block Fisher", "#cc79a7", "v"),
}


def _sweep(points: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    return [p for p in points if p["sweep"] == name]


def fitted(points: list[dict[str, Any]], sweep: str = "gaussians") -> list[dict[str, Any]]:
    """The points of a sweep that exponents are fitted to: the last two decades of N. Below, other things take the time."""
    by_n = _sweep(points, sweep)
    return [p for p in by_n if 100 * p["n"] >= by_n[-1]["n"]]


def scaling_exponents(points: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Fitted growth of each operation's time, and of peak memory, in N, pixels and (splat, block) pairs.

    Pairs grow alone where N and the image grow together. Where N grows by itself they grow more slowly than N, so that the
    work per Gaussian gains weight; where the image does, the work per pair: a fit each.
    """
    by_n, by_size = fitted(points), _sweep(points, "pixels")
    fits = {
        "N": (by_n, "n"),
        "pixels": (by_size, "pixels"),
        "pairs alone": (fitted(points, "both"), "pairs"),
        "pairs, N growing": (by_n, "pairs"),
        "pairs, image growing": (by_size, "pairs"),
    }
    labels = {name: label for name, (label, _, _) in OPERATIONS.items()} | {"peak_bytes": "peak memory"}
    return {
        label: {what: exponent([p[key] for p in of], [p[name] for p in of]) for what, (of, key) in fits.items()}
        for name, label in labels.items()
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
    """Four panels: time against N, pixels and pairs, and memory against N; threads as a note."""
    import matplotlib

    exponents, start = scaling_exponents(points), fitted(points)[0]["n"]
    with matplotlib.rc_context(STYLE | {"legend.fontsize": 7, "legend.title_fontsize": 7}):
        figure = new_figure(10, 7)
        panels = figure.subplots(2, 2)
        _time_panel(panels[0, 0], points, "n", {"gaussians": "N"}, exponents)
        panels[0, 0].set(xlabel="Gaussians N")
        panels[0, 0].legend(title=f"exponent, fitted from {start:,}")
        _time_panel(panels[0, 1], points, "pixels", {"pixels": "pixels"}, exponents)
        panels[0, 1].set(xlabel="pixels")
        panels[0, 1].legend(title="exponent")
        sweeps = {"both": "pairs alone", "gaussians": "pairs, N growing"}
        _time_panel(panels[1, 0], points, "pairs", sweeps, exponents)
        panels[1, 0].set(xlabel="(splat, block) pairs")
        panels[1, 0].legend(
            title=f"exponent as N and the image grow together (solid)\nand as N grows alone (dashed), from {start:,}",
            loc="upper left",
        )
        memory, by_n = panels[1, 1], _sweep(points, "gaussians")
        peak = f"peak of the kernels: {exponents['peak memory']['N']:.2f}"
        for key, style, colour, label in (
            ("peak_bytes", "o-", "#444444", peak),
            ("list_bytes", "s-", "#999999", "block lists of one camera"),
        ):
            memory.loglog([p["n"] for p in by_n], [p[key] / 1e6 for p in by_n], style, color=colour, label=label)
        memory.set(xlabel="Gaussians N", ylabel="memory, MB")
        memory.legend(title=f"exponent, fitted from {start:,}")
        for axis in panels.flat:
            axis.tick_params(which="minor", labelsize=6)
        threads = sorted(_sweep(points, "threads"), key=lambda p: p["threads"])
        if len(threads) > 1:
            gain = threads[0]["gradient_warm"] / threads[-1]["gradient_warm"]
            times = f"{gain:.2f} times as fast as {threads[0]['threads']} (forward + adjoint)"
            figure.suptitle(f"{threads[-1]['threads']} threads are {times}", fontsize=10)
        save_figure(figure, path)


def _time_panel(axis: Any, points: Any, key: str, sweeps: dict[str, str], exponents: Any) -> None:
    """Time against `key`, a line for each operation and sweep, the second dashed. sweeps: sweep -> exponent shown."""
    for name, (operation, colour, marker) in OPERATIONS.items():
        values = ", ".join(f"{exponents[operation][against]:.2f}" for against in sweeps.values())
        for sweep, dash in zip(sweeps, ("-", "--"), strict=False):
            chosen, label = _sweep(points, sweep), f"{operation}: {values}" if dash == "-" else None
            axis.loglog([p[key] for p in chosen], [1e3 * p[name] for p in chosen], dash + marker, color=colour, label=label)
    axis.set(ylabel="time, ms")
