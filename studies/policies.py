"""Policies kept for comparison alone, as a user's own: `--policy studies/policies.py:NAME`."""

from __future__ import annotations

import numpy as np

import mgs
from mgs.policy.criteria import Array, observed
from mgs.policy.poses import angles
from mgs.run.policies import each

BLOCKS_AT_ONCE = 2048
"""Blocks whose determinants are computed together: 2 MB, which fit into a core's cache."""


def a_optimal(F: Array) -> float:
    """POp-GS's A-optimal (p = -1), 1/l sum F: growth of the trace of the inverse covariance."""
    return float(F.mean(dtype=np.float64))


def e_optimal(F: Array, H: Array, lam: Array) -> float:
    """Increase of the smallest eigenvalue of H + lam; 0 while any parameter stays unobserved."""
    return float((H + F + lam).min() - (H + lam).min())


def i_optimal(scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
    """I-optimality over all poses of the dataset (`predicted_variance`) [C]."""
    H, lam, count = state.H, scene.lam, len(state.frames)
    others = [i for i in range(count) if i not in state.taken]
    mean = (H + sum(scene.information(state, i) for i in others)) / count
    F = scene.information
    return each(views, lambda i: predicted_variance(F(state, i), H, lam, mean))


def predicted_variance(F: Array, H: Array, lam: Array, weight: Array) -> float:
    """1/l sum weight [1/(H+lam) - 1/(H+F+lam)], the decrease of the predicted variance of a set of
    views, per parameter (diagonal, linearised).

    weight: mean information of these views [N,P]. With a weight of 1 it is T-optimality.
    """
    return float((weight * F / ((H + lam) * (H + F + lam))).mean(dtype=np.float64))


def block_d(scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
    """Eq. 7 for the exact 11x11 blocks, whatever the estimator of the run [C]."""

    def F(view: int) -> Array:
        return scene.information(state, view, "block")

    first, *others = state.taken
    H = np.array(F(first), np.float64)
    for view in others:
        H += F(view)
    before = block_log_determinant(H, scene.lam)
    return each(views, lambda i: block_log_determinant(H + F(i), scene.lam)) - before


def block_log_determinant(H: Array, lam: Array) -> float:
    """1/l sum over the Gaussians of log det(I + Lambda^-1/2 H Lambda^-1/2), Lambda = diag(lam).

    H: blocks of J^T J [N,P,P], which hold the correlations between the parameters of one Gaussian.
    The difference of two such values is Eq. 7 for blocks. If rounding has made an eigenvalue -1 or
    less, negative eigenvalues of its group of BLOCKS_AT_ONCE blocks count as 0.
    """
    whitening, total = 1 / np.sqrt(np.multiply.outer(lam, lam)), 0.0
    for first in range(0, len(H), BLOCKS_AT_ONCE):
        whitened = H[first : first + BLOCKS_AT_ONCE] * whitening
        try:
            factor = np.linalg.cholesky(whitened + np.eye(len(lam)))
            total += 2 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum()
        except np.linalg.LinAlgError:
            total += np.log1p(np.maximum(np.linalg.eigvalsh(whitened), 0)).sum()
    return float(total / (len(H) * len(lam)))


def angle(candidates: Array, taken: Array, centre: Array) -> Array:
    """Angle at `centre` to the nearest camera already taken, radians [C]."""
    return np.round(angles(candidates, taken, centre).min(axis=1), 9)


def completeness(seen: Array, surface_H: Array, surface_lam: Array) -> np.ndarray:
    """Completeness after ActiveSplat (2024): squared blending weights of the surface's Gaussians
    that no view has observed, summed [C]. Zero once all are, as with `coverage`."""
    return np.asarray(seen[:, ~observed(surface_H, surface_lam)].sum(axis=1))
