"""Settings of a fit: validated once and frozen. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

RATES = {"colour": 0.02, "scale": 0.04, "rotation": 0.02, "opacity": 0.1}
"""Learning rates of the optimiser, the longest step or about it, in each kind of parameter's own
unit: colour coefficient, log-scale, quaternion, opacity logit. Chosen constants (docs/fit.md)."""

MEAN_RATE = 0.02
"""The same for means that are learned, over the spacing of the prior's samples. With larger steps
more Gaussians are pushed behind others, where no image sees them. A chosen constant."""

PASSES, WARM_PASSES = 10, 5
"""Most passes of the first fit of a run, and of those after it, which start from a model that was
fitted to all images but one. More cost more and overfit. Chosen constants
(docs/speed-accuracy.md)."""


ALPHA_WEIGHT = 0.1
"""`TrainSettings.alpha_weight` of a run that says nothing of it, where all frames have a mask or
alpha. A chosen constant (docs/fit.md, An opaque surface)."""

COLOURS_ALONE = {"alpha_weight": 0.0}
"""Values of `TrainSettings` with which colours alone are fitted, as in the paper. All studies of
this project do so, but for those of alpha itself."""


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]

Scale = Annotated[float, Field(ge=1e-6, le=1e6, allow_inf_nan=False)]
"""A scale, as of lambda = (pixel noise / prior std)^2, bounded so that what is divided by it is far
from what overflows or vanishes in float64."""


def complete(given: Any, defaults: Mapping[str, float]) -> Any:
    """A number for each kind of parameter: those given, the others as in `defaults`. A list is what
    older runs wrote.

    A number for "mean" may be given too; it has no default, because its unit is the metre and
    scenes differ in size."""
    if isinstance(given, list | tuple) and len(given) == len(defaults):
        given = dict(zip(defaults, given, strict=True))
    if not isinstance(given, Mapping) or not given.keys() <= {*defaults, "mean"}:
        raise ValueError(
            f"must be a number for each of {', '.join(defaults)}; for mean, too, where means are learned"
        )
    return {**defaults, **given}


class TrainSettings(BaseModel):
    """How a fit is done: `mgs.fit.fitting.fit`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    means: Literal["frozen", "normal", "free"] = "frozen"
    """What the means may do: stay, as in the paper; move along the prior's normals; move freely
    (`mgs.splat.MEANS`)."""
    optimiser: str = "natural"
    """A row of `mgs.fit.optimisers.OPTIMISERS`."""
    passes: Annotated[int, Field(ge=1)] = PASSES
    """Most passes over the images."""
    tolerance: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.01
    """Settled when a pass lowers the loss by less than this share, twice in a row, and does not
    raise it by more (`mgs.fit.stopping.stop_reason`)."""
    rates: dict[str, Annotated[float, Field(ge=0, allow_inf_nan=False)]] = RATES
    """Learning rate of each kind of parameter; kinds left out take those of RATES. A rate of 0
    leaves a kind as it is. That of `mean`, metres, is read only where means are learned, and must
    be there then; `mgs nbv` sets it (`with_spacing`)."""
    alpha_weight: Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)] = 0.0
    """(sigma_rgb / sigma_alpha)^2, with which alpha is a fourth channel of a pixel; 0: it is none.
    Runs have ALPHA_WEIGHT by
    default. The criteria leave it out: with a weight up to 1 they chose the same views
    (docs/fit.md)."""
    decay: Positive = 0.1
    """The rates fall by this factor over `passes`."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Root of the order in which a pass takes the images."""

    _every_kind = field_validator("rates", mode="before")(lambda given: complete(given, RATES))
