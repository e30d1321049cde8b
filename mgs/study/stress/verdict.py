"""From numbers to a verdict, by one rule for all experiments.

A claim says on which side of a bound the mean of an effect lies. It *holds* where the whole 95 %
interval of the mean (Student's t over runs, which it takes for independent) lies on that side, it
*fails* where the whole interval lies on the other side, and otherwise it *depends*: on the rock, on
the views, or on chance, which so few runs cannot tell apart. Fewer than two runs have no interval,
so their verdict is `depends`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

import numpy as np

from mgs.study.statistics import interval

Row = dict[str, Any]

Effects = Callable[[Sequence[Row]], list[float]]
"""From the rows of an experiment to one number per run."""


class Outcome(StrEnum):
    """What the numbers say of a claim."""

    HOLDS = "holds"
    FAILS = "fails"
    DEPENDS = "depends"


@dataclass(frozen=True)
class Claim:
    """A hypothesis that was fixed before its numbers were seen.

    hypothesis: a sentence. effects: the numbers. unit: of these numbers. side, bound:
    the hypothesis in numbers: the mean effect is "above" the bound (or equal) or "below" it (or
    equal). over: what a run is.
    """

    hypothesis: str
    effects: Effects
    unit: str
    side: Literal["above", "below"]
    bound: float
    over: str


def outcome(side: str, bound: float, between: tuple[float, float] | None) -> Outcome:
    """The rule of this module. between: the interval of the mean effect."""
    if between is None:
        return Outcome.DEPENDS
    low, high = between if side == "above" else (-between[1], -between[0])
    limit = bound if side == "above" else -bound
    if low >= limit:
        return Outcome.HOLDS
    return Outcome.FAILS if high < limit else Outcome.DEPENDS


def judged(claim: Claim, rows: Sequence[Row]) -> dict[str, Any]:
    """What verdicts.json holds of a claim: hypothesis, verdict, effect, interval, runs, and the
    rule in numbers."""
    effects = claim.effects(rows)
    between = interval(effects)
    return {
        "hypothesis": claim.hypothesis,
        "verdict": str(outcome(claim.side, claim.bound, between)),
        "effect": float(np.mean(effects)) if effects else None,
        "interval": None if between is None else list(between),
        "runs": len(effects),
        "over": claim.over,
        "unit": claim.unit,
        "rule": f"mean {claim.side} {claim.bound:g}",
    }


def effect(claim: dict[str, Any]) -> str:
    """The effect of a claim with its interval, as text."""
    if claim["effect"] is None:
        return "no run"
    between = "" if claim["interval"] is None else " ({:.3g} to {:.3g})".format(*claim["interval"])
    return f"{claim['effect']:.3g}{between} {claim['unit']}"


def paired(value: str, one: Row, other: Row) -> Effects:
    """Effects: `value` of the rows that agree with `one`, minus that of the rows that agree with
    `other`, run by run."""
    return lambda rows: [
        _value(rows, value, one, run) - _value(rows, value, other, run)
        for run in runs_of(rows, one, other)
    ]


def single(value: str, one: Row) -> Effects:
    """Effects: `value` of the rows that agree with `one`, run by run."""
    return lambda rows: [_value(rows, value, one, run) for run in runs_of(rows, one)]


def runs_of(rows: Sequence[Row], *wanted: Row) -> list[str]:
    """The runs that have a row for each of the wanted entries, in their order."""
    found = [{row["run"]: None for row in rows if _agrees(row, one)} for one in wanted]
    return [run for run in found[0] if all(run in other for other in found)]


def _value(rows: Sequence[Row], value: str, one: Row, run: str) -> float:
    of = [row[value] for row in rows if row["run"] == run and _agrees(row, one)]
    return float(np.mean(of))


def _agrees(row: Row, one: Row) -> bool:
    return all(row.get(key) == wanted for key, wanted in one.items())


def roc_area(values: Sequence[float], failed: Sequence[bool]) -> float | None:
    """Area under the ROC of a statistic that should be large where a run failed: the probability
    that a failed run has the larger value, a tie counts half (Mann-Whitney). None where all runs
    failed, or none."""
    values_, failed_ = np.asarray(values, float), np.asarray(failed, bool)
    bad, good = values_[failed_], values_[~failed_]
    if not len(bad) or not len(good):
        return None
    larger = (bad[:, None] > good[None, :]).mean() + 0.5 * (bad[:, None] == good[None, :]).mean()
    return float(larger)
