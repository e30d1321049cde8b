"""Check of the lines of steps.jsonl, which may come from a stranger."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict

from mgs.run.ending import RunEnd


class _Checked(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False)


class _Ended(_Checked):
    reason: RunEnd
    views: int
    name: str = ""
    limit: float = 0.0
    uncertainty: float = 0.0
    information_gain: float = 0.0
    metres: float = 0.0


class _Line(_Checked):
    """Keys of every line, and the types of optional ones."""

    images: int
    coverage: float
    ended: _Ended | None = None
    step: int = 0
    name: str | None = None
    warnings: list[str] = []
    seconds: dict[str, float] = {}
    exposure: dict[str, list[float]] | None = None


class _SeedLine(_Line):
    """The first line, which is about the seeds."""

    seeds: list[int]


class _ChoiceLine(_Line):
    """Any other line, which is about one chosen view."""

    frame: int
    information_gain: float


def check_line(number: int, line: Any) -> None:
    """Raises ValueError (pydantic's ValidationError) where a line, counted from 1, is damaged."""
    (_SeedLine if number == 1 else _ChoiceLine).model_validate(line)


def frames_of(lines: Sequence[dict[str, Any]]) -> list[int]:
    """Indices of the frames taken, by checked lines: seeds, then chosen ones."""
    return [*lines[0]["seeds"], *(int(line["frame"]) for line in lines[1:])]
