"""Policies: objects that score candidate views of a scene, given the views taken.

A policy is called as policy(scene, state, views) and returns the score of each view [C], without
reading its image. In a batch, the views chosen before count as taken: H and surface include their
information. It has

- name: of the policy in files and messages.
- needs_fit: whether scores depend on the fitted model, so that a choice needs a fit before it.

and may have

- geometric: true if it ignores how much a view tells; a view of small gain then says nothing of the
  others.
- plan(scene, state, views, count, nearest): the views to choose from, those of a plan of at most
  `count` of `views`; with `nearest`, each among so many nearest to the one before.
- tour_gains(scene, state): gains by which a flight is planned (`PoolGains`), if any.
- relaxation(scene, state, views): criterion with upper bounds of plans.

To add one, write a class and a row of POLICIES, or a file of your own (docs/howto/policy.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from mgs.colour import SH_C0
from mgs.errors import InputError
from mgs.policy import criteria, poses
from mgs.policy import relaxation as relaxed
from mgs.policy.criteria import Array
from mgs.policy.relaxation import Relaxation
from mgs.policy.visibility import FEW
from mgs.progress import Stage, report

if TYPE_CHECKING:
    from mgs.policy.pool_gains import PoolGains
    from mgs.scene import Scene, State


class Policy(Protocol):
    """Interface that the loop needs; the module's docstring lists optional attributes."""

    @property
    def name(self) -> str: ...
    @property
    def needs_fit(self) -> bool: ...
    def __call__(self, scene: Scene, state: State, views: list[int]) -> Any: ...


def each(views: Sequence[int], score: Callable[[int], float]) -> np.ndarray:
    """Score of each view [C], with progress."""
    scores = np.empty(len(views))
    for done, view in enumerate(views):
        report(Stage.SCORE, done, len(views))
        scores[done] = score(view)
    return scores


@dataclass(frozen=True)
class Information:
    """A criterion of information at the model so far: criterion(F, H, lam) -> score of a view.

    F: information of the view [N,P]. H: of the views taken [N,P]. lam: lambda [P]."""

    name: str
    criterion: criteria.Score
    needs_fit: ClassVar[bool] = True

    def __call__(self, scene: Scene, state: State, views: list[int]) -> np.ndarray:
        F, H, lam = scene.information, state.H, scene.lam
        return each(views, lambda i: self.criterion(F(state, i), H, lam))


@dataclass(frozen=True)
class DOptimal(Information):
    """The paper's Eq. 7 with exact information (`criteria.d_optimal`)."""

    name: str = "d-optimal"
    criterion: criteria.Score = criteria.d_optimal

    def relaxation(self, scene: Scene, state: State, views: Sequence[int]) -> Relaxation:
        """Eq. 7 of these views, at the model so far."""
        F = np.stack([scene.information(state, i) for i in views])
        return relaxed.d_optimal(F, state.H, scene.lam)


def AOptimal() -> Information:
    """Decrease of the average variance (`criteria.a_optimal`)."""
    return Information("a-optimal", criteria.a_optimal)


def FisherRF() -> Information:
    """FisherRF's trace criterion (`criteria.fisherrf`)."""
    return Information("fisherrf", criteria.fisherrf)


@dataclass(frozen=True)
class Paper:
    """Eq. 7 as the paper has it: squared gradients of one scalar loss per image (`loss-gradient`),
    and one lambda: the mean squared gradient of one view taken. The paper states neither; the gain
    of the first choice is then near its 0.091 (Fig. 2; docs/nbv.md)."""

    name: ClassVar[str] = "paper"
    needs_fit: ClassVar[bool] = True

    def __call__(self, scene: Scene, state: State, views: list[int]) -> np.ndarray:
        def F(view: int) -> Array:
            return scene.information(state, view, "loss-gradient")

        first, *others = state.taken
        H = np.array(F(first), np.float64)
        for view in others:
            H += F(view)
        lam = np.full_like(scene.lam, H.mean(dtype=np.float64) / len(state.taken))
        return each(views, lambda i: criteria.d_optimal(F(i), H, lam))


@dataclass(frozen=True)
class Coverage:
    """Number of Gaussians of the surface newly observed (`criteria.coverage_greedy`)."""

    name: ClassVar[str] = "coverage"
    needs_fit: ClassVar[bool] = False

    def __call__(self, scene: Scene, state: State, views: list[int]) -> np.ndarray:
        F, H, lam = scene.surface(state).colours, state.surface[:, :3], scene.surface_lam[:3]
        return each(views, lambda i: criteria.coverage_greedy(F(i), H, lam))

    def relaxation(self, scene: Scene, state: State, views: Sequence[int]) -> relaxed.Coverage:
        surface, lam = scene.surface(state), scene.surface_lam
        rest = ~criteria.observed(state.surface, lam)
        F = np.stack([surface.colours(i)[rest] for i in views])
        return relaxed.Coverage(F, state.surface[rest, :3], lam[:3])


