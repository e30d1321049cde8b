"""Settings of a run: validated once, frozen, written whole beside the results.

The docstring of a field is the help of its option of `mgs nbv`. Needs neither Mitsuba nor Dr.Jit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mgs.errors import InputError, flag, row_named
from mgs.files import read_json, read_toml
from mgs.fit.settings import (
    ALPHA_WEIGHT,
    MEAN_RATE,
    PASSES,
    WARM_PASSES,
    ModelSettings,
    Positive,
    Scale,
    TrainSettings,
)
from mgs.policy.criteria import MEAN_STD, PRIOR_STD
from mgs.policy.registry import check_policy


@dataclass(frozen=True)
class RunPreset:
    """Defaults that trade speed for accuracy (docs/speed-accuracy.md); other options win.

    passes: `TrainSettings.passes`. warm_passes: `NbvSettings.warm_passes`. density:
    `mgs.prior.settings.PriorSettings.density` of a prior built in the run, without a number given.
    """

    passes: int
    warm_passes: int
    density: float


PRESETS = {
    "fast": RunPreset(passes=5, warm_passes=3, density=1 / 4),
    "balanced": RunPreset(passes=PASSES, warm_passes=WARM_PASSES, density=1 / 2),
    "accurate": RunPreset(passes=PASSES, warm_passes=WARM_PASSES, density=5 / 4),
}


class Mission(BaseModel):
    """Limits of a run: how many views it takes, where the camera may go, and when it ends."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    seeds: Annotated[int, Field(ge=1)] = 4
    """Number of seed views for the first fit, spread evenly over the directions of the poses."""
    budget: Annotated[int, Field(ge=0)] = 50
    """Most views to choose beyond the seed views. Default: 50, or all candidates if fewer."""
    batch: Annotated[int, Field(ge=1)] = 1
    """Views to choose before the next fit; the last batch may be smaller."""
    nearest: Annotated[int, Field(ge=1)] | None = None
    """Choose among this many candidates, the nearest to the last view. Default: all."""
    travel: Scale | None = None
    """Distance that costs as much as an image; scores are divided by 1 + distance / METRES."""
    flight_length: Scale | None = None
    """Longest flight in metres, from the first image and back to it. Default: no limit."""
    flight_time: Scale | None = None
    """Longest flight in seconds, at --speed, with --hover at each picture. Default: no limit."""
    speed: Scale = 2.0
    """Speed between pictures, metres per second."""
    hover: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 3.0
    """Seconds that a picture takes."""
    no_fly: Scale | None = None
    """Radius in metres of an upright cylinder around the object that the flight must not enter."""
    clearance: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    """Lowest height of a pose above the object's lowest point, metres."""
    stop_gain: Positive | None = None
    """End the run if the chosen view's information gain (Eq. 7, ½ nat per parameter) is lower."""
    stop_uncertainty: Annotated[float, Field(gt=0, lt=1)] | None = None
    """End the run when at most this share (0 to 1) of the prior's variance is left."""
    stop_psnr: Annotated[float, Field(gt=0, le=80, allow_inf_nan=False)] | None = None
    """End the run when the masked PSNR of the views not taken is predicted to be this high, dB."""

    @property
    def flies(self) -> bool:
        """Whether the flight has a limit, so that views are planned as a tour."""
        return self.flight_length is not None or self.flight_time is not None


class NbvSettings(ModelSettings, Mission):
    """Everything that decides what `mgs nbv` does: equal settings choose equal views."""

    dataset: Path
    """Folder of the dataset."""
    prior: Path
    """Folder of the prior."""
    policy: str = "directional-i"
    """Policy that scores candidate views: a name, or FILE.py:FUNCTION of your own."""
    evaluate_every: Annotated[int, Field(ge=0)] = 0
    """Measure PSNR each time after this many views; 0: only at the end. Does not affect choices."""

    def with_spacing(self, spacing: float, loose: float = 1.0) -> NbvSettings:
        """The settings with a rate and a prior std of learned means, from the samples' spacing, m.

        loose: factor on the default prior std of every kind. What is given stays; nothing changes
        where means are frozen.
        """
        if self.train.means == "frozen":
            return self
        rates = {"mean": MEAN_RATE * spacing} | self.train.rates
        train = self.train.model_copy(update={"rates": rates})
        prior_std = {
            kind: loose * std if std == PRIOR_STD.get(kind) else std
            for kind, std in self.prior_std.items()
        }
        prior_std = {"mean": loose * MEAN_STD * spacing} | prior_std
        return self.model_copy(update={"train": train, "prior_std": prior_std})


