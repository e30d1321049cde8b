"""Does evidence say which parameters a Gaussian needs? `python benchmarks/evidence.py OUT.json
DATASET:VIEWS...`

A model is fitted with all of its parameters. Laplace's approximation with the exact diagonal H then
says of every Gaussian what
each kind of its parameters adds to the logarithm of the marginal likelihood, nats, if all else
stays as it is:

    gain = 1/2 sum (H + lam) delta^2 / sigma^2  -  1/2 sum log((H + lam) / lam)

with delta a parameter's distance from its start, and sums over the kind's parameters. The first
part is what the images gain by it, the second what a further parameter costs. Where the gain is not
above 0, the Gaussian keeps the prior's values of that
kind, and the model is fitted again from the start, without these. Beside it: whole kinds left out;
and as many of each kind learned, but of Gaussians drawn at random, or of those about which the
images say most (the largest sums of the second part).

The same for the degree of the colours' spherical harmonics: degree 1 with several prior standard
deviations TAUS of its coefficients, in all Gaussians, in those in which their gain is above 0, and
in as many chosen in the other two ways. Two rules
that see no test view may choose tau: the evidence of the whole model, and the error of views that
are left out, a quarter of them at a time. Colour of degree 0 is always learned.

Models have as many Gaussians as the cameras resolve. VIEWS views spread evenly in azimuth are
fitted at once, and PSNR is measured on the dataset's test views.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.data.dataset import Frame, load_dataset, target_of
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.objective import objective
from mgs.gaussians import Gaussians, learned
from mgs.metrics import masked_squares
from mgs.policy.criteria import PIXEL_NOISE, observed, regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import Prior, build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.splat import ListCache, as_drjit, fisher, groups, render
from mgs.study.material import test_views_of

TAUS = (0.01, 0.03, 0.1, 0.3, 1.0)
KINDS = ("opacity", "scale", "rotation")
DIRECTIONAL = slice(3, 12)
"""Columns of the coefficients of degree 1."""

FOLDS = 4

HELD = 1e12
"""lam of a parameter that is not learned: no step of a fit is long enough to change a float32."""


@dataclass(frozen=True)
class Scene:
    """What models of a rock are fitted to, and judged by."""

    prior: Prior
    frames: Sequence[Frame]
    tests: Sequence[Frame]
    cache: ListCache


@dataclass(frozen=True)
class Model:
    """A fit, and what it says of its parameters. lam [P], learned [N,P] bool and H [N,P]: in the
    columns of the information."""

    start: Gaussians
    end: Gaussians
    lam: np.ndarray
    learned: np.ndarray
    H: np.ndarray


def opened(root: Path, views: int) -> Scene:
    """A dataset, with a prior of as many Gaussians as its cameras resolve."""
    dataset = load_dataset(root)
    prior, _ = build_prior(dataset, PriorSettings())
    positions = np.array([frame.camera.position for frame in dataset.frames])
    frames = [dataset.frames[i] for i in seed_views(positions, prior.points.mean(0), views)]
    return Scene(prior, frames, test_views_of(dataset).frames, ListCache())


def flat(gaussians: Gaussians) -> np.ndarray:
    """[N,P] the learned parameters, in the columns of the information."""
    return np.concatenate(
        [np.asarray(getattr(gaussians, name)).reshape(len(gaussians), -1) for name in learned()],
        axis=1,
    )


def by_name(values: np.ndarray, like: Gaussians) -> dict[str, np.ndarray]:
    """The way back: [N,P] as an array for each learned parameter, in its shape."""
    columns = groups(like.sh_degree)
    return {
        name: values[:, columns[kind]].reshape(getattr(like, name).shape)
        for name, kind in learned().items()
    }


def by_kind(values: np.ndarray, like: Gaussians) -> dict[str, np.ndarray]:
    """The same for each kind, as `fit` takes lam."""
    return {learned()[name]: array for name, array in by_name(values, like).items()}


def fitted(
    scene: Scene, frames: Sequence[Frame], lam: np.ndarray, which: np.ndarray | None = None
) -> tuple[Gaussians, ...]:
    """The Gaussians before and after a fit to some frames, of the degree that lam [P] is for.

    which: [N,P] the parameters that are learned, all by default; the others keep the prior's
    values."""
    start = initial_gaussians(scene.prior, frames)[0].with_degree(
        0 if len(lam) < DIRECTIONAL.stop else 1
    )
    which = np.ones((len(start), len(lam)), bool) if which is None else which
    cameras, targets = [frame.camera for frame in frames], [target_of(frame) for frame in frames]
    held = by_kind(np.where(which, lam, HELD), start)
    end = fit(start, cameras, targets, cache=scene.cache, start=start, lam=held).gaussians
    return start, replace(end, **by_name(np.where(which, flat(end), flat(start)), start))


def model_of(scene: Scene, lam: np.ndarray, which: np.ndarray | None = None) -> Model:
    """A fit to all frames of a scene."""
    start, end = fitted(scene, scene.frames, lam, which)
    H = sum(
        fisher(end, frame.camera, cache=scene.cache).astype(np.float64) for frame in scene.frames
    )
    return Model(start, end, lam, np.ones(H.shape, bool) if which is None else which, H)


def cost(model: Model) -> np.ndarray:
    """[N,P] what the evidence loses by each parameter that may move, nats."""
    return np.asarray(0.5 * np.log1p(model.H / model.lam))


def gain(model: Model) -> np.ndarray:
    """[N,P] what the evidence gains by each parameter, nats."""
    away = flat(model.end).astype(np.float64) - flat(model.start)
    return np.asarray(0.5 * (model.H + model.lam) * away**2 / PIXEL_NOISE**2 - cost(model))


def only(model: Model, parts: Mapping[str, slice], kept: Mapping[str, np.ndarray]) -> np.ndarray:
    """[N,P] which parameters are learned, if of some parts only some Gaussians learn theirs; kept:
    these, [N] bool each."""
    which = np.ones(model.H.shape, bool)
    for part, gaussians in kept.items():
        which[:, parts[part]] = gaussians[:, None]
    return which


def choices(model: Model, parts: Mapping[str, slice]) -> dict[str, dict[str, np.ndarray]]:
    """Which Gaussians learn each part [N]: by evidence; as many at random; as many about which the
    images say most."""
    gains, costs, rng = gain(model), cost(model), np.random.default_rng(0)
    kept = {part: gains[:, columns].sum(axis=1) > 0 for part, columns in parts.items()}
    told = {
        part: np.argsort(-costs[:, columns].sum(axis=1), kind="stable")
        for part, columns in parts.items()
    }
    return {
        "by evidence": kept,
        "at random": {part: rng.permutation(which) for part, which in kept.items()},
        "by information": {
            part: np.isin(np.arange(len(gains)), told[part][: kept[part].sum()]) for part in parts
        },
    }


def judged(scene: Scene, model: Model, parts: Mapping[str, slice]) -> dict[str, Any]:
    """What test views and evidence say of a model, how many parameters it learns, and each part in
    what share of Gaussians."""
    cameras, targets = (
        [frame.camera for frame in scene.frames],
        [target_of(frame) for frame in scene.frames],
    )
    lam = by_kind(np.broadcast_to(model.lam, model.H.shape), model.end)
    phi = objective(model.end, cameras, targets, model.start, lam, scene.cache).phi(
        as_drjit(model.end)
    )
    found = evaluate(model.end, (), (), test_frames=scene.tests)["test"]
    return {
        "parameters": int(model.learned.sum()),
        "shares": {
            part: float(model.learned[:, columns].all(axis=1).mean())
            for part, columns in parts.items()
        },
        "evidence": float(-phi / PIXEL_NOISE**2 - cost(model)[model.learned].sum()),
        "psnr": found["psnr"],
        "psnr_inside": found["psnr_inside"],
    }


def left_out_error(scene: Scene, lam: np.ndarray, which: np.ndarray | None = None) -> float:
    """Mean squared error inside the mask of views that a model was not fitted to, linear RGB: every
    FOLDS-th at a time."""
    errors = []
    for fold in range(FOLDS):
        rest = [frame for k, frame in enumerate(scene.frames) if k % FOLDS != fold]
        model = fitted(scene, rest, lam, which)[1]
        for frame in scene.frames[fold::FOLDS]:
            rgb = np.asarray(render(model, frame.camera, cache=scene.cache).rgb, np.float64)
            errors.append(masked_squares(rgb, target_of(frame), frame.mask()).mean())
    return float(np.mean(errors))


def kinds(scene: Scene) -> list[dict[str, Any]]:
    """Records of models of degree 0 that differ in the kinds that are learned."""
    lam, parts = regularisation(groups(0)), {kind: groups(0)[kind] for kind in KINDS}
    full = model_of(scene, lam)
    nobody = np.zeros(len(full.end), bool)
    ways = {f"without {kind}": {kind: nobody} for kind in KINDS} | choices(full, parts)
    first = {
        "what": "all",
        "gaussians": len(full.end),
        "observed": float(observed(full.H, lam).mean()),
    }
    records = [first | judged(scene, full, parts)]
    for what, kept in ways.items():
        records.append(
            {"what": what} | judged(scene, model_of(scene, lam, only(full, parts, kept)), parts)
        )
    return records


def degrees(scene: Scene) -> list[dict[str, Any]]:
    """Records of models of degree 1, the first with all coefficients of degree 1 held at 0. That is
    degree 0 but for the least value of a colour, which a fit has for degree 0 alone, and which
    would count as a loss of evidence."""
    parts, lam = {"degree 1": DIRECTIONAL}, regularisation(groups(1))
    which = np.ones((len(scene.prior.points) + scene.prior.backed, len(lam)), bool)
    which[:, DIRECTIONAL] = False
    error = left_out_error(scene, lam, which)
    records = [
        {"what": "none", "left_out_error": error}
        | judged(scene, model_of(scene, lam, which), parts)
    ]
    for tau in TAUS:
        lam = regularisation(groups(1))
        lam[DIRECTIONAL] = (PIXEL_NOISE / tau) ** 2
        full = model_of(scene, lam)
        records.append(
            {"tau": tau, "what": "all", "left_out_error": left_out_error(scene, lam)}
            | judged(scene, full, parts)
        )
        for what, kept in choices(full, parts).items():
            model = model_of(scene, lam, only(full, parts, kept))
            records.append({"tau": tau, "what": what} | judged(scene, model, parts))
    return records


def main(out: Path, *asked: str) -> None:
    """Measure and write."""
    runtime.start()
    scenes = []
    for root, _, views in (text.rpartition(":") for text in asked):
        scene = opened(Path(root), int(views))
        scenes.append(
            {"dataset": root, "views": int(views), "kinds": kinds(scene), "degrees": degrees(scene)}
        )
        for record in [*scenes[-1]["kinds"], *scenes[-1]["degrees"]]:
            print(root, record, flush=True)
        write_json(
            out,
            {
                "command": command_line(),
                "machine": runtime.processor(),
                "versions": versions(),
                "scenes": scenes,
            },
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