@dataclass(frozen=True)
class Cover:
    """COVER ("Coverage Optimization for Camera View Selection", 2026): new viewing directions.

    For each Gaussian (1 - cos)/2 of the angle between the candidate's direction and the nearest one
    from which it was observed, or 1 if it never was; then the mean over the candidate's view,
    weighted by squared blending weights, 0 to 1. The paper counts all Gaussians in the frustum,
    hidden or not, and rounds directions to bins."""

    name: ClassVar[str] = "cover"
    needs_fit: ClassVar[bool] = False
    geometric: ClassVar[bool] = True

    def __call__(self, scene: Scene, state: State, views: list[int]) -> np.ndarray:
        surface, least = scene.surface(state), scene.surface_lam[0] / SH_C0**2
        taken = [(surface.positions[i], surface.seen(i) > least) for i in state.taken]

        def score(view: int) -> float:
            weights = surface.seen(view)
            some = np.flatnonzero(weights)
            points, weights = surface.points[some], weights[some]
            here, apart = _directions(points, surface.positions[view]), np.ones(len(some))
            for position, observed in taken:
                angle = (1 - (here * _directions(points, position)).sum(1)) / 2
                apart = np.where(observed[some], np.minimum(apart, angle), apart)
            return float((apart * weights).sum() / max(weights.sum(), 1e-12))

        return each(views, score)


def _directions(points: Array, position: Array) -> Array:
    """Unit vectors from a camera to points [N,3]."""
    offset = points - position
    return np.asarray(offset / np.linalg.norm(offset, axis=1, keepdims=True))


@dataclass(frozen=True)
class Poses:
    """A rule about camera positions: rule(candidates [C,3], taken [T,3], centre [3]) -> scores [C].
    Positions are metres, +Z up."""

    name: str
    rule: Callable[[Array, Array, Array], Array]
    needs_fit: ClassVar[bool] = False
    geometric: ClassVar[bool] = True

    def __call__(self, scene: Scene, state: State, views: list[int]) -> np.ndarray:
        positions = scene.positions(state.frames)
        return self.rule(positions[views], positions[list(state.taken)], scene.centre)


def Uniform() -> Poses:
    """The most even azimuths (`poses.uniform_azimuth`)."""
    return Poses("uniform", poses.uniform_azimuth)


def Farthest() -> Poses:
    """The pose farthest from those taken (`poses.farthest_pose`)."""
    return Poses("farthest", poses.farthest_pose)


@dataclass(frozen=True)
class Random:
    """A random number for each view."""

    name: ClassVar[str] = "random"
    needs_fit: ClassVar[bool] = False
    geometric: ClassVar[bool] = True

    def __call__(self, scene: Scene, state: State, views: list[int]) -> np.ndarray:
        return scene.rng(state, self.name).random(len(views))


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
        return scene.plan_surface(state).gains(state.taken, views, self.model)

    def plan(
        self, scene: Scene, state: State, views: list[int], count: int, nearest: int | None
    ) -> Sequence[int]:
        """Rest of the plan made after the seeds. If a view outside it was taken, a new plan is made
        after all views taken."""
        surface = scene.plan_surface(state)
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
        return scene.plan_surface(state).plan_gains(self.tour, FEW)

    def relaxation(self, scene: Scene, state: State, views: Sequence[int]) -> Relaxation:
        surface = scene.plan_surface(state)
        relaxed.check_seen(surface.pool.of(views).seen)
        return surface.relaxation(state.taken, views, self.model)


DIRECTIONAL_D = Directional(degree=1, tau=0.3, over_dome=False)
"""Directional D-optimality. Chosen on five rocks that judge nothing."""


POLICIES: dict[str, Policy] = {
    policy.name: policy
    for policy in (
        Directional(),
        DIRECTIONAL_D,
        Paper(),
        DOptimal(),
        AOptimal(),
        FisherRF(),
        Coverage(),
        Cover(),
        Uniform(),
        Farthest(),
        Random(),
    )
}
"""Policies that `mgs nbv` knows by name; the first is the default."""


def policy_named(name: str) -> Policy:
    if name not in POLICIES:
        names = ", ".join(POLICIES)
        raise InputError(f"policy {name}: unknown; choose one of {names}, or FILE.py:NAME")
    return POLICIES[name]
