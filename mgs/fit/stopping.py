"""When a fit stops, and why: pure functions of its losses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum

DIVERGED_FACTOR = 1.5
"""A fit has diverged when its loss was above this many times the loss it started from, for
DIVERGED_PASSES passes in a row.
Chosen constants: Adam's first steps are as long as its rates, whatever the gradient, so a fit that
starts from a fitted model rises first (on the demo's: 1.04 times at the usual rates, above 1.5 for
one pass at ten times those), then falls."""

DIVERGED_PASSES = 5

LOSS_FLOOR = (1 / 255) ** 2 / 12
"""Mean squared error that rounding to 8 bits makes: losses below it are not told apart from it."""


class StopReason(StrEnum):
    """Why a fit stopped: `stop_reason` in steps.jsonl. Older runs have `converged` for settled, and
    `iteration-limit` for the pass limit."""

    SETTLED = "settled"
    PASS_LIMIT = "pass-limit"
    DIVERGED = "diverged"


def stop_reason(losses: Sequence[float], tolerance: float, limit: int) -> StopReason | None:
    """Whether a fit stops after its last pass, and why; None: it goes on.

    losses: of the model that the fit started from, then of each pass. tolerance: share of a loss.
    limit: most passes.

    Diverged: the last loss is not finite; or the last DIVERGED_PASSES (all, where the limit is
    lower) are above DIVERGED_FACTOR
    times the start. A fit that ends less far above its start has not diverged: one that starts from
    a fitted model rises first, and a short one may end on its way back (the sign `worse` of
    `mgs.run.detectors` tells of it).
    Settled: two passes in a row lower the loss of the pass before by less than the tolerance, and
    neither is more than the tolerance above the lowest loss until then. So a rise within the
    tolerance is the noise of a loss that falls no more; a
    larger one, or small ones that add up to more, are not. How far away the minimum is, it does not
    say: that is what `mgs.report.convergence` is for.
    """
    passes, start = len(losses) - 1, max(losses[0], LOSS_FLOOR)
    if not math.isfinite(losses[-1]):
        return StopReason.DIVERGED
    window = min(DIVERGED_PASSES, limit)
    if passes >= window and min(losses[-window:]) > DIVERGED_FACTOR * start:
        return StopReason.DIVERGED
    if passes >= 3 and all(_settled(losses, k, tolerance) for k in (passes - 1, passes)):
        return StopReason.SETTLED
    if passes < limit:
        return None
    return StopReason.PASS_LIMIT


def _settled(losses: Sequence[float], k: int, tolerance: float) -> bool:
    """Whether pass k neither lowered the loss by the tolerance nor left it higher than that above
    the lowest before."""
    lowest = max(min(losses[:k]), LOSS_FLOOR)
    return (1 - tolerance) * losses[k - 1] < losses[k] <= (1 + tolerance) * lowest
