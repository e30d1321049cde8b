"""Choose by evidence which kinds of parameters each Gaussian learns, and the SH degree of the
colours (docs/parsimony.md). In Laplace's approximation with the exact diagonal H, learning one
parameter adds

    gain = 1/2 (H + lam) delta^2 / sigma^2 - 1/2 log((H + lam) / lam)

nats to the log evidence (MacKay 1992), with delta how far the fit moved it from its start; without
it Phi rises by 1/2 (H + lam) delta^2.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.evaluation import render_view
from mgs.fit.fitting import fit_gaussians
from mgs.fit.objective import Objective, Vector, objective
from mgs.fit.settings import ModelSettings
from mgs.fit.stopping import StopReason
from mgs.gaussians import Gaussians
from mgs.memory import Deferred
from mgs.policy.criteria import LEARN_LOSS
from mgs.progress import report
from mgs.splat import ListCache, as_drjit, groups

DIRECTIONAL = "directional"  # kind of the colour coefficients of degrees above 0
BLOCKS = 4  # blocks of neighbouring views; each is left out of a fit once

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Images:
    """Input of a fit to V views."""

    cameras: Sequence[Camera]
    targets: Sequence[np.ndarray]  # [H,W,4], with the weights of the pixels, or [H,W,5], and alpha
    start: Callable[[Sequence[int]], Gaussians]  # of degree 0, coloured by these views (indices)
    order: Sequence[int]  # [V] indices of the views by azimuth

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class LeftOut:
    """Gain of SH degree 1 over degree 0 in the squared error of views left out, dB."""

    gain: float  # mean over the views
    error: float  # standard error; views of a block, which share fits, count apart

    @property
    def pays(self) -> bool:
        """Whether the gain is larger than two standard errors."""
        return self.gain > 2 * self.error


@dataclass(frozen=True)
class LeanModel:
    """A model in which each Gaussian learned only what pays."""

    gaussians: Gaussians
    whole: Gaussians  # of the first fit, which learned everything
    learned: dict[str, Mask]  # {kind: [N]} whether each Gaussian learned it
    parameters: int  # number that is learned
    left_out: LeftOut | None  # None if the degree was not chosen


def kinds(sh_degree: int, means: str = "frozen") -> dict[str, slice]:
    """Columns as `mgs.splat.groups`, with DIRECTIONAL as a kind of its own."""
    of = groups(sh_degree, means)
    if sh_degree == 0:
        return of
    colour = of.pop("colour")
    return {"colour": slice(0, 3), DIRECTIONAL: slice(3, colour.stop), **of}


def regularisation(settings: ModelSettings, sh_degree: int) -> NDArray[np.float64]:
    """lam [P] of a run's settings, in the columns of `kinds`, rounded to float32 as in the fit."""
    lam = settings.regularisation(groups(sh_degree, settings.train.means))
    return lam.astype(np.float32).astype(np.float64)


@dataclass(frozen=True)
class Worth:
    """Worth of each kind of each Gaussian's parameters."""

    gain: dict[str, NDArray[np.float64]]  # {kind: [N]} of log evidence, nats
    rise: dict[str, NDArray[np.float64]]  # {kind: [N]} of Phi without it, (pixel value)^2
    phi: float  # Phi itself
    unseen: Mask  # [N] Gaussians that no image shows


def worth(
    away: Array, precision: Array, lam: Array, sigma: float, of: Mapping[str, slice], phi: float
) -> Worth:
    """Worth of parameters by the formulas of this module; 0 if the images say nothing of the kind.
    away: [N,P] distance of each from its start. precision: [N,P] diagonal of J^T J + lam over all
    pixels. lam: [P]. sigma: noise of a value as blended. of: columns by kind. phi: objective."""
    rise = 0.5 * precision * np.square(away)
    gain = rise / sigma**2 - 0.5 * np.log(precision / lam)
    gains, rises, unseen = {}, {}, np.ones(len(away), bool)
    for kind, columns in of.items():
        some = (precision > lam)[:, columns].any(axis=1)
        gains[kind] = np.where(some, gain[:, columns].sum(axis=1), 0.0)
        rises[kind] = rise[:, columns].sum(axis=1)
        unseen &= ~some
    return Worth(gains, rises, phi, unseen)


def paying(worths: Worth, sizes: Mapping[str, int], loss: float) -> dict[str, Mask]:
    """Choose the Gaussians that learn each kind, {kind: [N]}: those that gain, without those that
    gain least per parameter while Phi rises by at most `loss` dB in all. sizes: {kind: parameters
    of a Gaussian}; only these kinds are decided."""
    gain = np.stack([worths.gain[kind] / size for kind, size in sizes.items()]).ravel()
    rise, pays = np.stack([worths.rise[kind] for kind in sizes]).ravel(), gain > 0
    least = np.flatnonzero(pays)[np.argsort(gain[pays], kind="stable")]
    budget = (10 ** (loss / 10) - 1) * worths.phi
    pays[least[np.cumsum(rise[least]) <= budget]] = False
    return dict(zip(sizes, pays.reshape(len(sizes), -1), strict=True))


