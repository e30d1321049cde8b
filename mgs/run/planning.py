"""Rank candidates by a policy, and plan a flight over some, before any of their images is read."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mgs.errors import InputError
from mgs.policy import poses, tour
from mgs.policy.context import PolicyContext
from mgs.run.problem import Problem
from mgs.run.state import Fitted

ROUNDING = 1e-9
"""Share of the limits: a stop in reach fits, though its metres are summed in another order."""


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
    scores = np.asarray(problem.policy(context), np.float64)
    farthest = poses.farthest_pose(context.candidates, context.taken, context.centre, context.rng)
    where = f"policy {problem.settings.policy}: returned"
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
        option = "--travel" if problem.settings.travel is not None else "--flight-length"
        raise InputError(f"{where} negative scores, which {option} cannot divide; leave it out")
    return [(context.candidate_frames[k], float(scores[k])) for k in order]


def plan_flight(
    problem: Problem, state: Fitted, fisher: Callable[[int], np.ndarray]
) -> list[tuple[int, float]]:
    """Views of the rest of the flight in flying order, each with its score when it was planned.

    Cost-benefit greedy: the view of largest score / cost joins the tour at its cheapest place, and
    2-opt shortens the tour. Then the next one, as if it were taken, until none fits. The cost is
    the share of the limits that a view adds, and its share of the views that the budget has left.
    """
    flight, settings = problem.flight, problem.settings
    pool, way = problem.reachable(state.taken), [state.taken[-1], flight.home]
    most = settings.budget - (len(state.taken) - settings.seeds)
    before, pictures = flight.flown(state.taken), len(state.taken) - flight.skipped
    planned, scores = state, dict[int, float]()
    while pool and len(scores) < most:
        metres, count = before + tour.tour_length(flight.legs, way), pictures + len(scores)
        added, places = tour.insertions(flight.legs, way, pool)
        shares = flight.share(metres + added, count + 1)
        fits = [k for k in range(len(pool)) if shares[k] <= 1 + ROUNDING]
        if not fits:
            break
        context = problem.context(planned, [pool[k] for k in fits], fisher)
        cost = shares[fits] - flight.share(metres, count) + 1 / most
        frame, score = rated(problem, context, cost)[0]
        scores[frame] = score
        way.insert(int(places[pool.index(frame)]), frame)
        way = tour.two_opt(flight.legs, way)
        pool.remove(frame)
        if pool and len(scores) < most:
            planned = with_view(problem, planned, frame, fisher(frame))
    return [(frame, scores[frame]) for frame in way[1:-1]]
