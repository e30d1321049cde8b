"""Statistics of paired differences, one for each rock: the rock is what is replicated, so draws and
views are no samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

MOST_ROCKS = 20
"""The permutation test enumerates all 2^n sign flips; with more rocks that would take long."""


def area(images: Sequence[float], values: Sequence[float]) -> float:
    """Area under values(images) over the length of the axis: the mean of the curve, in the unit of
    the values.

    images: numbers of images, rising. A curve of one point is its value.
    """
    if len(images) == 1:
        return float(values[0])
    return float(np.trapezoid(values, images) / (images[-1] - images[0]))


def images_to_reach(images: Sequence[float], values: Sequence[float], level: float) -> float | None:
    """Number of images at which a curve first reaches a level, on straight lines between its
    points; None if it never does.

    images: numbers of images, rising.
    """
    for k, value in enumerate(values):
        if value >= level:
            if k == 0:
                return float(images[0])
            share = (level - values[k - 1]) / (value - values[k - 1])
            return float(images[k - 1] + share * (images[k] - images[k - 1]))
    return None


def interval(numbers: Sequence[float]) -> tuple[float, float] | None:
    """Student's t interval of 95 % of the mean of independent numbers, (low, high); None for fewer
    than two of them."""
    if len(numbers) < 2:
        return None
    values = np.asarray(numbers, np.float64)
    half = float(stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return float(values.mean()) - half, float(values.mean()) + half


def permutation_p(differences: Sequence[float]) -> float | None:
    """Two-sided p-value of the exact paired permutation test: under the hypothesis that two
    policies are alike, each difference could as well have the other sign. None for fewer than two
    differences; at most MOST_ROCKS of them.

    The share of the 2^n sign flips whose mean is at least as far from 0 as the one observed, so 2 /
    2^n at least (1 if all differences are 0).
    """
    count = len(differences)
    if count < 2:
        return None
    if count > MOST_ROCKS:
        raise ValueError(f"{count} differences; the exact test is for at most {MOST_ROCKS}")
    result = stats.permutation_test(
        (np.asarray(differences, np.float64),),
        lambda sample, axis: np.mean(sample, axis=axis),
        permutation_type="samples", vectorized=True, n_resamples=2**count, batch=1 << 14,
    )  # fmt: skip
    return float(min(result.pvalue, 1.0))


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's correction for several tests: the adjusted p-values, in the order given.

    Whoever rejects all hypotheses whose adjusted value is at most alpha rejects a true one with a
    probability of at most alpha.
    """
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    adjusted, largest = [0.0] * len(p_values), 0.0
    for rank, k in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[k]))
        adjusted[k] = largest
    return adjusted
