"""When a fit stops and when a run ends, and why: pure functions of losses, and of what is known after a step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

from mgs.active.settings import NbvSettings

DIVERGED_FACTOR = 1.5
"""A fit has diverged when its loss was above this many times the loss it started from, for DIVERGED_PASSES passes in a row.
Chosen constants: Adam's first steps are as long as its rates, whatever the gradient, so a fit that starts from a fitted
model rises first (on the demo's: 1.04 times at the usual rates, above 1.5 for one pass at ten times those), then falls."""

DIVERGED_PASSES = 5

LOSS_FLOOR = (1 / 255) ** 2 / 12
"""Mean squared error that rounding to 8 bits makes: losses below it are not told apart from it."""


class StopReason(StrEnum):
    """Why a fit stopped: `stop_reason` in steps.jsonl. Older runs have `converged` for settled, and `iteration-limit` for the
    pass limit."""

    SETTLED = "settled"
    PASS_LIMIT = "pass-limit"
    DIVERGED = "diverged"


def stop_reason(losses: Sequence[float], tolerance: float, limit: int) -> StopReason | None:
    """Whether a fit stops after its last pass, and why; None: it goes on.

    losses: of the model that the fit started from, then of each pass. tolerance: share of a loss. limit: most passes.

    Diverged: the last loss is not finite; or the last DIVERGED_PASSES (all, where the limit is lower) are above DIVERGED_FACTOR
    times the start. A fit that ends less far above its start has not diverged: one that starts from a fitted model rises first,
    and a short one may end on its way back (the sign `worse` of `mgs.active.detectors` tells of it).
    Settled: two passes in a row lower the loss of the pass before by less than the tolerance, and neither is more than the
    tolerance above the lowest loss until then. So a rise within the tolerance is the noise of a loss that falls no more; a
    larger one, or small ones that add up to more, are not. How far away the minimum is, it does not say: that is what
    `mgs.active.convergence` is for.
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
    """Whether pass k neither lowered the loss by the tolerance nor left it higher than that above the lowest before."""
    lowest = max(min(losses[:k]), LOSS_FLOOR)
    return (1 - tolerance) * losses[k - 1] < losses[k] <= (1 + tolerance) * lowest


def diverged(out: Path, step: int, kept: int, losses: Sequence[float]) -> str:
    """What to say of a fit that diverged: the loss of the model it started from, and of its last passes.

    out: the run's folder. step: that of the fit. kept: how many steps are finished.
    """
    first, *passes = (f"{loss:.3g}" for loss in losses)
    fit = "the fit to the seeds" if step == 0 else f"the fit of step {step}"
    left = {0: "", 1: "; step 0 is kept"}.get(kept, f"; steps 0 to {kept - 1} are kept")
    rates = "`train.rates`" if step == 0 else "`warm_rate` or `train.rates`"
    return (
        f"{out}: {fit} diverged: its loss was {first} at the start, and {', '.join(passes[-3:])} in the last passes; "
        f"lower the learning rates ({rates} in {out / 'config.json'}) and go on with `mgs nbv --resume {out}`{left}"
    )


def fit_line(fit: dict[str, Any], stop_reason: str) -> str:
    """What to say of the last fit: whether it has converged, or how far from its end it stopped."""
    share = f"{100 * fit['predicted_decrease']:.2g} %"
    if fit["converged"]:
        return f"last fit: converged; its objective could fall by {share} yet, as predicted from its curvature"
    return f"last fit: stopped early ({stop_reason}); its objective could fall by {share} yet, as predicted from its curvature"


class RunEnd(StrEnum):
    """Why a run ended: `reason` of `ended`, in the last line of steps.jsonl."""

    BUDGET = "budget"
    UNCERTAINTY = "uncertainty"
    GAIN = "gain"


def run_end(settings: NbvSettings, views: int, uncertainty: float, refused: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """`ended` of steps.jsonl, where the run ends here: the `reason`, and the numbers that decided; None: it goes on.

    views: chosen so far. uncertainty: the mean over all parameters of the variance that is left, over that of the prior.
    refused: where the view to be taken next is known already, its `name` and `information_gain`.
    """
    if views >= settings.budget:
        return {"reason": str(RunEnd.BUDGET), "views": views}
    if settings.stop_uncertainty is not None and uncertainty <= settings.stop_uncertainty:
        numbers = {"uncertainty": uncertainty, "limit": settings.stop_uncertainty}
        return {"reason": str(RunEnd.UNCERTAINTY), "views": views, **numbers}
    if settings.stop_gain is not None and refused and refused.get("information_gain", math.inf) < settings.stop_gain:
        view = {key: refused[key] for key in ("name", "information_gain")}
        return {"reason": str(RunEnd.GAIN), "views": views, **view, "limit": settings.stop_gain}
    return None


def why_ended(ended: Mapping[str, Any]) -> str:
    """What to say of the end of a run, after "the run has ended: ". ended: as in steps.jsonl."""
    views = f"{ended['views']} chosen view{'' if ended['views'] == 1 else 's'}"
    if ended["reason"] == RunEnd.BUDGET:
        return f"its budget is spent, {views}"
    if ended["reason"] == RunEnd.UNCERTAINTY:
        limit = f"no more than --stop-uncertainty {ended['limit']:g}"
        return f"{ended['uncertainty']:.4g} of the prior's variance is left after {views}, {limit}"
    gain, limit = f"{ended['information_gain']:.4g}", f"less than --stop-gain {ended['limit']:g}"
    return f"the next view, {ended['name']}, would gain {gain} after {views}, {limit}"
