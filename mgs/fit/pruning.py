"""Prune a model: remove the Gaussians whose removal changes the images least."""

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

# They hide and replace each other: removing two changes more than the sum of both.
NEIGHBOURS = 8  # nearest Gaussians of which no two are removed in the same round
SHARE = 1 / 8  # most of the Gaussians that one round of `fewest` removes
ROUNDS = 8  # most rounds. Each spends half of the change that is still allowed, then measures it.


@one_at_a_time
def removal_cost(
    gaussians: Gaussians, cameras: Sequence[Camera], background: Any = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Squared change of the images when one Gaussian is removed, summed over the cameras: float64
    [N], (pixel value)².

    It is sum alpha² |D|² over pixels (docs/notation.md), exact because a pixel is affine in each
    alpha. It ignores thresholds: Gaussians too deep to be drawn (TRANSMITTANCE_MIN) may appear.
    gaussians, background: as in `mgs.splat.render`. Raises InputError as `render`.
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
    """Result of `prune`."""

    kept: np.ndarray  # indices of the remaining Gaussians [M]
    noise: float  # allowed rms change of pixel values
    predicted: float  # rms change, by `removal_cost`
    actual: float  # as measured


def prune(gaussians: Gaussians, cameras: Sequence[Camera], noise: float) -> Pruned:
    """Remove as many Gaussians as the noise allows, those that change the images least.

    noise: allowed rms change of the pixel values that the model covers (each counts by its alpha),
    in the space in which it is blended.

    The predicted change of a set is the sum of `removal_cost`, as if its members did not overlap.
    For this to be nearly true, a round removes no two of NEIGHBOURS. After each round the change
    and the costs are measured again. A round that exceeds the noise is undone, so the measured
    change never exceeds it. Nothing is fitted. gaussians: NumPy fields. Raises InputError as
    `render`, and if the noise is not positive.
    """
    if not 0 < noise < 1e9:
        raise InputError(f"prune: noise {noise} must be positive; correct `noise`")
    before, covered = _images(gaussians, cameras)
    indices, predicted, actual, budget = np.arange(len(gaussians)), 0.0, 0.0, noise**2 * covered
    for _ in range(ROUNDS):
        rest = gaussians[indices]
        cost = removal_cost(rest, cameras)
        cheap = _cheapest_apart(cost, rest.means, (budget - actual) / 2)
        fewer = np.delete(indices, cheap)
        after, _ = _images(gaussians[fewer], cameras)
        change = sum(float(((a - b) ** 2).sum()) for a, b in zip(after, before, strict=True))
        if not cheap or change > budget:
            break
        indices, predicted, actual = fewer, predicted + float(cost[cheap].sum()), change
    scale = max(covered, 1e-30)
    return Pruned(indices, noise, float(np.sqrt(predicted / scale)), float(np.sqrt(actual / scale)))


def fewest(gaussians: Gaussians, cameras: Sequence[Camera], count: int) -> np.ndarray:
    """Indices [count] of the Gaussians that are left when those that change the images least are
    removed, in rounds of at most SHARE of the rest (`prune`). Raises InputError as `render`, and if
    `count` is negative."""
    if count < 0:
        raise InputError(f"fewest: count {count} must be at least 0; correct `count`")
    indices = np.arange(len(gaussians))
    while len(indices) > count:
        rest = gaussians[indices]
        cheap = _cheapest_apart(removal_cost(rest, cameras), rest.means, np.inf)
        most = min(len(indices) - count, max(1, int(SHARE * len(indices))))
        indices = np.delete(indices, cheap[:most])
    return indices


def _images(gaussians: Gaussians, cameras: Sequence[Camera]) -> tuple[list[np.ndarray], float]:
    """Images [H,W,3], float64, and the number of pixel values that the model covers: 3 times the
    sum of alpha."""
    images = [render(gaussians, camera) for camera in cameras]
    covered = 3 * sum(float(np.asarray(image.alpha, np.float64).sum()) for image in images)
    return [np.asarray(image.rgb).astype(np.float64) for image in images], covered


def _cheapest_apart(cost: np.ndarray, means: np.ndarray, allowed: float) -> list[int]:
    """Cheapest Gaussians whose costs [N] add up to at most `allowed`, no two of them among each
    other's NEIGHBOURS. means: [N,3]."""
    cheap: list[int] = []
    if len(cost) == 0:
        return cheap
    near = cKDTree(means).query(means, min(NEIGHBOURS + 1, len(cost)))[1].reshape(len(cost), -1)
    blocked, total = np.zeros(len(cost), bool), 0.0
    for j in np.argsort(cost, kind="stable"):
        if total + cost[j] > allowed:
            break
        if not blocked[j]:
            total += cost[j]
            cheap.append(int(j))
            blocked[near[j]] = True
    return cheap
