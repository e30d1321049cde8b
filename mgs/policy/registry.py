"""All policies by name.

Three tables hold them, by what their functions use: information
(`mgs.policy.criteria.CRITERIA`), poses (`mgs.policy.poses.POSE_POLICIES`), or the whole
`PolicyContext` (CONTEXT_POLICIES below). A name like FILE.py:FUNCTION is a policy in a user's file
(`mgs.policy.from_file`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mgs.colour import SH_C0
from mgs.errors import InputError
from mgs.policy import from_file
from mgs.policy.context import Policy, PolicyContext
from mgs.policy.criteria import (
    CRITERIA,
    Array,
    Criterion,
    block_log_determinant,
    d_optimal,
    observed,
)
from mgs.policy.criteria import i_optimal as i_optimality
from mgs.policy.poses import POSE_POLICIES

PLANNED = {"directional-d": (1, 0.3, False), "directional-i": (2, 0.2, True)}
"""Policies that plan all views of a run (`Problem.planned`) -> SH degree, tau and over_dome of the
gains (`PolicyContext.gains`) that score a view and that the plan maximises. Chosen on five rocks
that judge nothing."""

FLOWN = 1, 0.1, True
"""SH degree, tau and over_dome of the gains that the tour of a policy of PLANNED maximises
(`mgs.policy.tour.planned_tour`). Chosen on two rocks that judge nothing."""


def directional_d(context: PolicyContext) -> Array:
    """Directional D-optimality, nats (`mgs.policy.directional`)."""
    return _directional(context, "directional-d")


def directional_i(context: PolicyContext) -> Array:
    """Directional I-optimality over a dome (`mgs.policy.directional`)."""
    return _directional(context, "directional-i")


def _directional(context: PolicyContext, name: str) -> Array:
    return context.gains(context.taken_frames, context.candidate_frames, *PLANNED[name])


def i_optimal(context: PolicyContext) -> Array:
    """I-optimality over all poses of the dataset (`mgs.policy.criteria.i_optimal`)."""
    H, lam, count = context.H, context.lam, len(context.positions)
    others = [i for i in range(count) if i not in context.taken_frames]
    mean = (H + sum(context.information(i) for i in others)) / count
    return _each(context, lambda i: i_optimality(context.information(i), H, lam, mean))


def block_d(context: PolicyContext) -> Array:
    """Eq. 7 for the exact 11x11 blocks, whatever the estimator of the run."""
    H, lam = _summed(context, "block"), context.lam
    before = block_log_determinant(H, lam)
    after = _each(context, lambda i: block_log_determinant(H + context.estimate(i, "block"), lam))
    return after - before


def paper(context: PolicyContext) -> Array:
    """Eq. 7 as the paper has it: squared gradients of one scalar loss per image, one lambda.

    The paper states neither. The loss is that of the estimator `loss-gradient`. Lambda is the mean
    squared gradient of one view taken: the gain of the first choice is then near the paper's 0.091
    (its Fig. 2; docs/nbv.md).
    """
    H = _summed(context, "loss-gradient")
    lam = np.full_like(context.lam, H.mean(dtype=np.float64) / len(context.taken_frames))
    return _each(context, lambda i: d_optimal(context.estimate(i, "loss-gradient"), H, lam))


def cover(context: PolicyContext) -> Array:
    """COVER ("Coverage Optimization for Camera View Selection", 2026): new viewing directions.

    For each Gaussian (1 - cos)/2 of the angle between the candidate's direction and the nearest one
    from which it was `observed`, or 1 if it never was; then the mean over the candidate's view,
    weighted by squared blending weights. In [0, 1]. The paper counts all Gaussians in the frustum,
    hidden or not, and rounds directions to bins.
    """
    least = context.prior_lam[0] / SH_C0**2
    taken = [(context.positions[i], context.seen(i) > least) for i in context.taken_frames]

    def score(frame: int) -> float:
        weights = context.seen(frame)
        some = np.flatnonzero(weights)
        points, weights = context.points[some], weights[some]
        here, apart = _directions(points, context.positions[frame]), np.ones(len(some))
        for position, known in taken:
            angle = (1 - (here * _directions(points, position)).sum(1)) / 2
            apart = np.where(known[some], np.minimum(apart, angle), apart)
        return float((apart * weights).sum() / max(weights.sum(), 1e-12))

    return _each(context, score)


def _directions(points: Array, position: Array) -> Array:
    """Unit vectors from a camera to points [N,3]."""
    offset = points - position
    return np.asarray(offset / np.linalg.norm(offset, axis=1, keepdims=True))


def completeness(context: PolicyContext) -> Array:
    """Completeness after ActiveSplat (2024): squared blending weights of the surface's Gaussians
    that no view has `observed`, summed. Zero once all are, as with `coverage`."""
    unknown = ~observed(context.surface_H, context.prior_lam)
    return _each(context, lambda i: context.seen(i)[unknown].sum())


def _each(context: PolicyContext, score: Callable[[int], float]) -> Array:
    """Score of each candidate [C]."""
    return np.array([score(i) for i in context.candidate_frames])


def _summed(context: PolicyContext, estimator: str) -> NDArray[np.float64]:
    """Information of the views taken, by an estimator. One view is in memory at a time."""
    first, *others = context.taken_frames
    total = np.array(context.estimate(first, estimator), np.float64)
    for i in others:
        total += context.estimate(i, estimator)
    return total


CONTEXT_POLICIES: dict[str, Policy] = {
    "i-optimal": i_optimal,
    "block-d": block_d,
    "paper": paper,
    "directional-d": directional_d,
    "directional-i": directional_i,
    "cover": cover,
    "completeness": completeness,
}
"""Policies that use the whole context, by name. A program may add its own
(docs/howto/policy.md)."""


def policy_names() -> list[str]:
    """Names of the three tables, which `mgs nbv --policy` accepts."""
    return [*CRITERIA, *CONTEXT_POLICIES, *POSE_POLICIES]


MODEL_POLICIES = ("i-optimal", "block-d", "paper")
"""Rows of CONTEXT_POLICIES that use the fitted model; the others need poses and prior alone."""


def needs_model(name: str) -> bool:
    """Whether a policy may use the fitted model, so that a choice needs a fit before it."""
    if name in CRITERIA:
        return CRITERIA[name].at == "fitted"
    return name in MODEL_POLICIES or from_file.in_file(name)


def check_policy(name: str) -> None:
    """Raise InputError for a name that is in no table, and is not that of a user's own policy. A
    user's file is not read: `policy_named` does so."""
    own = from_file.in_file(name) or from_file.is_function(name)
    if not own and name not in policy_names():
        raise InputError(
            f"policy {name}: unknown; choose one of {', '.join(policy_names())}, "
            "or add your own (docs/howto/policy.md)"
        )


