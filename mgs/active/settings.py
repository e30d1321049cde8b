"""Settings of a run: validated once, frozen, and written whole beside the results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from mgs.active.criteria import PIXEL_NOISE, PRIOR_STD
from mgs.errors import InputError


class NbvSettings(BaseModel):
    """Everything that decides what `mgs nbv` does; the same settings give the same choice of views."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset: Path
    prior: Path
    policy: str = "d-optimal"
    """A row of `mgs.active.criteria`, looked up when the loop starts: a finished run is read without it."""
    budget: Annotated[int, Field(ge=0)] = 50
    """Views chosen beyond the seeds."""
    seeds: Annotated[int, Field(ge=1)] = 4
    """Views at evenly spaced azimuths that start the model."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Root of every random draw."""
    pixel_noise: Annotated[float, Field(gt=0, allow_inf_nan=False)] = PIXEL_NOISE
    """sigma_e in lambda = (sigma_e / tau)^2, linear RGB; `mgs.active.criteria.regularisation`."""
    prior_std: dict[str, Annotated[float, Field(gt=0, allow_inf_nan=False)]] = PRIOR_STD
    """tau of each kind of parameter: those of `mgs.active.criteria.PRIOR_STD`."""
    evaluate_every: Annotated[int, Field(ge=0)] = 0
    """Measure PSNR on all views after every so many steps; 0 = only at the end. Never feeds back into the choice."""
    warm_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.3
    """Learning rates of the fits after the first, over those of the first: they start from a model that has converged on all
    but one image, so less is left to move. A chosen constant."""
    train: dict[str, Any] = {}
    """Fields of `mgs.active.fitting.TrainSettings`; those left out take its defaults."""

    @field_validator("prior_std")
    @classmethod
    def _every_kind(cls, given: dict[str, float]) -> dict[str, float]:
        if given.keys() != PRIOR_STD.keys():
            raise ValueError(f"must have a number for each of {', '.join(PRIOR_STD)}, and no other")
        return given


Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], values: dict[str, Any], file: Path | None = None) -> Model:
    """Build settings, from the options of a command or from `settings` of a file. Raises InputError with one line for the first
    value that is wrong, which names the option, or the file and the key."""
    try:
        return model(**values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        parts, message = [str(part) for part in first["loc"]], first["msg"].removeprefix("Value error, ")
        if file is not None:
            key = ".".join(["settings", *parts])
            raise InputError(f"{file}: {key}: {message}; correct it, or start the run anew") from None
        option = "--" + "-".join(parts).replace("_", "-")
        raise InputError(f"{option} {first['input']}: {message}") from None
