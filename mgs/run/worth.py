"""Worth of plans: their certificates, and the number of views that is enough."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mgs.errors import InputError
from mgs.memory import release
from mgs.policy.certificate import Certificate, certify, curve, greedy
from mgs.policy.poses import farthest_order
from mgs.policy.relaxation import Criterion
from mgs.progress import Stage, report
from mgs.run.choosing import plan_flight, planned_flight
from mgs.run.flight import free, views_left
from mgs.run.loop import choose_batch
from mgs.run.policies import Policy
from mgs.run.settings import ENOUGH, Mission
from mgs.scene import Scene, State

SEARCH_NODES, SEARCH_PAIRS = 40, 2_000_000  # most nodes, and nodes times pairs: about a second
CURVE_PAIRS = 1_000_000  # most pairs of a candidate and a Gaussian for the curve of a certificate


def certificate(
    scene: Scene,
    state: State,
    policy: Policy,
    mission: Mission,
    plan: Sequence[int],
    views: Sequence[int],
) -> Certificate | None:
    """Certify a plan of some of `views` by the policy's criterion. Returns None where the policy
    has no `relaxation`, the plan has no view or all of them, or adds nothing."""
    criterion = _criterion(scene, state, policy, views) if 0 < len(plan) < len(views) else None
    indices, limits = [views.index(i) for i in plan], mission.certificate
    if criterion is None or criterion.gain(indices) <= 0:
        return None
    nodes = min(SEARCH_NODES, SEARCH_PAIRS // criterion.pairs)
    nodes = nodes if limits.nodes is None else limits.nodes
    worth = certify(criterion, indices, policy.name, nodes, limits.seconds or np.inf)
    if criterion.pairs > CURVE_PAIRS:
        return worth
    positions = scene.positions(state.frames)
    even = farthest_order(positions[list(views)], positions[list(state.taken)], scene.centre)
    return replace(worth, curve=curve(criterion, indices, even))


def _criterion(
    scene: Scene, state: State, policy: Policy, views: Sequence[int]
) -> Criterion | None:
    """The policy's `relaxation`; None where it has none, or no view adds anything."""
    relaxation = getattr(policy, "relaxation", None)
    if relaxation is None or not views:
        return None
    report(Stage.SCORE, 0, 1)
    scene.cache.clear()  # lists of all views, of the plan; the bounds need the memory
    release()
    criterion: Criterion = relaxation(scene, state, views)
    return criterion if criterion.gain(range(len(views))) > 0 else None


def planned_certificate(
    scene: Scene, state: State, policy: Policy, mission: Mission
) -> Certificate | None:
    """`certificate` of all views that a run will take, also as a tour. Returns None where that
    depends on fits to come, or on the way from view to view."""
    count = views_left(state, mission)
    on_its_way = mission.travel is not None or mission.nearest is not None
    if policy.needs_fit or not hasattr(policy, "relaxation") or on_its_way or count <= 0:
        return None
    views = free(scene, state, mission)
    if mission.flies:
        planned = planned_flight(scene, state, policy, mission)
        planned = planned or [view for view, _ in plan_flight(scene, state, policy, mission)]
    elif plan := getattr(policy, "plan", None):
        planned = plan(scene, state, views, count, None)
    else:
        every = mission.model_copy(update={"batch": count})
        planned = [choice.view for choice in choose_batch(scene, state, policy, every)[1]]
    return certificate(scene, state, policy, mission, planned, views)


def enough_views(scene: Scene, state: State, policy: Policy, mission: Mission) -> int:
    """Fewest views of a greedy plan that have the share `enough` of the gain of all candidates.
    Raises InputError where the policy has no `relaxation`, or no candidate adds anything."""
    criterion = _criterion(scene, state, policy, free(scene, state, mission))
    if criterion is not None:
        return len(greedy(criterion, mission.enough or ENOUGH))
    why = "no candidate adds anything; give the number"
    if not hasattr(policy, "relaxation"):
        others = "directional-i, directional-d, d-optimal or coverage"
        why = f"has no bound to tell how many views are enough; give the number, or use {others}"
    raise InputError(f"policy {policy.name}: {why}")
