"""Every policy by its name, as a function of the `mgs.policy.context.PolicyContext` that gives each
candidate a score.

There are three tables, by what their functions look at: `mgs.policy.criteria.CRITERIA` at
information, `mgs.policy.poses.POSE_POLICIES` at poses, and CONTEXT_POLICIES here at whatever an
PolicyContext has. A name like FILE.py:FUNCTION is a policy in a file of the user's own
(`mgs.policy.from_file`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mgs.colour import SH_C0
from mgs.errors import InputError
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
from mgs.policy.from_file import in_file, load
from mgs.policy.poses import POSE_POLICIES

PAPER_LAM = 1e-6
"""The one lambda of the policy `paper`: that of POp-GS, since the paper does not say which it
used."""


def directional_d(context: PolicyContext) -> Array:
    """Directional D-optimality, nats, with colours of SH degree 2 and tau 0.3
    (`mgs.policy.directional`)."""
    return context.gains(context.visited, context.left, 2, 0.3, False)


def directional_i(context: PolicyContext) -> Array:
    """Directional I-optimality over a dome, with colours of SH degree 3 and tau 0.1
    (`mgs.policy.directional`)."""
    return context.gains(context.visited, context.left, 3, 0.1, True)


def i_optimal(context: PolicyContext) -> Array:
    """I-optimality over all poses of the dataset, taken or not
    (`mgs.policy.criteria.i_optimal`)."""
    others = [i for i in range(len(context.positions)) if i not in context.visited]
    mean = (context.H + sum(context.information(i) for i in others)) / len(context.positions)
    return np.array(
        [i_optimality(context.information(i), context.H, context.lam, mean) for i in context.left]
    )


def block_d(context: PolicyContext) -> Array:
    """Eq. 7 for the exact 11x11 blocks (`mgs.policy.criteria.block_log_determinant`), whatever the
    estimator of the run."""
    H = _sum(context, "block")
    before, lam = block_log_determinant(H, context.lam), context.lam
    return np.array(
        [
            block_log_determinant(H + context.estimate(i, "block"), lam) - before
            for i in context.left
        ]
    )


def paper(context: PolicyContext) -> Array:
    """The paper's method to the letter: Eq. 7 on squared gradients of one scalar loss per image,
    with one lambda (PAPER_LAM).

    The paper names neither the loss nor the lambda. The loss is that of the estimator
    `loss-gradient`, for the views taken too.
    """
    H, lam = _sum(context, "loss-gradient"), np.full_like(context.lam, PAPER_LAM)
    return np.array([d_optimal(context.estimate(i, "loss-gradient"), H, lam) for i in context.left])


def cover(context: PolicyContext) -> Array:
    """COVER ("Coverage Optimization for Camera View Selection", 2026): how far the direction of a
    view is from those from which the surface that it sees was observed before.

    For each Gaussian (1 - cos)/2 of the angle between the candidate's direction and the nearest one
    from which it was `observed`, or 1 where it never was; then the mean over what the candidate
    sees, by squared blending weights. In [0, 1]. The paper counts a view for all that lies in its
    frustum, hidden or not, and rounds directions to bins.
    """
    least = context.prior_lam[0] / SH_C0**2
    taken = [(context.positions[i], context.seen(i) > least) for i in context.visited]
    scores = []
    for i in context.left:
        weights = context.seen(i)
        some = np.flatnonzero(weights)
        points, weights = context.points[some], weights[some]
        here, apart = _directions(points, context.positions[i]), np.ones(len(some))
        for position, known in taken:
            angle = (1 - (here * _directions(points, position)).sum(1)) / 2
            apart = np.where(known[some], np.minimum(apart, angle), apart)
        scores.append((apart * weights).sum() / max(weights.sum(), 1e-12))
    return np.array(scores)


def _directions(points: Array, position: Array) -> Array:
    """[N,3] unit vectors from a camera to points."""
    offset = points - position
    return np.asarray(offset / np.linalg.norm(offset, axis=1, keepdims=True))


def completeness(context: PolicyContext) -> Array:
    """ActiveSplat's completeness (2024), the part of a view that no view has shown: here, where a
    prior knows the surface, the squared blending weights of its Gaussians that are not `observed`.
    Zero once all are, as with `coverage`."""
    unknown = ~observed(context.surface_H, context.prior_lam)
    return np.array([context.seen(i)[unknown].sum() for i in context.left])


def _sum(context: PolicyContext, estimator: str) -> NDArray[np.float64]:
    """Information of the views taken, by an estimator, summed; that of one view is in memory at a
    time."""
    first, *others = context.visited
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
"""Policies that are told all that there is, by name. A program may add its own
(docs/howto/policy.md)."""


def policy_names() -> list[str]:
    """Every name that `mgs nbv --policy` accepts: the rows of the three tables, as they are now."""
    return [*CRITERIA, *CONTEXT_POLICIES, *POSE_POLICIES]


def policy_named(name: str) -> Policy:
    """The policy of that name, as a function of an PolicyContext. Raises InputError if there is
    none, and as `policy_file.load`."""
    if in_file(name):
        return load(name)
    if name in CRITERIA:
        return _of_criterion(CRITERIA[name])
    if name in POSE_POLICIES:
        row = POSE_POLICIES[name]
        return lambda context: row(context.candidates, context.taken, context.centre, context.rng)
    if name in CONTEXT_POLICIES:
        return CONTEXT_POLICIES[name]
    known = ", ".join(policy_names())
    raise InputError(
        f"--policy {name}: unknown; choose one of {known}, or add your own (docs/howto/policy.md)"
    )


def _of_criterion(criterion: Criterion) -> Policy:
    """A criterion as a policy; the information of one candidate is in memory at a time."""

    def scores(context: PolicyContext) -> NDArray[np.float64]:
        at_prior = criterion.at == "prior"
        look, H = (
            (context.surface_information, context.surface_H)
            if at_prior
            else (context.information, context.H)
        )
        lam = context.prior_lam if at_prior else context.lam
        return np.array([criterion.score(look(i), H, lam) for i in context.left])

    return scores
