"""Learn the appearance of frozen Gaussians from posed images: the most probable parameters, given the images and the prior.

A pixel is the rendered value plus noise of standard deviation sigma, and each parameter lies around its start with a standard
deviation tau. The negative logarithm of the posterior is then, up to a constant and times sigma^2, the objective

    Phi = 1/2 sum over images, pixels and channels of (rendered - target)^2  +  1/2 sum over parameters of lam (theta - start)^2

with lam = (sigma / tau)^2 (`mgs.active.criteria.regularisation`). Its curvature, J^T J + lam, is the matrix whose diagonal the
criteria use: the model that is fitted and the one whose information is measured are the same. With lam = 0 it is maximum
likelihood, the paper's Eq. 2 up to a constant.

One optimiser step draws one image; a pass draws all of them once, in an order of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.active.optimisers import OPTIMISERS
from mgs.active.settings import TrainSettings
from mgs.active.stopping import StopReason, stop_reason
from mgs.camera import Camera
from mgs.colour import SH_C0
from mgs.errors import InputError
from mgs.gaussians import KINDS, LEARNED, Gaussians
from mgs.seeds import generator
from mgs.splat import ListCache, as_drjit, render
from mgs.splat.blocks import BlockLists
from mgs.splat.projection import camera_array, project
from mgs.splat.recording import frozen
from mgs.splat.rendering import composite


@dataclass(frozen=True)
class Fit:
    """What a fit found, and why it stopped.

    A loss is 2 Phi over the number of pixel values: the mean squared error plus the prior's part.
    gaussians: the model (NumPy fields) at the end of the pass of the lowest loss; the model given, where no pass had a finite
    one. loss: that lowest loss. losses: of the model given, then of each pass. The loss of a pass is the mean of its steps'
    losses, each measured before its step: of the models on the way through the pass, not of its last one.
    passes, iterations: how many were made, those after the lowest loss too.
    """

    gaussians: Gaussians
    loss: float
    losses: tuple[float, ...]
    passes: int
    iterations: int
    stop_reason: StopReason


@dataclass
class _Prior:
    """What holds the parameters near their start: for each of LEARNED its lam, Float. share: 1 / number of images, Float, the
    part of the prior that goes with one image."""

    start: Gaussians
    lam: dict[str, Any]
    share: Any


COLOUR_MIN = 1e-4
"""Least value of a colour of degree 0 after a step, linear RGB. A colour cannot be negative, and a coefficient whose colour is
clamped at 0 when it is drawn has no gradient that could bring it back. This bound is above 0, so that every channel keeps its
gradient, and below half a step of an 8-bit sRGB image."""


def _in_bounds(model: Gaussians) -> Gaussians:
    """The model with the colours of degree 0 at COLOUR_MIN or more. Of higher degrees, no single coefficient has a bound."""
    if model.sh.shape[1] > 1:
        return model
    sh = mi.TensorXf(dr.maximum(model.sh.array, (COLOUR_MIN - 0.5) / SH_C0), model.sh.shape)
    return Gaussians(model.means, model.log_scales, model.quats, model.logit_opacities, sh)


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
    *_: Any,
) -> tuple[Any, ...]:
    return optimiser, len(lists.splat), len(lists.block), len(target), *gaussians.sh.shape, *size


@frozen(lambda gaussians, camera: gaussians.sh.shape)
def _project(gaussians: Gaussians, camera: Any) -> Any:
    return project(gaussians, camera)


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
    prior: _Prior,
) -> tuple[Gaussians, list[list[Any]], Any]:
    """One step of the optimiser on one image and its share of the prior. Returns parameters, buffers, loss before the step.

    buffers, rates: for each of LEARNED; packed: the Gaussians' splats, packed for the lists; size: (width, height); t: UInt32,
    step number from 1; target, weight: Float [H*W*3].
    """
    values = [dr.copy(getattr(gaussians, name)) for name in LEARNED]
    dr.enable_grad(values)
    watched = Gaussians(gaussians.means, **dict(zip(LEARNED, values, strict=True)))
    rgb = composite(project(watched, camera), packed, lists, *size).rgb
    error = (rgb.array - target) * weight
    loss = dr.mean(dr.square(error))
    dr.backward(0.5 * dr.sum(dr.square(error)))
    step, moved, kept = mi.Float(t), {}, []
    for name, value, kept_before, rate in zip(LEARNED, values, buffers, rates, strict=True):
        away = dr.detach(value) - getattr(prior.start, name)
        pull = prior.lam[name] * prior.share
        gradient = dr.grad(value) + mi.TensorXf(pull * away.array, away.shape)
        loss += dr.sum(dr.square(away.array)) * pull / len(target)
        moved[name], after = OPTIMISERS[optimiser].step(dr.detach(value), gradient, kept_before, rate, step)
        kept.append(after)
    return _in_bounds(Gaussians(gaussians.means, **moved)), kept, dr.detach(loss)


def fit(
    gaussians: Gaussians,
    cameras: list[Camera],
    targets: list[np.ndarray],
    settings: TrainSettings | None = None,
    on_pass: Callable[[int, int], None] | None = None,
    cache: ListCache | None = None,
    start: Gaussians | None = None,
    lam: Mapping[str, float] | None = None,
) -> Fit:
    """Fit appearance (not means) to images: lower the objective Phi of this module's docstring.

    cameras, and a target of each: [H,W,3] linear RGB, the rock in front of black; or [H,W,4], in which the last channel is the
    weight of the pixel, 1 where its colour is known and 0 where it is not (`mgs.data.dataset.Frame.target`).
    start: where the prior holds the parameters; the Gaussians given, by default. lam: the prior's information about each kind
    of parameter (`mgs.gaussians.KINDS`), (pixel value / unit of the parameter)^2; by default there is none.
    Starts with fresh buffers of the optimiser, so the result depends on its arguments alone, bitwise. on_pass(done, most)
    reports. Stops as `mgs.active.stopping.stop_reason` says. Raises InputError where a parameter of the Gaussians given is not
    finite, the optimiser is unknown, or `start` is of another shape.
    """
    settings, cache = settings or TrainSettings(), cache or ListCache()
    if settings.optimiser not in OPTIMISERS:
        raise InputError(f"optimiser {settings.optimiser!r} is unknown; choose one of {', '.join(OPTIMISERS)}")
    model = as_drjit(gaussians)
    images = [_image(camera, np.asarray(target, np.float32)) for camera, target in zip(cameras, targets, strict=True)]
    count = OPTIMISERS[settings.optimiser].buffers
    buffers = [[dr.zeros(mi.TensorXf, getattr(model, name).shape) for _ in range(count)] for name in LEARNED]
    prior = _prior(gaussians if start is None else start, lam or {}, model, len(images))
    rng = generator(settings.seed, "train/order")
    losses, kept, stop = [_loss(model, images, prior, cache)], model, StopReason.PASS_LIMIT
    for done in range(settings.passes):
        fall = settings.decay ** (done / max(settings.passes - 1, 1))
        rates = [dr.opaque(mi.Float, rate * fall) for rate in settings.rates.values()]
        order = [images[i] for i in rng.permutation(len(images))]
        model, buffers, loss = _pass(settings.optimiser, model, buffers, order, rates, done * len(images), prior, cache)
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
    return Fit(numpy, min(finite, default=losses[0]), tuple(losses), passes, passes * len(images), stop)


@dataclass(frozen=True)
class _Image:
    """An image to fit to: its camera, the same for the kernels, its pixels and their weights, mi.Float [H*W*3]."""

    camera: Camera
    array: Any
    pixels: Any
    weights: Any


def _image(camera: Camera, target: np.ndarray) -> _Image:
    """target: as `fit` takes it."""
    rgb = target[..., :3]
    weights = np.broadcast_to(target[..., 3:] if target.shape[-1] == 4 else np.ones((), np.float32), rgb.shape)
    return _Image(camera, camera_array(camera), *(mi.Float(np.ascontiguousarray(a).ravel()) for a in (rgb, weights)))


def _prior(start: Gaussians, lam: Mapping[str, float], model: Gaussians, images: int) -> _Prior:
    """The prior of `fit`. Raises InputError where its start does not fit the model."""
    # A copy: Dr.Jit uses NumPy's memory in place, and a recorded step takes parameters and start for the same array for ever
    # if they were in the same memory when it was recorded (Dr.Jit 1.5).
    start = as_drjit(Gaussians(*(np.array(getattr(start, f.name), np.float32) for f in fields(start))))
    if start.sh.shape != model.sh.shape:
        raise InputError(f"start: has colours of shape {start.sh.shape}, expected {model.sh.shape}, that of the Gaussians")
    by_name = dict(zip(LEARNED, KINDS, strict=True))
    values = {name: dr.opaque(mi.Float, float(lam.get(kind, 0.0))) for name, kind in by_name.items()}
    return _Prior(start, values, dr.opaque(mi.Float, 1 / images))


def _loss(model: Gaussians, images: list[_Image], prior: _Prior, cache: ListCache) -> float:
    """The loss of one model (see `Fit`): the mean over the images of mean squared error and share of the prior."""
    away = [getattr(model, name).array - getattr(prior.start, name).array for name in LEARNED]
    pulls = zip(away, prior.lam.values(), strict=True)
    penalty = sum(lam * prior.share * dr.sum(dr.square(distance)) for distance, lam in pulls)
    errors = []
    for image in images:
        rgb = render(model, image.camera, cache=cache).rgb.array
        errors.append(dr.mean(dr.square((rgb - image.pixels) * image.weights)) + penalty / len(image.pixels))
    return float(np.mean([float(error[0]) for error in errors]))


def _pass(
    optimiser: str,
    model: Gaussians,
    buffers: list[list[Any]],
    images: list[_Image],
    rates: list[Any],
    t: int,
    prior: _Prior,
    cache: ListCache,
) -> tuple[Gaussians, list[list[Any]], float]:
    """One step on each image, in order, after t steps. Returns parameters, buffers and the mean of the steps' losses.

    The loss is NaN where a parameter is no longer finite: such a model cannot be rendered.
    """
    losses = []
    for image in images:
        t += 1
        splats = _project(model, image.array)
        try:
            lists, packed = cache.get(image.camera, splats)
        except InputError:
            if _is_finite(model):  # refused for another reason, such as too many pairs
                raise
            return model, buffers, float("nan")
        size = (image.camera.width, image.camera.height)
        model, buffers, loss = _step(
            optimiser, model, buffers, image.array, packed, lists, image.pixels, image.weights, size, rates,
            dr.opaque(mi.UInt32, t), prior,
        )  # fmt: skip
        losses.append(loss)
    return model, buffers, float(np.mean([float(loss[0]) for loss in losses])) if _is_finite(model) else float("nan")


def _is_finite(model: Gaussians) -> bool:
    """Whether all learned parameters are finite."""
    return bool(dr.all([dr.all(dr.isfinite(getattr(model, name).array)) for name in LEARNED])[0])
