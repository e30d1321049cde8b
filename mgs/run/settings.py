"""Settings of a run: validated once, frozen, and written whole beside the results. Needs neither
Mitsuba nor Dr.Jit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from mgs.errors import InputError
from mgs.fit.settings import (
    ALPHA_WEIGHT,
    MEAN_RATE,
    PASSES,
    WARM_PASSES,
    Positive,
    Scale,
    TrainSettings,
    complete,
)
from mgs.policy.criteria import MEAN_STD, PIXEL_NOISE, PRIOR_STD, regularisation


@dataclass(frozen=True)
class Preset:
    """A point of the chart of speed against accuracy (docs/speed-accuracy.md): defaults that give
    way to what is given."""

    passes: int
    """`TrainSettings.passes`."""
    warm_passes: int
    """`NbvSettings.warm_passes`."""
    density: float
    """`mgs.prior.settings.PriorSettings.density` of a prior that is built inside the run without a
    number of Gaussians."""


PRESETS = {
    "fast": Preset(passes=5, warm_passes=3, density=1 / 4),
    "balanced": Preset(passes=PASSES, warm_passes=WARM_PASSES, density=1 / 2),
    "accurate": Preset(passes=PASSES, warm_passes=WARM_PASSES, density=3 / 4),
}
"""What `mgs nbv --preset` knows, by name: chosen with the charts of docs/speed-accuracy.md, which
name them."""


class NbvSettings(BaseModel):
    """Everything that decides what `mgs nbv` does; the same settings give the same choice of
    views."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset: Path
    prior: Path
    policy: str = "d-optimal"
    """A name of `mgs.policy.registry.policy_names`, or FILE.py:FUNCTION; looked up when the loop
    starts: a finished run is read without it."""
    nearest: Annotated[int, Field(ge=1)] | None = None
    """The next view is one of so many that are nearest to the view taken last (at first, to the
    last seed); None: any view."""
    travel: Scale | None = None
    """Distance from view to view, metres, that costs as much as an image: scores are divided by 1 +
    distance / travel; None: moving costs nothing (`mgs.policy.poses.travel_cost`)."""
    estimator: str = "exact"
    """A row of `mgs.splat.ESTIMATORS` that gives [N,P]: how the Fisher information that criteria
    see is computed."""
    budget: Annotated[int, Field(ge=0)] = 50
    """Most views that are chosen beyond the seeds."""
    batch: Annotated[int, Field(ge=1)] = 1
    """Views that are chosen before their images are read and the model is fitted again; the last
    batch may be smaller."""
    stop_gain: Positive | None = None
    """The run ends where the view to be taken next has a smaller `information_gain` than this (Eq.
    7); None: never for that reason (`mgs.fit.stopping.run_end`)."""
    stop_uncertainty: Annotated[float, Field(gt=0, lt=1)] | None = None
    """The run ends where no more than this share of the prior's variance is left
    (`mgs.policy.criteria.uncertainty`, averaged);
    None: never for that reason."""
    seeds: Annotated[int, Field(ge=1)] = 4
    """Views at evenly spaced azimuths that start the model."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Root of every random draw."""
    lam: Annotated[float, Field(ge=1e-30, le=1e30, allow_inf_nan=False)] | None = None
    """One lambda for all parameters, as in the paper; None: (pixel_noise / prior_std)^2 of each
    kind of parameter."""
    pixel_noise: Scale = PIXEL_NOISE
    """sigma_e in lambda = (sigma_e / tau)^2, linear RGB; `mgs.policy.criteria.regularisation`."""
    prior_std: dict[str, Scale] = PRIOR_STD
    """tau of each kind of parameter; kinds left out take those of `mgs.policy.criteria.PRIOR_STD`.
    That of `mean`, metres, is read only where means are learned, and must be there then; `mgs nbv`
    sets it (`with_spacing`)."""
    evaluate_every: Annotated[int, Field(ge=0)] = 0
    """Measure PSNR on all views after every so many steps, or at the end of the batch that such a
    step is in; 0 = only at the end of the run. Never feeds back into the choice."""
    warm_passes: Annotated[int, Field(ge=1)] = WARM_PASSES
    """Most passes of the fits after the first, if `train.passes` is not less."""
    warm_rate: Positive = 1.0
    """Learning rates of the fits after the first, over those of the first."""
    exposure: bool = False
    """Estimate a gain per image and channel before every fit, and fit to the images divided by it
    (`mgs.prior.exposure`)."""
    train: TrainSettings = TrainSettings()
    """How each fit is done."""

    _every_kind = field_validator("prior_std", mode="before")(
        lambda given: complete(given, PRIOR_STD)
    )

    def train_at(self, step: int) -> TrainSettings:
        """How the fit of a step is done: that of the seeds, step 0, as `train` says, the others
        with what is warm."""
        if step == 0:
            return self.train
        rates = {kind: self.warm_rate * rate for kind, rate in self.train.rates.items()}
        return self.train.model_copy(
            update={"rates": rates, "passes": min(self.warm_passes, self.train.passes)}
        )

    def regularisation(self, groups: dict[str, slice]) -> NDArray[np.float64]:
        """lambda of every column of the Fisher information, [P]: what the criteria of this run see.
        groups: their kinds.

        Raises InputError where there is no tau of one of these kinds.
        """
        if missing := [kind for kind in groups if kind not in self.prior_std]:
            raise InputError(
                f"prior_std: has no number for {missing[0]}, which is learned; give one, metres"
            )
        by_kind = regularisation(groups, self.pixel_noise, self.prior_std)
        return by_kind if self.lam is None else np.full_like(by_kind, self.lam)

    def with_spacing(self, spacing: float) -> NbvSettings:
        """The settings for a prior whose samples are so far apart, metres: where means are learned,
        with a tau and a rate of theirs, unless these are given already."""
        if self.train.means == "frozen":
            return self
        train = self.train.model_copy(
            update={"rates": {"mean": MEAN_RATE * spacing} | self.train.rates}
        )
        return self.model_copy(
            update={"train": train, "prior_std": {"mean": MEAN_STD * spacing} | self.prior_std}
        )


