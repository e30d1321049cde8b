"""Plain data of the loop: what is known after a choice, after a fit, and in a run folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.gaussians import Gaussians

if TYPE_CHECKING:
    from mgs.fit.fitting import Fit


@dataclass(frozen=True)
class Choice:
    """A chosen view.

    frame: its index. score: the policy's own number. information_gain: Eq. 7 of this view by the
    run's estimator, whatever the policy. coverage: Eq. 9 of all views taken with this one, 0 to 1.
    """

    frame: int
    score: float
    information_gain: float
    coverage: float


@dataclass
class Fitted:
    """The model after a fit, and the Fisher information of the views taken.

    - gaussians: the model.
    - H: [N,P] information of the views taken, at that model (diagonal of J^T J).
    - surface: [S,P] their exact information about the S Gaussians on the prior's surface, as they
      were before training; it has no columns of means.
    - taken: frame indices in the order of their choice.
    """

    gaussians: Gaussians
    H: np.ndarray
    surface: np.ndarray
    taken: list[int]


@dataclass
class Learned(Fitted):
    """A `Fitted` state as `select_views` gives it, with how it was reached.

    fit: the fit that found the model. gains [V,3]: exposure of the views taken, if it is estimated.
    before: the model before these views, None after the seeds. choices: the views chosen since.
    """

    fit: Fit
    gains: np.ndarray | None = None
    before: Gaussians | None = None
    choices: list[Choice] = field(default_factory=list)


@dataclass
class State(Fitted):
    """State of a run after a step, as the run folder holds it.

    gaussians, H, surface, taken: as `Fitted`. steps: lines of steps.jsonl. inputs: hashes of the
    inputs (`mgs.run.inputs`).
    """

    steps: list[dict[str, Any]] = field(default_factory=list)
    inputs: dict[str, Any] = field(default_factory=dict)
