"""Every command of the `mgs` program, in the order of the pipeline."""

from __future__ import annotations

from collections.abc import Callable

from mgs.commands.doctor import doctor

COMMANDS: dict[str, Callable[..., None]] = {
    "doctor": doctor,
}
