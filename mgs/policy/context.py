"""`PolicyContext`: the data that a policy may use to score candidate views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mgs.policy.criteria import Array
from mgs.policy.directional import Views

Gains = Callable[[Sequence[int], Sequence[int], int, float, bool], NDArray[np.float64]]
"""(frames taken, candidate frames, SH degree, tau, over_dome) -> gain of each candidate [C]:
directional I-optimality if over_dome, else D-optimality (`mgs.policy.directional`)."""


@dataclass(frozen=True)
class PolicyContext:
    """Data for the choice of a view. Candidates' images are not part of it.

    Views are given by the index of their frame. Positions are in metres, with +Z up. In a batch,
    the views chosen before count as taken: H and surface_H include their information.

    positions: camera centres of all frames [V,3].
    candidate_frames: frames to score.
    taken_frames: frames taken, in order.
    centre: middle of the rock [3].
    rng: random generator, new in each step, derived from the run's seed.
    H: information of the views taken, about the model fitted so far [M,P].
    lam: lambda of the run [P].
    points: means of the Gaussians on the prior's surface, before training [N,3].
    surface_H, prior_lam: H and lam for these Gaussians.
    information(frame), surface_information(frame): contribution of one view to H, to surface_H.
    estimate(frame, estimator): information of one view by a row of `mgs.splat.ESTIMATORS`.
    seen(frame): squared blending weights of the surface's Gaussians in one view [N]
        (`mgs.policy.directional.squared_weights`).
    dome(): poses on a dome around the rock, and what they see of the surface.
    gains: directional gains of candidates (`Gains`). Fast while views are only added.
    """

    positions: Array
    candidate_frames: list[int]
    taken_frames: list[int]
    centre: Array
    rng: np.random.Generator
    H: Array
    lam: Array
    points: Array
    surface_H: Array
    prior_lam: Array
    information: Callable[[int], Array]
    surface_information: Callable[[int], Array]
    estimate: Callable[[int, str], Array]
    seen: Callable[[int], Array]
    dome: Callable[[], Views]
    gains: Gains

    @property
    def candidates(self) -> Array:
        """Camera centres of the candidates [C,3], metres."""
        return self.positions[self.candidate_frames]

    @property
    def taken(self) -> Array:
        """Camera centres of the views taken [T,3], in order, metres."""
        return self.positions[self.taken_frames]

    def views(self, frames: list[int]) -> Views:
        """Poses of some frames, and what they see of the surface."""
        return Views(self.positions[frames], np.stack([self.seen(i) for i in frames]))


Policy = Callable[[PolicyContext], Array]
"""(context) -> score of each candidate [C], in the order of `candidate_frames`."""
