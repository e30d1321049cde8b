"""Contents of the JSON files of a run, checked when they are read. A text is no number."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveInt, ValidationError, model_validator

from mgs.errors import InputError
from mgs.files import read_text
from mgs.run.ending import RunEnd

Number = Annotated[float, Field(ge=-1e30, le=1e30)]
"""A number that can be squared and summed."""


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)


class Config(_Strict):
    """config.json. settings: those of `mgs.run.settings.NbvSettings`, checked apart."""

    settings: dict[str, Any]
    frames: list[str]
    versions: dict[str, str] = {}


class _End(_Strict):
    reason: RunEnd
    views: int
    name: str = ""
    limit: Number = 0.0
    uncertainty: Number = 0.0
    psnr: Number = 0.0
    information_gain: Number = 0.0
    metres: Number = 0.0
    given_up: int = 0


class _Point(_Strict):
    """A row of `mgs.policy.certificate.curve`."""

    views: int
    bound: Number
    plan: Number
    even: Number
    random: Number


class _Certificate(_Strict):
    """A `mgs.policy.certificate.Certificate`, with prices by name."""

    criterion: str
    views: int
    candidates: int
    share: Number
    best: Number
    fewer: Number | None
    of_all: Number
    nodes: int
    stopped: Literal["gap", "nodes", "time"]
    prices: dict[str, Number]
    curve: list[_Point] = []


class _Line(_Strict, extra="allow"):
    """A line of steps.jsonl. All other keys are numbers, as PSNR."""

    __pydantic_extra__: dict[str, Number | None]
    step: int
    images: int
    coverage: Number
    seeds: list[int] | None = None
    seed_names: list[str] = []
    frame: int | None = None
    name: str | None
    score: Number | None
    information_gain: Number | None
    uncertainty: Number = 0.0
    iterations: int = 0
    loss: Number = 0.0
    residual: Number = 0.0
    stop_reason: str = ""
    exposure: dict[str, tuple[Number, Number, Number]] = {}
    prediction: dict[str, Number] = {}
    indicators: dict[str, Number] = {}
    warnings: list[str] = []
    seconds: dict[str, Number]
    ended: _End = Field(None)  # type: ignore[assignment]  # absent, never null
    certificate: _Certificate = Field(None)  # type: ignore[assignment]


_FIT = {"iterations", "loss", "stop_reason"}  # keys of a line with a fit, which has all of them


class _Inputs(_Strict):
    """Hashes of the inputs: `files` of each frame taken by kind."""

    prior: str
    cameras: dict[str, str]
    files: dict[str, dict[str, str | None]]
    policy: str | None = None


class Record(_Strict, extra="forbid"):
    """Text in checkpoint.npz: all of a state but its arrays."""

    taken: list[int]
    steps: list[_Line]
    inputs: _Inputs
    upright: bool = False
    antialiased: bool
    linear: bool = True

    @model_validator(mode="after")
    def _agree(self) -> "Record":
        seeds = (self.steps[0].seeds or []) if self.steps else []
        lines = self.steps[1:]
        if self.taken != [*seeds, *(line.frame for line in lines)] or not seeds:
            raise ValueError("its frames are not those of its steps")
        for step, line in enumerate(self.steps):
            if (line.step, line.images) != (step, len(seeds) + step):
                raise ValueError(f"step {step} has the number {line.step}, {line.images} images")
            if 0 < len(_FIT & line.model_fields_set) < len(_FIT):
                raise ValueError(f"step {step} has a part of its fit")
            keys = {"fitted"} | ({"new", "gain"} if step else set())
            if line.prediction and not keys <= line.prediction.keys():
                raise ValueError(f"the prediction of step {step} has not all its numbers")
        if any(line.information_gain is None for line in lines):
            raise ValueError("a chosen view has no information gain")
        return self


class _View(_Strict, extra="allow"):
    __pydantic_extra__: dict[str, Number | None]
    name: str
    trained: bool
    psnr: Number | None
    ssim: Number | None


class Metrics(_Strict):
    """metrics.json (`mgs.evaluation.evaluate_model`, `mgs.reports.evaluation.evaluate_run`)."""

    images: PositiveInt
    all: dict[str, Number | None]
    held_out: dict[str, Number | None]
    views: list[_View]
    test: dict[str, Number | None] = {}
    test_views: list[_View] = []
    pictures: bool = True
    of: str = ""


def parse_record(model: type[BaseModel], text: str) -> dict[str, Any]:
    """Parse JSON of a model. Raises ValueError if it is not of this model."""
    try:
        model.model_validate_json(text)
        return dict(json.loads(text))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = [str(part) for part in first["loc"]]
        raise ValueError(": ".join([".".join(where)] * bool(where) + [first["msg"]])) from None
    except RecursionError:
        raise ValueError("nested too deeply") from None


def read_checked(model: type[BaseModel], path: Path, cure: str) -> dict[str, Any]:
    """Read a JSON file. Raises InputError with the cure if it is missing or not of this model."""
    text = read_text(path)
    try:
        return parse_record(model, text)
    except ValueError as error:
        raise InputError(f"{path}: is damaged ({error}); {cure}") from None
