"""What a policy may look at when a view is chosen: poses, information and surface, each measured
when it is asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mgs.policy.criteria import Array
from mgs.policy.directional import Views

Gains = Callable[[Sequence[int], Sequence[int], int, float, bool], NDArray[np.float64]]
"""(views taken, candidates, degree, tau, whether over a dome) -> the gain of each candidate [C] by
directional I-optimality, or without a dome D-optimality (`mgs.policy.directional`)."""


@dataclass(frozen=True)
class PolicyContext:
    """What is known when a view is chosen: nothing of it from a candidate's image. Views are meant
    by the index of their frame.

    positions: [V,3] camera centres of all frames, metres; like `centre` and `points`, in
    coordinates in which +Z is up.
    left: the candidates. visited: the views taken, in their order, then those chosen before in the
    same batch: no image of these was read, but they count as taken, and what they would say about
    the present model is in H and surface_H.
    centre: [3] the middle of the rock. rng: new in each step, drawn from the run's seed.
    H, lam: [M,P] information of the views taken about the model fitted so far, and [P] lambda, of
    the run.
    points: [N,3] the Gaussians on the prior's surface, before training. surface_H, prior_lam: the
    same as H and lam for these.
    information(view), surface_information(view): what one view adds to H, and to surface_H.
    estimate(view, estimator): the information of one view about the fitted model, by any row of
    `mgs.splat.ESTIMATORS`.
    seen(view): [N] squared blending weights of the surface in one view
    (`mgs.policy.directional.squared_weights`).
    dome(): a dome of poses around the rock, and what they see of the surface.
    gains(visited, left, degree, tau, over_dome): directional gains of candidates (`Gains`), fast
    where `visited` only grows.
    """

    positions: Array
    left: list[int]
    visited: list[int]
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
        """[C,3] positions of the candidates, metres."""
        return self.positions[self.left]

    @property
    def taken(self) -> Array:
        """[T,3] positions of the views taken, in the order in which they were taken, metres."""
        return self.positions[self.visited]

    def views(self, frames: list[int]) -> Views:
        """Poses of some frames, and what they see of the surface."""
        return Views(self.positions[frames], np.stack([self.seen(i) for i in frames]))


Policy = Callable[[PolicyContext], Array]
"""(context) -> score of each candidate [C], in the order of `left`."""
