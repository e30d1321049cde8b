"""Optimisers that the fit does not have, for `benchmarks/optimisers.py`: what more curvature than a
diagonal would win.

Vectors are [N,11] float64, a row for each Gaussian, columns as in `mgs.splat.groups(0)`. Each
optimiser gives the work it has done so far, in passes (one is a render with gradients of every
view), and the model, after every step or pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from linearity import COORDINATES

from mgs.colour import SH_C0
from mgs.fit.fitting import COLOUR_MIN
from mgs.fit.objective import Objective, Vector
from mgs.fit.optimisers import INFORMATION_PASSES, NATURAL_BETA, NATURAL_OVERLAP
from mgs.fit.settings import RATES, TrainSettings
from mgs.gaussians import LEARNED, Gaussians
from mgs.memory import padded
from mgs.seeds import generator
from mgs.splat import fisher, groups

LM_CG, LM_DAMPING = 8, 300.0
"""Levenberg-Marquardt: iterations of conjugate gradients in each step, and first damping, a factor
of the prior's lam."""
COLOUR_CG, COLOUR_PASSES = 4, 5
"""Colours solved: iterations of conjugate gradients, and passes from one solution to the next."""
CURVATURE_COST = 1.5
"""Passes that a product with the curvature costs: one derivative in forward mode and one in reverse
mode for each view, where a gradient takes one in reverse mode and the render."""
BLOCK_COST = 2.5
"""Passes that the blocks of all views cost, against gradients of all views (`mgs bench splat`)."""

COLOUR = groups(0)["colour"]


def joined(vector: Vector) -> np.ndarray:
    """A vector of `mgs.fit.objective` as [N,11]."""
    parts = [np.asarray(part, np.float64) for part in vector]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def apart(matrix: np.ndarray, model: Gaussians) -> Vector:
    """The way back, in the shapes of the model's parameters."""
    shapes = [getattr(model, name).shape for name in LEARNED]
    columns = zip(shapes, groups(0).values(), strict=True)
    return [
        mi.TensorXf(padded(matrix[:, c].astype(np.float32)).ravel(), shape) for shape, c in columns
    ]


def moved(model: Gaussians, move: np.ndarray) -> Gaussians:
    """The model moved by [N,11], colours within their bound (`mgs.fit.fitting.COLOUR_MIN`)."""
    values = {
        name: getattr(model, name) + step
        for name, step in zip(LEARNED, apart(move, model), strict=True)
    }
    least = (COLOUR_MIN - 0.5) / SH_C0
    values["sh"] = mi.TensorXf(dr.maximum(values["sh"].array, least), values["sh"].shape)
    dr.eval(values)
    return replace(model, **values)


def lam_of(goal: Objective) -> np.ndarray:
    """[11] the prior's lam in each column."""
    columns = zip(groups(0).values(), goal.prior.lam.values(), strict=True)
    return np.concatenate([np.full(c.stop - c.start, float(lam[0])) for c, lam in columns])


def conjugate_gradients(
    product: Callable[[np.ndarray], np.ndarray],
    right: np.ndarray,
    precondition: Callable[[np.ndarray], np.ndarray],
    iterations: int,
) -> tuple[np.ndarray, np.ndarray]:
    """x with product(x) near `right`, and what is missing: right - product(x)."""
    x, residual = np.zeros_like(right), right.copy()
    z = precondition(residual)
    direction, rz = z, float((residual * z).sum())
    for _ in range(iterations):
        along = product(direction)
        step = rz / float((direction * along).sum())
        x, residual = x + step * direction, residual - step * along
        z = precondition(residual)
        before, rz = rz, float((residual * z).sum())
        direction = z + rz / before * direction
    return x, residual


def blocks(goal: Objective, model: Gaussians) -> np.ndarray:
    """[N,11,11] the diagonal blocks of J^T J, summed over the images."""
    total = np.zeros((len(model), 11, 11))
    for photo in goal.photos:
        total += fisher(model, photo.camera, "block", cache=goal.cache)
    return total


