"""Fit Gaussians to posed images: the most probable parameters, given the images and the prior.
Means stay frozen by default.

What is lowered is the objective of `mgs.fit.objective`. One optimiser step draws one image; a pass
draws all of them once, in an order of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.colour import SH_C0
from mgs.errors import InputError, row_named
from mgs.fit.objective import Objective, Prior, filled, objective, watched, weighted_squares
from mgs.fit.optimisers import INFORMATION_PASSES, OPTIMISERS
from mgs.fit.settings import TrainSettings
from mgs.fit.stopping import StopReason, stop_reason
from mgs.gaussians import Gaussians, learned
from mgs.seeds import generator
from mgs.splat import ListCache, as_drjit
from mgs.splat.blocks import BlockLists
from mgs.splat.projection import project
from mgs.splat.recording import frozen
from mgs.splat.rendering import composite_channels


@dataclass(frozen=True)
class Fit:
    """What a fit found, and why it stopped.

    A loss is 2 Phi over the number of pixel values: the mean squared error plus the prior's part.
    gaussians: the model (NumPy fields) at the end of the pass of the lowest loss; the model given,
    where no pass had a finite
    one. loss: that lowest loss. losses: of the model given, then of each pass. The loss of a pass
    is the mean of its steps'
    losses, each measured before its step: of the models on the way through the pass, not of its
    last one.
    passes, iterations: how many were made, those after the lowest loss too.
    """

    gaussians: Gaussians
    loss: float
    losses: tuple[float, ...]
    passes: int
    iterations: int
    stop_reason: StopReason


COLOUR_MIN = 1e-4
"""Least value of a colour of degree 0 after a step, linear RGB. A colour cannot be negative, and a
coefficient whose colour is clamped at 0 when it is drawn has no gradient that could bring it back.
This bound is above 0, so that every channel keeps its gradient, and below half a step of an 8-bit
sRGB image."""


def _in_bounds(model: Gaussians) -> Gaussians:
    """The model with the colours of degree 0 at COLOUR_MIN or more. Of higher degrees, no single
    coefficient has a bound."""
    if model.sh.shape[1] > 1:
        return model
    sh = mi.TensorXf(dr.maximum(model.sh.array, (COLOUR_MIN - 0.5) / SH_C0), model.sh.shape)
    return replace(model, sh=sh)


def _recorded_sizes(
    optimiser: str,
    gaussians: Gaussians,
    buffers: Any,
    camera: Any,
    packed: Any,
    lists: BlockLists,
    target: Any,
    weight: Any,
    size: Any,
    rates: Any,
    t: Any,
    prior: Prior,
    information: Any,
) -> tuple[Any, ...]:
    return (
        optimiser,
        prior.means,
        len(lists.splat),
        len(lists.block),
        len(target),
        *gaussians.sh.shape,
        *size,
    )


@frozen(_recorded_sizes)
def _step(
    optimiser: str,
    gaussians: Gaussians,
    buffers: list[list[Any]],
    camera: Any,
    packed: Any,
    lists: BlockLists,
    target: Any,
    weight: Any,
    size: Any,
    rates: list[Any],
    t: Any,
    prior: Prior,
    information: list[Any],
) -> tuple[Gaussians, list[list[Any]], Any]:
    """One step of the optimiser on one image and its share of the prior. Returns parameters,
    buffers, loss before the step.

    buffers, rates: for each of the learned arrays; packed: the Gaussians' splats, packed for the
    lists; size: that of a `Photo`; t: UInt32, step number from 1; target, weight: Float [H*W*C];
    information: see `mgs.fit.optimisers.Optimiser`.
    """
    copy = watched(gaussians, prior)
    drawn = composite_channels(project(copy, camera), packed, lists, *size)
    error = (drawn.array - target) * weight
    loss = dr.mean(dr.square(error))
    dr.backward(0.5 * dr.sum(dr.square(error)))
    step, moved, kept = mi.Float(t), {}, []
    for name, kept_before, rate, known in zip(prior.lam, buffers, rates, information, strict=True):
        value, slope = dr.detach(getattr(copy, name)), dr.grad(getattr(copy, name))
        away = prior.along(name, value - getattr(prior.start, name))
        pull = prior.lam[name] * prior.share
        gradient = prior.along(name, slope) + mi.TensorXf(pull * away.array, away.shape)
        loss += weighted_squares(pull, away.array) / len(target)
        is_offset = away.shape != value.shape  # learned in the place of a mean
        found, after = OPTIMISERS[optimiser].step(
            away if is_offset else value, gradient, known, kept_before, rate, step
        )
        moved[name] = value + prior.across(name, found - away) if is_offset else found
        kept.append(after)
    return _in_bounds(replace(gaussians, **moved)), kept, dr.detach(loss)


def fit(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    targets: Sequence[np.ndarray],
    settings: TrainSettings | None = None,
    on_pass: Callable[[int, int], None] | None = None,
    cache: ListCache | None = None,
    start: Gaussians | None = None,
    lam: Mapping[str, float | np.ndarray] | None = None,
    normals: np.ndarray | None = None,
    learns: Mapping[str, np.ndarray] | None = None,
) -> Fit:
    """Fit Gaussians to images: lower Phi (`mgs.fit.objective`). Their means stay unless
    `settings.means` says otherwise.

    cameras, and a target of each: [H,W,3] linear RGB, the rock in front of black; or [H,W,4], in
    which the last channel is the weight of the pixel, 1 where its colour is known and 0 where it is
    not; or [H,W,5], in which alpha comes after the weight, which counts for it, too
    (`mgs.data.dataset.target_of`). Where the settings' `alpha_weight` is not 0, alpha must be
    there.
    start: where the prior holds the parameters; the Gaussians given, by default. lam: the prior's
    information about each kind of parameter (`mgs.gaussians.learned`), (pixel value / unit of the
    parameter)^2: one number, or but for means an array that broadcasts to the parameter's shape
    (for colours, say, another number for each degree); by default there is none. normals: [N,3], of
    any length but 0, the directions of means that move along them; read only then. learns: for
    kinds of parameters
    that not all Gaussians learn, which do: a mask that broadcasts to what is learned ([N], [N,1]
    or, of colours, [N,K,1]). The others stay as they are given, but for colours below COLOUR_MIN.
    Starts with fresh buffers of the optimiser, so the result depends on its arguments alone,
    bitwise. on_pass(done, most) reports. Stops as `mgs.fit.stopping.stop_reason` says. Raises
    InputError where a parameter of the Gaussians given is not finite, the optimiser is unknown,
    `start` is of another shape, means are to move without normals or without a rate, or alpha has a
    weight and a target has no alpha.
    """
    settings = settings or TrainSettings()
    optimiser = row_named(OPTIMISERS, settings.optimiser, "optimiser")
    kinds = learned(settings.means).values()
    if missing := [kind for kind in kinds if kind not in settings.rates]:
        raise InputError(
            f"train.rates: has no rate of {missing[0]}, which is learned; give one, metres"
        )
    model = as_drjit(gaussians)
    goal = objective(
        gaussians,
        cameras,
        targets,
        start,
        lam,
        cache,
        settings.means,
        normals,
        settings.alpha_weight,
    )
    shapes = [away.shape for away, _ in goal.pulls(model)]
    masks = [
        filled((learns or {}).get(kind, 1.0), shape)
        for kind, shape in zip(kinds, shapes, strict=True)
    ]
    buffers = [[dr.zeros(mi.TensorXf, shape) for _ in range(optimiser.buffers)] for shape in shapes]
    information: list[Any] = [None] * len(shapes)
    rng = generator(settings.seed, "train/order")
    losses, kept, stop = [goal.loss(model)], model, StopReason.PASS_LIMIT
    for done in range(settings.passes):
        fall = settings.decay ** (done / max(settings.passes - 1, 1))
        rates = [
            dr.opaque(mi.Float, settings.rates[kind] * fall) * mask
            for kind, mask in zip(kinds, masks, strict=True)
        ]
        if optimiser.uses_information and done % INFORMATION_PASSES == 0:
            information = goal.largest_diagonal(model)
        order = rng.permutation(len(goal.photos))
        model, buffers, loss = _pass(
            goal, settings.optimiser, model, buffers, information, order, rates, done * len(order)
        )
        if loss <= min(losses[1:], default=np.inf):  # never of a loss that is not a number
            kept = model
        losses.append(loss)
        if on_pass:
            on_pass(done + 1, settings.passes)
        if found := stop_reason(losses, settings.tolerance, settings.passes):
            stop = found
            break
    passes = len(losses) - 1
    numpy = Gaussians(*(np.asarray(getattr(kept, f.name)) for f in fields(kept)))
    finite = [loss for loss in losses[1:] if np.isfinite(loss)]
    return Fit(
        numpy,
        min(finite, default=losses[0]),
        tuple(losses),
        passes,
        passes * len(goal.photos),
        stop,
    )


def _pass(
    goal: Objective,
    optimiser: str,
    model: Gaussians,
    buffers: list[list[Any]],
    information: list[Any],
    order: np.ndarray,
    rates: list[Any],
    t: int,
) -> tuple[Gaussians, list[list[Any]], float]:
    """One step on each image, in order, after t steps. Returns parameters, buffers and the mean of
    the steps' losses.

    The loss is NaN where a parameter is no longer finite: such a model cannot be rendered.
    """
    losses = []
    for photo in (goal.photos[i] for i in order):
        t += 1
        try:
            lists, packed = goal.lists(model, photo)
        except InputError:
            if _is_finite(model):  # refused for another reason, such as too many pairs
                raise
            return model, buffers, float("nan")
        model, buffers, loss = _step(
            optimiser, model, buffers, photo.array, packed, lists, photo.pixels, photo.weights, photo.size, rates,
            dr.opaque(mi.UInt32, t), goal.prior, information,
        )  # fmt: skip
        losses.append(loss)
    return (
        model,
        buffers,
        float(np.mean([float(loss[0]) for loss in losses])) if _is_finite(model) else float("nan"),
    )


def _is_finite(model: Gaussians) -> bool:
    """Whether all parameters are finite."""
    return bool(
        dr.all([dr.all(dr.isfinite(getattr(model, f.name).array)) for f in fields(model)])[0]
    )
