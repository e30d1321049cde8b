"""How time and memory grow: fits to the records of `mgs.bench.core.bench_scaling`. Nothing is
measured here."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import nnls

Records = list[dict[str, Any]]

OPERATIONS = {
    "forward_warm": "forward, warm",
    "forward_cold": "forward, cold",
    "gradient_warm": "forward + adjoint",
    "fisher_exact": "exact Fisher",
    "fisher_block": "block Fisher",
}
"""Operations that are timed: key in a record -> what to call it."""

MEMORY = {
    "peak_bytes": "peak memory",
    "list_bytes": "lists of one camera",
}
"""Memory that is measured: key in a record -> what to call it."""


def growth(points: Records) -> dict[str, Any]:
    """All fits: "exponents" of `scaling_exponents`, "exponents_from_n" (the least N that they are
    fitted to), "linear_growth"."""
    return {
        "exponents": scaling_exponents(points),
        "linear_growth": linear_growth(points),
        "exponents_from_n": fitted(points)[0]["n"],
    }


def sweep_points(points: Records, sweep: str) -> Records:
    """The records of one sweep: "gaussians", "pixels", "both" or "threads"."""
    return [p for p in points if p["sweep"] == sweep]


def fitted(points: Records, sweep: str = "gaussians") -> Records:
    """The records of a sweep over N that exponents are fitted to: N within a factor of 100 of the
    largest.

    With fewer Gaussians most of the time goes to what does not grow with them.
    """
    by_n = sweep_points(points, sweep)
    return [p for p in by_n if 100 * p["n"] >= by_n[-1]["n"]]


def scaling_exponents(points: Records) -> dict[str, dict[str, float]]:
    """Exponents of growth: label of an OPERATION or of MEMORY -> what grows -> exponent of time or
    memory in it.

    N, pixels, threads: each along its own sweep; threads are left out if there is only one number
    of them. The number of (splat, block) pairs has three exponents, because it can grow in three
    ways. "pairs alone": N and the image grow together, and the pairs of each Gaussian stay the
    same. "pairs, N growing": N grows faster than the pairs, so the work for each Gaussian gains
    weight. "pairs, image growing": N stays the same, so the work for each pair gains weight.
    """
    by_n, by_size, by_threads = (
        fitted(points),
        sweep_points(points, "pixels"),
        sweep_points(points, "threads"),
    )
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
    """Exponent of the growth y ~ x^exponent: the slope of log y against log x, by least squares."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def linear_growth(points: Records) -> dict[str, dict[str, float]]:
    """Time of each operation as constant + cost of a pair x pairs + cost of a Gaussian x N: label
    -> these three numbers, and the largest relative deviation of a measured time from the sum.

    The costs are not negative, and fitted by least squares of the relative deviations to all
    records with most threads. A Gaussian in view has at least one pair; so a time that fits is at
    most constant + (sum of both costs) x pairs.
    """
    most = max(p["threads"] for p in points)
    chosen = [p for p in points if p["threads"] == most]
    terms = np.array([[1.0, p["pairs"], p["n"]] for p in chosen])
    found = {}
    for name, label in OPERATIONS.items():
        seconds = np.array([p[name] for p in chosen])
        costs, _ = nnls(terms / seconds[:, None], np.ones(len(seconds)))
        values = (
            costs[0] * 1e3,
            costs[1] * 1e9,
            costs[2] * 1e9,
            np.abs(terms @ costs / seconds - 1).max(),
        )
        found[label] = dict(
            zip(
                ("constant, ms", "ns per pair", "ns per Gaussian", "worst deviation"),
                values,
                strict=True,
            )
        )
    return found
