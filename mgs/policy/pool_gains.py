"""The gains of `mgs.policy.directional` for a pool of poses, brought up to date when a view is
taken instead of computed anew.

With the symbols of that module, two numbers are kept of every pose c and Gaussian j that it sees: g
= y_c^T S_j y_c, and for I-optimality q = y_c^T S_j M_j S_j y_c. The gains follow from them: 3/2
log(1 + W g) nats, and W q / (1 + W g). A new view sees j along y with the squared weights W. With u
= S_j y, w = S_j M_j u and k = W / (1 + W y^T u), it changes (Sherman-Morrison)

    S_j by -k u u^T,   g by -k (u^T y_c)^2,   q by -2 k (u^T y_c) (w^T y_c) + k^2 (y^T w) (u^T
    y_c)^2,

so a choice costs two products of vectors for each pose and Gaussian, and nothing is inverted. All
is float64: in float32 a variance that falls from that of the prior to that of a hundred measured
pixels would be lost in rounding. Each number is written by one lane alone and depends on the views
and their order only, so a resumed run has the same, bit for bit.

What the matrices cost is reading and writing them. So of each only the upper triangle is kept,
entry by entry, all Gaussians'
numbers of one entry side by side: one kernel reads S and M once, and writes S once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mgs.memory import IMAGE_BYTES, padded
from mgs.policy.context import Gains
from mgs.policy.criteria import Array
from mgs.policy.directional import Views, gains, in_parts, information, precision
from mgs.splat.recording import one_at_a_time

BYTES_OF_ENTRY, BYTES_OF_PAIR = 16, 40
"""Memory of a Gaussian's entry of both matrices, and of a pose and a Gaussian that it sees. While a
view is taken, S, g and q exist twice."""


def pool_gains(
    points: Array, lam: float, pool: Callable[[], Views], dome: Callable[[], Views]
) -> Gains:
    """The gains of `mgs.policy.directional.gains` for poses of a pool, as a function that is fast
    after one more view.

    points: [N,3] means of the Gaussians on the surface, metres. pool(), dome(): all poses and the
    dome, and what they see. What is kept between calls takes at most IMAGE_BYTES for each degree;
    where it would take more, gains are computed anew.
    """
    known: dict[tuple[int, float, bool], PoolGains] = {}
    pairs = cache(lambda: int(np.count_nonzero(pool().seen)))

    def found(
        taken: Sequence[int], left: Sequence[int], degree: int, tau: float, over_dome: bool
    ) -> NDArray[np.float64]:
        key, views = (degree, tau, over_dome), pool()
        kept = (
            BYTES_OF_ENTRY * len(points) * len(_upper((degree + 1) ** 2)) + BYTES_OF_PAIR * pairs()
        )
        if kept > IMAGE_BYTES or not pairs():  # Dr.Jit has no kernels for empty arrays
            before, candidates = (
                Views(views.positions[list(some)], views.seen[list(some)]) for some in (taken, left)
            )
            return gains(
                points, lam, degree, tau, before, candidates, dome() if over_dome else None
            )
        if key not in known or known[key].taken != list(taken[: len(known[key].taken)]):
            known[key] = PoolGains(points, views, lam, degree, tau, dome() if over_dome else None)
        known[key].take(taken[len(known[key].taken) :])
        return known[key].of_poses(left)

    return found


class PoolGains:
    """Gains of the poses of a pool after views among them, `taken`. pool: all poses; the others as
    in `mgs.policy.directional.gains`.

    S, M: the matrices, as `_upper` counts their entries; of each, one number for every Gaussian. g,
    q: of each pair of a pose and a Gaussian that it sees, whose indices are `by` and `of`. M and q
    are None for D-optimality.
    """

    @one_at_a_time
    def __init__(
        self,
        points: Array,
        pool: Views,
        lam: float,
        degree: int,
        tau: float,
        dome: Views | None = None,
    ) -> None:
        self.pool, self.degree, self.taken = pool, degree, list[int]()
        self.points = mi.Float64(padded(points, np.float64).ravel())
        self.positions = mi.Float64(padded(pool.positions, np.float64).ravel())
        of, self.poses = np.nonzero(pool.seen.T)
        self.of, self.by = (
            mi.UInt32(padded(of, np.uint32)),
            mi.UInt32(padded(self.poses, np.uint32)),
        )
        self.weights = mi.Float64(padded(pool.seen[self.poses, of], np.float64))
        variance = 1 / precision(degree, tau, lam)
        upper = _upper(len(variance))
        self.S = [
            dr.opaque(mi.Float64, variance[a] if a == b else 0.0, len(points)) for a, b in upper
        ]
        y = self._harmonics(self.of, self.by)
        moved = [float(v) * value for v, value in zip(variance, y, strict=True)]
        self.g, self.M, self.q = _dot(moved, y), None, None
        if dome is not None:
            parts = in_parts(
                len(points),
                lambda s: information(points[s], Views(dome.positions, dome.seen[:, s]), degree),
            )
            M = np.concatenate(parts)
            self.M = [mi.Float64(padded(M[:, a, b], np.float64)) for a, b in upper]
            self.q = _dot(_times([_at(entry, self.of) for entry in self.M], moved), moved)
        dr.eval(self.S, self.M, self.g, self.q)

    @one_at_a_time
    def of_poses(self, poses: Sequence[int]) -> NDArray[np.float64]:
        """[C] the gain of each of some poses."""
        explained = self.weights * self.g
        of_pairs = (
            1.5 * np.log1p(explained) if self.q is None else self.weights * self.q / (1 + explained)
        )
        return np.asarray(
            np.bincount(self.poses, np.asarray(of_pairs), len(self.pool.positions))[list(poses)],
            np.float64,
        )

    @one_at_a_time
    def take(self, views: Sequence[int]) -> None:
        """Take more views, one after another."""
        for view in views:
            self.taken.append(view)
            self._take(view)

    def _take(self, view: int) -> None:
        """Bring everything up to date with one more view."""
        n = len(self.points) // 3
        weights, everyone = (
            mi.Float64(padded(self.pool.seen[view], np.float64)),
            dr.arange(mi.UInt32, n),
        )
        y = self._harmonics(everyone, dr.opaque(mi.UInt32, view, n))
        u = _times(self.S, y)
        w = None if self.M is None else _times(self.S, _times(self.M, u))
        k = weights / (1 + weights * _dot(y, u))
        both = None if w is None else dr.square(k) * _dot(y, w)
        self.S = [
            entry - k * u[a] * u[b] for entry, (a, b) in zip(self.S, _upper(len(y)), strict=True)
        ]
        u, w = _side_by_side(u), None if w is None else _side_by_side(w)
        dr.eval(self.S, u, w, k, both)
        self._update(u, w, k, both)

    def _update(self, u: Any, w: Any, k: Any, both: Any) -> None:
        """Bring g and q up to date. u, w: [N*K]; k: [N], 0 where the view misses a Gaussian; both:
        k^2 y^T w."""

        def change(k_of: Any, g: Any, q: Any) -> Any:
            y = self._harmonics(self.of, self.by)
            uy = _dot(self._row(u), y)
            if w is not None:
                q = q + _at(both, self.of) * dr.square(uy) - 2 * k_of * uy * _dot(self._row(w), y)
            return mi.Float64(0), g - k_of * dr.square(uy), q

        # A loop of one round. Lanes side by side are mostly of one Gaussian, and where the view
        # misses it they skip the round.
        before = _at(k, self.of), self.g, mi.Float64(0) if w is None else self.q
        _, self.g, q = dr.while_loop(before, lambda k_of, g, q: k_of > 0, change)
        self.q = None if w is None else q
        dr.eval(self.g, self.q)

    def _harmonics(self, of: Any, by: Any) -> list[Any]:
        """K spherical harmonics of the directions from poses to Gaussians, given the indices of
        both."""
        offset = dr.gather(mi.Point3d, self.points, of) - dr.gather(mi.Point3d, self.positions, by)
        return list(dr.sh_eval(mi.Vector3d(offset * dr.rcp(dr.norm(offset))), self.degree))

    def _row(self, vectors: Any) -> list[Any]:
        """K numbers of each pair's Gaussian from vectors [N*K]; four are read at once where K
        allows it."""
        K = (self.degree + 1) ** 2
        if K % 4:
            return [_at(vectors, self.of * K + b) for b in range(K)]
        return [
            v
            for b in range(K // 4)
            for v in dr.gather(mi.Vector4d, vectors, self.of * (K // 4) + b)
        ]


def _upper(K: int) -> list[tuple[int, int]]:
    """Rows and columns of the upper triangle of a K x K matrix."""
    return [(a, b) for a in range(K) for b in range(a, K)]


def _times(matrix: list[Any], vector: list[Any]) -> list[Any]:
    """Product of a symmetric matrix, given by its upper triangle, and a vector."""
    entries = dict(zip(_upper(len(vector)), matrix, strict=True))
    return [
        _dot([entries[min(a, b), max(a, b)] for b in range(len(vector))], vector)
        for a in range(len(vector))
    ]


def _side_by_side(vector: list[Any]) -> Any:
    """[N*K] with the K numbers of a Gaussian side by side, from K arrays [N]."""
    n, K = len(vector[0]), len(vector)
    packed, first = dr.zeros(mi.Float64, n * K), dr.arange(mi.UInt32, n) * K
    for b, values in enumerate(vector):
        dr.scatter_reduce(
            dr.ReduceOp.Add, packed, values, first + b, mode=dr.ReduceMode.NoConflicts
        )
    return packed


def _at(values: Any, index: Any) -> Any:
    return dr.gather(mi.Float64, values, index)


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = dr.fma(x, y, total)
    return total
