"""Criteria: what a view is worth, from Fisher information alone. Pure NumPy functions, each a row
of a table.

The loop of `mgs.run.loop` scores every candidate with the criterion that a run names, and takes the
one with the largest score; a tie goes to the camera farthest from those taken (a rule of our own,
the same for all policies: the paper names none, and coverage ties at every step once it has
saturated). Policies that look at poses instead of information are in `mgs.policy.poses`. Neither
kind ever sees a candidate's image. A criterion of your own is one more row: see
docs/howto/policy.md.

Notation, after the paper's Eq. 7 and POp-GS: H [N,P] is the diagonal of J^T J summed over the
training set, F [N,P] that of one candidate, lam [P] the regularisation (`regularisation`); l = N P
is the number of parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

Score = Callable[[Array, Array, Array], float]
"""(F [N,P], H [N,P], lam [P]) -> score of one candidate."""

PIXEL_NOISE = 0.02
"""sigma_e, standard deviation of a pixel's residual, linear RGB (34 dB): the scale at which one
pixel's evidence counts as one. A chosen constant."""

PRUNE_NOISE = PIXEL_NOISE / 5
"""rms change of a pixel value that pruning a model may make (`mgs prune`), linear RGB: so much less
than the noise that it costs about a tenth of a decibel (docs/parsimony.md). A chosen constant."""

DIRECTIONAL_STD = 0.03
"""tau of colour coefficients of degrees above 0, where that of degree 0 is 1 (`PRIOR_STD`): a rock
looks almost the same from all sides. A chosen constant (docs/parsimony.md)."""

LEARN_LOSS = 0.05
"""By how much the objective of a fit may rise where parameters are left out that the images hardly
pay for (`mgs refit`), dB: on views that were not fitted that costs as much, or twice that
(docs/parsimony.md). A chosen constant."""

PRIOR_STD = {"colour": 1.0, "scale": 0.125, "rotation": 0.0625, "opacity": 2.0}
"""tau: how far each parameter may plausibly lie from its start before any image is seen, in the
parameter's own unit:
colour 1 SH unit (0.28 linear RGB: albedo and shading of a rock), scale 0.125 (13 %), quaternion
0.0625 (about 7 degrees), opacity logit 2 (0.12 to 0.88 about one half). The mesh says how large the
Gaussians are and how they lie, so scale and rotation
are held tightly: with a wider tau they grow into needles that stand out of the rock
(docs/fit.md)."""

MEAN_STD = 0.5
"""tau of means that are learned, over the spacing of the prior's samples: a surface that is off by
more than that between its samples is another surface. A chosen constant. `mgs nbv` multiplies it by
the spacing, so that `prior_std` is in metres."""


BLOCKS_AT_ONCE = 2048
"""Blocks of which the determinants are computed together: 2 MB, which stay in a core's cache."""


def regularisation(
    groups: dict[str, slice],
    pixel_noise: float = PIXEL_NOISE,
    prior_std: Mapping[str, float] = PRIOR_STD,
) -> NDArray[np.float64]:
    """lam [P], the prior's information about each parameter, in the units of H: (sigma_e / tau)^2.

    J^T J has units (pixel value / parameter)^2, which differ between parameters, so one number
    cannot serve all of them. With a prior theta ~ N(theta_0, tau^2) the posterior precision is H /
    sigma_e^2 + 1 / tau^2 = (H + lam) / sigma_e^2, so this lam makes Eq. 7 equal 2/l times the
    mutual information of the parameters and the new image (diagonal, linearised), in
    nats. groups: columns of each kind of parameter, from `mgs.splat.groups`; prior_std: a number
    for each of these kinds.
    """
    lam = np.empty(max(columns.stop for columns in groups.values()))
    for name, columns in groups.items():
        lam[columns] = (pixel_noise / prior_std[name]) ** 2
    return lam


def lam_by_kind(lam: Array, groups: dict[str, slice]) -> dict[str, float]:
    """The number that lam [P] has in all columns of a kind of parameter, for each kind. groups: as
    in `regularisation`."""
    return {kind: float(lam[columns][0]) for kind, columns in groups.items()}


def observed(H: Array, lam: Array) -> NDArray[np.bool_]:
    """[N] which Gaussians the images say more about than the prior does (Eq. 9 with epsilon = lam).

    Read off the colour columns: colour information is the sum of squared blending weights, what the
    views see of a Gaussian.
    """
    return np.asarray((H[:, :3] > lam[:3]).any(axis=1))


