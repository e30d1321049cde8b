"""State of a run after a step, as the run folder holds it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mgs.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """State of a run after a step, as the run folder holds it.

    gaussians, H, surface, taken: as `mgs.scene.State`. steps: lines of steps.jsonl. inputs: hashes
    of the inputs (`mgs.run.inputs`). upright: whether the model's world has +Z up.
    """

    gaussians: Gaussians
    H: np.ndarray
    surface: np.ndarray
    taken: list[int]
    steps: list[dict[str, Any]] = field(default_factory=list)
    inputs: dict[str, Any] = field(default_factory=dict)
    upright: bool = True
