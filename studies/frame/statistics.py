"""Statistics of studies. Scenes are the replicates: draws and views of one rock are no samples."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

MOST_ROCKS = 20
"""Most differences of a permutation test, which enumerates all 2^n sign flips."""


def interval(numbers: Sequence[float]) -> tuple[float, float] | None:
    """Student's t interval of 95 % of the mean of independent numbers, (low, high); None for fewer
    than two."""
    if len(numbers) < 2:
        return None
    values = np.asarray(numbers, np.float64)
    half = float(stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return float(values.mean()) - half, float(values.mean()) + half


def permutation_p(differences: Sequence[float]) -> float | None:
    """Two-sided p-value of the exact paired permutation test: the share of the 2^n sign flips whose
    mean is at least as far from 0 as the observed one. None for fewer than two differences.

    Raises ValueError for more than MOST_ROCKS differences.
    """
    count = len(differences)
    if count < 2:
        return None
    if count > MOST_ROCKS:
        raise ValueError(f"{count} differences; the exact test is for at most {MOST_ROCKS}")
    result = stats.permutation_test(
        (np.asarray(differences, np.float64),),
        lambda sample, axis: np.mean(sample, axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=2**count,
        batch=1 << 14,
    )
    return float(min(result.pvalue, 1.0))


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values adjusted by Holm's correction for several tests, in the order given."""
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    adjusted, largest = [0.0] * len(p_values), 0.0
    for rank, k in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[k]))
        adjusted[k] = largest
    return adjusted


def pareto_front(costs: Sequence[float], gains: Sequence[float]) -> np.ndarray:
    """Mask [n] of the points that no other point beats: at most the cost, at least the gain, and
    one of both better. Points with NaN are not on the front; of equal points all are."""
    cost, gain = np.asarray(costs, np.float64), np.asarray(gains, np.float64)
    no_worse = (cost[None] <= cost[:, None]) & (gain[None] >= gain[:, None])
    better = (cost[None] < cost[:, None]) | (gain[None] > gain[:, None])
    return np.asarray(~(no_worse & better).any(axis=1) & ~np.isnan(cost) & ~np.isnan(gain))


Row = dict[str, Any]
