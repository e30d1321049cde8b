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

from mgs.active.optimisers import OPTIMISERS
from mgs.active.settings import TrainSettings
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
    optimiser: str,
    gaussians: Gaussians,
    buffers: Any,
    camera: Any,
    packed: Any,
    lists: BlockLists,
    target: Any,
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
    size: Any,
    rates: list[Any],
    t: Any,
) -> tuple[Gaussians, list[list[Any]], Any]:
    """One step of the optimiser on one image. Returns parameters, buffers, mean squared error before the step.

    buffers, rates: for each of LEARNED; packed: the Gaussians' splats, packed for the lists; size: (width, height); t: UInt32,
    step number from 1; target: Float [H*W*3].
    """
    values = [dr.copy(getattr(gaussians, name)) for name in LEARNED]
    dr.enable_grad(values)
    watched = Gaussians(gaussians.means, **dict(zip(LEARNED, values, strict=True)))
    rgb = composite(project(watched, camera), packed, lists, *size).rgb
    error = rgb.array - target
    loss = dr.mean(dr.square(error))
    dr.backward(0.5 * dr.sum(dr.square(error)))
    step, moved, kept = mi.Float(t), {}, []
    for name, value, kept_before, rate in zip(LEARNED, values, buffers, rates, strict=True):
        moved[name], after = OPTIMISERS[optimiser].step(dr.detach(value), dr.grad(value), kept_before, rate, step)
        kept.append(after)
    return Gaussians(gaussians.means, **moved), kept, dr.detach(loss)


def fit(
    gaussians: Gaussians,
    cameras: list[Camera],
    targets: list[np.ndarray],
    settings: TrainSettings | None = None,
    on_pass: Callable[[int, int], None] | None = None,
    cache: ListCache | None = None,
) -> Fit:
    """Fit appearance (not means) to images: cameras and targets [H,W,3] linear RGB, rock on black.

    Starts with fresh buffers of the optimiser, so the result depends on its arguments alone, bitwise. on_pass(done, most)
    reports. Stops as `mgs.active.stopping.stop_reason` says. Raises InputError where a parameter of the Gaussians given is not
    finite, or the optimiser is unknown.
    """
    settings, cache = settings or TrainSettings(), cache or ListCache()
    if settings.optimiser not in OPTIMISERS:
        raise InputError(f"optimiser {settings.optimiser!r} is unknown; choose one of {', '.join(OPTIMISERS)}")
    model = as_drjit(gaussians)
    images = [
        _Image(camera, camera_array(camera), mi.Float(np.ascontiguousarray(target, np.float32).ravel()))
        for camera, target in zip(cameras, targets, strict=True)
    ]
    count = OPTIMISERS[settings.optimiser].buffers
    buffers = [[dr.zeros(mi.TensorXf, getattr(model, name).shape) for _ in range(count)] for name in LEARNED]
    rng = generator(settings.seed, "train/order")
    losses, kept, stop = [_loss(model, images, cache)], model, StopReason.PASS_LIMIT
    for done in range(settings.passes):
        fall = settings.decay ** (done / max(settings.passes - 1, 1))
        rates = [dr.opaque(mi.Float, rate * fall) for rate in settings.rates.values()]
        order = [images[i] for i in rng.permutation(len(images))]
        model, buffers, loss = _pass(settings.optimiser, model, buffers, order, rates, done * len(images), cache)
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
    optimiser: str, model: Gaussians, buffers: list[list[Any]], images: list[_Image], rates: list[Any], t: int, cache: ListCache
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
            return model, buffers, float("nan")
        size = (image.camera.width, image.camera.height)
        model, buffers, loss = _step(
            optimiser, model, buffers, image.array, packed, lists, image.pixels, size, rates, dr.opaque(mi.UInt32, t)
        )
        losses.append(loss)
    finite = dr.all([dr.all(dr.isfinite(getattr(model, name).array)) for name in LEARNED])
    return model, buffers, float(np.mean([float(loss[0]) for loss in losses])) if finite[0] else float("nan")