def with_defaults(
    values: Mapping[str, Any], preset: Preset | None = None, alpha_weight: float = ALPHA_WEIGHT
) -> dict[str, Any]:
    """Fields of NbvSettings with this alpha_weight and the defaults of a preset in them. What
    `values` holds stays as it is."""
    train = values.get("train", {})
    given = train.model_dump(exclude_unset=True) if isinstance(train, TrainSettings) else train
    if not isinstance(given, Mapping):
        return dict(values)  # what is wrong with it is for `validated` to say
    with_alpha = {"alpha_weight": alpha_weight, **given}
    if preset is None:
        return {**values, "train": with_alpha}
    return {
        "warm_passes": preset.warm_passes,
        **values,
        "train": {"passes": preset.passes, **with_alpha},
    }


Model = TypeVar("Model", bound=BaseModel)

OPTIONS = (
    "policy", "nearest", "travel", "estimator", "budget", "batch", "stop_gain", "stop_uncertainty", "seeds", "seed", "lam",
    "pixel_noise", "evaluate_every", "means", "optimiser", "alpha_weight", "exposure", "passes", "warm_passes",
)  # fmt: skip
"""Settings that `mgs nbv` has an option for, of the same name."""


def validated(model: type[Model], values: dict[str, Any], file: Path | None = None) -> Model:
    """Build settings, from the options of a command or from `settings` of a file. Raises InputError
    with one line for the first value that is wrong, which names the option, or the file and the
    key."""
    try:
        return model(**values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        parts, message = (
            [str(part) for part in first["loc"]],
            first["msg"].removeprefix("Value error, "),
        )
        if file is not None:
            key = ".".join(["settings", *parts])
            raise InputError(
                f"{file}: {key}: {message}; correct it, or start the run anew"
            ) from None
        raise InputError(f"{_named(parts, first['input'])}: {message}") from None


def _named(parts: list[str], value: Any) -> str:
    """How a wrong setting is called: as it is given to `mgs nbv`, or by its key where that has no
    option for it."""
    key, *kind = [part for part in parts if part != "train"]
    option = {
        "rates": "--rate",
        "prior_std": "--prior-std",
        **{name: f"--{name.replace('_', '-')}" for name in OPTIONS},
    }.get(key)
    if option is None:
        return f"setting {'.'.join(parts)} = {value!r}"
    return f"{option} {kind[0]}={value}" if kind else f"{option} {value}"
