"""Upper bounds for the best k of C candidate views. Pure NumPy, float64 (docs/certificate.md).

A criterion f is concave in weights x of the views, so its tangent at any x bounds every set S of k:

    f(S) <= f(x) + max over sets T of k of  grad f(x)^T (1_T - x)

The maximum takes the k largest entries of the gradient, the prices of the views."""

import heapq
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mgs.errors import InputError
from mgs.policy.relaxation import TOLERANCE, Bound, Criterion, Floats

CLOSE = 1e-2  # gap at which `best_set` stops, as a share of the bound
CURVE = (1, 2, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)  # numbers of views of `curve`
NODES = 1000  # most nodes of `best_set`; chosen

Free = slice | NDArray[np.intp]  # indices of candidates


class Best(NamedTuple):
    """A set of candidates, its gain, and the `bound` that no set of as many exceeds.

    nodes: number of relaxations solved after the first. prices: of the first one [C]. stopped:
    "gap" if that is small enough, else "nodes" or "time"."""

    views: list[int]
    gain: float
    bound: float
    nodes: int
    prices: Floats
    stopped: str


def upper_bound(
    criterion: Criterion, k: int, tolerance: float = TOLERANCE, seconds: float = np.inf
) -> Bound:
    """Upper bound for the gain of every set of k candidates, by their criterion. It stops at a gap
    of `tolerance` or after `seconds`. Raises InputError for k < 1 and for fewer candidates than
    k."""
    count = criterion.candidates
    if not 1 <= k <= count:
        raise InputError(f"certificate: {k} of {count} candidates; ask for 1 to {count}")
    box = np.zeros(count), np.ones(count)
    return criterion.bound(np.full(count, k / count), box, tolerance, seconds + time.monotonic())


def least_bound(criterion: Criterion, k: int, tolerance: float = TOLERANCE) -> float:
    """The smaller one of `upper_bound` and `added_bound` for every set of k candidates."""
    return min(upper_bound(criterion, k, tolerance).value, added_bound(criterion, (), k))


def added_bound(
    criterion: Criterion, views: Iterable[int], room: int, free: Free = slice(None)
) -> float:
    """Gain of `views`, and the `room` largest gains after them of the candidates `free`, by default
    all. Infinite where the criterion is not submodular, unless `room` is 1.

    No set of `views` and so many of `free` has more (Nemhauser, Wolsey and Fisher 1978), nor has a
    set of so many candidates without `views`."""
    if room > 1 and not criterion.submodular:
        return np.inf
    gains = np.sort(criterion.added(views)[free])[::-1]
    return criterion.gain(views) + float(gains[:room].sum())


def best_set(
    criterion: Criterion,
    plan: Sequence[int],
    gap: float = CLOSE,
    most: int = NODES,
    seconds: float = np.inf,
) -> Best:
    """Improve a plan by branch and bound, and bound all sets of as many candidates.

    Stops when the gain is within `gap` of the bound, after `most` nodes, or after `seconds`. Each
    node fixes some views as taken and some as left out. The node with the largest bound is next,
    and branches on the view whose weight is nearest to 1/2. Raises InputError as `upper_bound`."""
    k, until, reason = len(plan), time.monotonic() + seconds, "gap"
    root = upper_bound(criterion, k, seconds=seconds)
    gains = {tuple(sorted(plan)): criterion.gain(plan)}
    lo, hi = np.zeros(len(root.weights)), np.ones(len(root.weights))
    above = min(root.value, *(added_bound(criterion, some, k) for some in ((), plan)))
    heap = [(-above, 0, lo, hi, root.weights)]
    closed, count, nodes = 0.0, 0, 0
    while heap and -heap[0][0] > (enough := max(gains.values()) / (1 - gap)):
        if nodes == most or time.monotonic() > until:
            reason = "nodes" if nodes == most else "time"
            break
        parent, _, lo, hi, x = heapq.heappop(heap)
        nodes += 1
        if len(views := _last_view(criterion, lo, hi, k)):
            closed = max(closed, _noted(gains, criterion, views))
            continue
        bound = criterion.bound(x, (lo, hi), CLOSE / 4, until, enough)
        taken, free = np.flatnonzero(lo), np.flatnonzero(hi > lo)
        above = min(bound.value, -parent, added_bound(criterion, taken, k - len(taken), free))
        _noted(gains, criterion, np.argsort(-bound.weights, kind="stable")[:k])
        if above <= (enough := max(gains.values()) / (1 - gap)):
            closed = max(closed, above)
            continue
        lo, hi, ceiling = _fixed(bound, lo, hi, k, enough)
        closed, free = max(closed, ceiling), np.flatnonzero(hi > lo)
        if not len(free):
            closed = max(closed, _noted(gains, criterion, np.flatnonzero(lo)))
            continue
        x = bound.weights
        split = free[(x * (1 - x))[free].argmax()]
        for choice in (0, 1):
            low, high = lo.copy(), hi.copy()
            low[split] = high[split] = choice
            if low.sum() <= k <= high.sum():
                count += 1
                start = _moved(x, low, high, k)
                heapq.heappush(heap, (-above, count, low, high, start))
    best = max(gains, key=lambda views: gains[views])
    bound_of_all = max([gains[best], closed, *(-node[0] for node in heap)])
    return Best(list(best), gains[best], bound_of_all, nodes, root.prices, reason)


