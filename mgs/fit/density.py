"""Density control of a fit: between passes, Gaussians move to where the images need them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.special import comb, logit

from mgs.colour import SH_C0
from mgs.fit.objective import Objective, View
from mgs.gaussians import Gaussians
from mgs.memory import padded
from mgs.rotation import rotmat_from_quat
from mgs.splat import as_drjit
from mgs.splat.recording import frozen

DENSITY_PASSES = 5
"""Passes between two calls of a density control, each as costly as a pass."""

DENSITY_UNTIL = 0.75
"""Share of the passes after which the number and places of Gaussians are left alone."""

LEAST_OPACITY = 0.005
"""Opacity at and below which a Gaussian is dead (Kheradmand et al. 2024)."""

MOVED_SHARE = 0.05
"""Share of the Gaussians, those of least blending weight in the images, that count as dead too."""

MOST_COPIES = 51
"""Most Gaussians in one place after a relocation (Kheradmand et al. 2024)."""

SPREAD = 0.5
"""Standard deviation of a moved Gaussian's offset from its copy, over that of the copy."""


@dataclass(frozen=True)
class Statistics:
    """Sums over images and pixels for each Gaussian at a model, [N].

    weight: blending weights. error: squared residuals times blending weights.
    """

    weight: np.ndarray
    error: np.ndarray


Control = Callable[[Gaussians, Statistics, np.random.Generator], tuple[Gaussians, np.ndarray]]
"""control(model, statistics, rng) -> (model, kept [N]): index of the Gaussian of the given model
that each still is, -1 for a changed one. Models have NumPy fields."""


def split(opacity: np.ndarray, copies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Opacity and scale factor of `copies` equal Gaussians that replace one of this opacity, [M].

    They keep the opacity at the centre, and its integral along a line through the centre (Eq. 9 of
    Kheradmand et al. 2024, 3D Gaussian splatting as Markov chain Monte Carlo).
    """
    o = np.asarray(opacity, np.float64)
    new = -np.expm1(np.log1p(-o) / copies)
    k = np.arange(1, MOST_COPIES + 1)
    signed = (-1.0) ** (k + 1) / np.sqrt(k) * comb(np.asarray(copies)[:, None], k)
    return new, o / (signed * new[:, None] ** k).sum(1)


def relocate(
    model: Gaussians, found: Statistics, rng: np.random.Generator
) -> tuple[Gaussians, np.ndarray]:
    """A `Control` with a fixed number of Gaussians: dead ones become copies of others, drawn by
    their error.

    As Kheradmand et al. 2024, but the error of the images, not opacity, says where Gaussians are
    needed, and the least seen ones move too.
    """
    n = len(model)
    opacity = np.clip(model.opacities.astype(np.float64), 1e-6, 1 - 1e-6)
    dead = opacity <= LEAST_OPACITY
    dead[np.argsort(found.weight, kind="stable")[: round(MOVED_SHARE * n)]] = True
    needed = np.where(dead, 0.0, found.error)
    if not dead.any() or not needed.sum() > 0:
        return model, np.arange(n)
    drawn = rng.multinomial(dead.sum(), needed / needed.sum())
    count = np.minimum(drawn, MOST_COPIES - 1)
    split_ones = np.flatnonzero(count)
    sources = np.repeat(np.arange(n), count)
    moved = rng.permutation(np.flatnonzero(dead))[: len(sources)]
    parts = [np.array(getattr(model, f.name)) for f in fields(model)]
    new = Gaussians(*parts)
    opacities, factors = split(opacity[split_ones], count[split_ones] + 1)
    new.logit_opacities[split_ones] = logit(opacities)
    new.log_scales[split_ones] += np.log(factors)[:, None]
    for part in parts:
        part[moved] = part[sources]
    along = SPREAD * np.exp(new.log_scales[moved].astype(np.float64))
    offsets = rotmat_from_quat(new.quats[moved]) @ (along * rng.normal(size=along.shape))[..., None]
    new.means[moved] += offsets[..., 0]
    kept = np.arange(n)
    kept[moved] = kept[split_ones] = -1
    return new, kept


DENSITIES: dict[str, Control | None] = {"fixed": None, "relocate": relocate}
"""Density controls by name."""


def controlled(
    control: Control,
    goal: Objective,
    model: Gaussians,
    buffers: list[list[Any]],
    rng: np.random.Generator,
) -> tuple[Objective, Gaussians, list[list[Any]]]:
    """Call a control. A Gaussian that changed is its own start in the prior, and its buffers are
    zero."""
    before = Gaussians(*(np.array(getattr(model, f.name)) for f in fields(model)))
    after, kept = control(before, statistics(goal, model), rng)
    same, rows = kept >= 0, np.maximum(kept, 0)

    def carried(old: Any, new: Any = 0.0) -> Any:
        found = np.array(old)[rows]
        found[~same] = new
        return mi.TensorXf(padded(found))

    start = Gaussians(
        *(
            carried(getattr(goal.prior.start, f.name), getattr(after, f.name)[~same])
            for f in fields(after)
        )
    )
    kept_buffers = [[carried(buffer) for buffer in each] for each in buffers]
    return replace(goal, prior=replace(goal.prior, start=start)), as_drjit(after), kept_buffers


def statistics(goal: Objective, model: Gaussians) -> Statistics:
    """Statistics of a model, TensorXf fields, in all images of an objective."""
    weight, error = np.zeros(len(model)), np.zeros(len(model))
    for photo in goal.photos:
        found = _image_statistics(model, goal.view(model, photo))
        weight, error = weight + np.array(found[0]), error + np.array(found[1])
    return Statistics(weight, error)


@frozen(lambda model, view: (*model.sh.shape, *view.recorded_sizes))
def _image_statistics(model: Gaussians, view: View) -> list[Any]:
    """Blending weights, and squared residuals times blending weights, of one image, Float [N] each.

    A colour's derivative is the blending weight, so both are derivatives of a sum of pixels.
    """
    found, (count, coefficients, _) = [], model.sh.shape
    first = dr.arange(mi.UInt32, count) * (3 * coefficients)
    for squared in (False, True):
        copy = replace(model, sh=dr.copy(dr.detach(model.sh)))
        dr.enable_grad(copy.sh)
        drawn = view.rendered(copy).array
        residual = dr.detach((drawn - view.target.pixels) * view.target.weights)
        dr.backward(dr.sum(drawn * dr.square(residual) if squared else drawn))
        slope = dr.grad(copy.sh).array
        found.append(sum(dr.gather(mi.Float, slope, first + c) for c in range(3)) / (3 * SH_C0))
    return found
