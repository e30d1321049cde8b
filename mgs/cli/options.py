"""Options, and values of options, that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from mgs.errors import InputError


def option(text: str, *flags: str, **more: Any) -> Any:
    """A `typer.Option` with this help."""
    return typer.Option(*flags, help=text, **more)


def argument(text: str, **more: Any) -> Any:
    """A `typer.Argument` with this help."""
    return typer.Argument(help=text, **more)


Runs = Annotated[list[Path], argument("Folders that `mgs nbv` wrote.", metavar="RUN...")]
DatasetFolder = Annotated[Path, argument("Dataset folder (transforms.json).")]
Seed = Annotated[
    int,
    option(
        "Seed of all random draws: the same seed gives the same result.", "--random-seed", min=0
    ),
]
Force = Annotated[bool, option("Replace an existing output.", "--force")]


def parse_up(text: str) -> tuple[float, float, float] | None:
    """Unit vector of an option like 0,0,1; None for auto. Raises InputError for anything else."""
    from mgs.data.up import unit_up

    if text == "auto":
        return None
    try:
        return unit_up([float(part) for part in text.split(",")])
    except (ValueError, InputError):
        raise InputError(
            f"--up {text!r}: expected auto, or three numbers X,Y,Z that are not all zero, "
            "as in 0,0,1"
        ) from None


def parse_gaussians(text: str | None) -> int | Literal["auto"] | None:
    """Number of an option --gaussians, or auto. Raises InputError for anything else."""
    if text is None:
        return None
    if text == "auto":
        return "auto"
    try:
        count = int(text)
    except ValueError:
        raise InputError(f"--gaussians {text!r}: expected a whole number, or auto") from None
    if count < 1:
        raise InputError(f"--gaussians {count}: must be at least 1, or auto")
    return count
