"""Criteria as concave functions of weights of views. Pure NumPy, float64.

Each is a sum over Gaussians j of a concave function of their information,

    f(x) = sum_j phi(A_j(x)) - phi(A_j(0)),   A_j(x) = A_j(0) + sum_v x_v z_jv z_jv^T,

with the weight x_v = 1 for a candidate that is taken, and 0 otherwise. A(0) holds the prior and the
views taken before. `mgs.policy.certificate` bounds f over all sets of k candidates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mgs.errors import InputError
from mgs.memory import VIEW_BYTES
from mgs.policy.criteria import Array
from mgs.policy.directional import Views, in_parts, information, of_points, precision

Floats = NDArray[np.float64]

COARSE = 1024
"""About the number of Gaussians of `Relaxation.coarse`. A chosen constant."""


@dataclass(frozen=True)
class Relaxation:
    """A criterion as a concave function of the weights x [C] of the candidates.

    phi is scale log det A, or -scale trace(A^-1 M) where `over` is given.
    vectors(some): z [n,C,K] of a slice of the N Gaussians.
    base: A(0) [N,K,K]. over: M [N,K,K].
    """

    candidates: int
    vectors: Callable[[slice], Floats]
    base: Floats
    over: Floats | None = None
    scale: float = 1.0

    @property
    def submodular(self) -> bool:
        """Whether gains only fall as views are added, so that greedy choice has a guarantee."""
        return self.over is None

    @cached_property
    def coarse(self) -> Relaxation:
        """The same for about COARSE of the Gaussians, which stand for all."""
        step = max(len(self.base) // COARSE, 1)

        def vectors(some: slice) -> Floats:
            return self.vectors(slice(some.start * step, some.stop * step, step))

        base, over = self.base[::step], None if self.over is None else self.over[::step]
        scale = self.scale * len(self.base) / len(base)
        return replace(self, vectors=vectors, base=base, over=over, scale=scale)

    @cached_property
    def before(self) -> Floats:
        """phi of each Gaussian without a candidate [N]."""

        def part(some: slice) -> Floats:
            return self._phi(self.base[some], some)[0]

        return np.concatenate(in_parts(len(self.base), part))

    def gain(self, views: Iterable[int]) -> float:
        """f of a set of candidates."""
        taken = np.flatnonzero(self._taken(views))

        def part(some: slice) -> float:
            z = self.vectors(some)[:, taken]
            A = self.base[some] + z.transpose(0, 2, 1) @ z
            return float((self._phi(A, some)[0] - self.before[some]).sum())

        return sum(in_parts(len(self.base), part))

    def tangent(self, x: Floats) -> tuple[float, Floats]:
        """f at weights x [C], and its gradient [C]."""

        def part(some: slice) -> tuple[float, Floats]:
            z, A = self._at(x, some)
            value, slope, _ = self._phi(A, some)
            return float((value - self.before[some]).sum()), np.einsum("nvk,nvk->v", z @ slope, z)

        values, slopes = zip(*in_parts(len(self.base), part), strict=True)
        return sum(values), sum(slopes)

    def curvature(self, x: Floats) -> Floats:
        """Minus the Hessian of f [C,C]."""

        def part(some: slice) -> Floats:
            z, A = self._at(x, some)
            one, other = self._phi(A, some)[2]
            across = z.transpose(0, 2, 1)
            return np.asarray((((z @ one) @ across) * ((z @ other) @ across)).sum(0))

        return np.asarray(sum(in_parts(len(self.base), part)))

    def added(self, views: Iterable[int]) -> Floats:
        """Gain of each candidate after these views [C] (`mgs.policy.directional`); 0 for them."""
        x = self._taken(views)

        def part(some: slice) -> Floats:
            z, A = self._at(x, some)
            explained = np.einsum("nvk,nvk->nv", z @ np.linalg.inv(A), z)
            if self.over is None:
                return np.asarray(self.scale * np.log1p(explained).sum(0))
            slope = self._phi(A, some)[1]
            return np.asarray((np.einsum("nvk,nvk->nv", z @ slope, z) / (1 + explained)).sum(0))

        return np.where(x > 0, 0.0, sum(in_parts(len(self.base), part)))

    def _taken(self, views: Iterable[int]) -> Floats:
        x = np.zeros(self.candidates)
        x[list(views)] = 1
        return x

    def _at(self, x: Floats, some: slice) -> tuple[Floats, Floats]:
        """z and A(x)."""
        z = self.vectors(some)
        return z, self.base[some] + (z * x[:, None]).transpose(0, 2, 1) @ z

    def _phi(self, A: Floats, some: slice) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
        """phi at A [n,K,K]; P [n,K,K] with d phi = trace(P dA); and Q, R [n,K,K] with
        d^2 phi = -(z_u^T Q z_v) (z_u^T R z_v) for views u and v."""
        S = np.asarray(np.linalg.inv(A), np.float64)
        if self.over is None:
            value = self.scale * np.linalg.slogdet(A)[1]
            return value, self.scale * S, (S, self.scale * S)
        M = self.over[some]
        slope, value = self.scale * (S @ M @ S), -self.scale * np.einsum("nkl,nkl->n", S, M)
        return value, slope, (S, 2 * slope)


def directional(
    points: Array,
    lam: float,
    degree: int,
    tau: float,
    taken: Views,
    candidates: Views,
    dome: Views | None = None,
) -> Relaxation:
    """Directional D-optimality of candidates, or I-optimality with a dome.

    Arguments as `mgs.policy.directional.gains`. Raises InputError as `checked`.
    """
    from mgs.splat.reference import sh_basis  # imported here because mgs.splat loads Dr.Jit

    checked(candidates.seen)
    means, centres = (np.asarray(a, np.float64) for a in (points, candidates.positions))

    def vectors(some: slice) -> Floats:
        offset = means[some, None] - centres
        offset /= np.sqrt(np.einsum("nvk,nvk->nv", offset, offset))[..., None]
        y = sh_basis(offset.reshape(-1, 3), degree).reshape(*offset.shape[:2], -1)
        y *= np.sqrt(candidates.seen[:, some].T.astype(np.float64))[..., None]
        return np.asarray(y)

    def summed(views: Views) -> Floats:
        def part(some: slice) -> Floats:
            return information(means[some], of_points(views, some), degree)

        return np.concatenate(in_parts(len(means), part))

    base = np.diag(precision(degree, tau, lam)) + summed(taken)
    made = Relaxation(len(centres), vectors, base, scale=1.5)
    if dome is not None:
        made = Relaxation(len(centres), vectors, base, summed(dome))
    if 8 * base.shape[1] * candidates.seen.size > VIEW_BYTES:
        return made
    z = np.concatenate(in_parts(len(means), vectors))
    return replace(made, vectors=lambda some: z[some])


def d_optimal(F: Array, H: Array, lam: Array) -> Relaxation:
    """`mgs.policy.criteria.d_optimal` (Eq. 7) at a fixed model. F: [C,N,P]. Errors: `checked`."""
    checked(F)
    flat = F.reshape(len(F), -1)

    def vectors(some: slice) -> Floats:
        return np.sqrt(flat[:, some].T.astype(np.float64))[..., None]

    base = np.asarray(H + lam, np.float64).reshape(-1, 1, 1)
    return Relaxation(len(F), vectors, base, scale=1 / base.size)


def checked(seen: Array) -> None:
    """Raise InputError where candidates have no number, or none of them sees anything."""
    bad = [v for v, of_view in enumerate(seen) if not np.isfinite(of_view).all()]
    if bad:
        raise InputError(f"certificate: candidate {bad[0]} has information that is not finite")
    if not len(seen) or not np.any(seen):
        raise InputError(f"certificate: none of the {len(seen)} candidates sees the object")
