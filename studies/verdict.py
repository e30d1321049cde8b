"""Claims and verdicts: one rule for all studies.

A claim states on which side of a bound the mean of an effect lies. It *holds* if the whole 95 %
interval of the mean (Student's t, over independent runs) lies there, *fails* if it lies on the
other side, and otherwise, and for fewer than two runs, *depends* on rock, views or chance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

import numpy as np

from mgs.reports.tables import markdown
from studies.statistics import interval

Row = dict[str, Any]

Effects = Callable[[Sequence[Row]], list[float]]
"""Function of the rows of an experiment that returns one number for each run."""


class Outcome(StrEnum):
    """Verdict on a claim."""

    HOLDS = "holds"
    FAILS = "fails"
    DEPENDS = "depends"


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


def outcome(side: str, bound: float, between: tuple[float, float] | None) -> Outcome:
    """Verdict from the interval of the mean effect."""
    if between is None:
        return Outcome.DEPENDS
    low, high = between if side == "above" else (-between[1], -between[0])
    limit = bound if side == "above" else -bound
    if low >= limit:
        return Outcome.HOLDS
    return Outcome.FAILS if high < limit else Outcome.DEPENDS


def judged(claim: Claim, rows: Sequence[Row]) -> Row:
    """Record of a claim: hypothesis, verdict, effect, interval, number of runs, and the rule."""
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


def effect(record: Row) -> str:
    """Effect of a judged claim with its interval, as text."""
    if record["effect"] is None:
        return "no run"
    between = (
        "" if record["interval"] is None else " ({:.3g} to {:.3g})".format(*record["interval"])
    )
    return f"{record['effect']:.3g}{between} {record['unit']}"


def verdict_table(records: Sequence[Row]) -> str:
    """Judged claims as a Markdown table."""
    return markdown(
        ("hypothesis", "verdict", "mean effect (95 % interval)", "runs"),
        [
            (
                one["hypothesis"],
                f"**{one['verdict']}**",
                effect(one),
                f"{one['runs']} ({one['over']})",
            )
            for one in records
        ],
    )


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
