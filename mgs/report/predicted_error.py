"""What a run expects its errors to be in views that it has not seen, and whether they are so: `mgs
diagnose RUN --calibrate`.

The posterior of the parameters alone, N(0, sigma^2 / (H + lambda)), says how noise in the images
moves the render. It does not
say what no parameters of this model can draw. So a predicted variance, for each pixel and channel,
has three terms:

- `parameters`: J diag(sigma^2 / (H + lambda)) J^T, the variance that the parameters bring;
- `residual`: the mean squared error that each Gaussian showed in the views it was fitted to,
blended as colours are;
- `gradient`: the squared gradient of the render, across a pixel: what a shift of detail costs;

and a constant. Their weights are fitted to views of the run itself, each predicted by a model that
was fitted without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mgs.camera import Camera
from mgs.colour import SH_C0
from mgs.data.dataset import Frame, target_of
from mgs.errors import InputError
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.gaussians import Gaussians, learned, sh_from_rgb
from mgs.images import write_exr
from mgs.memory import padded
from mgs.policy.criteria import lam_by_kind
from mgs.prior.build import Prior, load_prior
from mgs.prior.initial import initial_gaussians
from mgs.provenance import versions
from mgs.report.calibration import NORMAL, Calibration, fit_calibration, judged
from mgs.run import folder as run_folder
from mgs.run.settings import NbvSettings
from mgs.seeds import generator
from mgs.splat import ListCache, as_drjit, fisher, groups, jvp, render

Array = NDArray[np.floating]

DRAWS = 32
"""Draws from the posterior; the standard deviation of a variance estimated from so many is a
quarter of it."""

FOLDS = 3
"""Parts of a run's views, each of which is predicted by a model that was fitted to the others."""

TERMS = ("parameters", "residual", "gradient")

ROWS: dict[str, tuple[str, ...]] = {
    "parameters": TERMS[:1],
    "parameters, residual": TERMS[:2],
    "all": TERMS,
}
"""Predictions that are calibrated and judged, by the terms they have. The last is the one that maps
show."""

UNCALIBRATED = "as the criteria assume"
"""The prediction of sigma and the posterior alone, with normal intervals: nothing is fitted."""

MAPPED = 3
"""Views whose maps are written."""


def parameter_variance(
    gaussians: Gaussians,
    camera: Camera,
    variance: Array,
    rng: np.random.Generator,
    draws: int = DRAWS,
) -> Array:
    """J diag(variance) J^T, the variance of each pixel and channel, [H,W,3], as the mean square of
    J v over random draws v.

    variance: [N,P], of the parameters, columns as in `mgs.splat.groups` with frozen means.
    """
    columns, cache = groups(gaussians.sh_degree), ListCache()
    total = np.zeros((camera.height, camera.width, 3))
    for _ in range(draws):
        draw = (np.sqrt(variance) * rng.standard_normal(variance.shape)).astype(np.float32)
        tangents = {
            name: draw[:, columns[kind]].reshape(np.shape(getattr(gaussians, name)))
            for name, kind in learned().items()
        }
        total += np.square(
            np.asarray(jvp(gaussians, tangents, camera, cache=cache).rgb), dtype=np.float64
        )
    return total / draws


def residual_variance(gaussians: Gaussians, frames: Sequence[Frame]) -> Array:
    """Mean squared error of the pixels that show each Gaussian, weighted as it is blended into
    them, [N]; 0 where none does.

    The sums over pixels are gradients of a sum of pixels by the colours of the Gaussians, which are
    blended linearly.
    """
    import drjit as dr
    import mitsuba as mi

    sums = np.zeros((2, len(gaussians)))
    grey = as_drjit(_coloured(gaussians, np.zeros(len(gaussians))))
    for frame in frames:
        truth, weight = frame.target()
        error = (
            np.square(np.asarray(render(gaussians, frame.camera).rgb) - truth[..., :3]).mean(
                axis=-1
            )
            * weight
        )
        for row, pixels in zip(sums, (error, weight), strict=True):
            sh = mi.TensorXf(padded(grey.sh))
            dr.enable_grad(sh)
            image = render(replace(grey, sh=sh), frame.camera)
            dr.backward(dr.sum(image.rgb.array * mi.Float(padded(np.repeat(pixels.ravel(), 3)))))
            row += np.asarray(dr.grad(sh))[:, 0].mean(axis=-1) / SH_C0
    return sums[0] / np.maximum(sums[1], np.finfo(np.float32).tiny)


def _coloured(gaussians: Gaussians, values: Array) -> Gaussians:
    """The Gaussians with these numbers [N] as their grey."""
    return replace(gaussians, sh=sh_from_rgb(np.repeat(values[:, None], 3, axis=1)))