def policy_of(policy: str | Callable[..., Any]) -> Policy:
    """The policy of a name, or of a function. Raises InputError as `policy_named`."""
    if isinstance(policy, str):
        return policy_named(policy)
    return from_file.by_parameter_name(from_file.name_of(policy), policy)


def policy_named(name: str) -> Policy:
    """The policy of that name. Executes a user's file. Raises InputError as `check_policy` and
    `mgs.policy.from_file.load`."""
    if from_file.in_file(name):
        return from_file.load(name)
    if from_file.is_function(name):
        raise InputError(f"policy {name}: is a Python function; give it again in Python")
    check_policy(name)
    if name in CRITERIA:
        return _of_criterion(CRITERIA[name])
    if name in CONTEXT_POLICIES:
        return CONTEXT_POLICIES[name]
    rule = POSE_POLICIES[name]
    return lambda context: rule(context.candidates, context.taken, context.centre, context.rng)


def _of_criterion(criterion: Criterion) -> Policy:
    """A criterion as a policy."""

    def scores(context: PolicyContext) -> Array:
        F, H, lam = context.information, context.H, context.lam
        if criterion.at == "prior":
            F, H, lam = context.surface_information, context.surface_H, context.prior_lam
        return _each(context, lambda i: criterion.score(F(i), H, lam))

    return scores
