"""No more parameters than the images pay for: which kinds of them each Gaussian learns, and the SH
degree of the colours.

Kinds of parameters are chosen by the evidence, the marginal likelihood of the images: the
likelihood, averaged over the prior of the parameters. A model with more parameters fits the images
better, and spreads its prior over more images that were not taken. In Laplace's approximation at a
fit, with the exact diagonal H, learning a parameter, where all else stays as it is, adds

    gain = 1/2 (H + lam) delta^2 / sigma^2 - 1/2 log((H + lam) / lam)

nats to the log evidence (MacKay 1992), with lam = (sigma / tau)^2, and delta how far the fit moved
the parameter from its
start: what the images gain by it, less what it costs. Of what gains something, the least is left
out, too, as long as Phi, the
objective of the fit, should not rise by more than is allowed: without the parameter it rises by 1/2
(H + lam) delta^2.

Whether colours depend on the direction at all, so have spherical harmonics of degree 1, is no
question to the images that are
fitted: they lie on the orbit, and what is wanted is how the rock looks from elsewhere. It is chosen
by blocked cross-validation (Roberts et al. 2017): views that are neighbours in azimuth are left out
together, so that the others have to foretell views that lie beyond them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mgs.camera import Camera
from mgs.data.dataset import Frame, target_of
from mgs.data.up import upright
from mgs.errors import InputError
from mgs.fit.fitting import fit
from mgs.fit.objective import Vector, objective
from mgs.fit.stopping import StopReason
from mgs.gaussians import Gaussians
from mgs.memory import Deferred
from mgs.policy.criteria import DIRECTIONAL_STD, LEARN_LOSS
from mgs.policy.poses import azimuths
from mgs.prior.build import Prior
from mgs.prior.exposure import exposure_of, without_gain
from mgs.prior.initial import initial_gaussians, initial_normals
from mgs.run.settings import NbvSettings
from mgs.splat import ListCache, as_drjit, groups, render

DIRECTIONAL = "directional"
"""What the colour coefficients of degrees above 0 are called beside the other kinds of
parameters."""

BLOCKS = 4
"""Blocks of neighbouring views, each of which is left out of the fit once."""

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Images:
    """What a model is fitted to, and from where.

    cameras: V of them. targets: one of each, [H,W,4] with the weights of the pixels, or [H,W,5]
    with alpha after them, as in `mgs.fit.fitting.fit`. start(views): the Gaussians before any
    training, of degree 0, in the colours of these views,
    indices. order: [V] indices of the views, so that neighbours in azimuth follow each other.
    normals: [N,3], read only where means move along them."""

    cameras: Sequence[Camera]
    targets: Sequence[np.ndarray]
    start: Callable[[Sequence[int]], Gaussians]
    order: Sequence[int]
    normals: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class LeftOut:
    """What degree 1 does to the squared error of views that were left out, dB; above 0 where it is
    the better model.

    gain: the mean over the views; error: its standard error, as if views of one block, which share
    their fits, were independent."""

    gain: float
    error: float

    @property
    def pays(self) -> bool:
        """Whether the gain is larger than its standard error: of models that are as good as that
        the smallest is taken."""
        return self.gain > self.error


@dataclass(frozen=True)
class LeanModel:
    """A model in which each Gaussian learned only what pays.

    learned: {kind: [N]} which Gaussians learned it. parameters: how many numbers that is. whole:
    the model of the first fit, in
    which all did. left_out: why the colours are of the degree that they are; None where there was
    no choice."""

    gaussians: Gaussians
    whole: Gaussians
    learned: dict[str, Mask]
    parameters: int
    left_out: LeftOut | None


def last_images(settings: NbvSettings, prior: Prior, frames: Sequence[Frame]) -> Images:
    """What the last fit of a run was given. frames: those taken, in their order, so the seeds
    first. Raises InputError where a frame cannot be read."""
    gains = exposure_of(prior)(frames) if settings.exposure else np.ones((len(frames), 3))
    of_seeds, with_alpha = (
        initial_gaussians(prior, frames[: settings.seeds])[0],
        settings.train.alpha_weight > 0,
    )

    def start(
        views: Sequence[int],
    ) -> Gaussians:  # as in the loop: means of the seeds' start, colours of all views
        return replace(
            of_seeds,
            sh=initial_gaussians(prior, [frames[i] for i in views], gains=gains[list(views)])[0].sh,
        )

    targets = Deferred(
        range(len(frames)), lambda k: without_gain(target_of(frames[k], with_alpha), gains[k])
    )
    turn, cameras = upright(prior.up), [frame.camera for frame in frames]
    positions = np.array([camera.position for camera in cameras]) @ turn.T
    order = np.argsort(
        azimuths(positions, turn @ prior.points.mean(axis=0)), kind="stable"
    ).tolist()
    return Images(cameras, targets, start, order, initial_normals(prior))


def kinds(sh_degree: int, means: str = "frozen") -> dict[str, slice]:
    """Columns of the Fisher information by kind of parameter, as `mgs.splat.groups`, but colours of
    degrees above 0 are a kind of their own."""
    of = groups(sh_degree, means)
    if sh_degree == 0:
        return of
    colour = of.pop("colour")
    return {"colour": slice(0, 3), DIRECTIONAL: slice(3, colour.stop), **of}


def regularisation(settings: NbvSettings, sh_degree: int) -> NDArray[np.float64]:
    """lam [P] of a run's settings, in the columns of `kinds`; a run itself has colours of degree
    0."""
    of = kinds(sh_degree, settings.train.means)
    lam = settings.regularisation(groups(sh_degree, settings.train.means))
    if DIRECTIONAL in of:
        lam[of[DIRECTIONAL]] = lam[0] / DIRECTIONAL_STD**2
    return lam.astype(np.float32).astype(
        np.float64
    )  # as the fit has it, so that no information is exactly none


def fit_lam(lam: Array, sh_degree: int, means: str = "frozen") -> dict[str, float | np.ndarray]:
    """lam [P] in the columns of `kinds`, as `mgs.fit.fitting.fit` takes it."""
    by_kind: dict[str, float | np.ndarray] = {
        kind: float(lam[of][0]) for kind, of in groups(sh_degree, means).items()
    }
    if sh_degree:
        by_kind["colour"] = lam[groups(sh_degree)["colour"]].reshape(1, -1, 3)
    return by_kind


@dataclass(frozen=True)
class Worth:
    """What each kind of each Gaussian's parameters is worth, {kind: [N]}, and what can be spared.

    gain: what it adds to the log evidence, nats. rise: by how much Phi rises without it, (pixel
    value)^2. phi: Phi itself.
    unseen: [N] Gaussians about which no image says anything."""

    gain: dict[str, NDArray[np.float64]]
    rise: dict[str, NDArray[np.float64]]
    phi: float
    unseen: Mask


def worth(
    away: Array, precision: Array, lam: Array, sigma: float, of: Mapping[str, slice], phi: float
) -> Worth:
    """What parameters are worth by the formulas of this module: nothing, where the images say
    nothing of the kind.

    away: [N,P] how far each is from its start; precision: [N,P] the diagonal of J^T J + lam, in
    which all pixels count; lam: [P]; sigma: noise of a pixel, linear RGB; of: columns by kind; phi:
    as in `Worth`."""
    rise = 0.5 * precision * np.square(away)
    gain = rise / sigma**2 - 0.5 * np.log(precision / lam)
    told = {
        kind: (precision > lam)[:, columns].any(axis=1) for kind, columns in of.items()
    }  # not only by the prior
    gains = {
        kind: np.where(told[kind], gain[:, columns].sum(axis=1), 0.0)
        for kind, columns in of.items()
    }
    rises = {kind: rise[:, columns].sum(axis=1) for kind, columns in of.items()}
    return Worth(gains, rises, phi, ~np.any(list(told.values()), axis=0))


def paying(found: Worth, sizes: Mapping[str, int], loss: float) -> dict[str, Mask]:
    """{kind: [N]} what is learned of some kinds: that whose gain is above 0, without those that
    gain least for each number, as long as Phi rises by no more than `loss`, dB, in all. sizes:
    {kind: numbers of a Gaussian}."""
    gain = np.stack([found.gain[kind] / size for kind, size in sizes.items()]).ravel()
    rise, kept = np.stack([found.rise[kind] for kind in sizes]).ravel(), gain > 0
    least = np.flatnonzero(kept)[np.argsort(gain[kept], kind="stable")]
    kept[least[np.cumsum(rise[least]) <= (10 ** (loss / 10) - 1) * found.phi]] = False
    return dict(zip(sizes, kept.reshape(len(sizes), -1), strict=True))


def lean_fit(
    images: Images,
    settings: NbvSettings,
    learn: Literal["all", "auto"] = "auto",
    sh: Literal["0", "auto"] = "auto",
    loss: float = LEARN_LOSS,
    cache: ListCache | None = None,
    say: Callable[[str], None] = lambda stage: None,
) -> LeanModel:
    """Fit a model that has no more parameters than the images pay for.

    Where sh is "auto", colours are of degree 1 if that pays on views left out (`LeftOut`), or else
    of degree 0, as with fewer views than BLOCKS. A first fit learns everything. A last fit, from
    the start, then learns of every Gaussian what is `paying`, of these kinds: DIRECTIONAL and,
    where learn is "auto", opacity, scale, rotation and a mean that is learned. Colour of degree 0
    is always learned, but by Gaussians that no image sees; kinds of which the run has a rate of 0
    never are.
    loss: as in `paying`. say(stage) is called as a stage starts. Raises InputError as `fitted`.
    """
    cache, views = cache or ListCache(), range(len(images))
    left_out = (
        directional_gain(images, settings, cache, say)
        if sh == "auto" and len(images) >= BLOCKS
        else None
    )
    degree = 1 if left_out and left_out.pays else 0
    say("fitting all parameters")
    whole = fitted(images, views, settings, degree, cache)
    found, of = _worth(whole, images, settings, cache), kinds(degree, settings.train.means)
    sizes = {kind: columns.stop - columns.start for kind, columns in of.items()}
    rates = settings.train.rates | {DIRECTIONAL: settings.train.rates["colour"]}
    asked = {
        kind
        for kind in of
        if rates[kind] > 0 and (kind == DIRECTIONAL or (learn == "auto" and kind != "colour"))
    }
    kept = {kind: ~found.unseen & (rates[kind] > 0) for kind in of}
    if asked:
        kept |= paying(found, {kind: size for kind, size in sizes.items() if kind in asked}, loss)
    say("fitting what the images pay for")
    last = fitted(images, views, settings, degree, cache, kept)
    return LeanModel(
        last,
        whole,
        kept,
        sum(int(mask.sum()) * sizes[kind] for kind, mask in kept.items()),
        left_out,
    )


def directional_gain(
    images: Images,
    settings: NbvSettings,
    cache: ListCache,
    say: Callable[[str], None] = lambda stage: None,
) -> LeftOut:
    """What colours of degree 1 gain over those of degree 0 on views left out: BLOCKS fits of each
    degree, each without some views that follow each other in `images.order`. say(stage) is called
    as a stage starts."""
    decibels = []
    for done, block in enumerate(np.array_split(np.asarray(images.order), BLOCKS)):
        say(f"fitting without some views, {done + 1} of {BLOCKS}")
        rest = [i for i in images.order if i not in block]
        models = [fitted(images, rest, settings, degree, cache) for degree in (0, 1)]
        for i in block:
            errors = [
                _squared_error(model, images.cameras[i], images.targets[i], cache)
                for model in models
            ]
            decibels.append(10 * np.log10(max(errors[0], 1e-30) / max(errors[1], 1e-30)))
    return LeftOut(
        float(np.mean(decibels)), float(np.std(decibels, ddof=1) / np.sqrt(len(decibels)))
    )


def _squared_error(model: Gaussians, camera: Camera, target: np.ndarray, cache: ListCache) -> float:
    """Mean squared error of the pixel values that are known, linear RGB."""
    rgb = np.asarray(render(model, camera, cache=cache).rgb, np.float64)
    return float(np.square(rgb - target[..., :3])[target[..., 3] > 0].mean())


def _worth(model: Gaussians, images: Images, settings: NbvSettings, cache: ListCache) -> Worth:
    """What the parameters of a model are worth that was fitted to all images."""
    degree, train, views = model.sh_degree, settings.train, range(len(images))
    start, lam = images.start(views).with_degree(degree), regularisation(settings, degree)
    given = images.cameras, images.targets, start, fit_lam(lam, degree, train.means)
    goal, fields = (
        objective(model, *given, cache, train.means, images.normals, train.alpha_weight),
        as_drjit(model),
    )
    away = _flat([part for part, _ in goal.offsets(fields)], len(model))
    precision, of = _flat(goal.diagonal(fields), len(model)), kinds(degree, train.means)
    return worth(away, precision, lam, settings.pixel_noise, of, goal.phi(fields))


def _flat(vector: Vector, n: int) -> NDArray[np.float64]:
    """[N,P] a number for every learned parameter, in the columns of the information."""
    return np.concatenate([np.asarray(part, np.float64).reshape(n, -1) for part in vector], axis=1)


def fitted(
    images: Images,
    views: Sequence[int],
    settings: NbvSettings,
    degree: int,
    cache: ListCache,
    kept: Mapping[str, Mask] | None = None,
) -> Gaussians:
    """The Gaussians after a fit to some views, from the start. kept: as in `LeanModel.learned`;
    without it, all is learned. Raises InputError as `mgs.fit.fitting.fit`, and where the fit
    diverges."""
    start, train = images.start(views).with_degree(degree), settings.train
    by_kind = fit_lam(regularisation(settings, degree), degree, train.means)
    learns = None if kept is None else _by_array(kept, start.sh.shape[1], train.means)
    cameras, targets = (
        [images.cameras[i] for i in views],
        Deferred(views, lambda i: images.targets[i]),
    )
    found = fit(start, cameras, targets, train, None, cache, start, by_kind, images.normals, learns)
    if found.stop_reason == StopReason.DIVERGED:
        raise InputError(
            f"refit: a fit diverged, its loss rose to {found.losses[-1]:.3g}; lower `train.rates` of the run"
        )
    return found.gaussians


def _by_array(kept: Mapping[str, Mask], coefficients: int, means: str) -> dict[str, np.ndarray]:
    """Which Gaussians learn a kind, as masks that broadcast to what is learned. coefficients: of a
    colour channel."""
    flat = ("opacity", "mean") if means == "normal" else ("opacity",)  # one number a Gaussian, [N]
    masks = {
        kind: mask if kind in flat else mask[:, None]
        for kind, mask in kept.items()
        if kind != DIRECTIONAL
    }
    of_degrees = [masks["colour"]]
    if DIRECTIONAL in kept:
        of_degrees += [kept[DIRECTIONAL][:, None]] * (coefficients - 1)
    return masks | {"colour": np.stack(of_degrees, axis=1)}
