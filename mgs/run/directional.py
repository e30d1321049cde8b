"""The default policy, directional optimality (`mgs.policy.directional`), which plans all views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from mgs.policy import relaxation as relaxed
from mgs.policy.relaxation import Relaxation
from mgs.policy.visibility import FEW

if TYPE_CHECKING:
    from mgs.policy.pool_gains import PoolGains
    from mgs.scene import Scene, State


@dataclass(frozen=True)
class Directional:
    """Directional optimality: information about colour in all directions, D or I.

    degree: of the spherical harmonics. tau: share of the prior's standard deviation that degrees
    above 0 have. over_dome: I-optimality over a dome of poses; else D-optimality, nats. tour: the
    same three for the plan of a flight. Defaults were chosen on rocks that judge nothing."""

    degree: int = 2
    tau: float = 0.2
    over_dome: bool = True
    tour: tuple[int, float, bool] = (1, 0.1, True)
    needs_fit: ClassVar[bool] = False

    @property
    def name(self) -> str:
        return "directional-i" if self.over_dome else "directional-d"

    @property
    def model(self) -> tuple[int, float, bool]:
        return self.degree, self.tau, self.over_dome

    def __call__(self, scene: Scene, state: State, views: list[int]) -> np.ndarray:
        return scene.surface(state).gains(state.taken, views, *self.model)

    def plan(
        self, scene: Scene, state: State, views: list[int], count: int, nearest: int | None
    ) -> Sequence[int]:
        """Rest of the plan made after the seeds. If a view outside it was taken, a new plan is made
        after all views taken."""
        surface = scene.surface(state)
        for first in (state.seeds, len(state.taken)):
            start, past = state.taken[:first], list(state.taken[first:])
            task = start, tuple(sorted({*views, *past})), count + len(past)
            if nearest is not None:
                path = surface.path(*task, nearest, self.model)
                if path[: len(past)] == past and path[len(past) :]:
                    return path[len(past) : len(past) + 1]
            else:
                plan = surface.planned(*task, self.model)
                if set(past) <= set(plan) and set(plan) - set(past):
                    return plan
        return views

    def tour_gains(self, scene: Scene, state: State) -> PoolGains | None:
        """Gains by which a flight is planned, for some of the Gaussians."""
        return scene.surface(state).plan_gains(self.tour, FEW)

    def relaxation(self, scene: Scene, state: State, views: Sequence[int]) -> Relaxation:
        surface = scene.surface(state)
        taken, others = surface.pool.of(state.taken), surface.pool.of(views)
        dome = surface.dome if self.over_dome else None
        lam, degree, tau = surface.lam, self.degree, self.tau
        return relaxed.directional(surface.points, lam, degree, tau, taken, others, dome)


DIRECTIONAL_D = Directional(degree=1, tau=0.3, over_dome=False)
"""Directional D-optimality. Chosen on five rocks that judge nothing."""