def with_defaults(
    values: Mapping[str, Any], preset: RunPreset | None = None, alpha_weight: float = ALPHA_WEIGHT
) -> dict[str, Any]:
    """Add this alpha_weight and a preset's values to fields of NbvSettings that lack them."""
    train = values.get("train", {})
    given = train.model_dump(exclude_unset=True) if isinstance(train, TrainSettings) else train
    if not isinstance(given, Mapping):
        return dict(values)  # `validated` reports it
    passes = {} if preset is None else {"passes": preset.passes}
    warm = {} if preset is None else {"warm_passes": preset.warm_passes}
    return {**warm, **values, "train": {**passes, "alpha_weight": alpha_weight, **given}}


Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], values: dict[str, Any], file: Path | None = None) -> Model:
    """Build settings from options, or from `settings` of a file.

    Raises InputError for the first invalid value; it names the option, or the file and the key.
    """
    try:
        return model(**values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        parts = [str(part) for part in first["loc"]]
        message = first["msg"].removeprefix("Value error, ")
        for bound, words in BOUNDS.items():
            if bound in first.get("ctx", {}):
                message = f"must be {words} {first['ctx'][bound]:g}"
        if file is not None:
            if file.suffix != ".json":
                raise InputError(f"{file}: {'.'.join(parts)}: {message}; correct it") from None
            key = ".".join(["settings", *parts])
            message = f"{file}: {key}: {message}; correct it, or start the run anew"
            raise InputError(message) from None
        raise InputError(f"{option_of(parts, first['input'])}: {message}") from None


def settings_in(file: Path) -> dict[str, Any]:
    """Settings that a TOML file, or the config.json of a run, has; paths are from its folder.

    Raises InputError where the file cannot be read, or a key or a value is wrong.
    """
    if file.suffix == ".json":
        config = read_json(file)
        found = config.get("settings") if isinstance(config, dict) else None
    else:
        found = read_toml(file)
    if not isinstance(found, dict):
        raise InputError(f"{file}: has no settings; give a TOML file or the config.json of a run")
    validated(NbvSettings, {"dataset": "", "prior": "", **found}, file)
    paths = {key: file.parent / found[key] for key in ("dataset", "prior") if key in found}
    return {**found, **paths}


BOUNDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}
"""Words for the limits of pydantic's numbers."""

NO_OPTION = (
    "warm_rate",
    "tolerance",
    "decay",
    "steady_rates",
    "sh_steps",
    "directional_rate",
    "dataset",
    "prior",
)
"""Settings without an option of their own."""


def option_of(parts: list[str], value: Any) -> str:
    """Name a setting and its value as on the command line, or by key where it has no option."""
    key, *kind = [part for part in parts if part != "train"]
    known = NbvSettings.model_fields.keys() | TrainSettings.model_fields.keys()
    if key in NO_OPTION or key not in known:
        return f"setting {'.'.join(parts)} = {value!r}"
    option = flag(key)
    return f"{option} {kind[0]}={value}" if kind else f"{option} {value}"


def check_settings(settings: NbvSettings, frames: int) -> None:
    """Raises InputError where settings do not go together, or a dataset has too few frames.

    Unknown are: a policy, an estimator without a diagonal, an optimiser, a loss; an estimator or a
    policy that has no columns of learned means; seeds and budget beyond the number of frames.
    """
    from mgs.fit.density import DENSITIES  # loads Dr.Jit, as the next three
    from mgs.fit.losses import LOSSES
    from mgs.fit.optimisers import OPTIMISERS
    from mgs.splat import ESTIMATORS

    diagonal = [name for name in ESTIMATORS if name != "block"]
    check_policy(settings.policy)
    if settings.estimator not in diagonal:
        known = ", ".join(diagonal)
        raise InputError(f"--estimator {settings.estimator}: unknown; choose one of {known}")
    fixed = [f"--estimator {settings.estimator}"] if settings.estimator != "exact" else []
    fixed += ["--policy paper"] if settings.policy == "paper" else []
    if settings.train.means != "frozen" and fixed:
        message = f"{fixed[0]} has no information about means; leave out either"
        raise InputError(f"--means {settings.train.means}: {message}")
    row_named(OPTIMISERS, settings.train.optimiser, "--optimiser")
    row_named(LOSSES, settings.train.loss, "--loss")
    control = row_named(DENSITIES, settings.train.density, "--density")
    if control and (settings.train.means != "free" or settings.budget > 0):
        needs = "needs free means and all images at once; give `mgs fit --means free`"
        raise InputError(f"--density {settings.train.density}: {needs}")
    if settings.flies and settings.travel is not None:
        raise InputError(
            f"--travel {settings.travel:g}: a flight with a limit has its own travel cost; "
            "leave out --travel"
        )
    left, where = frames - settings.seeds, settings.dataset
    if left < 0:
        few = f"has {frames} frames, fewer than {settings.seeds} seeds; lower --seed-views"
        raise InputError(f"{where}: {few}")
    if settings.budget > left:
        many = f"--budget {settings.budget} exceeds its {left} candidates; lower --budget"
        raise InputError(f"{where}: {many}")
