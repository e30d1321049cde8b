"""Policies that were tried and are no rows of `mgs nbv --policy`: `--policy
benchmarks/policies.py:NAME` takes them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mgs.policy.context import PolicyContext
from mgs.policy.criteria import d_optimal
from mgs.policy.directional import Views, gains, squared_weights
from mgs.policy.registry import PAPER_LAM


def linear_look(context: PolicyContext) -> np.ndarray:
    """`directional-i` with colours that change with the direction linearly (SH degree 1, tau 0.1)
    instead of degree 3."""
    return context.gains(context.taken_frames, context.candidate_frames, 1, 0.1, True)


def degree_0(context: PolicyContext) -> np.ndarray:
    """`directional-i` with colours that are the same from everywhere: what is left are pixels on
    parts seen little so far."""
    return context.gains(context.taken_frames, context.candidate_frames, 0, 0.1, True)


def poses_alone(context: PolicyContext) -> np.ndarray:
    """`directional-i` of one point in the middle of the rock, which every pose sees alike: angles
    between poses, no surface."""

    def alike(positions: np.ndarray) -> Views:
        return Views(positions, np.ones((len(positions), 1)))

    middle, lam = context.centre[None], float(context.prior_lam[0])
    return gains(
        middle,
        lam,
        3,
        0.1,
        alike(context.taken),
        alike(context.candidates),
        alike(context.dome().positions),
    )


def trained_gaussians(context: PolicyContext) -> np.ndarray:
    """`directional-i` that measures on the fitted Gaussians what the views taken and the candidates
    see, not on the prior's.

    Their shapes and opacities are those of the last fit. What the dome sees is still measured on
    the prior's: of the fitted model a policy is told what the dataset's own poses see, and no
    others.
    """

    def fitted(frames: list[int]) -> Views:
        on_surface = slice(len(context.points))  # not those behind it
        seen = [squared_weights(context.estimate(i, "exact"))[on_surface] for i in frames]
        return Views(context.positions[frames], np.stack(seen))

    lam = float(context.prior_lam[0])
    return gains(
        context.points,
        lam,
        3,
        0.1,
        fitted(context.taken_frames),
        fitted(context.candidate_frames),
        context.dome(),
    )


def without_opacity(F: np.ndarray, H: np.ndarray, lam: np.ndarray) -> float:
    """`d-optimal` of all parameters but the opacities (column 10), which POp-GS leaves out of its
    score."""
    return float(np.log1p(F / (H + lam))[:, :10].mean(dtype=np.float64))


def _of_kind(kind: str) -> Callable[[np.ndarray, np.ndarray, np.ndarray], float]:
    """`d-optimal` of one kind of parameters alone."""

    def score(F: np.ndarray, H: np.ndarray, lam: np.ndarray) -> float:
        from mgs.splat import groups

        return float(np.log1p(F / (H + lam))[:, groups(0)[kind]].mean(dtype=np.float64))

    return score


colour_alone, scale_alone = _of_kind("colour"), _of_kind("scale")
rotation_alone, opacity_alone = _of_kind("rotation"), _of_kind("opacity")


def _by_loss(context: PolicyContext, estimator: str, lam: np.ndarray) -> np.ndarray:
    """Eq. 7 of an estimator, for the views taken too."""
    H = sum(context.estimate(i, estimator).astype(np.float64) for i in context.taken_frames)
    return np.array(
        [d_optimal(context.estimate(i, estimator), H, lam) for i in context.candidate_frames]
    )


def paper_black(context: PolicyContext) -> np.ndarray:
    """`paper` with another loss: the mean squared colour, so the difference from black."""
    return _by_loss(
        context,
        _squared_gradient("loss-black", lambda rgb: rgb * (2 / len(rgb.array))),
        _one_lam(context),
    )


def paper_mean(context: PolicyContext) -> np.ndarray:
    """`paper` with a third loss: the mean colour itself."""
    return _by_loss(
        context,
        _squared_gradient("loss-mean", lambda rgb: rgb * 0 + 1 / len(rgb.array)),
        _one_lam(context),
    )


def paper_scaled(context: PolicyContext) -> np.ndarray:
    """`paper` with the lambdas of `d-optimal`, which have units, times one number: the ratio of the
    mean entries of its information and of the exact. A mean loss has far smaller gradients than
    pixels have, and one lambda of 1e-6 swamps them."""
    means = [
        np.mean([context.estimate(i, name).mean() for i in context.taken_frames])
        for name in ("loss-gradient", "exact")
    ]
    return _by_loss(context, "loss-gradient", context.lam * float(means[0] / means[1]))


def paper_small_lam(context: PolicyContext) -> np.ndarray:
    """`paper` with one lambda that is as small for its information as 1e-6 is for the exact."""
    means = [
        np.mean([context.estimate(i, name).mean() for i in context.taken_frames])
        for name in ("loss-gradient", "exact")
    ]
    return _by_loss(context, "loss-gradient", _one_lam(context) * float(means[0] / means[1]))


def exact_one_lam(context: PolicyContext) -> np.ndarray:
    """`d-optimal` with the one lambda of `paper`."""
    return _by_loss(context, "exact", _one_lam(context))


def _one_lam(context: PolicyContext) -> np.ndarray:
    return np.full_like(context.lam, PAPER_LAM)


def _squared_gradient(name: str, image_gradient: Callable[[Any], Any]) -> str:
    """Add the squared gradient of a scalar loss to the estimators, and return its name.
    image_gradient: of the loss."""
    from mgs.splat import ESTIMATORS
    from mgs.splat.information import _gradient

    def estimator(gaussians: Any, camera: Any, background: Any, cache: Any) -> np.ndarray:
        return _gradient(gaussians, image_gradient, camera, background, cache) ** 2

    ESTIMATORS.setdefault(name, estimator)
    return name