def _noted(
    gains: dict[tuple[int, ...], float], criterion: Criterion, views: Iterable[int]
) -> float:
    """Gain of a set, computed once."""
    key = tuple(sorted(int(v) for v in views))
    if key not in gains:
        gains[key] = criterion.gain(key)
    return gains[key]


def _last_view(criterion: Criterion, lo: Floats, hi: Floats, k: int) -> list[int]:
    """Best set of a node that lacks at most one view; empty where it lacks more."""
    taken = [int(v) for v in np.flatnonzero(lo)]
    if len(taken) == k or (hi == lo).all():
        return taken
    if len(taken) < k - 1:
        return []
    return [*taken, int(np.where(hi > lo, criterion.added(taken), -np.inf).argmax())]


def _moved(x: Floats, lo: Floats, hi: Floats, k: int) -> Floats:
    """Weights in the box with the sum k, near to x."""
    ends = np.concatenate([lo - x, hi - x])
    order = ends.argsort(kind="stable")
    shifts, free = ends[order], np.cumsum(np.where(order < len(x), 1, -1))
    sums = lo.sum() + np.append(0, np.cumsum(free[:-1] * np.diff(shifts)))  # linear between
    return np.clip(x + np.interp(k, sums, shifts), lo, hi)


def _fixed(
    bound: Bound, lo: Floats, hi: Floats, k: int, enough: float
) -> tuple[Floats, Floats, float]:
    """Fix the views whose other choice has a bound of at most `enough`; also the largest bound."""
    free = np.flatnonzero(hi > lo)
    order = free[np.argsort(-bound.prices[free], kind="stable")]
    room, lo, hi, ceiling = k - int(lo.sum()), lo.copy(), hi.copy(), 0.0
    if 0 < room < len(free):
        prices, inside = bound.prices[order], np.arange(len(free)) < room
        other = bound.value - np.where(inside, prices - prices[room], prices[room - 1] - prices)
        sure = other <= enough
        lo[order[sure & inside]], hi[order[sure & ~inside]] = 1, 0
        ceiling = float(other[sure].max(initial=0.0))
    return lo, hi, ceiling