@dataclass(frozen=True)
class Predictor:
    """A fitted model with what its errors are predicted from. variance: [N,P]; residual: [N]."""

    gaussians: Gaussians
    variance: Array
    residual: Array

    def terms(self, camera: Camera, rng: np.random.Generator) -> dict[str, Array]:
        """Each of TERMS for one view, [H,W,3], squared linear RGB."""
        largest = max(
            float(self.residual.max(initial=0)), 1e-30
        )  # drawn as colours of about 1, which float32 keeps precise
        image = render(_coloured(self.gaussians, self.residual / largest), camera)
        drawn = np.asarray(image.rgb) * (
            largest / np.maximum(np.asarray(image.alpha), 1e-6)[..., None]
        )
        rgb = np.asarray(render(self.gaussians, camera).rgb, np.float64)
        down, right = np.gradient(rgb, axis=(0, 1))
        parameters = parameter_variance(self.gaussians, camera, self.variance, rng)
        return {
            "parameters": parameters,
            "residual": drawn.astype(np.float64),
            "gradient": down**2 + right**2,
        }

    def errors(self, frame: Frame) -> tuple[Array, NDArray[np.bool_]]:
        """The true error of a view, [H,W,3] linear RGB, and which of its pixels lie wholly on the
        rock, [H,W]."""
        truth, weight = frame.target()
        inside = frame.mask() & (truth[..., 3] > 0.999) & (weight > 0)
        return np.asarray(render(self.gaussians, frame.camera).rgb, np.float64) - truth[
            ..., :3
        ], inside


def predictor(
    gaussians: Gaussians, H: Array, frames: Sequence[Frame], settings: NbvSettings
) -> Predictor:
    """Of a model that was fitted to these frames. H: [N,P], their information about it."""
    lam = settings.regularisation(groups(gaussians.sh_degree))
    return Predictor(
        gaussians,
        settings.pixel_noise**2 / (H.astype(np.float64) + lam),
        residual_variance(gaussians, frames),
    )


def _without(
    fold: int, frames: Sequence[Frame], prior: Prior, settings: NbvSettings
) -> tuple[Predictor, list[Frame]]:
    """A model of the frames that are not in a fold, and the frames that are."""
    kept = [frame for i, frame in enumerate(frames) if i % FOLDS != fold]
    start, cache = initial_gaussians(prior, kept)[0], ListCache()
    columns = groups(start.sh_degree)
    by_kind = lam_by_kind(settings.regularisation(columns), columns)
    targets = [target_of(frame, settings.train.alpha_weight > 0) for frame in kept]
    model = fit(
        start,
        [f.camera for f in kept],
        targets,
        settings.train,
        cache=cache,
        start=start,
        lam=by_kind,
    ).gaussians
    H = np.stack([fisher(model, frame.camera, cache=cache) for frame in kept]).sum(
        axis=0, dtype=np.float64
    )
    return predictor(model, H, kept, settings), [
        frame for i, frame in enumerate(frames) if i % FOLDS == fold
    ]


def _pixels(
    found: Predictor, frames: Sequence[Frame], seed: int, on_view: Callable[[], None]
) -> tuple[dict[str, Array], Array]:
    """TERMS and signed errors of all pixels wholly on the rock, and all channels, in one row."""
    terms: dict[str, list[Array]] = {name: [] for name in TERMS}
    errors = []
    for frame in frames:
        error, inside = found.errors(frame)
        errors.append(error[inside].ravel())
        for name, term in found.terms(
            frame.camera, generator(seed, f"calibration/{frame.name}")
        ).items():
            terms[name].append(term[inside].ravel())
        on_view()
    return {name: np.concatenate(values) for name, values in terms.items()}, np.concatenate(errors)


def _joined(parts: Sequence[tuple[dict[str, Array], Array]]) -> tuple[dict[str, Array], Array]:
    return {
        name: np.concatenate([terms[name] for terms, _ in parts]) for name in TERMS
    }, np.concatenate([e for _, e in parts])


