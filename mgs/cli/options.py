"""Values of options that several commands share."""

from __future__ import annotations

from typing import Literal

from mgs.errors import InputError


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
        return int(text)
    except ValueError:
        raise InputError(f"--gaussians {text!r}: expected a whole number, or auto") from None
