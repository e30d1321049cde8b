"""Why a run ended, and what is said about the end of a run and of its last fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mgs.run.settings import NbvSettings


def diverged(out: Path, step: int, kept: int, losses: Sequence[float]) -> str:
    """What to say of a fit that diverged: the loss of the model it started from, and of its last
    passes.

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


def run_end(
    settings: NbvSettings, views: int, uncertainty: float, refused: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """`ended` of steps.jsonl, where the run ends here: the `reason`, and the numbers that decided;
    None: it goes on.

    views: chosen so far. uncertainty: the mean over all parameters of the variance that is left,
    over that of the prior.
    refused: where the view to be taken next is known already, its `name` and `information_gain`.
    """
    if views >= settings.budget:
        return {"reason": str(RunEnd.BUDGET), "views": views}
    if settings.stop_uncertainty is not None and uncertainty <= settings.stop_uncertainty:
        numbers = {"uncertainty": uncertainty, "limit": settings.stop_uncertainty}
        return {"reason": str(RunEnd.UNCERTAINTY), "views": views, **numbers}
    if (
        settings.stop_gain is not None
        and refused
        and refused.get("information_gain", math.inf) < settings.stop_gain
    ):
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
