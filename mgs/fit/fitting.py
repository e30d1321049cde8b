"""Fit Gaussians to posed images: lower the objective of `mgs.fit.objective` by steps on one image
each. A pass uses every image once, in random order."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.colour import SH_C0
from mgs.errors import InputError, row_named
from mgs.fit.density import DENSITIES, Density, controlled, slopes_of
from mgs.fit.losses import Loss, loss_name, loss_named
from mgs.fit.objective import (
    Objective,
    ParameterPrior,
    Photo,
    Target,
    View,
    filled,
    objective,
    weighted_squares,
    with_gradients,
)
from mgs.fit.optimisers import INFORMATION_PASSES, OPTIMISERS
from mgs.fit.settings import TrainSettings
from mgs.fit.stopping import StopReason, stop_reason
from mgs.fit.unfinished import FitState, Unfinished
from mgs.gaussians import ARRAYS, MAX_SH_DEGREE, Gaussians, learned
from mgs.memory import Deferred
from mgs.seeds import generator
from mgs.splat import ListCache, as_drjit
from mgs.splat.recording import frozen


@dataclass(frozen=True)
class Fit:
    """Result of a fit. A loss is 2 Phi over the number of pixel values (`Objective.loss`).

    gaussians: model (NumPy fields) at the end of the pass with the lowest loss; the given model, if
        no pass had a finite loss.
    loss: that lowest loss.
    losses: of the given model, then of each pass: the mean of its steps' losses, each measured
        before its step.
    passes, iterations: number of passes and of steps made.
    """

    gaussians: Gaussians
    loss: float
    losses: tuple[float, ...]
    passes: int
    iterations: int
    stop_reason: StopReason


# Above 0, where a colour is clamped and has no gradient; below half a step of an 8-bit sRGB image.
COLOUR_MIN = 1e-4  # lower bound of colours of degree 0 after a step, as the model blends them


def _in_bounds(model: Gaussians) -> Gaussians:
    """The model with colours of degree 0 at COLOUR_MIN or more. Coefficients of a model of higher
    degree have no bound of their own."""
    if model.sh.shape[1] > 1:
        return model
    sh = mi.TensorXf(dr.maximum(model.sh.array, (COLOUR_MIN - 0.5) / SH_C0), model.sh.shape)
    return replace(model, sh=sh)


@frozen(
    lambda optimiser, error, model, prior, view, *others: (
        optimiser,
        error,
        prior.means,
        *model.recorded,
        *view.recorded_sizes,
        len(others[-1]),
    )
)
def _step(
    optimiser: str,
    error: str,
    model: Gaussians,
    prior: ParameterPrior,
    view: View,
    buffers: list[list[Any]],
    rates: list[Any],
    t: Any,
    information: list[Any],
    slopes: list[Any],
) -> tuple[Gaussians, list[list[Any]], Any, list[Any]]:
    """One optimiser step on one image and its share of the prior. Returns the model, the buffers,
    the loss before the step, and the slopes.

    optimiser, error: names, in OPTIMISERS and of `loss_named`.
    buffers, rates, information: for each learned array (`mgs.fit.optimisers.Optimiser`).
    t: UInt32, step number from 1. slopes: sums of `View.slopes`, to which the step's are added; if
        empty, they are not measured.
    """
    copy, shift = with_gradients(model, prior), [dr.zeros(mi.Float, len(model)) for _ in slopes]
    dr.enable_grad(shift)
    image = view.rendered(copy, shift).array
    target = view.target
    values = loss_named(error)(image, target.pixels, target.weights, view.size, model.linear)
    loss = dr.mean(dr.detach(values))
    dr.backward(0.5 * dr.sum(values))
    step, after, states = mi.Float(t), {}, []
    for name, buffer, rate, bound in zip(prior.lam, buffers, rates, information, strict=True):
        value, slope = dr.detach(getattr(copy, name)), dr.grad(getattr(copy, name))
        offset = value - getattr(prior.start, name)
        pull = prior.lam[name] * prior.share
        gradient = slope + mi.TensorXf(pull * offset.array, offset.shape)
        loss += weighted_squares(pull, offset.array) / len(view.target)
        after[name], state = OPTIMISERS[optimiser].step(value, gradient, bound, buffer, rate, step)
        states.append(state)
    if slopes:
        slopes = [total + new for total, new in zip(slopes, view.slopes(shift), strict=True)]
    return _in_bounds(replace(model, **after)), states, dr.detach(loss), slopes


def fit_gaussians(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    targets: Sequence[np.ndarray | Target],
    settings: TrainSettings | None = None,
    on_pass: Callable[[int, int, Gaussians], None] | None = None,
    cache: ListCache | None = None,
    start: Gaussians | None = None,
    lam: Mapping[str, float | np.ndarray] | None = None,
    learns: Mapping[str, np.ndarray] | None = None,
    loss: Loss | None = None,
    on_image: Callable[[int, int], None] = lambda done, most: None,
    unfinished: Unfinished | None = None,
) -> Fit:
    """Fit Gaussians to images by lowering Phi (`mgs.fit.objective`). The result depends on the
    arguments alone, bitwise.

    targets: one per camera (`mgs.data.dataset.target_of`): linear RGB [H,W,3], the rock in front of
        black; or [H,W,4] with a weight per pixel, 1 where its colour is known and 0 where not; or
        [H,W,5] with weight and alpha, required if `settings.alpha_weight` is not 0. They are
        compared in the space in which the Gaussians are blended (`Gaussians.linear`). A `Target`
        made for that space and weight is not copied.
    on_pass(done, most, model): called after each pass, with a model of TensorXf fields.
    start: mean of the prior; by default the given Gaussians.
    lam: the prior's information about each kind of parameter (`mgs.gaussians.learned`), (pixel
        value / unit of the parameter)^2: a number, or except for means an array that broadcasts to
        the parameter's shape. Default 0.
    learns: masks of the Gaussians that learn a kind of parameter, broadcast to its shape ([N],
        [N,1] or, for colours, [N,K,1]). The others keep their values, except colours below
        COLOUR_MIN. Default: all learn.
    loss: a function in place of `settings.loss` (`mgs.fit.losses.Loss`): loss(drawn, pixels,
        weights, size, linear) of Dr.Jit arrays, which differentiates it. It is recorded once, so it
        must depend on its arguments alone.
    on_image(done, most): called whenever an image is used, with how many were before, and how many
        are at most.
    unfinished: file from which the fit continues, and which is written from time to time.

    Raises InputError if there is no camera, a parameter or a target is not finite, a target has
    integers, a name is unknown, `start` has another shape, means are to move without a rate, or a
    required alpha is missing.
    """
    settings = settings or TrainSettings()
    optimiser = row_named(OPTIMISERS, settings.optimiser, "optimiser")
    density = row_named(DENSITIES, settings.density, "density")
    if density and (settings.means != "free" or learns):
        raise InputError("density: Gaussians can move only where all learn free means")
    for kind in (*(lam or ()), *(learns or ())):
        row_named(dict.fromkeys(learned("free").values()), kind, "kind of parameter")
    kinds = learned(settings.means).values()
    if absent := [kind for kind in kinds if kind not in settings.rates]:
        raise InputError(
            f"train.rates: has no rate of {absent[0]}, which is learned; give one, metres"
        )
    model, how = as_drjit(gaussians), (settings.means, settings.alpha_weight)
    goal = objective(
        gaussians, cameras, targets, start, lam, cache, *how, loss_name(loss or settings.loss)
    )
    arrays = [offset.shape for offset, _ in goal.offsets(model)]
    buffers = [[dr.zeros(mi.TensorXf, each) for _ in range(optimiser.buffers)] for each in arrays]
    informed = optimiser.uses_information
    information = [dr.zeros(mi.TensorXf, each) if informed else None for each in arrays]
    rng, draws = (generator(settings.seed, f"train/{name}") for name in ("order", "density"))
    new = FitState(model, model, goal.prior, buffers, information, draws)
    state = (unfinished.load(new) if unfinished else None) or new
    keep = unfinished.save if unfinished else lambda state: None
    times = density.times(settings.passes, len(cameras)) if density else ()
    end = max(times, default=0)
    every = {*times, *range(0, settings.passes, INFORMATION_PASSES)}
    measured = every if informed else set()  # before these passes
    uses = 1 + settings.passes + len(measured)
    goal = _counted(replace(goal, prior=state.prior), state, uses * len(goal.photos), on_image)

    def reason() -> StopReason | None:
        tolerance = 0.0 if len(state.losses) <= end + 1 else settings.tolerance
        return stop_reason(state.losses, tolerance, settings.passes)

    state.losses = state.losses or [goal.loss(model)]
    orders = [rng.permutation(len(goal.photos)) for _ in state.losses[1:]]
    stop = reason() if orders else None
    while stop is None:
        done = len(state.losses) - 1
        if not state.steps:  # a new pass
            goal = _changed(goal, state, density, times, cameras, settings.most_gaussians)
            if done in measured:
                largest = goal.largest_diagonal(state.model)
                state.information = [_together(part) for part in largest]
        parts = zip(kinds, goal.offsets(state.model), strict=True)
        shapes = {kind: offset.shape for kind, (offset, _) in parts}
        rates = _rates(settings, shapes, learns or {}, done, len(cameras))
        order = rng.permutation(len(goal.photos))
        mean = _pass(goal, settings.optimiser, state, order, rates, keep)
        if mean <= min(state.losses[1:], default=np.inf):  # false for NaN
            state.best = state.model
        state.losses.append(mean)
        state.steps = []
        if on_pass:
            on_pass(done + 1, settings.passes, state.model)
        stop = reason()
    keep(state)
    losses = state.losses
    passes = len(losses) - 1
    lowest = min((loss for loss in losses[1:] if np.isfinite(loss)), default=losses[0])
    best = state.best.map(np.asarray)
    return Fit(best, lowest, tuple(losses), passes, passes * len(goal.photos), stop)


def _changed(
    goal: Objective,
    state: FitState,
    density: Density | None,
    times: Sequence[int],
    cameras: Sequence[Camera],
    most: int,
) -> Objective:
    """The objective before a pass, after the density control, whose `times` these are, has changed
    the state's Gaussians, if it is time. Slopes are summed until its last call."""
    done = len(state.losses) - 1
    if density and state.slopes and done in times:
        measure = slopes_of(
            state.slopes, cameras, (state.changed * len(cameras), done * len(cameras)), most
        )
        changed = controlled(density, measure, goal, state.model, state.buffers, state.draws)
        goal, state.model, state.buffers = changed
        state.prior, state.slopes, state.changed = goal.prior, [], done
    if density and not state.slopes and done < max(times, default=0):
        state.slopes = [dr.zeros(mi.Float, len(state.model)) for _ in range(2)]
        dr.make_opaque(state.slopes)
    return goal


