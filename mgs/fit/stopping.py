"""When a fit stops, and why: pure functions of its losses."""

import math
from collections.abc import Sequence
from enum import StrEnum

# A fit diverges if its loss stays above this many times the first for DIVERGED_PASSES passes.
# Chosen constants: a fit that starts from a fitted model first rises a little, then falls.
DIVERGED_FACTOR = 1.5
DIVERGED_PASSES = 5
LOSS_FLOOR = (1 / 255) ** 2 / 12  # of rounding to 8 bits; smaller losses count as this one


class StopReason(StrEnum):
    """Why a fit stopped; `stop_reason` in steps.jsonl."""

    SETTLED = "settled"
    PASS_LIMIT = "pass-limit"
    DIVERGED = "diverged"


class DivergedError(Exception):
    """A fit diverged. step: of the loop, 0 for the seeds. losses: of the start, then each pass."""

    def __init__(self, step: int, losses: Sequence[float]) -> None:
        super().__init__(f"the fit of step {step} diverged")
        self.step, self.losses = step, losses


def stop_reason(losses: Sequence[float], tolerance: float, limit: int) -> StopReason | None:
    """Why a fit stops after its last pass, or None if it continues.

    losses: of the initial model, then of each pass. tolerance: share of a loss. limit: most passes.

    DIVERGED: the last loss is not finite, or the last DIVERGED_PASSES losses (all, if the limit is
    lower) exceed DIVERGED_FACTOR times the first.
    SETTLED: in each of the last two passes, of at least three, the loss fell by less than the
    tolerance, and is at most the tolerance above the lowest before. It does not say how far the
    minimum is (docs/fit.md).
    """
    passes, start = len(losses) - 1, max(losses[0], LOSS_FLOOR)
    if not math.isfinite(losses[-1]):
        return StopReason.DIVERGED
    window = min(DIVERGED_PASSES, limit)
    if passes >= window and min(losses[-window:]) > DIVERGED_FACTOR * start:
        return StopReason.DIVERGED
    if passes >= 3 and all(_settled(losses, k, tolerance) for k in (passes - 1, passes)):
        return StopReason.SETTLED
    return StopReason.PASS_LIMIT if passes >= limit else None


def _settled(losses: Sequence[float], k: int, tolerance: float) -> bool:
    lowest = max(min(losses[:k]), LOSS_FLOOR)
    return (1 - tolerance) * losses[k - 1] < losses[k] <= (1 + tolerance) * lowest