def coverage(H: Array, lam: Array) -> float:
    """Surface coverage C_0 of Eq. 9: the share of Gaussians that are `observed`, 0 to 1.

    The loop passes H of the prior's Gaussians, as they were before training. At the trained model
    Eq. 9 mixes two things: Gaussians that fade behind their neighbours as training goes on would
    count as surface that no view sees.
    """
    return float(observed(H, lam).mean())


def uncertainty(H: Array, lam: Array) -> NDArray[np.float64]:
    """[N] mean over the parameters of each Gaussian of lam / (H + lam): the variance that is left,
    over that of the prior.

    In (0, 1]: 1 where nothing is known but the prior, near 0 where nearly everything is.
    """
    return np.asarray((lam / (H + lam)).mean(axis=1, dtype=np.float64))


def d_optimal(F: Array, H: Array, lam: Array) -> float:
    """Paper's Eq. 7: 1/l sum log(1 + F / (H + lam)), the decrease of the log-determinant of the
    posterior's covariance, per parameter."""
    return float(np.log1p(F / (H + lam)).mean(dtype=np.float64))


def t_optimal(F: Array, H: Array, lam: Array) -> float:
    """1/l sum [1/(H+lam) - 1/(H+F+lam)], the decrease of the average variance.

    The paper calls this A-optimal; POp-GS (and here) T-optimal, keeping A for its own p = -1.
    """
    return float((F / ((H + lam) * (H + F + lam))).mean(dtype=np.float64))


def a_optimal(F: Array, H: Array, lam: Array) -> float:
    """POp-GS's A-optimal (p = -1): the increase of the trace of the inverse covariance, 1/l sum F.
    Blind to H."""
    return float(F.mean(dtype=np.float64))


def e_optimal(F: Array, H: Array, lam: Array) -> float:
    """Increase of the smallest eigenvalue of H + lam. It is 0 while any parameter stays
    unobserved."""
    return float((H + F + lam).min() - (H + lam).min())


def fisherrf(F: Array, H: Array, lam: Array) -> float:
    """FisherRF's trace criterion, 1/l sum F / (H + lam): Eq. 7 without the logarithm, so nothing
    saturates."""
    return float((F / (H + lam)).mean(dtype=np.float64))


def i_optimal(F: Array, H: Array, lam: Array, weight: Array) -> float:
    """1/l sum weight [1/(H+lam) - 1/(H+F+lam)], the decrease of the variance predicted for a set of
    views, per parameter.

    weight: [N,P] mean information of those views, so how much their pixels depend on each parameter
    (diagonal, linearised). With a weight of 1 it is `t_optimal`.
    """
    return float((weight * F / ((H + lam) * (H + F + lam))).mean(dtype=np.float64))


def block_log_determinant(H: Array, lam: Array) -> float:
    """1/l sum over the Gaussians of log det(I + Lambda^-1/2 H Lambda^-1/2), Lambda = diag(lam):
    what the images say about them.

    H: [N,P,P] blocks of J^T J, so correlations between the parameters of one Gaussian count, those
    between Gaussians do not. The difference of two such values is Eq. 7 for blocks. Where rounding
    has made an eigenvalue -1 or less, so that there is no Cholesky factor, all negative eigenvalues
    of those BLOCKS_AT_ONCE blocks count as 0.
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


def coverage_greedy(F: Array, H: Array, lam: Array) -> float:
    """Number of Gaussians newly `observed`."""
    return float((observed(H + F, lam) & ~observed(H, lam)).sum())


@dataclass(frozen=True)
class Criterion:
    """A score, and the Gaussians at which its F and H are measured: as fitted so far, or as the
    prior gave them, before any training (then by exact Fisher information, whatever the estimator
    of the run)."""

    score: Score
    at: Literal["fitted", "prior"] = "fitted"


CRITERIA: dict[str, Criterion] = {
    "d-optimal": Criterion(d_optimal),
    "coverage": Criterion(coverage_greedy, at="prior"),
    "t-optimal": Criterion(t_optimal),
    "a-optimal": Criterion(a_optimal),
    "e-optimal": Criterion(e_optimal),
    "fisherrf": Criterion(fisherrf),
}
"""Policies that look at information, by name. A program may add its own (docs/howto/policy.md)."""