def _counted(
    goal: Objective, state: FitState, most: int, on_image: Callable[[int, int], None]
) -> Objective:
    """The objective with `on_image` called, and `state.images` counted, at each use of an image."""
    photos = goal.photos

    def photo(i: int) -> Photo:
        on_image(state.images, most)
        state.images += 1
        return photos[i]

    return replace(goal, photos=Deferred(range(len(photos)), photo))


def _together(information: Any) -> Any:
    """Metric of a kind of parameter, by its information with that of the prior. The K coefficients
    of a colour [N,K,3] move a pixel together, so directional ones step 1/K as far."""
    if len(information.shape) < 3 or information.shape[1] == 1:
        return information
    count = information.shape[1]
    factors = np.where(np.arange(count) > 0, count, 1).astype(np.float32)
    return information * mi.TensorXf(factors[None, :, None])


def _rates(
    settings: TrainSettings,
    shapes: Mapping[str, tuple[int, ...]],
    learns: Mapping[str, np.ndarray],
    done: int,
    images: int,
) -> list[Any]:
    """Rate of each kind of parameter, of these shapes, after some passes over the images: a Float
    of one number or one per parameter. learns: as in
    `fit_gaussians`."""
    fall, rates = settings.decay ** (done / max(settings.passes - 1, 1)), []
    for kind, shape in shapes.items():
        rate: Any = settings.rates[kind] * (1.0 if kind in settings.steady_rates else fall)
        rate = rate * learns.get(kind, 1.0)
        if kind == "colour" and (settings.sh_steps or settings.directional_rate < 1):
            degree = done * images // settings.sh_steps if settings.sh_steps else MAX_SH_DEGREE
            factors = np.where(np.arange(shape[1]) > 0, settings.directional_rate, 1.0)
            factors[(degree + 1) ** 2 :] = 0
            rate = rate * factors[:, None]
        rates.append(filled(rate, shape))
    return rates