def levenberg_marquardt(
    goal: Objective,
    model: Gaussians,
    steps: int,
    by_blocks: bool = False,
    straighter: bool = False,
    damping: float = LM_DAMPING,
) -> Iterator[tuple[float, Gaussians]]:
    """Steps (J^T J + (1 + mu) lam)^-1 g by conjugate gradients, kept where they lower the
    objective; mu falls after good steps
    and rises after bad ones. by_blocks: the preconditioner is not the diagonal of that matrix, but
    its 11x11 blocks.
    straighter: steps are made in opacities and squared scales, in which images are more nearly
    linear (`linearity.py`).
    damping: the first mu."""
    work, mu, phi = 1.0, damping, goal.phi(model)
    for _ in range(steps):
        move, expected = _damped_step(goal, model, mu * lam_of(goal), by_blocks)
        candidate = moved(model, _straighter(model, move) if straighter else move)
        work += (
            1 + (BLOCK_COST if by_blocks else 1) + 0.4 + CURVATURE_COST * LM_CG
        )  # gradient, preconditioner, objective
        found = goal.phi(candidate)
        gain = (phi - found) / expected
        if gain > 0.05:
            model, phi = candidate, found
        mu *= 1 / 3 if gain > 0.75 else 3 if gain < 0.4 else 1
        yield work, model


def _straighter(model: Gaussians, move: np.ndarray) -> np.ndarray:
    """The move that is the same to first order, but straight in opacities and squared scales."""
    columns, bent = dict(zip(LEARNED, groups(0).values(), strict=True)), move.copy()
    for name, values in (COORDINATES["opacity itself"], COORDINATES["scale squared"]):
        now, c = np.asarray(getattr(model, name), np.float64).reshape(len(model), -1), columns[name]
        bent[:, c] = values(now, move[:, c]) - now
    return bent


def _damped_step(
    goal: Objective, model: Gaussians, damping: np.ndarray, by_blocks: bool
) -> tuple[np.ndarray, float]:
    """One such step, damping [11] being mu lam, and by how much it lowers Phi where images are
    linear."""
    gradient = joined(goal.gradient(model))
    if by_blocks:
        inverse = np.linalg.inv(blocks(goal, model) + np.diag(lam_of(goal) + damping))
    else:
        diagonal = joined(goal.diagonal(model)) + damping

    def precondition(r: np.ndarray) -> np.ndarray:
        return np.einsum("nij,nj->ni", inverse, r) if by_blocks else r / diagonal

    def product(v: np.ndarray) -> np.ndarray:
        return joined(goal.curvature_times(model, apart(v, model))) + damping * v

    x, residual = conjugate_gradients(product, -gradient, precondition, LM_CG)
    return x, 0.5 * float(((residual - gradient) * x).sum())


def natural_by_blocks(
    goal: Objective, model: Gaussians, passes: int
) -> Iterator[tuple[float, Gaussians]]:
    """The natural gradient of `mgs.fit.optimisers` with 11x11 blocks as its metric: the diagonal
    that it has there, and beyond that the correlations of each Gaussian's parameters, those of all
    images together. A Gaussian's step is cut as a
    whole, so that it keeps its direction: cut one by one, steps against the correlations make the
    objective rise."""

    def metric(now: Gaussians) -> Callable[[np.ndarray], np.ndarray]:
        whole = blocks(goal, now) + np.diag(lam_of(goal))
        std = np.sqrt(np.einsum("nii->ni", whole))
        largest = np.sqrt(NATURAL_OVERLAP * joined(goal.largest_diagonal(now)))
        inverse = np.linalg.inv(whole / (std[:, :, None] * std[:, None, :]))
        return lambda m: np.einsum("nij,nj->ni", inverse, m / largest) / largest

    yield from _natural(goal, model, passes, metric, BLOCK_COST + 1, cut=_as_a_whole)


