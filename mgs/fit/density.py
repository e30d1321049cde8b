"""Density control of a fit: between passes, Gaussians are moved, added or removed where the images
need it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.special import logit

from mgs.camera import Camera, extent_of
from mgs.fit.objective import Objective
from mgs.gaussians import ARRAYS, Gaussians
from mgs.memory import padded
from mgs.rotation import rotmat_from_quat
from mgs.splat import as_drjit

LEAST_OPACITY = 0.005  # opacity below which a Gaussian is removed
# Numbers of `adapt` are those of Kerbl et al. 2023 or, where it is silent, of the authors' program.
LEAST_GRADIENT = 2e-4  # least gradient (`Slopes`) at which a Gaussian is added
SMALL = 0.01  # largest standard deviation of a Gaussian that is copied, not divided; over extent
DIVISION = 1.6  # factor by which the two parts of a divided Gaussian are smaller
TOO_LARGE = 0.1  # largest standard deviation of a Gaussian after RESET_STEPS, over the extent
RESET_OPACITY, RESET_STEPS = 0.01, 3000  # opacity to which all are lowered, and steps between that
# Steps between two calls of `adapt`, and the steps after and before which it is called; the last is
# half of all steps in a shorter fit.
ADAPTION_STEPS, ADAPTION_FROM, ADAPTION_UNTIL = 100, 500, 15_000
# Share of the Gaussians that `split` divides, distance of a half from the middle and length of a
# half, over the length of the whole. Chosen constants.
GROWTH, APART, SHORTER = 0.3, 0.6, 0.75
SPLITS = 6  # times that `split` is called, in the first half of the passes


@dataclass(frozen=True)
class Slopes:
    """Means over the steps since the last call of a control."""

    gradient: np.ndarray  # [N] |d loss / d centre|, per half image side, mean over its images
    before: int  # steps made until the last call
    step: int  # and until now
    extent: float  # of the scene, metres (`extent_of`)
    most: int  # largest number of Gaussians


@dataclass(frozen=True)
class Density:
    """A density control and when it is called.

    control(model, slopes, rng) -> (model, origin [N]): index i of the Gaussian of the given model
        that each still is, or ~i for a changed copy of i. Models have NumPy fields.
    times(passes, images): the numbers of passes after which it is called.
    """

    control: Callable[[Gaussians, Slopes, np.random.Generator], tuple[Gaussians, np.ndarray]]
    times: Callable[[int, int], Sequence[int]]


def _rotated(quats: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Offsets along the axes of Gaussians, [N,3] -> in the world."""
    return (rotmat_from_quat(quats) @ offsets[..., None])[..., 0]


def adapt(
    model: Gaussians, slopes: Slopes, rng: np.random.Generator
) -> tuple[Gaussians, np.ndarray]:
    """The control of Kerbl et al. 2023: Gaussians of large gradient are copied if small and divided
    in two if large; faint and too large ones are removed, and at times all opacities lowered. With
    no room for all, those of largest gradient are taken. Not removed are Gaussians that are large
    in an image: the authors' program clears that measure before it reads it."""
    grow = np.argsort(-slopes.gradient, kind="stable")[: max(slopes.most - len(model), 0)]
    grow = np.sort(grow[slopes.gradient[grow] >= LEAST_GRADIENT])
    small = _size(model)[grow] <= SMALL * slopes.extent
    copied, divided = grow[small], grow[~small]
    whole = np.delete(np.arange(len(model)), divided)
    source = np.concatenate([whole, copied, divided, divided])
    new, parts = model[source], slice(len(whole) + len(copied), None)
    scales = np.exp(new.log_scales[parts].astype(np.float64))
    new.means[parts] += _rotated(new.quats[parts], scales * rng.normal(size=scales.shape))
    new.log_scales[parts] -= np.log(DIVISION)
    origin = np.where(np.arange(len(source)) < len(whole), source, ~source)
    alive = new.opacities >= LEAST_OPACITY
    if slopes.step > RESET_STEPS:
        alive &= _size(new) <= TOO_LARGE * slopes.extent
    if alive.any():
        new, origin = new[alive], origin[alive]
    if slopes.step // RESET_STEPS > slopes.before // RESET_STEPS:
        np.minimum(new.logit_opacities, logit(RESET_OPACITY), out=new.logit_opacities)
    return new, origin


