"""Criteria as concave functions of weights of views, and their upper bounds. Float64.

A `Relaxation` is a sum over Gaussians j of a concave function of their information,

    f(x) = sum_j phi(A_j(x)) - phi(A_j(0)),   A_j(x) = A_j(0) + sum_v x_v z_jv z_jv^T,

with the weight x_v = 1 for a candidate that is taken, and 0 otherwise. A(0) holds the prior and the
views taken before. `Coverage` counts Gaussians instead. `mgs.policy.certificate` bounds both over
all sets of k candidates."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mgs.errors import InputError
from mgs.memory import VIEW_BYTES
from mgs.policy.criteria import Array, coverage_greedy, observed
from mgs.policy.directional import Views, in_parts, information, of_points, precision, vectors

Floats = NDArray[np.float64]

COARSE = 1024  # about the number of Gaussians of `Relaxation.coarse`; chosen
TOLERANCE = 1e-3  # gap at which `upper_bound` stops, as a share of the bound
STEPS, EXCHANGES, CUTS = 30, 3000, 300  # Newton steps, exchanges in each, cuts at most; chosen
CURVATURE = 1 << 21  # numbers [n,C,C] that a thread holds at once for the curvature
SUFFICIENT = 1e-3  # least share of the predicted ascent that a step of the line search must reach


class Bound(NamedTuple):
    """No set of k candidates has a gain above `value`.

    weights: [C], sum k. prices: derivative of the gain by each weight [C].
    gap: (value - gain of the best weights) / value. stopped: "gap" if that is small enough, else
    "time" or "steps"."""

    value: float
    weights: Floats
    prices: Floats
    gap: float = 0.0
    stopped: str = "steps"


class Bounded(ABC):
    """A concave criterion."""

    @property
    @abstractmethod
    def pairs(self) -> int:
        """Pairs of a candidate and a Gaussian, by which the time of a bound grows."""

    @property
    @abstractmethod
    def coarse(self) -> "Bounded":
        """The same for fewer Gaussians, or itself."""

    @abstractmethod
    def steps(self, x: Floats, box: tuple[Floats, Floats]) -> Iterator[tuple[float, Bound]]:
        """Yield the value at weights in the box of 0 and 1 whose size is sum x, and a bound by
        tangents there."""

    def bound(
        self,
        x: Floats,
        box: tuple[Floats, Floats],
        tolerance: float,
        until: float,
        enough: float = -np.inf,
    ) -> Bound:
        """Least upper bound of the `steps`, first for the coarse criterion, then from there. Stops
        at a gap of `tolerance`, at the time `until`, or once it is at most `enough`."""
        if self.pairs > 2 * self.coarse.pairs:
            x = self.coarse.bound(x, box, tolerance, until).weights
        best, lower, reason = None, -np.inf, "steps"
        for gain, bound in self.steps(x, box):
            lower = max(lower, gain)
            best = bound if best is None or bound.value < best.value else best
            if best.value - lower <= tolerance * best.value or best.value <= enough:
                reason = "gap"
                break
            if time.monotonic() > until:
                reason = "time"
                break
        assert best is not None
        return best._replace(gap=(best.value - lower) / max(best.value, 1e-300), stopped=reason)


@dataclass(frozen=True)
class Relaxation(Bounded):
    """A criterion as a concave function of the weights x [C] of the candidates. phi is scale log
    det A, or -scale trace(A^-1 M) where `over` is given. vectors(some): z [n,C,K] of a slice of the
    N Gaussians. base: A(0) [N,K,K]. over: M [N,K,K]."""

    candidates: int
    vectors: Callable[[slice], Floats]
    base: Floats
    over: Floats | None = None
    scale: float = 1.0

    @property
    def submodular(self) -> bool:
        """Whether gains only fall as views are added, so that greedy choice has a guarantee."""
        return self.over is None

    @property
    def pairs(self) -> int:
        return self.candidates * len(self.base)

    @cached_property
    def coarse(self) -> "Relaxation":
        """The same for about COARSE of the Gaussians, which stand for all."""
        step, fine = max(len(self.base) // COARSE, 1), self.vectors

        def vectors(some: slice) -> Floats:  # without `self`, whose arrays go as soon as it does
            return fine(slice(some.start * step, some.stop * step, step))

        base, over = self.base[::step], None if self.over is None else self.over[::step]
        scale = self.scale * len(self.base) / len(base)
        return replace(self, vectors=vectors, base=base, over=over, scale=scale)

    @cached_property
    def before(self) -> Floats:
        """phi of each Gaussian without a candidate [N]."""

        def part(some: slice) -> Floats:
            return self._value(self.base[some], np.linalg.inv(self.base[some]), some)

        return np.concatenate(in_parts(len(self.base), part))

    def gain(self, views: Iterable[int]) -> float:
        taken, before = np.flatnonzero(self._taken(views)), self.before

        def part(some: slice) -> float:
            z = self.vectors(some)[:, taken]
            A = self.base[some] + z.transpose(0, 2, 1) @ z
            value = self._value(A, np.linalg.inv(A), some)
            return float((value - before[some]).sum())

        return sum(in_parts(len(self.base), part))

    def tangent(self, x: Floats) -> tuple[float, Floats]:
        """f at weights x [C], and its gradient [C]."""
        before = self.before

        def part(some: slice) -> tuple[float, Floats]:
            z, A = self._at(x, some)
            value, slope, _ = self._phi(A, some)
            return float((value - before[some]).sum()), np.einsum("nvk,nvk->v", z @ slope, z)

        values, slopes = zip(*in_parts(len(self.base), part), strict=True)
        return sum(values), sum(slopes)

    def curvature(self, x: Floats) -> Floats:
        """Minus the Hessian of f [C,C]."""

        most = max(CURVATURE // self.candidates**2, 1)

        def part(some: slice) -> Floats:
            z, A = self._at(x, some)
            one, other = self._phi(A, some)[2]
            total = np.zeros((self.candidates, self.candidates))
            for k in range(0, len(z), most):
                Z, P, Q = (values[k : k + most] for values in (z, one, other))
                across = Z.transpose(0, 2, 1)
                total += (((Z @ P) @ across) * ((Z @ Q) @ across)).sum(0)
            return total

        return np.asarray(sum(in_parts(len(self.base), part)))

    def added(self, views: Iterable[int]) -> Floats:
        """Gain of each candidate after these views [C], 0 for them, by the Sherman-Morrison formula
        (`mgs.policy.directional`)."""
        x = self._taken(views)

        def part(some: slice) -> Floats:
            z, A = self._at(x, some)
            leverages = np.einsum("nvk,nvk->nv", z @ np.linalg.inv(A), z)
            if self.over is None:
                return np.asarray(self.scale * np.log1p(leverages).sum(0))
            slope = self._phi(A, some)[1]
            return np.asarray((np.einsum("nvk,nvk->nv", z @ slope, z) / (1 + leverages)).sum(0))

        return np.where(x > 0, 0.0, sum(in_parts(len(self.base), part)))

    def steps(self, x: Floats, box: tuple[Floats, Floats]) -> Iterator[tuple[float, Bound]]:
        """Newton steps with the coarse curvature."""
        k, (value, slope) = round(float(x.sum())), self.tangent(x)
        for _ in range(STEPS):
            above = value + float(slope @ (_largest(slope, *box, k) - x))
            yield value, Bound(above, x, slope)
            d = _newton_step(self.coarse.curvature(x), slope, x, *box)
            t, ascent = 1.0, float(slope @ d)
            new, after = self.tangent(x + d)
            while new < value + SUFFICIENT * t * ascent and t > SUFFICIENT:
                t /= 2
                new, after = self.tangent(x + t * d)
            x, value, slope = x + t * d, new, after

    def _taken(self, views: Iterable[int]) -> Floats:
        x = np.zeros(self.candidates)
        x[list(views)] = 1
        return x

    def _at(self, x: Floats, some: slice) -> tuple[Floats, Floats]:
        z = self.vectors(some)
        if not x.any():
            return z, self.base[some]
        return z, self.base[some] + (z * x[:, None]).transpose(0, 2, 1) @ z

    def _phi(self, A: Floats, some: slice) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
        """phi at A [n,K,K]; P [n,K,K] with d phi = trace(P dA); and Q, R [n,K,K] with
        d^2 phi = -(z_u^T Q z_v) (z_u^T R z_v) for views u and v."""
        S = np.asarray(np.linalg.inv(A), np.float64)
        value = self._value(A, S, some)
        if self.over is None:
            return value, self.scale * S, (S, self.scale * S)
        slope = self.scale * (S @ self.over[some] @ S)
        return value, slope, (S, 2 * slope)

    def _value(self, A: Floats, S: Array, some: slice) -> Floats:
        """phi at A [n,K,K], of inverse S [n,K,K]."""
        if self.over is None:
            return np.asarray(self.scale * np.linalg.slogdet(A)[1])
        return np.asarray(-self.scale * np.einsum("nkl,nkl->n", S, self.over[some]))


def _largest(prices: Floats, lo: Floats, hi: Floats, k: int) -> Floats:
    """Weights 0 or 1 in the box, with the sum k, that maximise prices^T x."""
    free = np.flatnonzero(hi > lo)
    order = free[np.argsort(-prices[free], kind="stable")]
    x = np.array(lo, np.float64)
    x[order[: k - int(lo.sum())]] = 1
    return x


def _newton_step(H: Floats, slope: Floats, x: Floats, lo: Floats, hi: Floats) -> Floats:
    """Maximise slope^T d - d^T H d / 2 for x + d in the box and sum d = 0, H [C,C], by exchanges of
    weight between the pair of views that gains most, as solvers of support vector machines do."""
    y, g, diagonal = np.array(x), np.array(slope), np.diagonal(H)
    small = 1e-9 * float(np.abs(slope).max())
    least = 1e-9 * float(diagonal.max()) + small  # a flat direction is followed to the box
    for _ in range(EXCHANGES):
        i = int(np.where(y < hi, g, -np.inf).argmax())
        ascent = np.where(y > lo, g[i] - g, 0.0)
        curve = np.maximum(diagonal[i] + diagonal - 2 * H[i], least)
        j = int((ascent * np.abs(ascent) / curve).argmax())
        if ascent[j] <= small:
            break
        t = min(ascent[j] / curve[j], hi[i] - y[i], y[j] - lo[j])
        y[i], y[j] = min(y[i] + t, hi[i]), max(y[j] - t, lo[j])
        g -= t * (H[i] - H[j])
    return np.asarray(y - x)


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

    points: means of the Gaussians on the surface [N,3], metres. lam, degree, tau: see `precision`.
    """
    means = np.asarray(points, np.float64)

    def seen(some: slice) -> Floats:
        return vectors(means[some], of_points(candidates, some), degree)

    base = np.diag(precision(degree, tau, lam)) + information(means, taken, degree)
    relaxation = Relaxation(len(candidates.positions), seen, base, scale=1.5)
    if dome is not None:
        relaxation = replace(relaxation, over=information(means, dome, degree), scale=1.0)
    if 8 * base.shape[1] * candidates.seen.size > VIEW_BYTES:
        return relaxation
    z = np.empty((len(means), len(candidates.positions), base.shape[1]))

    def fill(some: slice) -> None:
        z[some] = seen(some)

    in_parts(len(means), fill)  # to join the parts would take their memory twice
    return replace(relaxation, vectors=lambda some: z[some])


