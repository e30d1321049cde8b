"""The gains of `mgs.active.directional` for a pool of poses, brought up to date when a view is taken instead of computed anew.

With the symbols of that module, two numbers are kept of every pose c and Gaussian j that it sees: g = y_c^T S_j y_c, and for
I-optimality q = y_c^T S_j M_j S_j y_c. The gains follow from them: 3/2 log(1 + W g) nats, and W q / (1 + W g). A new view sees
j along y with the squared weights W. With u = S_j y, w = S_j M_j u and k = W / (1 + W y^T u), it changes (Sherman-Morrison)

    S_j by -k u u^T,   g by -k (u^T y_c)^2,   q by -2 k (u^T y_c) (w^T y_c) + k^2 (y^T w) (u^T y_c)^2,

so a choice costs two products of vectors for each pose and Gaussian, and nothing is inverted. All is float64: in float32 a
variance that falls from that of the prior to that of a hundred measured pixels would be lost in rounding. Each number is
written by one lane alone and depends on the views and their order only, so a resumed run has the same, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mgs.active.criteria import Array
from mgs.active.directional import Views, gains, in_parts, information, precision
from mgs.active.outlook import Gains
from mgs.memory import IMAGE_BYTES, padded
from mgs.splat.recording import one_at_a_time

BYTES_OF_GAUSSIAN, BYTES_OF_PAIR = 16, 40
"""Memory of a Gaussian, for each entry of its matrices; and of a pose and a Gaussian that it sees."""


def pool_gains(points: Array, lam: float, pool: Callable[[], Views], dome: Callable[[], Views]) -> Gains:
    """The gains of `mgs.active.directional.gains` for poses of a pool, as a function that is fast after one more view.

    points: [N,3] means of the Gaussians on the surface, metres. pool(), dome(): all poses and the dome, and what they see. What
    is kept between calls takes at most IMAGE_BYTES for each degree; where it would take more, gains are computed anew.
    """
    known: dict[tuple[int, float, bool], PoolGains] = {}
    pairs = cache(lambda: int(np.count_nonzero(pool().seen)))

    def found(taken: Sequence[int], left: Sequence[int], degree: int, tau: float, over_dome: bool) -> NDArray[np.float64]:
        key, views = (degree, tau, over_dome), pool()
        kept = BYTES_OF_GAUSSIAN * len(points) * (degree + 1) ** 4 + BYTES_OF_PAIR * pairs()
        if kept > IMAGE_BYTES or not pairs():  # Dr.Jit has no kernels for empty arrays
            before, candidates = (Views(views.positions[list(some)], views.seen[list(some)]) for some in (taken, left))
            return gains(points, lam, degree, tau, before, candidates, dome() if over_dome else None)
        if key not in known or known[key].taken != list(taken[: len(known[key].taken)]):
            known[key] = PoolGains(points, views, lam, degree, tau, dome() if over_dome else None)
        known[key].take(taken[len(known[key].taken) :])
        return known[key].of_poses(left)

    return found


class PoolGains:
    """Gains of the poses of a pool after views among them, `taken`. pool: all poses; the others as in
    `mgs.active.directional.gains`.

    S, M: [N*K*K] matrices, one Gaussian after another. g, q: of each pair of a pose and a Gaussian that it sees, whose indices
    are `by` and `of`. M and q are None for D-optimality.
    """

    @one_at_a_time
    def __init__(self, points: Array, pool: Views, lam: float, degree: int, tau: float, dome: Views | None = None) -> None:
        self.pool, self.degree, self.taken = pool, degree, list[int]()
        self.points = mi.Float64(padded(points, np.float64).ravel())
        self.positions = mi.Float64(padded(pool.positions, np.float64).ravel())
        of, self.poses = np.nonzero(pool.seen.T)
        self.of, self.by = mi.UInt32(padded(of, np.uint32)), mi.UInt32(padded(self.poses, np.uint32))
        self.weights = mi.Float64(padded(pool.seen[self.poses, of], np.float64))
        variance = 1 / precision(degree, tau, lam)
        self.size = len(variance)
        self.S = mi.Float64(padded(np.tile(np.diag(variance).ravel(), len(points)), np.float64))
        y = self._harmonics(self.of, self.by)
        moved = [float(v) * value for v, value in zip(variance, y, strict=True)]
        self.g, self.M, self.q = _dot(moved, y), None, None
        if dome is not None:
            M = in_parts(len(points), lambda s: information(points[s], Views(dome.positions, dome.seen[:, s]), degree))
            self.M, first = mi.Float64(padded(np.concatenate(M), np.float64).ravel()), self.of * self.size**2
            self.q = _dot([_dot(self._row(self.M, first + a * self.size), moved) for a in range(self.size)], moved)
        dr.eval(self.S, self.M, self.g, self.q)

    @one_at_a_time
    def of_poses(self, poses: Sequence[int]) -> NDArray[np.float64]:
        """[C] the gain of each of some poses."""
        explained = self.weights * self.g
        of_pairs = 1.5 * np.log1p(explained) if self.q is None else self.weights * self.q / (1 + explained)
        return np.asarray(np.bincount(self.poses, np.asarray(of_pairs), len(self.pool.positions))[list(poses)], np.float64)

    @one_at_a_time
    def take(self, views: Sequence[int]) -> None:
        """Take more views, one after another."""
        for view in views:
            self.taken.append(view)
            seen = np.flatnonzero(self.pool.seen[view])
            if len(seen):
                self._take(mi.UInt32(padded(seen, np.uint32)), mi.Float64(padded(self.pool.seen[view, seen], np.float64)), view)

    def _take(self, rows: Any, weights: Any, view: int) -> None:
        """Take a view, which sees the Gaussians `rows` with these squared weights."""
        K, n = self.size, len(rows)
        columns = self._harmonics(rows, dr.opaque(mi.UInt32, view, n))
        y, start = dr.zeros(mi.Float64, n * K), dr.arange(mi.UInt32, n) * K
        for a, column in enumerate(columns):
            dr.scatter(y, column, start + a)
        dr.eval(y)
        # One number of a kernel (`lane`) for each Gaussian that is seen and each row of its matrices.
        lane = dr.arange(mi.UInt32, n * K)
        row, a = lane // K, lane % K
        first = dr.gather(mi.UInt32, rows, row) * K**2 + a * K

        def times(matrices: Any, vectors: Any) -> Any:
            product = _dot(self._row(matrices, first), self._row(vectors, row * K))
            dr.eval(product)
            return product

        u = times(self.S, y)
        w = None if self.M is None else times(self.S, times(self.M, u))
        k = weights / (1 + weights * _dot(self._row(u, start), columns))
        both = None if w is None else dr.square(k) * _dot(self._row(w, start), columns)
        dr.eval(k, both)
        change, by = -_at(k, row) * _at(u, lane), self._row(u, row * K)
        for b in range(K):
            dr.scatter_reduce(dr.ReduceOp.Add, self.S, change * by[b], first + b, mode=dr.ReduceMode.NoConflicts)
        dr.eval(self.S)
        self._update(rows, u, w, k, both)

    def _update(self, rows: Any, u: Any, w: Any, k: Any, both: Any) -> None:
        """Bring g and q up to date with a view that sees the Gaussians `rows`. both: k^2 (y^T w)."""
        place = dr.zeros(mi.UInt32, len(self.points) // 3)  # where in `rows` each Gaussian is, from 1; 0: the view misses it
        dr.scatter(place, dr.arange(mi.UInt32, len(k)) + 1, rows)
        dr.eval(place)
        row = dr.gather(mi.UInt32, place, self.of)
        seen, row = row > 0, row - 1
        y, k = self._harmonics(self.of, self.by), _at(k, row, seen)
        uy = _dot(self._row(u, row * self.size, seen), y)
        if w is not None:
            wy = _dot(self._row(w, row * self.size, seen), y)
            self.q += _at(both, row, seen) * dr.square(uy) - 2 * k * uy * wy
        self.g -= k * dr.square(uy)
        dr.eval(self.g, self.q)

    def _harmonics(self, of: Any, by: Any) -> list[Any]:
        """K spherical harmonics of the directions from poses to Gaussians, given the indices of both."""
        offset = dr.gather(mi.Point3d, self.points, of) - dr.gather(mi.Point3d, self.positions, by)
        return list(dr.sh_eval(mi.Vector3d(offset * dr.rcp(dr.norm(offset))), self.degree))

    def _row(self, values: Any, first: Any, active: Any = True) -> list[Any]:
        """K numbers that stand one after another in an array; four are read at once where K allows it."""
        if self.size % 4:
            return [_at(values, first + b, active) for b in range(self.size)]
        return [v for b in range(self.size // 4) for v in dr.gather(mi.Vector4d, values, first // 4 + b, active)]


def _at(values: Any, index: Any, active: Any = True) -> Any:
    return dr.gather(mi.Float64, values, index, active)


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = dr.fma(x, y, total)
    return total
