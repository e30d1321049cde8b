"""Policies that were tried and are no rows of `mgs nbv --policy`: `--policy benchmarks/policies.py:NAME` takes them."""

from __future__ import annotations

import numpy as np

from mgs.active.directional import Views, gains, squared_weights
from mgs.active.outlook import Outlook


def linear_look(outlook: Outlook) -> np.ndarray:
    """`directional-i` with colours that change with the direction linearly (SH degree 1, tau 0.1) instead of degree 3."""
    return outlook.gains(outlook.visited, outlook.left, 1, 0.1, True)


def degree_0(outlook: Outlook) -> np.ndarray:
    """`directional-i` with colours that are the same from everywhere: what is left are pixels on parts seen little so far."""
    return outlook.gains(outlook.visited, outlook.left, 0, 0.1, True)


def poses_alone(outlook: Outlook) -> np.ndarray:
    """`directional-i` of one point in the middle of the rock, which every pose sees alike: angles between poses, no surface."""

    def alike(positions: np.ndarray) -> Views:
        return Views(positions, np.ones((len(positions), 1)))

    middle, lam = outlook.centre[None], float(outlook.prior_lam[0])
    return gains(middle, lam, 3, 0.1, alike(outlook.taken), alike(outlook.candidates), alike(outlook.dome().positions))


def trained_gaussians(outlook: Outlook) -> np.ndarray:
    """`directional-i` that measures on the fitted Gaussians what the views taken and the candidates see, not on the prior's.

    Their shapes and opacities are those of the last fit. What the dome sees is still measured on the prior's: of the fitted
    model a policy is told what the dataset's own poses see, and no others.
    """

    def fitted(frames: list[int]) -> Views:
        on_surface = slice(len(outlook.points))  # not those behind it
        seen = [squared_weights(outlook.estimate(i, "exact"))[on_surface] for i in frames]
        return Views(outlook.positions[frames], np.stack(seen))

    lam = float(outlook.prior_lam[0])
    return gains(outlook.points, lam, 3, 0.1, fitted(outlook.visited), fitted(outlook.left), outlook.dome())


def without_opacity(F: np.ndarray, H: np.ndarray, lam: np.ndarray) -> float:
    """`d-optimal` of all parameters but the opacities (column 10), which POp-GS leaves out of its score."""
    return float(np.log1p(F / (H + lam))[:, :10].mean(dtype=np.float64))