def lean_fit(
    images: Images,
    settings: ModelSettings,
    learn: Literal["all", "auto"] = "auto",
    sh: Literal["0", "auto"] = "auto",
    loss: float = LEARN_LOSS,
) -> LeanModel:
    """Fit a model that has no more parameters than the images need.

    1. With sh "auto", choose degree 1 if it predicts left-out views better, else 0. Fewer views
       than BLOCKS always get degree 0.
    2. Fit everything, and find the worth of each kind of each Gaussian.
    3. Fit once more from the start. DIRECTIONAL and, with learn "auto", all kinds but colour are
       learned only where they are `paying` (loss: dB, as there). Colour of degree 0 is learned by
       all Gaussians that some image shows. Kinds whose rate is 0 are never learned.

    Worth is always that in squared differences, also where the fits have another loss.

    Raises InputError as `fitted`.
    """
    cache, views = ListCache(), range(len(images))
    left_out = None
    if sh == "auto" and len(images) >= BLOCKS:
        left_out = directional_gain(images, settings, cache)
    degree = 1 if left_out and left_out.pays else 0
    report("fitting all parameters")
    whole = fitted(images, views, settings, degree, cache)
    worths = _worth(whole, images, settings, cache)
    columns = kinds(degree, settings.train.means)
    sizes = {kind: of.stop - of.start for kind, of in columns.items()}
    rates = settings.train.rates | {DIRECTIONAL: settings.train.rates["colour"]}
    learns = {kind: ~worths.unseen & (rates[kind] > 0) for kind in sizes}
    decided = [
        kind
        for kind in sizes
        if rates[kind] > 0 and (kind == DIRECTIONAL or (learn == "auto" and kind != "colour"))
    ]
    if decided:
        learns |= paying(worths, {kind: sizes[kind] for kind in decided}, loss)
    report("fitting what the images pay for")
    last = fitted(images, views, settings, degree, cache, learns)
    parameters = sum(int(mask.sum()) * sizes[kind] for kind, mask in learns.items())
    return LeanModel(last, whole, learns, parameters, left_out)


def directional_gain(images: Images, settings: ModelSettings, cache: ListCache) -> LeftOut:
    """Gain of colours of degree 1 over degree 0 on views left out: fits of both degrees without
    each of BLOCKS blocks of neighbours in `images.order` (Roberts et al. 2017)."""
    decibels = []
    for done, block in enumerate(np.array_split(np.asarray(images.order), BLOCKS)):
        report("fitting without some views", done, BLOCKS)
        rest = [i for i in images.order if i not in block]
        models = [fitted(images, rest, settings, degree, cache) for degree in (0, 1)]
        for i in block:
            flat, directional = (
                _squared_error(model, images.cameras[i], images.targets[i], cache)
                for model in models
            )
            decibels.append(10 * np.log10(max(flat, 1e-30) / max(directional, 1e-30)))
    error = float(np.std(decibels, ddof=1) / np.sqrt(len(decibels)))
    return LeftOut(float(np.mean(decibels)), error)


def _squared_error(model: Gaussians, camera: Camera, target: np.ndarray, cache: ListCache) -> float:
    """Mean squared error of the pixels whose colour is known, (linear RGB)^2."""
    rgb = render_view(model, camera, cache)[0].astype(np.float64)
    return float(np.square(rgb - target[..., :3])[target[..., 3] > 0].mean())


def _worth(model: Gaussians, images: Images, settings: ModelSettings, cache: ListCache) -> Worth:
    """Worth of the parameters of a model that was fitted to all images."""
    goal, degree = objective_of(images, model, settings, cache), model.sh_degree
    fields, columns = as_drjit(model), kinds(degree, settings.train.means)
    away = _flat([part for part, _ in goal.offsets(fields)], len(model))
    precision, lam = _flat(goal.diagonal(fields), len(model)), regularisation(settings, degree)
    return worth(away, precision, lam, settings.pixel_noise, columns, goal.phi(fields))


def objective_of(
    images: Images, model: Gaussians, settings: ModelSettings, cache: ListCache | None = None
) -> Objective:
    """Objective of a fit to all images with the settings of a run, in squared differences."""
    degree, train = model.sh_degree, settings.train
    return objective(
        model,
        images.cameras,
        images.targets,
        images.start(range(len(images))).with_degree(degree),
        settings.lam_by_kind(groups(degree, train.means)),
        cache,
        train.means,
        train.alpha_weight,
    )


def _flat(vector: Vector, n: int) -> NDArray[np.float64]:
    """A number for every learned parameter, [N,P] in the columns of `kinds`."""
    return np.concatenate([np.asarray(part, np.float64).reshape(n, -1) for part in vector], axis=1)


def fitted(
    images: Images,
    views: Sequence[int],
    settings: ModelSettings,
    degree: int,
    cache: ListCache,
    learns: Mapping[str, Mask] | None = None,
) -> Gaussians:
    """Fit some views (indices) from the start; return the Gaussians. learns: as
    `LeanModel.learned`; None: all is learned. Raises InputError as `mgs.fit_gaussians`, and if the
    fit diverges."""
    start, train = images.start(views).with_degree(degree), settings.train
    fit = fit_gaussians(
        start,
        [images.cameras[i] for i in views],
        Deferred(views, lambda i: images.targets[i]),
        train,
        cache=cache,
        start=start,
        lam=settings.lam_by_kind(groups(degree, train.means)),
        learns=None if learns is None else _masks(learns, start.sh.shape[1]),
    )
    if fit.stop_reason == StopReason.DIVERGED:
        raise InputError(
            f"a new fit to the views of the run diverged: its loss rose to {fit.losses[-1]:.3g}; "
            "lower its `train.rates`"
        )
    return fit.gaussians


def _masks(learns: Mapping[str, Mask], coefficients: int) -> dict[str, np.ndarray]:
    # Opacities have shape [N], all others more dimensions.
    masks = {kind: mask if kind == "opacity" else mask[:, None] for kind, mask in learns.items()}
    directional = masks.pop(DIRECTIONAL, None)
    colour = [masks["colour"]]
    if directional is not None:
        colour += [directional] * (coefficients - 1)
    return masks | {"colour": np.stack(colour, axis=1)}