@dataclass(frozen=True)
class Certificate:
    """Worth of a plan of k of C candidates by a criterion; it says nothing about PSNR.

    criterion: name of the policy. views, candidates: k and C. share, best: gain of the plan, and of
    the best set met, over the bound of any k. fewer: bound of any k - 1 over the plan's gain, or
    None. of_all: gain over that of all candidates. nodes, stopped: of the search (`Best`). prices:
    of the bound [C], over its value."""

    criterion: str
    views: int
    candidates: int
    share: float
    best: float
    fewer: float | None
    of_all: float
    nodes: int
    stopped: str
    prices: list[float]
    curve: list[dict[str, float]] = field(default_factory=list)

    def record(self, names: Iterable[str]) -> dict[str, Any]:
        """The certificate as JSON, with prices by name of the candidate."""
        return asdict(self) | {"prices": dict(zip(names, self.prices, strict=True))}

    def sentence(self) -> str:
        """The certificate in words; shares are rounded to the safe side."""
        k, share = self.views, np.floor(1000 * self.share + 1e-6) / 10
        fewer = np.ceil(1000 * (self.fewer or 1)) / 10
        largest = f"the largest that {k} can have"
        if share < 100:
            largest = f"at least {share:.1f} % of {largest}"
        text = f"These {k} views have" if k > 1 else "This view has"
        text += f" {100 * self.of_all:.1f} % of the gain of all {self.candidates} candidates"
        few = f"no {k - 1}" if k > 2 else "no single one"
        less = f"; {few} can have more than {fewer:.1f} % of theirs" if fewer < 100 else ""
        search = {
            "gap": f"the search closed the gap to {100 * CLOSE:g} %",
            "nodes": f"the search ended at its limit of {self.nodes} nodes",
            "time": f"the search ended at its time limit, after {self.nodes} nodes",
        }[self.stopped]
        if self.best > self.share + 5e-4:
            search += f", and met a set with {100 * self.best:.1f} %"
        return f"{text}, {largest}{less} (by {self.criterion}, which is not PSNR; {search})."


def certify(
    criterion: Criterion, plan: Sequence[int], name: str, most: int = NODES, seconds: float = np.inf
) -> Certificate:
    """Certificate of a plan by the policy `name`: `best_set` for as many views, with its limits,
    and `least_bound` for one less. Raises InputError as `upper_bound`."""
    k, gain, count = len(plan), criterion.gain(plan), criterion.candidates
    best = best_set(criterion, plan, most=most, seconds=seconds)
    fewer = least_bound(criterion, k - 1) / gain if k > 1 else None
    of_all, prices = gain / criterion.gain(range(count)), (best.prices / best.bound).tolist()
    shares = gain / best.bound, best.gain / best.bound, fewer, of_all
    return Certificate(name, k, count, *shares, best.nodes, best.stopped, prices)


def curve(criterion: Criterion, plan: Sequence[int], even: Sequence[int]) -> list[dict[str, float]]:
    """Rows with "views", and shares of the gain of all candidates: "bound" of any set of as many,
    "plan" (for other sizes greedy), "even" and "random".

    even: candidates in the order in which even spacing takes them. The last two shares are those of
    `criterion.coarse`."""
    count, coarse, rng = criterion.candidates, criterion.coarse, np.random.default_rng(0)
    every, about = (one.gain(range(count)) for one in (criterion, coarse))
    sizes = sorted(k for k in {*CURVE, len(plan)} if k < count)
    order, draws = greedy(coarse, 1.0, sizes[-1]), [rng.permutation(count) for _ in range(5)]
    rows = []
    for k in sizes:
        taken = plan if k == len(plan) else order[:k]
        shares = {
            "bound": min(least_bound(criterion, k, CLOSE / 4) / every, 1.0),
            "plan": criterion.gain(taken) / every,
            "even": coarse.gain(even[:k]) / about,
            "random": float(np.mean([coarse.gain(some[:k]) for some in draws])) / about,
        }
        rows.append({"views": k} | shares)
    return rows


def greedy(criterion: Criterion, share: float, most: int | None = None) -> list[int]:
    """Candidates by greedy choice, until they have `share` of the gain of all of them together.

    most: number of views after which it stops anyway."""
    views, gain, enough = list[int](), 0.0, share * criterion.gain(range(criterion.candidates))
    while len(views) < (most or criterion.candidates):
        gains = criterion.added(views)
        gains[views] = -1
        views.append(int(gains.argmax()))
        gain += gains[views[-1]]
        if gain >= enough:
            break
    return views
