"""Plans of several views by their directional gains together: as a set, or as a path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mgs.policy.pool_gains import PoolGains

BETTER = 1 + 1e-6  # least ratio of gains for an exchange: above rounding errors; chosen
WIDTH = 16  # paths that `planned_path` keeps at each step; chosen


def planned_views(gains: PoolGains, candidates: Sequence[int], count: int) -> list[int]:
    """Views to take next, as a set: greedily, then exchanged one by one until no exchange has a
    larger gain (V. V. Fedorov, Theory of Optimal Experiments, 1972).

    gains: after the views taken; changed. candidates: poses, more than `count`."""
    views: list[int] = []
    for _ in range(count):
        free = [view for view in candidates if view not in views]
        views.append(free[int(gains.of_poses(free).argmax())])
        gains.take(views[-1:])
    improved = True
    while improved:
        improved = False
        for k, view in enumerate(views):
            gains.drop(view)
            free = [view] + [other for other in candidates if other not in views]
            values = gains.of_poses(free)
            best = int(values.argmax())
            if values[best] > BETTER * values[0]:
                views[k], improved = free[best], True
            gains.take([views[k]])
    return views


def planned_path(
    gains: PoolGains, reach: Callable[[Sequence[int]], Sequence[int]], count: int
) -> list[int]:
    """Views to take next, in this order and each in reach: a beam search for the largest gain of
    all together. Fewer than `count` where nothing is left in reach.

    gains: after the views taken. reach(views): poses in reach after these views."""
    paths = [(0.0, gains)]
    for _ in range(count):
        longer: dict[tuple[frozenset[int], int], tuple[float, int, PoolGains]] = {}
        for total, path in paths:
            near = reach(path.taken)
            for view, gain in zip(near, path.of_poses(near), strict=True):
                key = frozenset([*path.taken, view]), view
                better = total + float(gain), view, path
                longer[key] = max(longer.get(key, better), better, key=lambda one: one[0])
        best = sorted(longer.values(), key=lambda one: one[0], reverse=True)[:WIDTH]
        if not best:
            break
        paths = [(total, path.copy()) for total, _, path in best]
        for (_, path), (_, view, _) in zip(paths, best, strict=True):
            path.take([view])
    return paths[0][1].taken[len(gains.taken) :]
