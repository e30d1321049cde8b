"""Every policy by its name, as a function of the `mgs.active.outlook.Outlook` that gives each candidate a score.

There are three tables, by what their functions look at: `mgs.active.criteria.CRITERIA` at information,
`mgs.active.pose_policies.POSE_POLICIES` at poses, and OUTLOOK_POLICIES here at whatever an Outlook has. A name like
FILE.py:FUNCTION is a policy in a file of the user's own (`mgs.active.policy_file`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mgs.active.criteria import CRITERIA, Array, Criterion, block_log_determinant, d_optimal, observed
from mgs.active.criteria import i_optimal as i_optimality
from mgs.active.outlook import Outlook, Policy
from mgs.active.policy_file import in_file, load
from mgs.active.pose_policies import POSE_POLICIES
from mgs.colour import SH_C0
from mgs.errors import InputError

PAPER_LAM = 1e-6
"""The one lambda of the policy `paper`: that of POp-GS, since the paper does not say which it used."""


def directional_d(outlook: Outlook) -> Array:
    """Directional D-optimality, nats, with colours of SH degree 2 and tau 0.3 (`mgs.active.directional`)."""
    return outlook.gains(outlook.visited, outlook.left, 2, 0.3, False)


def directional_i(outlook: Outlook) -> Array:
    """Directional I-optimality over a dome, with colours of SH degree 3 and tau 0.1 (`mgs.active.directional`)."""
    return outlook.gains(outlook.visited, outlook.left, 3, 0.1, True)


def i_optimal(outlook: Outlook) -> Array:
    """I-optimality over all poses of the dataset, taken or not (`mgs.active.criteria.i_optimal`)."""
    others = [i for i in range(len(outlook.positions)) if i not in outlook.visited]
    mean = (outlook.H + sum(outlook.information(i) for i in others)) / len(outlook.positions)
    return np.array([i_optimality(outlook.information(i), outlook.H, outlook.lam, mean) for i in outlook.left])


def block_d(outlook: Outlook) -> Array:
    """Eq. 7 for the exact 11x11 blocks (`mgs.active.criteria.block_log_determinant`), whatever the estimator of the run."""
    H = _sum(outlook, "block")
    before, lam = block_log_determinant(H, outlook.lam), outlook.lam
    return np.array([block_log_determinant(H + outlook.estimate(i, "block"), lam) - before for i in outlook.left])


def paper(outlook: Outlook) -> Array:
    """The paper's method to the letter: Eq. 7 on squared gradients of one scalar loss per image, with one lambda (PAPER_LAM).

    The paper names neither the loss nor the lambda. The loss is that of the estimator `loss-gradient`, for the views taken too.
    """
    H, lam = _sum(outlook, "loss-gradient"), np.full_like(outlook.lam, PAPER_LAM)
    return np.array([d_optimal(outlook.estimate(i, "loss-gradient"), H, lam) for i in outlook.left])


def cover(outlook: Outlook) -> Array:
    """COVER ("Coverage Optimization for Camera View Selection", 2026): how far the direction of a view is from those from which
    the surface that it sees was observed before.

    For each Gaussian (1 - cos)/2 of the angle between the candidate's direction and the nearest one from which it was
    `observed`, or 1 where it never was; then the mean over what the candidate sees, by squared blending weights. In [0, 1].
    The paper counts a view for all that lies in its frustum, hidden or not, and rounds directions to bins.
    """
    least = outlook.prior_lam[0] / SH_C0**2
    taken = [(outlook.positions[i], outlook.seen(i) > least) for i in outlook.visited]
    scores = []
    for i in outlook.left:
        weights = outlook.seen(i)
        some = np.flatnonzero(weights)
        points, weights = outlook.points[some], weights[some]
        here, apart = _directions(points, outlook.positions[i]), np.ones(len(some))
        for position, known in taken:
            angle = (1 - (here * _directions(points, position)).sum(1)) / 2
            apart = np.where(known[some], np.minimum(apart, angle), apart)
        scores.append((apart * weights).sum() / max(weights.sum(), 1e-12))
    return np.array(scores)


def _directions(points: Array, position: Array) -> Array:
    """[N,3] unit vectors from a camera to points."""
    offset = points - position
    return np.asarray(offset / np.linalg.norm(offset, axis=1, keepdims=True))


def completeness(outlook: Outlook) -> Array:
    """ActiveSplat's completeness (2024), the part of a view that no view has shown: here, where a prior knows the surface, the
    squared blending weights of its Gaussians that are not `observed`. Zero once all are, as with `coverage`."""
    unknown = ~observed(outlook.surface_H, outlook.prior_lam)
    return np.array([outlook.seen(i)[unknown].sum() for i in outlook.left])


def _sum(outlook: Outlook, estimator: str) -> NDArray[np.float64]:
    """Information of the views taken, by an estimator, summed; that of one view is in memory at a time."""
    first, *others = outlook.visited
    total = np.array(outlook.estimate(first, estimator), np.float64)
    for i in others:
        total += outlook.estimate(i, estimator)
    return total


OUTLOOK_POLICIES: dict[str, Policy] = {
    "i-optimal": i_optimal,
    "block-d": block_d,
    "paper": paper,
    "directional-d": directional_d,
    "directional-i": directional_i,
    "cover": cover,
    "completeness": completeness,
}
"""Policies that are told all that there is, by name. A program may add its own (docs/howto/policy.md)."""


def policy_names() -> list[str]:
    """Every name that `mgs nbv --policy` accepts: the rows of the three tables, as they are now."""
    return [*CRITERIA, *OUTLOOK_POLICIES, *POSE_POLICIES]


def policy_named(name: str) -> Policy:
    """The policy of that name, as a function of an Outlook. Raises InputError if there is none, and as `policy_file.load`."""
    if in_file(name):
        return load(name)
    if name in CRITERIA:
        return _of_criterion(CRITERIA[name])
    if name in POSE_POLICIES:
        row = POSE_POLICIES[name]
        return lambda outlook: row(outlook.candidates, outlook.taken, outlook.centre, outlook.rng)
    if name in OUTLOOK_POLICIES:
        return OUTLOOK_POLICIES[name]
    known = ", ".join(policy_names())
    raise InputError(f"--policy {name}: unknown; choose one of {known}, or add your own (docs/howto/policy.md)")


def _of_criterion(criterion: Criterion) -> Policy:
    """A criterion as a policy; the information of one candidate is in memory at a time."""

    def scores(outlook: Outlook) -> NDArray[np.float64]:
        at_prior = criterion.at == "prior"
        look, H = (outlook.surface_information, outlook.surface_H) if at_prior else (outlook.information, outlook.H)
        lam = outlook.prior_lam if at_prior else outlook.lam
        return np.array([criterion.score(look(i), H, lam) for i in outlook.left])

    return scores