def d_optimal(F: Array, H: Array, lam: Array) -> Relaxation:
    """`mgs.policy.criteria.d_optimal` (Eq. 7), fixed model. F: [C,N,P]. Errors: `check_seen`."""
    check_seen(F)
    flat = F.reshape(len(F), -1)

    def vectors(some: slice) -> Floats:
        return np.sqrt(flat[:, some].T.astype(np.float64))[..., None]

    base = np.asarray(H + lam, np.float64).reshape(-1, 1, 1)
    return Relaxation(len(F), vectors, base, scale=1 / base.size)


def check_seen(per_view: Array) -> None:
    """Raise InputError where candidates have no number, or none of them sees anything."""
    check_finite(per_view)
    if not len(per_view) or not np.any(per_view):
        raise InputError(f"certificate: none of the {len(per_view)} candidates sees the object")


def check_finite(per_view: Array) -> None:
    bad = [v for v, of_view in enumerate(per_view) if not np.isfinite(of_view).all()]
    if bad:
        raise InputError(f"certificate: candidate {bad[0]} has information that is not finite")


@dataclass(frozen=True)
class Coverage(Bounded):
    """Number of Gaussians that candidates newly observe (`mgs.policy.criteria.coverage_greedy`).

    A set observes a Gaussian only if its views' shares s of the information that is missing add up
    to 1. So the number is at most the sum of min(1, s^T x), which is concave in the weights.

    F: information of the candidates about colours [C,N,3]. H: of the views taken [N,3]. lam: [3].
    Raises InputError where F has a number that is not finite."""

    F: Array
    H: Array
    lam: Array
    submodular: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_finite(self.F)

    @property
    def candidates(self) -> int:
        return len(self.F)

    @property
    def pairs(self) -> int:
        return len(self.F) * len(self.H)

    @property
    def coarse(self) -> "Coverage":
        return self

    @cached_property
    def shares(self) -> tuple[Floats, Floats]:
        """Different shares of what is missing, at most 1 [n,C], and their numbers of Gaussians."""
        deficit = np.asarray(self.lam - self.H, np.float64)
        some = (deficit >= 0).all(axis=1) & observed(self.H + self.F.sum(axis=0), self.lam)
        share = (self.F[:, some] / np.maximum(deficit[some], 1e-300)).max(axis=2)
        rows, counts = np.unique(np.minimum(share.T, 1), axis=0, return_counts=True)
        return rows, counts.astype(np.float64)

    def gain(self, views: Iterable[int]) -> float:
        return coverage_greedy(self.F[list(views)].sum(axis=0), self.H, self.lam)

    def added(self, views: Iterable[int]) -> Floats:
        """Number of Gaussians that each candidate observes after these views [C]; 0 for them."""
        taken = list(views)
        H = self.H + self.F[taken].sum(axis=0)
        gains = np.array([coverage_greedy(F, H, self.lam) for F in self.F])
        gains[taken] = 0
        return gains

    def steps(self, x: Floats, box: tuple[Floats, Floats]) -> Iterator[tuple[float, Bound]]:
        """Cutting planes: every x tried gives a tangent, and HiGHS finds the next x, where the
        least tangent is largest. Any mean of tangents is a bound; the prices are its slope."""
        from scipy.optimize import linprog  # takes half a second

        rows, counts = self.shares
        size = round(float(x.sum()))
        most = np.sort(rows * box[1], axis=1)[:, -size:].sum(axis=1)
        rows, counts = rows[most >= 1 - 1e-6], counts[most >= 1 - 1e-6]
        slopes, heights = [], []
        for _ in range(CUTS):
            share = rows @ x
            value = float(counts @ np.minimum(share, 1))
            slopes.append((counts * (share < 1)) @ rows)
            heights.append(value - slopes[-1] @ x)
            solved = linprog(
                [*np.zeros(len(x)), -1],
                A_ub=np.column_stack([-np.array(slopes), np.ones(len(slopes))]),
                b_ub=heights,
                A_eq=[[*np.ones(len(x)), 0]],
                b_eq=[size],
                bounds=[*zip(*box, strict=True), (None, None)],
            )
            mean = np.maximum(-solved.ineqlin.marginals, 0)
            mean /= mean.sum()
            prices, x = mean @ slopes, solved.x[:-1]
            above = float(mean @ heights + prices @ _largest(prices, *box, size))
            yield value, Bound(above, x, prices)


Criterion = Relaxation | Coverage
