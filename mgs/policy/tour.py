"""Tours of a flight: lengths of legs, 2-opt, and plans within a limit. Metres. A tour is a list of
poses, indices of rows of a matrix of legs. Its two ends stay where they are."""

from collections.abc import Callable, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from mgs.policy.criteria import BETTER, Array
from mgs.policy.pool_gains import PoolGains

Share = Callable[[Array, int], NDArray[np.float64]]
"""(metres of a tour, number of its stops) -> share of the limits that it takes; at most 1 fits."""

Pick = Callable[[list[int], NDArray[np.float64]], tuple[int, float]]
"""(stops, their costs) -> the next stop and its gain. It counts as taken from then on."""

ROUNDING = 1e-9  # share of the limits, for metres that are summed in another order
WIDTHS = (1, 2, 3)  # numbers of neighbouring stops that are replaced together; chosen
ARC_STEP = np.radians(15)  # largest angle between two corners of a leg around a cylinder; chosen


def legs(positions: Array, axis: Array, radius: float = 0.0) -> NDArray[np.float64]:
    """Lengths of the legs between all pairs of positions [V,3], metres [V,V]. A leg is straight. If
    it would cross the upright cylinder of this radius around `axis` [2], it leads around it through
    the corners of `leg_corners`. For a pose inside the cylinder, the cylinder shrinks to it."""
    offset = positions[:, None] - positions[None]
    level = np.linalg.norm(offset[..., :2], axis=2)
    if radius > 0:
        out = np.linalg.norm(positions[:, :2] - axis, axis=1)
        clear = np.minimum(radius, np.minimum(out[:, None], out[None]))
        tangents, arc = _around(positions[:, :2] - axis, out, clear)
        half, count = _steps(arc)
        level = np.where(arc > 0, tangents + 2 * count * clear * np.tan(half), level)
    return np.hypot(level, offset[..., 2])


def _around(level: Array, out: Array, clear: Array) -> tuple[Array, Array]:
    """Both tangents to the circle, metres, and the arc between them, radians [V,V]; else 0."""
    radii = np.stack(np.broadcast_arrays(out[:, None], out[None]))
    safe = np.maximum(radii, 1e-12)
    cosine = np.clip((level @ level.T) / (safe[0] * safe[1]), -1, 1)
    behind = np.arccos(np.clip(clear / safe, 0, 1))
    arc = np.arccos(cosine) - behind.sum(0)
    tangents = np.sqrt(np.maximum(radii**2 - clear**2, 0)).sum(0)
    return tangents, np.where(arc > 1e-9, arc, 0.0)


def _steps(arc: Array) -> tuple[Array, Array]:
    """Half the angle between the corners of an arc, and their number."""
    count = np.maximum(np.ceil(arc / ARC_STEP), 1)
    return arc / (2 * count), count


def leg_corners(start: Array, end: Array, axis: Array, radius: float) -> NDArray[np.float64]:
    """Corners [M,3] of the leg from `start` to `end` [3] (`legs`); none if it is straight. They lie
    just outside the cylinder, and their heights change evenly along the leg."""
    ends = np.stack([start, end])
    level, out = ends[:, :2] - axis, np.linalg.norm(ends[:, :2] - axis, axis=1)
    clear = min(radius, float(out.min()))
    tangents, arcs = _around(level, out, np.full((2, 2), clear))
    arc = float(arcs[0, 1])
    if radius <= 0 or arc == 0:
        return np.zeros((0, 3))
    half, count = (float(value) for value in _steps(np.array(arc)))
    turn = 1.0 if level[0, 0] * level[1, 1] - level[0, 1] * level[1, 0] >= 0 else -1.0
    first = np.arctan2(level[0, 1], level[0, 0]) + turn * np.arccos(min(clear / out[0], 1))
    step = np.arange(int(count))
    angles = first + turn * (2 * step + 1) * half
    flat = axis + clear / np.cos(half) * np.stack([np.cos(angles), np.sin(angles)], 1)
    whole = tangents[0, 1] + 2 * count * clear * np.tan(half)
    tangent = np.sqrt(max(out[0] ** 2 - clear**2, 0))
    along = (tangent + (2 * step + 1) * clear * np.tan(half)) / whole
    return np.column_stack([flat, start[2] + along * (end[2] - start[2])])


