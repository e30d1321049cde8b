"""The Pareto front: the points that no other point beats in both measures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def pareto_front(costs: Sequence[float], gains: Sequence[float]) -> NDArray[np.bool_]:
    """[n] which points lie on the front: no other point has at most the cost and at least the gain,
    and one of both better.

    costs: the less the better; gains: the more the better. Points with a NaN are not on it. Of
    equal points all are.
    """
    cost, gain = np.asarray(costs, np.float64), np.asarray(gains, np.float64)
    no_worse = (cost[None] <= cost[:, None]) & (gain[None] >= gain[:, None])
    better = (cost[None] < cost[:, None]) | (gain[None] > gain[:, None])
    return np.asarray(~(no_worse & better).any(axis=1) & ~np.isnan(cost) & ~np.isnan(gain))
