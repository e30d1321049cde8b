"""Why a run ended, and the messages about the end of a run and of its fits."""

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

from mgs.fit.stopping import DIVERGED_PASSES
from mgs.policy.criteria import GAIN_UNIT
from mgs.run.settings import NbvSettings


def diverged(out: Path, step: int, steps: int, losses: Sequence[float]) -> str:
    """Message for a fit that diverged: its first and last losses, and how to go on.

    step: that of the fit. steps: number of finished steps."""
    first, *passes = (f"{loss:.3g}" for loss in losses)
    fit = "the fit to the seeds" if step == 0 else f"the fit of step {step}"
    rest = {0: "", 1: "; step 0 is kept"}.get(steps, f"; steps 0 to {steps - 1} are kept")
    rates = "`train.rates`" if step == 0 else "`warm_rate` or `train.rates`"
    longer = "`train.passes`" if step == 0 else "`warm_passes`"
    short = len(passes) < DIVERGED_PASSES and math.isfinite(losses[-1])
    more = f"raise {longer}, or " if short else ""
    return (
        f"{out}: {fit} diverged: its loss was {first} at the start, and {', '.join(passes[-3:])} "
        f"in the last passes; {more}lower the learning rates ({rates} in {out / 'config.json'}) "
        f"and go on with `mgs nbv --resume {out}`{rest}"
    )


class RunEnd(StrEnum):
    """Why a run ended: `reason` of `ended`, in the last line of steps.jsonl."""

    BUDGET = "budget"
    UNCERTAINTY = "uncertainty"
    PSNR = "psnr"
    GAIN = "gain"
    FLIGHT = "flight"


def run_end(
    settings: NbvSettings,
    views: int,
    uncertainty: float,
    refused: Mapping[str, Any] | None,
    metres: float | None = None,
    predicted: float | None = None,
    given_up: int = 0,
) -> dict[str, Any] | None:
    """`ended` of steps.jsonl where the run ends here: the `reason` and its numbers; else None.

    views: chosen so far. uncertainty: mean variance left, over that of the prior. refused: name and
    gain of the next view, if known. metres: of the flight, where no pose is in reach. predicted:
    PSNR of the views not taken, dB. given_up: number of poses without a picture."""

    def end(reason: RunEnd, **numbers: Any) -> dict[str, Any]:
        return {"reason": str(reason), "views": views, **numbers}

    if views >= settings.budget:
        return end(RunEnd.BUDGET)
    if (limit := settings.stop_uncertainty) is not None and uncertainty <= limit:
        return end(RunEnd.UNCERTAINTY, uncertainty=uncertainty, limit=limit)
    if (limit := settings.stop_psnr) is not None and predicted is not None and predicted >= limit:
        return end(RunEnd.PSNR, psnr=predicted, limit=limit)
    if metres is not None:
        return end(RunEnd.FLIGHT, metres=metres, **({"given_up": given_up} if given_up else {}))
    gain = refused.get("information_gain", math.inf) if refused else math.inf
    if refused and (limit := settings.stop_gain) is not None and gain < limit:
        return end(RunEnd.GAIN, name=refused["name"], information_gain=gain, limit=limit)
    return None


def why_ended(ended: Mapping[str, Any]) -> str:
    """Reason of a run's end in words, after "the run has ended: ". ended: as in steps.jsonl."""
    views = f"{ended['views']} chosen view{'' if ended['views'] == 1 else 's'}"
    if ended["reason"] == RunEnd.BUDGET:
        return f"its budget is spent, {views}"
    if ended["reason"] == RunEnd.UNCERTAINTY:
        limit = f"no more than stop_uncertainty = {ended['limit']:g}"
        return f"{ended['uncertainty']:.4g} of the prior's variance is left after {views}, {limit}"
    if ended["reason"] == RunEnd.PSNR:
        limit = f"after {views}, no less than stop_psnr = {ended['limit']:g}"
        psnr = f"the masked PSNR of the views not taken is predicted to be {ended['psnr']:.1f} dB"
        return f"{psnr} {limit}"
    if ended["reason"] == RunEnd.FLIGHT:
        way = f"the flight is {ended['metres']:.1f} m long with the way home"
        if count := ended.get("given_up"):
            note = f"{count} pose{'' if count == 1 else 's'} gave no picture"
            return f"no pose is left in reach, {views}; {note}, resuming asks for them again; {way}"
        return f"no pose is left that the flight's limits allow, {views}; {way}"
    gain = f"{ended['information_gain']:.4g} {GAIN_UNIT} after {views}"
    limit = f"less than stop_gain = {ended['limit']:g}"
    return f"the next view, {ended['name']}, would gain {gain}, {limit}"
