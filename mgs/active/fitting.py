"""Learn the appearance of frozen Gaussians from posed images: maximum likelihood, to convergence.

The loss is the mean squared error over pixels and channels, the paper's Eq. 2 up to a constant: it is the model for which the
Fisher information is exact. One optimiser step draws one image; a pass draws all of them once, in an order of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.active.stopping import StopReason, stop_reason
from mgs.camera import Camera
from mgs.errors import InputError
from mgs.gaussians import LEARNED, Gaussians
from mgs.seeds import generator
from mgs.splat import ListCache, as_drjit, render
from mgs.splat.blocks import BlockLists
from mgs.splat.projection import camera_array, project
from mgs.splat.recording import frozen
from mgs.splat.rendering import composite


@dataclass(frozen=True)
class TrainSettings:
    """Learning rates are Adam's, per step, in each parameter's own unit; they fall by `decay` over `passes`."""

    passes: int = 40
    """Most passes over the images."""
    tolerance: float = 0.01
    """Converged when a pass lowers the loss by less than this share, twice in a row, and does not raise it by more
    (`mgs.active.stopping.stop_reason`)."""
    rates: tuple[float, float, float, float] = (0.02, 0.02, 0.01, 0.05)
    """For sh, log_scales, quats, logit_opacities."""
    decay: float = 0.1
    """Last rate over first."""
    seed: int = 0


@dataclass(frozen=True)
class Fit:
    """What a fit found, and why it stopped.

    gaussians: the model (NumPy fields) at the end of the pass of the lowest loss; the model given, where no pass had a finite
    one. loss: that lowest loss. losses: mean squared error of the model given, then of each pass. The loss of a pass is the
    mean of its steps' losses, each measured before its step: of the models on the way through the pass, not of its last one.
    passes, iterations: how many were made, those after the lowest loss too.
    """

    gaussians: Gaussians
    loss: float
    losses: tuple[float, ...]
    passes: int
    iterations: int
    stop_reason: StopReason


def _recorded_sizes(
    gaussians: Gaussians, moments: Any, camera: Any, packed: Any, lists: BlockLists, target: Any, size: Any, *_: Any
) -> tuple[int, ...]:
    return len(lists.splat), len(lists.block), len(target), *gaussians.sh.shape, *size


EPSILON = 1e-3
"""Adam's epsilon, (pixel value)^2 per unit of the parameter: a gradient of the summed squared error below it is noise, and a
parameter that no image sees stays where the prior put it instead of walking full steps."""


@frozen(lambda gaussians, camera: gaussians.sh.shape)
def _project(gaussians: Gaussians, camera: Any) -> Any:
    return project(gaussians, camera)


@frozen(_recorded_sizes)
def _step(
    gaussians: Gaussians,
    moments: list[list[Any]],
    camera: Any,
    packed: Any,
    lists: BlockLists,
    target: Any,
    size: Any,
    rates: list[Any],
    t: Any,
) -> tuple[Gaussians, list[list[Any]], Any]:
    """One Adam step (Kingma & Ba 2015, beta 0.9 and 0.999) on one image. Returns parameters, moments, mean squared error.

    packed: the Gaussians' splats, packed for the lists; size: (width, height); t: UInt32, step number from 1; target: Float
    [H*W*3].
    """
    values = [dr.copy(getattr(gaussians, name)) for name in LEARNED]
    dr.enable_grad(values)
    watched = Gaussians(gaussians.means, **dict(zip(LEARNED, values, strict=True)))
    rgb = composite(project(watched, camera), packed, lists, *size).rgb
    error = rgb.array - target
    loss = dr.mean(dr.square(error))
    dr.backward(0.5 * dr.sum(dr.square(error)))
    new_values, new_moments = [], []
    step = mi.Float(t)
    unbias1, unbias2 = 1 - dr.power(mi.Float(0.9), step), 1 - dr.power(mi.Float(0.999), step)
    for value, (m, v), rate in zip(values, moments, rates, strict=True):
        gradient = dr.grad(value)
        m, v = dr.lerp(gradient, m, 0.9), dr.lerp(dr.square(gradient), v, 0.999)
        update = (m.array / unbias1) / (dr.sqrt(v.array / unbias2) + EPSILON) * rate
        new_values.append(mi.TensorXf(dr.detach(value).array - update, value.shape))
        new_moments.append([m, v])
    return Gaussians(gaussians.means, **dict(zip(LEARNED, new_values, strict=True))), new_moments, dr.detach(loss)


def fit(
    gaussians: Gaussians,
    cameras: list[Camera],
    targets: list[np.ndarray],
    settings: TrainSettings | None = None,
    on_pass: Callable[[int, int], None] | None = None,
    cache: ListCache | None = None,
) -> Fit:
    """Fit appearance (not means) to images: cameras and targets [H,W,3] linear RGB, rock on black.

    Starts with fresh optimiser moments, so the result depends on its arguments alone, bitwise. on_pass(done, most) reports.
    Stops as `mgs.active.stopping.stop_reason` says. Raises InputError where a parameter of the Gaussians given is not finite.
    """
    settings, cache = settings or TrainSettings(), cache or ListCache()
    model = as_drjit(gaussians)
    images = [
        _Image(camera, camera_array(camera), mi.Float(np.ascontiguousarray(target, np.float32).ravel()))
        for camera, target in zip(cameras, targets, strict=True)
    ]
    moments = [[dr.zeros(mi.TensorXf, getattr(model, n).shape) for _ in range(2)] for n in LEARNED]
    rng = generator(settings.seed, "train/order")
    losses, kept, stop = [_loss(model, images, cache)], model, StopReason.PASS_LIMIT
    for done in range(settings.passes):
        fall = settings.decay ** (done / max(settings.passes - 1, 1))
        rates = [dr.opaque(mi.Float, rate * fall) for rate in settings.rates]
        order = [images[i] for i in rng.permutation(len(images))]
        model, moments, loss = _pass(model, moments, order, rates, done * len(images), cache)
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
    """An image to fit to: its camera, the same for the kernels, and its pixels, mi.Float [H*W*3]."""

    camera: Camera
    array: Any
    pixels: Any


def _loss(model: Gaussians, images: list[_Image], cache: ListCache) -> float:
    """Mean squared error of one model over the images."""
    errors = [dr.mean(dr.square(render(model, image.camera, cache=cache).rgb.array - image.pixels)) for image in images]
    return float(np.mean([float(error[0]) for error in errors]))


def _pass(
    model: Gaussians, moments: list[list[Any]], images: list[_Image], rates: list[Any], t: int, cache: ListCache
) -> tuple[Gaussians, list[list[Any]], float]:
    """One step on each image, in order, after t steps. Returns parameters, moments and the mean of the steps' losses.

    The loss is NaN where a parameter is no longer finite: such a model cannot be rendered.
    """
    losses = []
    for image in images:
        t += 1
        splats = _project(model, image.array)
        try:
            lists, packed = cache.get(image.camera, splats)
        except InputError:
            return model, moments, float("nan")
        size = (image.camera.width, image.camera.height)
        model, moments, loss = _step(
            model, moments, image.array, packed, lists, image.pixels, size, rates, dr.opaque(mi.UInt32, t)
        )
        losses.append(loss)
    finite = dr.all([dr.all(dr.isfinite(getattr(model, name).array)) for name in LEARNED])
    return model, moments, float(np.mean([float(loss[0]) for loss in losses])) if finite[0] else float("nan")
