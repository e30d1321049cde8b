"""Claims and their statistics: one rule for all studies.

A claim states on which side of a bound the mean of an effect lies. It *holds* if the whole 95 %
interval of the mean (Student's t, over independent runs) lies there, *fails* if it lies on the
other side, and otherwise, and for fewer than two runs, *depends* on rock, views or chance. Rocks
are the replicates: draws and views of one rock are no samples.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats

from mgs.reports.tables import markdown

MOST_ROCKS = 20
"""Most differences of a permutation test, which enumerates all 2^n sign flips."""


def interval(numbers: Sequence[float]) -> tuple[float, float] | None:
    """Student's t interval of 95 % of the mean of independent numbers, (low, high); None for fewer
    than two."""
    if len(numbers) < 2:
        return None
    values = np.asarray(numbers, np.float64)
    half = float(stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return float(values.mean()) - half, float(values.mean()) + half


def permutation_p(differences: Sequence[float]) -> float | None:
    """Two-sided p-value of the exact paired permutation test: the share of the 2^n sign flips whose
    mean is at least as far from 0 as the observed one. None for fewer than two differences.

    Raises ValueError for more than MOST_ROCKS differences.
    """
    count = len(differences)
    if count < 2:
        return None
    if count > MOST_ROCKS:
        raise ValueError(f"{count} differences; the exact test is for at most {MOST_ROCKS}")
    result = stats.permutation_test(
        (np.asarray(differences, np.float64),),
        lambda sample, axis: np.mean(sample, axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=2**count,
        batch=1 << 14,
    )
    return float(min(result.pvalue, 1.0))


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values adjusted by Holm's correction for several tests, in the order given."""
    order = sorted(range(len(p_values)), key=lambda k: p_values[k])
    adjusted, largest = [0.0] * len(p_values), 0.0
    for rank, k in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[k]))
        adjusted[k] = largest
    return adjusted


def pareto_front(costs: Sequence[float], gains: Sequence[float]) -> np.ndarray:
    """Mask [n] of the points that no other point beats: at most the cost, at least the gain, and
    one of both better. Points with NaN are not on the front; of equal points all are."""
    cost, gain = np.asarray(costs, np.float64), np.asarray(gains, np.float64)
    no_worse = (cost[None] <= cost[:, None]) & (gain[None] >= gain[:, None])
    better = (cost[None] < cost[:, None]) | (gain[None] > gain[:, None])
    return np.asarray(~(no_worse & better).any(axis=1) & ~np.isnan(cost) & ~np.isnan(gain))


Row = dict[str, Any]

Effects = Callable[[Sequence[Row]], list[float]]
"""Function of the rows of an experiment that returns one number for each run."""


@dataclass(frozen=True)
class Claim:
    """A hypothesis that is fixed before the numbers are seen.

    hypothesis: a sentence. effects: the numbers, in `unit`. side, bound: the mean effect is "above"
    or "below" the bound, or equal to it. over: what a run is.
    """

    hypothesis: str
    effects: Effects
    unit: str
    side: Literal["above", "below"]
    bound: float
    over: str = "rock and set of views"


def verdict(claim: Claim, between: tuple[float, float] | None) -> str:
    """Verdict from the interval of the mean effect."""
    if between is None:
        return "depends"
    sign = 1 if claim.side == "above" else -1
    low, high = sorted(sign * (end - claim.bound) for end in between)
    return "holds" if low >= 0 else "fails" if high < 0 else "depends"


def judged(claim: Claim, rows: Sequence[Row]) -> Row:
    """Record of a claim: hypothesis, verdict, effect, interval, number of runs, and the rule."""
    effects = claim.effects(rows)
    between = interval(effects)
    return {
        "hypothesis": claim.hypothesis,
        "verdict": verdict(claim, between),
        "effect": float(np.mean(effects)) if effects else None,
        "interval": None if between is None else list(between),
        "runs": len(effects),
        "over": claim.over,
        "unit": claim.unit,
        "rule": f"mean {claim.side} {claim.bound:g}",
    }


def effect(record: Row) -> str:
    """Effect of a judged claim with its interval, as text."""
    if record["effect"] is None:
        return "no run"
    ends = "" if record["interval"] is None else " ({:.3g} to {:.3g})".format(*record["interval"])
    return f"{record['effect']:.3g}{ends} {record['unit']}"


def verdict_table(records: Sequence[Row]) -> str:
    """Judged claims as a Markdown table."""
    heading = "hypothesis", "verdict", "mean effect (95 % interval)", "runs"
    rows = [
        (one["hypothesis"], f"**{one['verdict']}**", effect(one), f"{one['runs']} ({one['over']})")
        for one in records
    ]
    return markdown(heading, rows)


def paired(value: str, one: Row, other: Row) -> Effects:
    """Effects: `value` of the rows that match `one`, minus that of the rows that match `other`, run
    by run."""
    return lambda rows: [
        _mean(rows, value, one, run) - _mean(rows, value, other, run)
        for run in runs_of(rows, one, other)
    ]


def single(value: str, one: Row) -> Effects:
    """Effects: `value` of the rows that match `one`, run by run."""
    return lambda rows: [_mean(rows, value, one, run) for run in runs_of(rows, one)]


def runs_of(rows: Sequence[Row], *wanted: Row) -> list[str]:
    """Runs that have a row matching each of the wanted entries, in their order."""
    found = [{row["run"]: None for row in rows if _matches(row, one)} for one in wanted]
    return [run for run in found[0] if all(run in other for other in found)]


def _mean(rows: Sequence[Row], value: str, one: Row, run: str) -> float:
    return float(np.mean([row[value] for row in rows if row["run"] == run and _matches(row, one)]))


def _matches(row: Row, one: Row) -> bool:
    return all(row.get(key) == wanted for key, wanted in one.items())