def natural_cut_whole(
    goal: Objective, model: Gaussians, passes: int
) -> Iterator[tuple[float, Gaussians]]:
    """The same with the diagonal alone, to tell what the blocks do from what the cut does."""
    yield from _natural(goal, model, passes, _diagonal(goal), 1, cut=_as_a_whole)


def natural_colours_solved(
    goal: Objective, model: Gaussians, passes: int
) -> Iterator[tuple[float, Gaussians]]:
    """The natural gradient as it is, and every COLOUR_PASSES passes all colours at once: while the
    rest stays as it is they are a linear least squares problem, at whose solution the gradient of
    the rest is that of variable projection."""
    yield from _natural(goal, model, passes, _diagonal(goal), 1, colours=True)


Metric = Callable[[Gaussians], Callable[[np.ndarray], np.ndarray]]
"""(model) -> what a gradient [N,11] is turned into a step by."""


def _diagonal(goal: Objective) -> Metric:
    def metric(now: Gaussians) -> Callable[[np.ndarray], np.ndarray]:
        largest = NATURAL_OVERLAP * joined(goal.largest_diagonal(now))
        return lambda m: m / largest

    return metric


def _one_by_one(step: np.ndarray, rate: np.ndarray) -> np.ndarray:
    return np.clip(step, -rate, rate)


def _as_a_whole(step: np.ndarray, rate: np.ndarray) -> np.ndarray:
    return step / np.maximum(np.abs(step) / rate, 1).max(axis=1, keepdims=True)


def _natural(
    goal: Objective,
    model: Gaussians,
    passes: int,
    metric: Metric,
    cost: float,
    colours: bool = False,
    cut: Callable[[np.ndarray, np.ndarray], np.ndarray] = _one_by_one,
) -> Iterator[tuple[float, Gaussians]]:
    """Passes with one step on each image. cost: of the metric, passes; colours: whether they are
    solved; cut(step, rates) shortens steps that are longer than the rates."""
    alone = [replace(goal, photos=[photo]) for photo in goal.photos]
    others = lam_of(goal) * (1 - 1 / len(alone))  # the prior goes with each image by its share
    start = joined([getattr(goal.prior.start, name) for name in LEARNED])
    rates = np.concatenate(
        [np.full(c.stop - c.start, RATES[kind]) for kind, c in groups(0).items()]
    )
    rng, momentum, work, decay = (
        generator(0, "train/order"),
        np.zeros_like(start),
        0.0,
        TrainSettings().decay,
    )
    for done in range(passes):
        rate = rates * decay ** (done / max(passes - 1, 1))
        if done % INFORMATION_PASSES == 0:
            times, work = metric(model), work + cost
        for i in rng.permutation(len(alone)):
            away = joined([getattr(model, name) for name in LEARNED]) - start
            gradient = joined(alone[i].gradient(model)) - others * away
            momentum = NATURAL_BETA * momentum + (1 - NATURAL_BETA) * gradient
            model = moved(model, cut(-times(momentum), rate))
        work += 1
        if colours and (done + 1) % COLOUR_PASSES == 0:
            model = _with_best_colours(goal, model)
            work += 2 + CURVATURE_COST * COLOUR_CG  # gradient, diagonal, products
        yield work, model


def _with_best_colours(goal: Objective, model: Gaussians) -> Gaussians:
    """The model with the colours that lower the objective most while all else stays."""

    def product(v: np.ndarray) -> np.ndarray:
        whole = np.zeros((len(model), 11))
        whole[:, COLOUR] = v
        return joined(goal.curvature_times(model, apart(whole, model)))[:, COLOUR]

    gradient, diagonal = (
        joined(found)[:, COLOUR] for found in (goal.gradient(model), goal.diagonal(model))
    )
    move = np.zeros((len(model), 11))
    move[:, COLOUR] = conjugate_gradients(product, -gradient, lambda r: r / diagonal, COLOUR_CG)[0]
    return moved(model, move)
