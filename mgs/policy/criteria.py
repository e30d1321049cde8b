"""Criteria: scores of a view from Fisher information alone (docs/nbv.md). H [N,P] is the diagonal
of J^T J summed over the training views, F [N,P] that of a candidate, lam [P] the regularisation."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from mgs.errors import InputError

Array = NDArray[np.floating]

Score = Callable[[Array, Array, Array], float]
"""(F [N,P], H [N,P], lam [P]) -> score of one candidate."""

PIXEL_NOISE = 0.02  # sigma_e, std of a pixel value's residual (34 dB); chosen
PRUNE_NOISE = PIXEL_NOISE / 5  # rms change by `mgs simplify`: about 0.1 dB; chosen
DIRECTIONAL_STD = 0.03  # tau of colours of degrees above 0: rocks look alike from all sides
LEARN_LOSS = 0.5  # rise of the objective, dB, that a refit may cause (docs/parsimony.md)

PRIOR_STD = {"colour": 1.0, "scale": 0.125, "rotation": 0.0625, "opacity": 2.0}
"""tau: standard deviation of each parameter around its start, in its own unit. Those of scale and
rotation (7 degrees) are small: with larger ones, Gaussians grow into needles (docs/fit.md)."""

MEAN_STD = 0.5  # tau of learned means over the spacing of the samples; chosen
BETTER = 1 + 1e-6  # least ratio of gains for a better plan: above rounding errors; chosen
GAIN_UNIT = "½ nat per parameter"  # of `d_optimal`: 2/l times mutual information in nats


def regularisation(
    groups: dict[str, slice],
    pixel_noise: float = PIXEL_NOISE,
    prior_std: Mapping[str, float] = PRIOR_STD,
) -> NDArray[np.float64]:
    """lam [P] = (sigma_e / tau)^2, the prior's information about each parameter, in the units of H,
    (pixel value / parameter)^2.

    With a prior theta ~ N(theta_0, tau^2) the posterior precision is (H + lam) / sigma_e^2, so Eq.
    7 is 2/l times the mutual information of the parameters and the new image, nats.

    groups: columns of each kind of parameter (`mgs.splat.groups`). prior_std: tau of each kind;
    that of colour is for degree 0. Higher degrees have DIRECTIONAL_STD. Raises InputError where
    `prior_std` lacks a kind."""
    if missing := [kind for kind in groups if kind not in prior_std]:
        raise InputError(f"prior_std: has no number for {missing[0]}; give one, metres")
    lam = np.empty(max(columns.stop for columns in groups.values()))
    for name, columns in groups.items():
        lam[columns] = (pixel_noise / prior_std[name]) ** 2
    lam[groups["colour"]][3:] = (pixel_noise / DIRECTIONAL_STD) ** 2
    return lam


def lam_by_kind(lam: Array, groups: dict[str, slice]) -> dict[str, float | Array]:
    """lam [P] by kind of parameter, as `mgs.fit_gaussians` takes it: a number; for colours of
    degrees above 0 an array [1,K,3]. groups: as in `regularisation`."""
    by_kind: dict[str, float | Array] = {kind: float(lam[of][0]) for kind, of in groups.items()}
    colour = lam[groups["colour"]].reshape(1, -1, 3)
    return by_kind if colour.shape[1] == 1 else by_kind | {"colour": colour}


def observed(H: Array, lam: Array) -> NDArray[np.bool_]:
    """Mask [N] of the Gaussians about which the images say more than the prior (Eq. 9 with epsilon
    = lam).

    Only the colour columns count: colour information is the sum of squared blending weights."""
    return np.asarray((H[:, :3] > lam[:3]).any(axis=1))


def coverage(H: Array, lam: Array) -> float:
    """Surface coverage C_0 of Eq. 9: the share of Gaussians that are `observed`, 0 to 1. The loop
    passes H of the Gaussians before training. With the trained model, Gaussians that fade behind
    their neighbours would count as unseen surface."""
    return float(observed(H, lam).mean())


def uncertainty(H: Array, lam: Array) -> NDArray[np.float64]:
    """Remaining share of the prior's variance of each Gaussian [N], in (0, 1]: the mean of
    lam / (H + lam) over its parameters."""
    return np.asarray((lam / (H + lam)).mean(axis=1, dtype=np.float64))


def d_optimal(F: Array, H: Array, lam: Array) -> float:
    """Paper's Eq. 7: 1/l sum log(1 + F / (H + lam)), the decrease of the log-determinant of the
    posterior covariance, per parameter."""
    return float(np.log1p(F / (H + lam)).mean(dtype=np.float64))


def a_optimal(F: Array, H: Array, lam: Array) -> float:
    """1/l sum [1/(H+lam) - 1/(H+F+lam)], the decrease of the average variance. A-optimality, as in
    the paper and in textbooks; POp-GS calls it T-optimal."""
    return float((F / ((H + lam) * (H + F + lam))).mean(dtype=np.float64))


def fisherrf(F: Array, H: Array, lam: Array) -> float:
    """FisherRF's trace criterion, 1/l sum F / (H + lam): Eq. 7 without the logarithm."""
    return float((F / (H + lam)).mean(dtype=np.float64))


def coverage_greedy(F: Array, H: Array, lam: Array) -> float:
    """Number of Gaussians newly `observed`."""
    return float((observed(H + F, lam) & ~observed(H, lam)).sum())
