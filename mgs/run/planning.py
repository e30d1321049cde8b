"""Rank candidates by a policy, and plan a flight over some, before any of their images is read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mgs.errors import InputError
from mgs.policy import poses, tour
from mgs.policy.certificate import Certificate, certify, greedy
from mgs.progress import Stage, report
from mgs.run.flight import flight_of, free, reachable, views_left
from mgs.run.policies import Policy
from mgs.run.settings import Mission
from mgs.scene import Scene, State, with_view

CERTIFY_NODES, CERTIFY_PAIRS = 20, 15_000_000
"""Most nodes of the branch and bound of a certificate, and most nodes times pairs of a candidate
and a Gaussian: seconds of work. Chosen constants."""


def rated(
    scene: Scene,
    state: State,
    policy: Policy,
    views: list[int],
    cost: np.ndarray | float | None = None,
) -> list[tuple[int, float]]:
    """(view, score) by falling score / cost [C]; of equals, the farthest from the views taken comes
    first. Raises InputError as `mgs.run.loop.choose`."""
    report(Stage.SCORE, 0, len(views))
    where, returned = f"policy {policy.name}: returned", policy(scene, state, views)
    try:
        scores = np.asarray(returned, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} no numbers ({error}); return one for each candidate") from None
    if scores.shape != (len(views),):
        raise InputError(
            f"{where} scores of shape {scores.shape} for {len(views)} candidates; return one "
            "number for each"
        )
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
    limits that a view adds, and its share of the views that the budget has left.
    """
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
    """Rest of the tour that a policy with `tour_gains` plans after the seeds; empty for others.

    If another view was taken than the next one of the plan, a new plan is made after all views
    taken.
    """
    tour_gains = getattr(policy, "tour_gains", None)
    if tour_gains is None or mission.nearest is not None:
        return []
    flight = flight_of(scene, state, mission)
    for count in (state.seeds, len(state.taken)):
        start, done = state.taken[:count], list(state.taken[count:])
        before = replace(state, taken=start)
        stops = tuple(reachable(scene, before, mission))
        if (start, stops) not in flight.tours:
            gains = tour_gains(scene, state)
            if gains is None:
                return []
            report("planning the flight", 0, 1)
            gains.take(start)
            most = views_left(before, mission)
            ends, share = [start[-1], flight.home], flight.share_from(start, most)
            way = tour.planned_tour(flight.legs, ends, stops, gains, share, 1 / most)
            flight.tours[start, stops] = way[1:-1]
        plan = flight.tours[start, stops]
        if plan[: len(done)] == done and plan[len(done) :]:
            return plan[len(done) :]
    return []


def certificate(
    scene: Scene, state: State, policy: Policy, plan: Sequence[int], views: Sequence[int]
) -> Certificate | None:
    """Certify a plan of some of `views` by the policy's criterion.

    Returns None where the policy has no `relaxation`, or the plan has no view or all of them.
    """
    relaxation = getattr(policy, "relaxation", None)
    if relaxation is None or not 0 < len(plan) < len(views):
        return None
    report(Stage.SCORE, 0, 1)
    made = relaxation(scene, state, views)
    if made is None:
        return None
    nodes = min(CERTIFY_NODES, CERTIFY_PAIRS // (len(views) * len(made.base)))
    return certify(made, [views.index(i) for i in plan], policy.name, nodes)


def planned_certificate(
    scene: Scene, state: State, policy: Policy, mission: Mission
) -> Certificate | None:
    """`certificate` of all views that a run plans to take, also as a tour; None where it plans no
    set of views."""
    plan, left = getattr(policy, "plan", None), views_left(state, mission)
    if plan is None or mission.travel is not None or mission.nearest is not None or left <= 0:
        return None
    views = free(scene, state, mission)
    if mission.flies:
        planned = planned_flight(scene, state, policy, mission)
    else:
        planned = plan(scene, state, views, left, None)
    return certificate(scene, state, policy, planned, views)


def enough_views(scene: Scene, state: State, policy: Policy, mission: Mission) -> int:
    """Fewest views of a greedy plan that have the share `enough` of the gain of all candidates.

    Raises InputError where the policy has no `relaxation`.
    """
    relaxation, views = getattr(policy, "relaxation", None), free(scene, state, mission)
    made = relaxation(scene, state, views) if relaxation and views else None
    if made is None:
        raise InputError(
            f"policy {policy.name}: has no bound by which a number of views could be enough; give "
            "the number, or use directional-i, directional-d or d-optimal"
        )
    return len(greedy(made, mission.enough))