def split(
    model: Gaussians, slopes: Slopes, rng: np.random.Generator
) -> tuple[Gaussians, np.ndarray]:
    """Divide the GROWTH of all Gaussians whose gradient is largest along their longest axis, into
    halves of nearly the same mean and covariance; remove the faint."""
    most = min(round(GROWTH * len(model)), max(slopes.most - len(model), 0))
    divided = np.sort(np.argsort(-slopes.gradient, kind="stable")[:most])
    whole = np.delete(np.arange(len(model)), divided)
    source = np.concatenate([whole, divided, divided])
    new, parts = model[source], slice(len(whole), None)
    longest = np.argmax(new.log_scales[parts], 1)[:, None]
    length = np.take_along_axis(new.log_scales[parts], longest, 1)
    side = np.where(np.arange(2 * most) < most, APART, -APART)[:, None]
    offsets = np.zeros((2 * most, 3))
    np.put_along_axis(offsets, longest, side * np.exp(length), 1)
    new.means[parts] += _rotated(new.quats[parts], offsets)
    shorter = length + np.log(SHORTER)
    np.put_along_axis(new.log_scales[parts], longest, shorter, 1)
    origin = np.where(np.arange(len(source)) < len(whole), source, ~source)
    alive = new.opacities >= LEAST_OPACITY
    return (new[alive], origin[alive]) if alive.any() else (new, origin)


def _size(model: Gaussians) -> np.ndarray:
    """Largest standard deviation of each Gaussian, metres [N]."""
    return np.exp(model.log_scales.max(1).astype(np.float64))


def slopes_of(
    sums: list[Any], cameras: Sequence[Camera], steps: tuple[int, int], most: int
) -> Slopes:
    """`Slopes` from the sums of `View.slopes` between two numbers of steps."""
    norms, views = (np.array(total) for total in sums)
    return Slopes(norms / np.maximum(views, 1), *steps, extent_of(cameras), most)


def _adaption_times(passes: int, images: int) -> list[int]:
    end = min(ADAPTION_UNTIL, passes * images / 2)
    steps = [(done, done * images) for done in range(1, passes)]
    return [
        done
        for done, step in steps
        if ADAPTION_FROM < step < end and step // ADAPTION_STEPS > (step - images) // ADAPTION_STEPS
    ]


def split_times(passes: int) -> list[int]:
    """Numbers of passes after which a fit of so many calls `split`."""
    step = max(1, round(passes / 2 / (SPLITS + 1)))
    return [step * k for k in range(1, SPLITS + 1) if step * k < passes]


DENSITIES: dict[str, Density | None] = {
    "fixed": None,
    "adaptive": Density(adapt, _adaption_times),
    "split": Density(split, lambda passes, _: split_times(passes)),
}


def controlled(
    density: Density,
    slopes: Slopes,
    goal: Objective,
    model: Gaussians,
    buffers: list[list[Any]],
    rng: np.random.Generator,
) -> tuple[Objective, Gaussians, list[list[Any]]]:
    """Call a control. A Gaussian that changed is its own start in the prior; buffers are zero where
    a parameter changed."""
    before = model.map(np.array)
    after, origin = density.control(before, slopes, rng)
    same, source, prior = origin >= 0, np.where(origin < 0, ~origin, origin), goal.prior

    def start(name: str) -> Any:
        values = np.array(getattr(prior.start, name))[source]
        values[~same] = getattr(after, name)[~same]
        return mi.TensorXf(padded(values))

    def lam(name: str) -> Any:
        values = np.array(prior.lam[name])
        if len(values) == 1:
            return prior.lam[name]
        rows = values.reshape(getattr(before, name).shape)[source]
        return mi.Float(padded(rows).ravel())

    def buffer(name: str, values: Any) -> Any:
        old, new = getattr(before, name)[source], getattr(after, name)
        rows = same.reshape(-1, *[1] * (new.ndim - 1))
        return mi.TensorXf(padded(np.where(rows & (old == new), np.array(values)[source], 0)))

    refilled = replace(
        prior,
        start=replace(after, **{name: start(name) for name in ARRAYS}),
        lam={name: lam(name) for name in prior.lam},
    )
    new_buffers = [
        [buffer(name, values) for values in each]
        for name, each in zip(prior.lam, buffers, strict=True)
    ]
    return replace(goal, prior=refilled), as_drjit(after), new_buffers
