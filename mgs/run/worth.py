"""Worth of plans: their certificates, and the number of views that is enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mgs.errors import InputError
from mgs.policy.certificate import Certificate, certify, curve, greedy
from mgs.policy.poses import spread
from mgs.progress import Stage, report
from mgs.run.choosing import planned_flight
from mgs.run.flight import free, views_left
from mgs.run.policies import Policy
from mgs.run.settings import Mission
from mgs.scene import Scene, State

CERTIFY_NODES, CERTIFY_PAIRS = 10, 10_000_000
"""Most nodes of the branch and bound of a certificate, and most nodes times pairs of a candidate
and a Gaussian: seconds of work. Chosen constants."""

CURVE_PAIRS = 3_000_000
"""Most pairs of a candidate and a Gaussian with which the curve of a certificate is computed."""


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
    pairs, chosen = len(views) * len(made.base), [views.index(i) for i in plan]
    worth = certify(made, chosen, policy.name, min(CERTIFY_NODES, CERTIFY_PAIRS // pairs))
    if pairs > CURVE_PAIRS:
        return worth
    positions = scene.positions(state.frames)
    even = spread(positions[list(views)], positions[list(state.taken)], scene.centre)
    return replace(worth, curve=curve(made, chosen, even))


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
