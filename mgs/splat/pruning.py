"""Which Gaussians a model can do without: how much the removal of each changes the images, and a
prune that uses it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from scipy.spatial import cKDTree

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.gaussians import Gaussians
from mgs.splat import kernels
from mgs.splat.recording import one_at_a_time
from mgs.splat.rendering import as_colour, as_drjit, render, splats_and_lists
from mgs.splat.walking import sums_by_splat

NEIGHBOURS = 8
"""Of so many nearest Gaussians none is removed in the same round: they hide and replace each other,
so that the removal of two changes more than both removals by themselves. About those that touch one
on the surface, and the one behind it."""

ROUNDS = 8
"""Most rounds. In each, half of the change that is still allowed is spent, and what it came to is
then measured."""


@one_at_a_time
def removal_cost(
    gaussians: Gaussians, cameras: Sequence[Camera], background: Any = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """The squared change of the images of these cameras where one Gaussian is removed: float64 [N],
    (linear RGB)².

    It is sum alpha² |D|² over pixels (docs/notation.md), summed over the cameras: exact, since a
    pixel is affine in each alpha.
    Left out is what the removal does to thresholds: where a pixel was finished before
    (TRANSMITTANCE_MIN), Gaussians that lay
    too deep to be drawn may appear. gaussians, background: as in `mgs.splat.render`. Raises
    InputError as `render`.
    """
    cost = np.zeros(len(gaussians))
    if len(gaussians) == 0:
        return cost
    model, colour = as_drjit(gaussians), dr.detach(as_colour(background))
    for camera in cameras:
        _, lists, packed = splats_and_lists(model, camera, None)
        cost += np.asarray(sums_by_splat(lists, kernels.removal(lists, packed, colour), 1)[0])
    return cost


@dataclass(frozen=True)
class Pruned:
    """kept: indices [M] of the Gaussians that stay. noise: rms change that was allowed, linear RGB.
    predicted, actual: rms
    change of the images by the whole set that was removed: predicted from `removal_cost`, and
    measured; over the pixel values that the model covers."""

    kept: np.ndarray
    noise: float
    predicted: float
    actual: float


def prune(gaussians: Gaussians, cameras: Sequence[Camera], noise: float) -> Pruned:
    """Remove the Gaussians without which the images of these cameras change least, as many as the
    noise allows.

    noise: rms change of a pixel value that is allowed, linear RGB, over the pixels that the model
    covers (each counts by its alpha). Predicted for a set is the sum of its members'
    `removal_cost`, as if they did not overlap. So that this nearly holds, a round removes no two of
    NEIGHBOURS. After each round the images are drawn and the costs measured anew; a round that went
    beyond the noise is taken back, so the change that is measured never exceeds it.
    gaussians: NumPy fields. Nothing is fitted. Raises InputError as `render`, and for a noise that
    is not positive.
    """
    if not 0 < noise < np.inf:
        raise InputError(f"prune: noise {noise} must be positive, linear RGB; correct --noise")
    before, covered = _images(gaussians, cameras)
    kept, predicted, actual, allowed = np.arange(len(gaussians)), 0.0, 0.0, noise**2 * covered
    for _ in range(ROUNDS):
        left = gaussians[kept]
        cost = removal_cost(left, cameras)
        chosen = _cheapest_apart(cost, left.means, (allowed - actual) / 2)
        fewer = np.delete(kept, chosen)
        after, _ = _images(gaussians[fewer], cameras)
        change = sum(float(((a - b) ** 2).sum()) for a, b in zip(after, before, strict=True))
        if not chosen or change > allowed:
            break
        kept, predicted, actual = fewer, predicted + float(cost[chosen].sum()), change
    scale = max(covered, 1e-30)
    return Pruned(kept, noise, float(np.sqrt(predicted / scale)), float(np.sqrt(actual / scale)))


def _images(gaussians: Gaussians, cameras: Sequence[Camera]) -> tuple[list[np.ndarray], float]:
    """The images [H,W,3], float64, and the number of pixel values that the model covers: three
    times the sum of alpha."""
    drawn = [render(gaussians, camera) for camera in cameras]
    covered = 3 * sum(float(np.asarray(image.alpha, np.float64).sum()) for image in drawn)
    return [np.asarray(image.rgb).astype(np.float64) for image in drawn], covered


def _cheapest_apart(cost: np.ndarray, means: np.ndarray, allowed: float) -> list[int]:
    """The cheapest Gaussians, taken one by one while their costs [N] add up to no more than is
    allowed, no two of them among each other's NEIGHBOURS nearest; means [N,3]."""
    chosen: list[int] = []
    if len(cost) == 0:
        return chosen
    near = cKDTree(means).query(means, min(NEIGHBOURS + 1, len(cost)))[1].reshape(len(cost), -1)
    blocked, total = np.zeros(len(cost), bool), 0.0
    for j in np.argsort(cost, kind="stable"):
        if total + cost[j] > allowed:
            break
        if not blocked[j]:
            total += cost[j]
            chosen.append(int(j))
            blocked[near[j]] = True
    return chosen
