"""Every command of the `mgs` program, in the order of the pipeline."""

from __future__ import annotations

from collections.abc import Callable

COMMANDS: dict[str, Callable[..., None]] = {}
