"""Settings of a run, validated once. The docstring of a field is the help of its option."""

from pathlib import Path
from reprlib import repr
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, Field, ValidationError, model_validator

from mgs.errors import InputError, row_named
from mgs.files import read_json, read_toml
from mgs.fit.settings import MEAN_RATE, Frozen, ModelSettings, PoseNoise, Positive, Scale
from mgs.policy.criteria import MEAN_STD, PRIOR_STD
from mgs.run.policy_file import check_policy

ENOUGH = 0.95  # share of the gain that is enough by default (docs/certificate.md)


class FlightLimits(Frozen):
    """Limits of a flight, which starts and ends at the first view taken, and of its poses."""

    length: Scale | None = None
    """Longest flight in metres, from the first image and back to it. Default: no limit."""
    time: Scale | None = None
    """Longest flight in seconds, with `speed` and `hover`. Default: no limit."""
    speed: Scale = 2.0
    """Speed between pictures, metres per second."""
    hover: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 3.0
    """Seconds that a picture takes."""
    no_fly: Scale | None = None
    """Radius in metres of an upright cylinder around the object that the flight must not enter."""
    clearance: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    """Lowest height of a pose above the object's lowest point, metres."""

    @property
    def limits_poses(self) -> bool:
        """Whether poses may be ruled out, and not the flight alone."""
        return self.no_fly is not None or self.clearance is not None


class SearchLimits(Frozen):
    """Limits of the search for a better set than the plan, which proves how good the plan is."""

    nodes: Annotated[int, Field(ge=0)] | None = None
    """Most nodes of branch and bound. Default: 40, or about a second of them."""
    seconds: Positive | None = None
    """Most seconds; results then depend on the machine. Default: no limit."""


class Mission(Frozen):
    """Limits of a run: how many views it takes, where the camera may go, and when it ends."""

    seeds: Annotated[int, Field(ge=1)] = 4
    """Number of seed views for the first fit, spread evenly over the directions of near poses."""
    budget: Annotated[int, Field(ge=0)] = 50
    """Most views to choose beyond the seed views. Default: 50, or all candidates if fewer."""
    enough: Annotated[float, Field(gt=0, le=1)] | None = None
    """Share of the criterion's gain of all candidates, with an automatic number of views. Default:
    0.95."""
    certificate: SearchLimits = SearchLimits()
    """Limits of the search for a better set than the plan."""
    batch: Annotated[int, Field(ge=1)] = 1
    """Views to choose before the next fit; the last batch may be smaller."""
    nearest: Annotated[int, Field(ge=1)] | None = None
    """Choose among this many candidates, the nearest to the last view. Default: all."""
    travel: Scale | None = None
    """Distance that costs as much as an image; scores are divided by 1 + distance / METRES."""
    flight: FlightLimits = FlightLimits()
    """Limits of the flight and of its poses."""
    stop_gain: Positive | None = None
    """End the run if the chosen view's information gain (Eq. 7, ½ nat per parameter) is lower."""
    stop_uncertainty: Annotated[float, Field(gt=0, lt=1)] | None = None
    """End the run when at most this share (0 to 1) of the prior's variance is left."""
    stop_psnr: Annotated[float, Field(gt=0, le=80, allow_inf_nan=False)] | None = None
    """End the run when the masked PSNR of the views not taken is predicted to be this high, dB."""

    @property
    def flies(self) -> bool:
        """Whether the flight has a limit, so that views are planned as a tour."""
        return self.flight.length is not None or self.flight.time is not None


