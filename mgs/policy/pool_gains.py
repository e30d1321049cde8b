"""Gains of `mgs.policy.directional` for a pool of poses, updated when a view is taken.

Kept are g = y_c^T S_j y_c and q = y_c^T S_j M_j S_j y_c of each pose c and Gaussian j that it sees.
The gains are 3/2 log(1 + W g) nats, and W q / (1 + W g). A new view sees j along y with squared
weights W. By the Sherman-Morrison formula, with u = S_j y, w = S_j M_j u, k = W / (1 + W y^T u):

    S_j changes by -k u u^T
    g changes by -k (u^T y_c)^2
    q changes by -2 k (u^T y_c) (w^T y_c) + k^2 (y^T w) (u^T y_c)^2

All is float64: variances fall by many orders of magnitude. Each number is written by one lane, so a
resumed run has the same bits. Of a matrix the upper triangle is kept, an array [N] an entry."""

from collections.abc import Sequence
from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mgs.memory import padded
from mgs.policy.criteria import Array
from mgs.policy.directional import Views, information, precision
from mgs.splat.recording import one_at_a_time


class PoolGains:
    """Gains of the poses of a pool after the views `taken`. Arguments as in
    `mgs.policy.relaxation.directional`.

    S, M: matrices, one array [N] for each entry of `_upper`.
    g, q: one number for each pair of a pose and a Gaussian that it sees.
    by, of: pose and Gaussian of each pair. M and q are None for D-optimality."""

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
        of, by = np.nonzero(pool.seen.T)
        self.of, self.by = mi.UInt32(padded(of, np.uint32)), mi.UInt32(padded(by, np.uint32))
        self.weights = mi.Float(padded(pool.seen[by, of]))
        variance = 1 / precision(degree, tau, lam)
        upper = _upper(len(variance))
        self.S = [
            dr.opaque(mi.Float64, variance[a] if a == b else 0.0, len(points)) for a, b in upper
        ]
        y = self._harmonics(self.of, self.by)
        Sy = [float(v) * value for v, value in zip(variance, y, strict=True)]
        self.g, self.M, self.q = _dot(Sy, y), None, None
        if dome is not None:
            M = information(points, dome, degree)
            self.M = [mi.Float64(padded(M[:, a, b], np.float64)) for a, b in upper]
            self.q = _dot(_times([_at(entry, self.of) for entry in self.M], Sy), Sy)
        dr.eval(self.S, self.M, self.g, self.q)

    def copy(self) -> "PoolGains":
        other = copy(self)
        other.taken = list(self.taken)
        return other

    @one_at_a_time
    def of_poses(self, poses: Sequence[int]) -> NDArray[np.float64]:
        weights = mi.Float64(self.weights)
        leverages = weights * self.g
        if self.q is None:
            of_pairs = 1.5 * np.log1p(leverages)
        else:
            of_pairs = weights * self.q / (1 + leverages)
        sums = np.bincount(np.asarray(self.by), np.asarray(of_pairs), len(self.pool.positions))
        return np.asarray(sums[list(poses)], np.float64)

    @one_at_a_time
    def take(self, views: Sequence[int]) -> None:
        for view in views:
            self.taken.append(view)
            self._take(view)

    @one_at_a_time
    def without(self, view: int) -> "PoolGains":
        """The gains if a view taken had not been: an update by -W y y^T."""
        other = self.copy()
        other.taken.remove(view)
        other._take(view, sign=-1.0)
        return other

    def _take(self, view: int, sign: float = 1.0) -> None:
        dr.eval(self.S)
        n = len(self.points) // 3
        weights = sign * mi.Float64(padded(self.pool.seen[view], np.float64))
        y = self._harmonics(dr.arange(mi.UInt32, n), dr.opaque(mi.UInt32, view, n))
        u = _times(self.S, y)
        w = None if self.M is None else _times(self.S, _times(self.M, u))
        k = weights / (1 + weights * _dot(y, u))
        both = None if w is None else dr.square(k) * _dot(y, w)
        pairs = zip(self.S, _upper(len(y)), strict=True)
        self.S = [entry - k * u[a] * u[b] for entry, (a, b) in pairs]
        u, w = _interleaved(u), None if w is None else _interleaved(w)
        # Most gains without a view are only looked at: their S is computed where it is used.
        dr.eval(self.S if sign > 0 else [], u, w, k, both)
        self._update(u, w, k, both)

    def _update(self, u: Any, w: Any, k: Any, both: Any) -> None:
        """Update g and q. u, w: [N*K]; k: [N], 0 where the view misses it; both: k^2 y^T w [N]."""

        def change(k_of: Any, g: Any, q: Any) -> Any:
            y = self._harmonics(self.of, self.by)
            uy = _dot(self._row(u), y)
            if w is not None:
                q = q + _at(both, self.of) * dr.square(uy) - 2 * k_of * uy * _dot(self._row(w), y)
            return mi.Float64(0), g - k_of * dr.square(uy), q

        # A loop of at most one round: neighbouring lanes mostly belong to one Gaussian, and skip
        # the round if the view misses it.
        before = _at(k, self.of), self.g, mi.Float64(0) if w is None else self.q
        _, self.g, q = dr.while_loop(before, lambda k_of, g, q: k_of != 0, change)
        self.q = None if w is None else q
        dr.eval(self.g, self.q)

    def _harmonics(self, of: Any, by: Any) -> list[Any]:
        """K spherical harmonics of the directions from poses to Gaussians, given their indices."""
        offset = dr.gather(mi.Point3d, self.points, of) - dr.gather(mi.Point3d, self.positions, by)
        return list(dr.sh_eval(mi.Vector3d(offset * (1 / dr.norm(offset))), self.degree))

    def _row(self, vectors: Any) -> list[Any]:
        """The K entries for each pair's Gaussian of vectors [N*K]; four at once if K allows it."""
        K = (self.degree + 1) ** 2
        if K % 4:
            return [_at(vectors, self.of * K + b) for b in range(K)]
        fours = [dr.gather(mi.Vector4d, vectors, self.of * (K // 4) + b) for b in range(K // 4)]
        return [v for four in fours for v in four]


def _upper(K: int) -> list[tuple[int, int]]:
    """Rows and columns of the upper triangle of a K x K matrix."""
    return [(a, b) for a in range(K) for b in range(a, K)]


def _times(matrix: list[Any], vector: list[Any]) -> list[Any]:
    """Product of a symmetric matrix, given by its upper triangle, and a vector."""
    K = len(vector)
    entries = dict(zip(_upper(K), matrix, strict=True))
    return [_dot([entries[min(a, b), max(a, b)] for b in range(K)], vector) for a in range(K)]


def _interleaved(vector: list[Any]) -> Any:
    n, K = len(vector[0]), len(vector)
    packed, first = dr.zeros(mi.Float64, n * K), dr.arange(mi.UInt32, n) * K
    add, mode = dr.ReduceOp.Add, dr.ReduceMode.NoConflicts
    for b, values in enumerate(vector):
        dr.scatter_reduce(add, packed, values, first + b, mode=mode)
    return packed


def _at(values: Any, index: Any) -> Any:
    return dr.gather(mi.Float64, values, index)


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = dr.fma(x, y, total)
    return total