def _pass(
    goal: Objective,
    optimiser: str,
    state: FitState,
    order: np.ndarray,
    rates: list[Any],
    keep: Callable[[FitState], None],
) -> float:
    """One step on each image in this order, but for those that a state in the middle of the pass
    has. Returns the mean loss of the steps, or NaN if a parameter is no longer finite, which cannot
    be rendered. keep(state): called after each step."""
    before = (len(state.losses) - 1) * len(order)
    for i in order[len(state.steps) :]:
        photo = goal.photos[i]
        try:
            view = goal.view(state.model, photo)
        except InputError:
            if _is_finite(state.model):  # raised for another reason, such as too many pairs
                raise
            return float("nan")
        count = dr.opaque(mi.UInt32, before + len(state.steps) + 1)
        arguments = view, state.buffers, rates, count, state.information, state.slopes
        state.model, state.buffers, loss, state.slopes = _step(
            optimiser, goal.error, state.model, goal.prior, *arguments
        )
        state.steps.append(loss)
        keep(state)
    if not _is_finite(state.model):
        return float("nan")
    return float(np.mean([float(loss[0]) for loss in state.steps]))


def _is_finite(model: Gaussians) -> bool:
    parts = [dr.all(dr.isfinite(getattr(model, name).array)) for name in ARRAYS]
    return bool(dr.all(parts)[0])