class NbvSettings(ModelSettings, Mission):
    """Everything that decides what `mgs nbv` does: equal settings choose equal views."""

    dataset: Path
    """Folder of the dataset."""
    prior: Path
    """Folder of the prior."""
    policy: str = "directional-i"
    """Policy that scores candidate views: a name, or FILE.py:FUNCTION of your own. Default from
    random points: farthest."""
    evaluate_every: Annotated[int, Field(ge=0)] = 0
    """Measure PSNR each time after this many views; 0: only at the end. Does not affect choices."""

    refine_poses: bool = False
    """Refine the poses of all views before the fit, by the images."""
    pose_noise: PoseNoise = PoseNoise()
    """Standard deviations of the poses that are refined."""

    @model_validator(mode="after")
    def _go_together(self) -> "NbvSettings":
        means, density = self.train.means, self.train.density
        fixed = [f"estimator {self.estimator}"] if self.estimator != "exact" else []
        fixed += ["policy paper"] if self.policy == "paper" else []
        if means != "frozen" and fixed:
            lacks = f"{fixed[0]} has no information about means"
            raise ValueError(f"train.means {means}: {lacks}; leave out either")
        if density != "fixed" and (means != "free" or self.budget > 0):
            needs = "needs free means and all images at once; give `mgs fit --means free`"
            raise ValueError(f"train.density {density}: {needs}")
        if self.refine_poses and self.budget > 0:
            raise ValueError("refine_poses: needs all images at once; give it to `mgs fit`")
        if self.flies and self.travel is not None:
            own = "a flight with a limit has its own travel cost; leave out `travel`"
            raise ValueError(f"travel {self.travel:g}: {own}")
        return self

    def with_spacing(self, spacing: float, loose: float = 1.0) -> "NbvSettings":
        """The settings with a rate and a prior std of learned means, from the samples' spacing, m.

        loose: factor on the default prior std of every kind. What is given stays; nothing changes
        where means are frozen."""
        if self.train.means == "frozen":
            return self
        rates = {"mean": MEAN_RATE * spacing} | self.train.rates
        train = self.train.model_copy(update={"rates": rates})
        prior_std = {"mean": loose * MEAN_STD * spacing}
        for kind, std in self.prior_std.items():
            prior_std[kind] = loose * std if std == PRIOR_STD.get(kind) else std
        return self.model_copy(update={"train": train, "prior_std": prior_std})


Model = TypeVar("Model", bound=BaseModel)


def validated(
    model: type[Model], values: dict[str, Any], file: Path | None = None, within: str = ""
) -> Model:
    """Build settings from values, or from `settings` of a file.

    within: key of these values, if they are part of other settings. Raises InputError for the first
    invalid value; it names the setting, and the file if there is one."""
    try:
        return model(**values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        message = first["msg"].removeprefix("Value error, ")
        for bound, words in BOUNDS.items():
            if bound in first.get("ctx", {}):
                message = f"must be {words} {first['ctx'][bound]:g}"
        key = ".".join([part for part in (within, *map(str, first["loc"])) if part])
        if first["type"] == "extra_forbidden":
            message = f"{key}: unknown setting; this release of mgs has no such key"
        elif first["loc"]:
            message = f"{key} = {repr(first['input'])}: {message}"
        if file is not None:
            cure = "start the run anew" if file.suffix == ".json" else "leave it out"
            message = f"{file}: {message}; correct it, or {cure}"
        raise InputError(message) from None


def settings_in(file: Path) -> dict[str, Any]:
    """Settings that a TOML file, or the config.json of a run, has; paths are from its folder.
    Raises InputError where the file cannot be read, or a key or a value is wrong."""
    if file.suffix == ".json":
        config = read_json(file)
        table = config.get("settings") if isinstance(config, dict) else None
    else:
        table = read_toml(file)
    if not isinstance(table, dict):
        raise InputError(f"{file}: has no settings; give a TOML file or the config.json of a run")
    validated(NbvSettings, {"dataset": "", "prior": "", **table}, file)
    paths = {key: file.parent / table[key] for key in ("dataset", "prior") if key in table}
    return {**table, **paths}


BOUNDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}  # pydantic's


def check_settings(settings: NbvSettings, frames: int) -> None:
    """Raises InputError for the name of an unknown policy, estimator (or one without a diagonal),
    optimiser, loss or density control, and where a dataset has too few frames."""
    from mgs.fit.density import DENSITIES  # loads Dr.Jit, as the next three
    from mgs.fit.losses import LOSSES
    from mgs.fit.optimisers import OPTIMISERS
    from mgs.splat import ESTIMATORS

    diagonal = [name for name in ESTIMATORS if name != "block"]
    check_policy(settings.policy)
    if settings.estimator not in diagonal:
        names = ", ".join(diagonal)
        raise InputError(f"estimator {settings.estimator!r}: unknown; choose one of {names}")
    row_named(OPTIMISERS, settings.train.optimiser, "train.optimiser")
    row_named(LOSSES, settings.train.loss, "train.loss")
    row_named(DENSITIES, settings.train.density, "train.density")
    count, where = frames - settings.seeds, settings.dataset
    if count < 0:
        few = f"has {frames} frames, fewer than {settings.seeds} seeds; lower `seeds`"
        raise InputError(f"{where}: {few}")
    if settings.budget > count:
        many = f"has {count} candidates, fewer than the budget of {settings.budget}; lower `budget`"
        raise InputError(f"{where}: {many}")
