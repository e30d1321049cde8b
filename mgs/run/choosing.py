"""Choose the next view: rank candidates by a policy, or plan a flight over some."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mgs.errors import InputError
from mgs.learning import with_view
from mgs.policy import poses, tour
from mgs.progress import Stage, report
from mgs.run.flight import flight_of, free, reachable, views_left
from mgs.run.policies import Policy
from mgs.run.policy_file import policy_of
from mgs.run.settings import Mission
from mgs.scene import Scene, State


def choose(
    scene: Scene, state: State, policy: Any, mission: Mission = Mission()
) -> tuple[int, float]:
    """Choose the next view: (its index, its score), of the largest score / travel cost in reach.

    Of equal views, the one farthest from those taken is chosen. A policy with a `plan` chooses
    among the views of its plan. If the flight has a limit, the result is the first stop of
    `plan_flight`.

    policy: a name, an object, or a function (docs/howto/policy.md). Raises InputError if it returns
    no valid score, or no view is in reach."""
    policy = policy_of(policy)
    if not (views := reachable(scene, state, mission)):
        raise InputError(f"{scene.dataset.root}: no view is left to choose; end the loop before")
    if mission.flies:
        return next(plan_flight(scene, state, policy, mission))
    cost: np.ndarray | None = None
    plan = getattr(policy, "plan", None)
    if mission.travel is not None:
        positions = scene.positions(state.frames)
        here = positions[state.taken[-1]]
        cost = poses.travel_cost(positions[views], here, mission.travel)
    elif plan is not None:
        count = views_left(state, mission)
        planned = plan(scene, state, free(scene, state, mission), count, mission.nearest)
        views = [i for i in views if i in planned] or views
    return rated(scene, state, policy, views, cost)[0]


def rated(
    scene: Scene,
    state: State,
    policy: Policy,
    views: list[int],
    cost: np.ndarray | float | None = None,
) -> list[tuple[int, float]]:
    """(view, score) by falling score / cost [C]; of equals, the farthest from the views taken comes
    first. Raises InputError as `choose`."""
    report(Stage.SCORE, 0, len(views))
    where, returned = f"policy {policy.name}: returned", policy(scene, state, views)
    try:
        if np.iscomplexobj(returned):  # which NumPy would cut
            raise TypeError("they are complex")
        scores = np.asarray(returned, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where} no numbers ({error}); return one for each candidate") from None
    if scores.shape != (len(views),):
        wrong = f"scores of shape {scores.shape} for {len(views)} candidates"
        raise InputError(f"{where} {wrong}; return one number for each")
    positions = scene.positions(state.frames)
    farthest = poses.farthest_pose(positions[views], positions[list(state.taken)], scene.centre)
    weighed = scores / (1.0 if cost is None else cost)
    order = sorted(range(len(scores)), key=lambda k: (weighed[k], farthest[k]), reverse=True)
    best = order[0]
    if np.isnan(scores).any() or np.isinf(scores[best]):
        raise InputError(f"{where} a score that is NaN or infinite (docs/howto/policy.md)")
    if cost is not None and scores[best] < 0:
        raise InputError(f"{where} negative scores, which a travel cost cannot divide")
    return [(views[k], float(scores[k])) for k in order]


def plan_flight(
    scene: Scene, state: State, policy: Policy, mission: Mission
) -> Iterator[tuple[int, float]]:
    """Views of the rest of the flight in flying order, each with its score.

    With a policy that has `tour_gains` it is the rest of `planned_flight`, and scores are those
    after the views before. Otherwise the tour is `grown` by the view of largest score / cost, as if
    those before it were taken, and scores are those at that time. The cost is the share of the
    limits that a view adds, and its share of the views that the budget has left."""
    if plan := planned_flight(scene, state, policy, mission):
        for k, view in enumerate(plan):
            before = replace(state, taken=(*state.taken, *plan[:k]))
            yield rated(scene, before, policy, [view])[0]
        return
    planned, scores = state, dict[int, float]()

    def pick(views: list[int], cost: np.ndarray) -> tuple[int, float]:
        nonlocal planned
        view, score = rated(scene, planned, policy, views, cost)[0]
        scores[view] = score
        planned = with_view(scene, planned, view, scene.information(planned, view))
        return view, score

    flight, most = flight_of(scene, state, mission), views_left(state, mission)
    share = flight.share_from(state.taken, most)
    ends, stops = [state.taken[-1], flight.home], reachable(scene, state, mission)
    way, _ = tour.grown(flight.legs, ends, stops, pick, share, 1 / most)
    yield from ((view, scores[view]) for view in way[1:-1])


def planned_flight(scene: Scene, state: State, policy: Policy, mission: Mission) -> Sequence[int]:
    """Rest of the tour that a policy with `tour_gains` plans after the seeds; empty for others. If
    another view was taken than the next one of the plan, a new plan is made after all views
    taken."""
    tour_gains = getattr(policy, "tour_gains", None)
    if tour_gains is None or mission.nearest is not None:
        return []
    flight = flight_of(scene, state, mission)
    for count in (state.seeds, len(state.taken)):
        start, past = state.taken[:count], list(state.taken[count:])
        before = replace(state, taken=start)
        stops, most = tuple(reachable(scene, before, mission)), views_left(before, mission)
        task = id(policy), most, start, stops
        if task not in flight.tours:
            gains = tour_gains(scene, state)
            if gains is None:
                return []
            report("planning the flight", 0, 1)
            gains.take(start)
            ends, share = [start[-1], flight.home], flight.share_from(start, most)
            way = tour.planned_tour(flight.legs, ends, stops, gains, share, 1 / most)
            flight.tours[task] = policy, way[1:-1]
        _, plan = flight.tours[task]
        if plan[: len(past)] == past and plan[len(past) :]:
            return plan[len(past) :]
    return []
