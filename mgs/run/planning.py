"""Rank candidates by a policy, and plan a flight over some, before any of their images is read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from mgs.errors import InputError
from mgs.policy import poses, tour
from mgs.policy.context import PolicyContext
from mgs.policy.registry import FLOWN, PLANNED
from mgs.policy.visibility import FEW
from mgs.run.problem import Problem
from mgs.run.state import Fitted


def surface_information(
    problem: Problem, new: Sequence[int], before: Fitted | None = None
) -> np.ndarray:
    """`Fitted.surface` after new views; it depends on poses and the prior alone."""
    if before is None:
        return np.zeros((problem.on_surface, len(problem.prior_lam))) + sum(
            problem.surface_information(i) for i in new
        )
    surface = before.surface
    for i in new:
        surface = surface + problem.surface_information(i)
    return surface


def with_view(problem: Problem, state: Fitted, frame: int, F: np.ndarray) -> Fitted:
    """The state as if a view were taken, its model unchanged. F: its information [N,P]."""
    surface = surface_information(problem, [frame], state)
    return Fitted(state.gaussians, state.H + F, surface, [*state.taken, frame])


def rated(
    problem: Problem, context: PolicyContext, cost: np.ndarray | float = 1.0
) -> list[tuple[int, float]]:
    """(frame, score) of the candidates by falling score / cost [C]; of equals, the farthest from
    the views taken comes first. Raises InputError as `choose`."""
    where = f"policy {problem.settings.policy}: returned"
    returned = problem.policy(context)
    try:
        scores = np.asarray(returned, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} no numbers ({error}); return one for each candidate") from None
    farthest = poses.farthest_pose(context.candidates, context.taken, context.centre, context.rng)
    if scores.shape != (len(context.candidate_frames),):
        raise InputError(
            f"{where} scores of shape {scores.shape} for {len(context.candidate_frames)} "
            "candidates; return one number for each"
        )
    weighed = scores / cost
    order = sorted(range(len(scores)), key=lambda k: (weighed[k], farthest[k]), reverse=True)
    best = order[0]
    if np.isnan(scores).any() or np.isinf(scores[best]):
        raise InputError(f"{where} a score that is NaN or infinite (docs/howto/policy.md)")
    if (problem.settings.travel is not None or problem.settings.flies) and scores[best] < 0:
        option = "travel" if problem.settings.travel is not None else "flight.length"
        raise InputError(f"{where} negative scores, which `{option}` cannot divide; leave it out")
    return [(context.candidate_frames[k], float(scores[k])) for k in order]


def plan_flight(
    problem: Problem, state: Fitted, fisher: Callable[[int], np.ndarray]
) -> Iterator[tuple[int, float]]:
    """Views of the rest of the flight in flying order, each with its score.

    With a policy of PLANNED it is the rest of `planned_flight`, and scores are those after the
    views before. Otherwise the tour is `grown` by the view of largest score / cost, as if those
    before it were taken, and scores are those at that time. The cost is the share of the limits
    that a view adds, and its share of the views that the budget has left.
    """
    if plan := planned_flight(problem, state.taken):
        for k, frame in enumerate(plan):
            before = replace(state, taken=[*state.taken, *plan[:k]])
            yield rated(problem, problem.context(before, [frame], fisher))[0]
        return
    planned, scores = state, dict[int, float]()

    def pick(frames: list[int], cost: np.ndarray) -> tuple[int, float]:
        nonlocal planned
        frame, score = rated(problem, problem.context(planned, frames, fisher), cost)[0]
        planned, scores[frame] = with_view(problem, planned, frame, fisher(frame)), score
        return frame, score

    most, ends = problem.views_left(state.taken), [state.taken[-1], problem.flight.home]
    share = problem.flight.share_from(state.taken, most)
    free = problem.reachable(state.taken)
    way, _ = tour.grown(problem.flight.legs, ends, free, pick, share, 1 / most)
    yield from ((frame, scores[frame]) for frame in way[1:-1])


def planned_flight(problem: Problem, taken: Sequence[int]) -> list[int]:
    """Rest of the tour that a policy of PLANNED plans after the seeds; empty for other policies.

    If another view was taken than the next one of the plan, a new plan is made after all views
    taken.
    """
    settings, flight = problem.settings, problem.flight
    if settings.policy not in PLANNED or settings.nearest is not None:
        return []
    for start in (taken[: settings.seeds], taken):
        key = tuple(start), tuple(problem.reachable(start))
        if key not in flight.tours:
            gains = problem.visibility.plan_gains(FLOWN, FEW)
            if gains is None:
                return []
            problem.progress("planning the flight", 0, 1)
            gains.take(start)
            most = problem.views_left(start)
            ends, share = [start[-1], flight.home], flight.share_from(start, most)
            way = tour.planned_tour(flight.legs, ends, key[1], gains, share, 1 / most)
            flight.tours[key] = way[1:-1]
        plan, done = flight.tours[key], list(taken[len(start) :])
        if plan[: len(done)] == done and plan[len(done) :]:
            return plan[len(done) :]
    return []