def tour_length(matrix: Array, tour: Sequence[int]) -> float:
    """Length of a tour, metres. matrix: `legs` [V,V]."""
    return float(matrix[list(tour[:-1]), list(tour[1:])].sum())


def insertions(
    matrix: Array, tour: Sequence[int], stops: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Least metres that each stop adds to a tour [C], and the index in the tour that it takes."""
    before, after, new = list(tour[:-1]), list(tour[1:]), list(stops)
    extra = matrix[np.ix_(new, before)] + matrix[np.ix_(new, after)] - matrix[before, after]
    place = extra.argmin(axis=1)
    return np.maximum(extra[np.arange(len(new)), place], 0.0), place + 1


def two_opt(matrix: Array, tour: Sequence[int]) -> list[int]:
    """Reverse parts of a tour while that shortens it; both ends stay."""
    best, improved = list(tour), True
    while improved:
        improved = False
        for i in range(1, len(best) - 2):
            for j in range(i + 1, len(best) - 1):
                a, b, c, d = best[i - 1], best[i], best[j], best[j + 1]
                if matrix[a, c] + matrix[b, d] < matrix[a, b] + matrix[c, d] - 1e-9:
                    best[i : j + 1] = best[i : j + 1][::-1]
                    improved = True
    return best


def flying_order(matrix: Array, start: int, stops: Sequence[int], home: int) -> list[int]:
    """Stops in the order of a short tour from `start` to `home`: nearest next, then 2-opt."""
    tour, rest = [start], list(stops)
    while rest:
        nearest = min(rest, key=lambda stop: (matrix[tour[-1], stop], stop))
        rest.remove(nearest)
        tour.append(nearest)
    return two_opt(matrix, [*tour, home])[1:-1]


def grown(
    legs: Array, tour: Sequence[int], free: Sequence[int], pick: Pick, share: Share, per_stop: float
) -> tuple[list[int], float]:
    """Add stops to a tour until none fits: (the tour, the sum of their gains). The stop that is
    picked joins at its cheapest place, then 2-opt shortens the tour. The cost of a stop is the
    share of the limits that it adds, and `per_stop`."""
    way, rest, total = list(tour), list(free), 0.0
    while rest:
        metres, stops = tour_length(legs, way), len(way) - 2
        extra, places = insertions(legs, way, rest)
        shares = share(metres + extra, stops + 1)
        fits = np.flatnonzero(shares <= 1 + ROUNDING)
        if not len(fits):
            break
        cost = shares[fits] - share(np.array(metres), stops) + per_stop
        stop, gain = pick([rest[k] for k in fits], cost)
        way.insert(int(places[rest.index(stop)]), stop)
        way, total = two_opt(legs, way), total + gain
        rest.remove(stop)
    return way, total


def planned_tour(
    legs: Array,
    ends: Sequence[int],
    free: Sequence[int],
    gains: PoolGains,
    share: Share,
    per_stop: float,
) -> list[int]:
    """Tour between `ends` of large total gain: `grown` by gain per cost, then improved. Each one to
    three neighbouring stops are dropped and the tour grown again without the first of them, as long
    as that raises the total gain. gains: after the views taken; changed."""

    def of(state: PoolGains) -> Pick:
        def pick(stops: list[int], cost: NDArray[np.float64]) -> tuple[int, float]:
            values = state.of_poses(stops)
            best = int((values / cost).argmax())
            state.take([stops[best]])
            return stops[best], float(values[best])

        return pick

    tour, _ = grown(legs, ends, free, of(gains), share, per_stop)
    improved = True
    while improved:
        improved = False
        for width, first in product(WIDTHS, range(1, len(free) + 1)):
            dropped = tour[first:-1][:width]
            if len(dropped) < width:
                continue
            state, loss = gains, 0.0
            for stop in dropped:
                state = state.without(stop)
                loss += float(state.of_poses([stop])[0])
            rest = two_opt(legs, [stop for stop in tour[:-1] if stop not in dropped] + tour[-1:])
            others = [stop for stop in free if stop not in rest and stop != dropped[0]]
            new, won = grown(legs, rest, others, of(state), share, per_stop)
            new, more = grown(legs, new, dropped[:1], of(state), share, per_stop)
            if won + more > BETTER * loss:
                tour, gains, improved = new, state, True
    return tour