def calibrate_run(
    run: str | Path, progress: Callable[[int, int], None] | None = None
) -> list[Path]:
    """Predict errors, calibrate on the run's own views, and judge on those it has not seen:
    RUN/diagnostics/uncertainty.json.

    Written beside it: uncertainty.png, and for a few views NAME.errors.exr with the true error and
    the predicted sigma of each channel, linear RGB. The JSON has "rows": for each prediction and
    each set of views what `judged` found. The sets: "folds", the run's own views, on which the
    weights were fitted; "test", the dataset's test views; "held out", frames that were never
    trained on. Returns the paths. progress(views done, views in all). Raises InputError as
    `mgs.run.folder.load_run`, and for a run that learns means, has fewer than 2 FOLDS images, or
    has seen all views there are.
    """
    from mgs.report.figures import uncertainty_figure

    run = Path(run)
    gaussians, dataset, trained, _ = run_folder.load_run(run)
    settings, state = run_folder.read_settings(run), run_folder.read_checkpoint(run)
    assert state is not None
    frames, unseen = _views(run, settings, dataset, trained)
    total, done = len(frames) + sum(map(len, unseen.values())), 0

    def on_view() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total)

    prior, seed = load_prior(settings.prior), settings.seed
    own = _joined(
        [_pixels(*_without(fold, frames, prior, settings), seed, on_view) for fold in range(FOLDS)]
    )
    final = predictor(gaussians, state.H, frames, settings)
    sets = {"folds": own} | {
        name: _pixels(final, views, seed, on_view) for name, views in unseen.items()
    }
    calibrations = {
        UNCALIBRATED: Calibration({"parameters": 1.0, "noise": settings.pixel_noise**2}, NORMAL)
    }
    calibrations |= {
        row: fit_calibration({name: own[0][name] for name in terms}, own[1])
        for row, terms in ROWS.items()
    }
    rows = _rows(calibrations, sets, seed)
    counts = {"folds": len(frames)} | {name: len(views) for name, views in unseen.items()}
    record = {
        "run": str(run),
        "policy": settings.policy,
        "views": counts,
        "rows": rows,
        "versions": versions(),
    }
    out, shown = run / "diagnostics", next(iter(unseen.values()))
    write_json(out / "uncertainty.json", record)
    maps = [
        _maps(final, frame, calibrations["all"], seed)
        for frame in shown[:: -(-len(shown) // MAPPED)]
    ]
    uncertainty_figure(out / "uncertainty.png", rows, maps)
    return [
        out / "uncertainty.json",
        out / "uncertainty.png",
        *(_write_maps(out, *of_view) for of_view in maps),
    ]


def _rows(
    calibrations: dict[str, Calibration], sets: dict[str, tuple[dict[str, Array], Array]], seed: int
) -> list[dict[str, Any]]:
    """What `judged` found of each prediction on each set of views, and the weights of its terms."""
    return [
        {"prediction": row, "views": name, "weights": dict(calibration.weights)}
        | judged(
            errors,
            calibration.sigma(terms),
            calibration.widths,
            generator(seed, f"calibration/{row}/{name}"),
        )
        for row, calibration in calibrations.items()
        for name, (terms, errors) in sets.items()
    ]


def _write_maps(folder: Path, name: str, error: Array, sigma: Array, _: NDArray[np.bool_]) -> Path:
    channels = {
        f"{what}.{c}": v[..., i]
        for what, v in (("error", error), ("sigma", sigma))
        for i, c in enumerate("RGB")
    }
    write_exr(
        folder / f"{name}.errors.exr",
        {key: value.astype(np.float32) for key, value in channels.items()},
    )
    return folder / f"{name}.errors.exr"


def _views(
    run: Path, settings: NbvSettings, dataset: Any, trained: Sequence[str]
) -> tuple[list[Frame], dict[str, tuple[Frame, ...]]]:
    """The frames that the run was trained on, and sets of views that it was not, by name; none of
    these is empty."""
    if settings.train.means != "frozen":
        raise InputError(f"{run}: learns means; --calibrate knows the errors of frozen means only")
    if settings.exposure:
        raise InputError(
            f"{run}: estimates exposure; --calibrate knows the errors of images as they are only"
        )
    if len(trained) < 2 * FOLDS:
        raise InputError(
            f"{run}: has {len(trained)} images; --calibrate leaves out a third of them, and needs {2 * FOLDS} or more"
        )
    by_name, tests = {frame.name: frame for frame in dataset.frames}, dataset.test_views()
    held_out = tuple(
        frame for frame in dataset.with_images(trained) if frame.name not in set(trained)
    )
    unseen = ({"test": tests.frames} if tests else {}) | (
        {"held out": held_out} if held_out else {}
    )
    if not unseen:
        raise InputError(
            f"{run}: was trained on all views there are; --calibrate needs some that it has not seen"
        )
    return [by_name[name] for name in trained], unseen


def _maps(
    found: Predictor, frame: Frame, calibration: Calibration, seed: int
) -> tuple[str, Array, Array, NDArray[np.bool_]]:
    """A view's name, its true error and predicted sigma, [H,W,3], and which of its pixels lie
    wholly on the rock."""
    error, inside = found.errors(frame)
    return (
        frame.name,
        error,
        calibration.sigma(found.terms(frame.camera, generator(seed, f"calibration/{frame.name}"))),
        inside,
    )
