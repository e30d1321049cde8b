"""Upper bounds for the best k of C candidate views. Pure NumPy, float64 (docs/certificate.md).

Weights x between 0 and 1 relax the choice of views (Joshi and Boyd 2009). A criterion f is concave
in them (`mgs.policy.relaxation`), so its tangent at any x bounds every set S of k:

    f(S) <= f(x) + max over sets T of k of  grad f(x)^T (1_T - x)

The maximum takes the k largest entries of the gradient, the prices of the views. `upper_bound`
looks for the x whose bound is least. A bad x makes the bound loose, never wrong. `best_set` closes
the rest of the gap by branch and bound.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.optimize import LinearConstraint, brentq, milp

from mgs.errors import InputError
from mgs.policy.criteria import Array, coverage_greedy
from mgs.policy.relaxation import Floats, Relaxation, checked

TOLERANCE = 1e-3
"""Gap at which `upper_bound` stops, as a share of the bound."""

CLOSE = 1e-2
"""Gap at which `best_set` stops, as a share of the bound."""

CURVE = (1, 2, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
"""Numbers of views of `curve`."""

NODES = 1000
"""Most nodes of `best_set`. A chosen constant."""

SECONDS = 60.0
"""Time limit of a bound, by which its gap may depend on the machine. A chosen constant."""

STEPS, EXCHANGES = 30, 3000
"""Most Newton steps of a bound, and exchanges of weight in each. Chosen constants."""

SUFFICIENT = 1e-3
"""Least share of the predicted ascent that a step of the line search must reach."""


class Bound(NamedTuple):
    """No set of k candidates has a gain above `value`.

    weights: [C], sum k. prices: derivative of the gain by each weight [C].
    gap: (value - gain of the best weights) / value. stopped: "gap" if that is small enough, else
    "time" or "steps".
    """

    value: float
    weights: Floats
    prices: Floats
    gap: float
    stopped: str


class Best(NamedTuple):
    """A set of candidates, its gain, and the `bound` that no set of as many exceeds.

    nodes: number of relaxations solved. prices: those of the relaxation without integers [C].
    """

    views: list[int]
    gain: float
    bound: float
    nodes: int
    prices: Floats


def upper_bound(
    relaxation: Relaxation, k: int, tolerance: float = TOLERANCE, seconds: float = SECONDS
) -> Bound:
    """Upper bound for the gain of every set of k candidates.

    It stops at a gap of `tolerance` or after `seconds`. Raises InputError for k < 1 and for fewer
    candidates than k.
    """
    count = relaxation.candidates
    _check_size(k, count)
    box = np.zeros(count), np.ones(count)
    return _bound(relaxation, np.full(count, k / count), box, tolerance, seconds + time.monotonic())


def _check_size(k: int, count: int) -> None:
    if not 1 <= k <= count:
        raise InputError(f"certificate: {k} of {count} candidates; ask for 1 to {count}")


def best_set(
    relaxation: Relaxation,
    plan: Sequence[int],
    gap: float = CLOSE,
    most: int = NODES,
    seconds: float = SECONDS,
) -> Best:
    """Improve a plan by branch and bound, and bound all sets of as many candidates.

    Stops when the gain is within `gap` of the bound, after `most` nodes, or after `seconds`. Each
    node fixes some views as taken and some as left out. The node with the largest bound is next,
    and branches on the view whose weight is nearest to 1/2. Raises InputError as `upper_bound`.
    """
    k, until = len(plan), time.monotonic() + seconds
    root = upper_bound(relaxation, k, seconds=seconds)
    gains = {tuple(sorted(plan)): relaxation.gain(plan)}
    heap = [(-root.value, 0, np.zeros(len(root.weights)), np.ones(len(root.weights)), root.weights)]
    closed, pushed, nodes = 0.0, 0, 0
    while heap and -heap[0][0] > (enough := max(gains.values()) / (1 - gap)):
        if nodes == most or time.monotonic() > until:
            break
        parent, _, lo, hi, x = heapq.heappop(heap)
        nodes += 1
        if len(views := _last_view(relaxation, lo, hi, k)):
            closed = max(closed, _noted(gains, relaxation, views))
            continue
        bound = _bound(relaxation, x, (lo, hi), CLOSE / 4, until, enough)
        bound = bound._replace(value=min(bound.value, -parent))
        _noted(gains, relaxation, np.argsort(-bound.weights, kind="stable")[:k])
        if bound.value <= (enough := max(gains.values()) / (1 - gap)):
            closed = max(closed, bound.value)
            continue
        lo, hi, lost = _fixed(bound, lo, hi, k, enough)
        closed, free = max(closed, lost), np.flatnonzero(hi > lo)
        if not len(free):
            closed = max(closed, _noted(gains, relaxation, np.flatnonzero(lo)))
            continue
        x = bound.weights
        split = free[(x * (1 - x))[free].argmax()]
        for choice in (0, 1):
            low, high = lo.copy(), hi.copy()
            low[split] = high[split] = choice
            if low.sum() <= k <= high.sum():
                pushed += 1
                start = _moved(x, low, high, k)
                heapq.heappush(heap, (-bound.value, pushed, low, high, start))
    best = max(gains, key=lambda views: gains[views])
    bound_of_all = max([gains[best], closed, *(-node[0] for node in heap)])
    return Best(list(best), gains[best], bound_of_all, nodes, root.prices)


def best_coverage(
    F: Array, H: Array, lam: Array, k: int, gap: float = CLOSE, seconds: float = SECONDS
) -> Best:
    """`best_set` for `mgs.policy.criteria.coverage_greedy`, in Gaussians. F: [C,N,P].

    A set observes a Gaussian if its information exceeds what is missing. So the number is at most
    the sum of min(1, s), with s the sum of the views' shares of what is missing: a mixed-integer
    linear programme, solved by HiGHS. Raises InputError as `upper_bound`.
    """
    checked(F)
    _check_size(k, len(F))
    missing = np.asarray((lam - H)[:, :3], np.float64)
    some = (missing >= 0).all(axis=1)
    share = (F[:, some, :3] / np.maximum(missing[some], 1e-300)).max(axis=2)
    rows, counts = np.unique(np.minimum(share.T, 1), axis=0, return_counts=True)
    x, t = np.zeros(len(F)), np.ones(len(rows))
    observes = LinearConstraint(
        sparse.hstack([-sparse.csr_array(rows), sparse.eye_array(len(rows))]), ub=0
    )
    size = LinearConstraint(np.concatenate([x + 1, 0 * t])[None], k, k)
    found = milp(
        np.concatenate([x, -counts]),
        integrality=np.concatenate([x + 1, 0 * t]),
        bounds=(0, 1),
        constraints=[observes, size],
        options={"time_limit": seconds, "mip_rel_gap": gap},
    )
    bound = counts.sum() if found.mip_dual_bound is None else -found.mip_dual_bound
    weights = x if found.x is None else found.x[: len(F)]
    views = sorted(int(v) for v in np.argsort(-weights, kind="stable")[:k])
    gain = coverage_greedy(F[views].sum(axis=0), H, lam)
    return Best(views, gain, max(gain, float(bound)), found.mip_node_count or 0, x)


def _noted(
    gains: dict[tuple[int, ...], float], relaxation: Relaxation, views: Iterable[int]
) -> float:
    """Gain of a set, computed once."""
    key = tuple(sorted(int(v) for v in views))
    if key not in gains:
        gains[key] = relaxation.gain(key)
    return gains[key]


def _last_view(relaxation: Relaxation, lo: Floats, hi: Floats, k: int) -> list[int]:
    """Best set of a node that lacks at most one view; empty where it lacks more."""
    taken = [int(v) for v in np.flatnonzero(lo)]
    if len(taken) == k or (hi == lo).all():
        return taken
    if len(taken) < k - 1:
        return []
    return [*taken, int(np.where(hi > lo, relaxation.added(taken), -np.inf).argmax())]


def _moved(x: Floats, lo: Floats, hi: Floats, k: int) -> Floats:
    """Weights in the box with the sum k, near to x."""
    shift = brentq(lambda t: np.clip(x + t, lo, hi).sum() - k, -2, 2)
    return np.clip(x + shift, lo, hi)


def _fixed(
    bound: Bound, lo: Floats, hi: Floats, k: int, enough: float
) -> tuple[Floats, Floats, float]:
    """lo and hi with the views fixed whose other choice has a bound of at most `enough`; and the
    largest of these bounds."""
    free = np.flatnonzero(hi > lo)
    order = free[np.argsort(-bound.prices[free], kind="stable")]
    room, lo, hi, lost = k - int(lo.sum()), lo.copy(), hi.copy(), 0.0
    if 0 < room < len(free):
        prices, inside = bound.prices[order], np.arange(len(free)) < room
        other = bound.value - np.where(inside, prices - prices[room], prices[room - 1] - prices)
        sure = other <= enough
        lo[order[sure & inside]], hi[order[sure & ~inside]] = 1, 0
        lost = float(other[sure].max(initial=0.0))
    return lo, hi, lost


def _bound(
    relaxation: Relaxation,
    x: Floats,
    box: tuple[Floats, Floats],
    tolerance: float,
    until: float,
    enough: float = -np.inf,
) -> Bound:
    """Least upper bound from tangents, for sets between the 0 and 1 of `box` whose size is sum x.

    First for the coarse relaxation, then from there: Newton steps with the coarse curvature. Stops
    once the bound is at most `enough`, too.
    """
    if len(relaxation.base) > 2 * len(relaxation.coarse.base):
        x = _bound(relaxation.coarse, x, box, tolerance, until).weights
    k, best, lower = round(float(x.sum())), None, -np.inf
    (value, slope), stopped = relaxation.tangent(x), "steps"
    for _ in range(STEPS):
        above = value + float(slope @ (_largest(slope, *box, k) - x))
        if best is None or above < best.value:
            best = Bound(above, x, slope, 0.0, stopped)
        lower = max(lower, value)
        if best.value - lower <= tolerance * best.value or best.value <= enough:
            stopped = "gap"
            break
        if time.monotonic() > until:
            stopped = "time"
            break
        d = _newton_step(relaxation.coarse.curvature(x), slope, x, *box)
        t, ascent = 1.0, float(slope @ d)
        new, after = relaxation.tangent(x + d)
        while new < value + SUFFICIENT * t * ascent and t > SUFFICIENT:
            t /= 2
            new, after = relaxation.tangent(x + t * d)
        x, value, slope = x + t * d, new, after
    assert best is not None
    return best._replace(gap=(best.value - lower) / max(best.value, 1e-300), stopped=stopped)


def _largest(prices: Floats, lo: Floats, hi: Floats, k: int) -> Floats:
    """Weights 0 or 1 in the box, with the sum k, that maximise prices^T x."""
    free = np.flatnonzero(hi > lo)
    order = free[np.argsort(-prices[free], kind="stable")]
    x = np.array(lo, np.float64)
    x[order[: k - int(lo.sum())]] = 1
    return x


def _newton_step(H: Floats, slope: Floats, x: Floats, lo: Floats, hi: Floats) -> Floats:
    """Maximise slope^T d - d^T H d / 2 for x + d in the box and sum d = 0.

    Exchanges weight between the pair of views that gains most, again and again, as solvers of
    support vector machines do. H: [C,C].
    """
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


@dataclass(frozen=True)
class Certificate:
    """Worth of a plan of k of C candidates by a criterion; it says nothing about PSNR.

    criterion: name of the policy. views, candidates: k and C.
    share: gain of the plan over the bound of any k. fewer: bound of any k - 1 over that gain; None
    for one view. of_all: gain of the plan over that of all candidates. prices: of the bound of any
    k [C] (`Bound`), over its value. curve: see `curve`.
    """

    criterion: str
    views: int
    candidates: int
    share: float
    fewer: float | None
    of_all: float
    prices: list[float]
    curve: list[dict[str, float]] = field(default_factory=list)

    def sentence(self) -> str:
        """The certificate in words; shares are rounded to the safe side."""
        k, share = self.views, np.floor(1000 * self.share + 1e-6) / 10
        fewer = np.ceil(1000 * (self.fewer or 1)) / 10
        largest = f"the largest that {k} can have"
        if share < 100:
            largest = f"at least {share:.1f} % of {largest}"
        text = f"These {k} views have" if k > 1 else "This view has"
        text += f" {100 * self.of_all:.1f} % of the gain of all {self.candidates} candidates"
        less = f"; no {k - 1} can have more than {fewer:.1f} % of theirs" if fewer < 100 else ""
        return f"{text}, {largest}{less} (by {self.criterion}, which is not PSNR)."


def certify(
    relaxation: Relaxation, plan: Sequence[int], criterion: str, most: int = NODES
) -> Certificate:
    """Certificate of a plan: `best_set` for as many views, and `upper_bound` for one less.

    most: nodes of `best_set`. Raises InputError as `upper_bound`.
    """
    k, gain, count = len(plan), relaxation.gain(plan), relaxation.candidates
    best = best_set(relaxation, plan, most=most)
    fewer = upper_bound(relaxation, k - 1).value / gain if k > 1 else None
    of_all = gain / relaxation.gain(range(count))
    prices = (best.prices / best.bound).tolist()
    return Certificate(criterion, k, count, gain / best.bound, fewer, of_all, prices)


def curve(
    relaxation: Relaxation, plan: Sequence[int], even: Sequence[int]
) -> list[dict[str, float]]:
    """Rows with "views", and shares of the gain of all candidates: "bound" of any set of as many,
    "plan" (for other sizes greedy), "even" and "random".

    even: candidates in the order in which even spacing takes them. The last two shares are those of
    `Relaxation.coarse`.
    """
    count, coarse, rng = relaxation.candidates, relaxation.coarse, np.random.default_rng(0)
    every, about = (one.gain(range(count)) for one in (relaxation, coarse))
    order, draws = greedy(coarse, 1.0), [rng.permutation(count) for _ in range(5)]
    rows = []
    for k in sorted(k for k in {*CURVE, len(plan)} if k < count):
        taken = plan if k == len(plan) else order[:k]
        shares = {
            "bound": min(upper_bound(relaxation, k, CLOSE / 4).value / every, 1.0),
            "plan": relaxation.gain(taken) / every,
            "even": coarse.gain(even[:k]) / about,
            "random": float(np.mean([coarse.gain(some[:k]) for some in draws])) / about,
        }
        rows.append({"views": k} | shares)
    return rows


def greedy(relaxation: Relaxation, share: float, most: int | None = None) -> list[int]:
    """Candidates by greedy choice, until they have `share` of the gain of all of them together.

    most: number of views after which it stops anyway.
    """
    views, enough = list[int](), share * relaxation.gain(range(relaxation.candidates))
    while len(views) < (most or relaxation.candidates):
        gains = relaxation.added(views)
        gains[views] = -1
        views.append(int(gains.argmax()))
        if relaxation.gain(views) >= enough:
            break
    return views
