"""Predicted errors of a run in views that it has not seen, and how true the predictions are.

The posterior of the parameters, N(0, sigma^2 / (H + lambda)), does not say what no parameters of
this model can draw. So the predicted variance of a pixel and channel has three terms:

- `parameters`: J diag(sigma^2 / (H + lambda)) J^T, the variance that the parameters bring;
- `residual`: the mean squared error that each Gaussian showed in its training views, blended as
  colours are;
- `gradient`: the squared gradient of the render, across a pixel: the cost of a shift of detail;

and a constant. Their weights are fitted to the run's own views, each predicted by a model that was
fitted without it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mgs import (
    Camera,
    Frame,
    Gaussians,
    InputError,
    ListCache,
    Run,
    Scene,
    as_drjit,
    fisher,
    jvp,
    open_run,
    render,
)
from mgs.colour import SH_C0
from mgs.files import write_json
from mgs.fit.evidence import Images, fitted
from mgs.gaussians import learned, sh_from_rgb
from mgs.images import write_exr
from mgs.learning import images_of
from mgs.memory import padded
from mgs.provenance import versions
from mgs.run.settings import NbvSettings
from mgs.seeds import generator
from mgs.splat import groups
from studies.calibration import NORMAL, Calibration, fit_calibration, judged
from studies.uncertainty_figure import uncertainty_figure

Array = NDArray[np.floating]

DRAWS = 32
"""Draws from the posterior, which give a variance within a quarter."""

FOLDS = 3
"""Parts of a run's views; each is predicted by a model that was fitted to the others."""

TERMS = ("parameters", "residual", "gradient")

ROWS: dict[str, tuple[str, ...]] = {
    "parameters": TERMS[:1],
    "parameters, residual": TERMS[:2],
    "all": TERMS,
}
"""Predictions that are calibrated and judged -> their terms. Maps show the last one."""

UNCALIBRATED = "as the criteria assume"
"""The prediction of sigma and the posterior alone, with normal intervals: nothing is fitted."""

MAPPED = 3
"""Number of views whose maps are written."""


def parameter_variance(
    gaussians: Gaussians,
    camera: Camera,
    variance: Array,
    rng: np.random.Generator,
    draws: int = DRAWS,
) -> Array:
    """J diag(variance) J^T: variance of each pixel and channel, [H,W,3], as the mean square of J v
    over random draws v.

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
        moved = np.asarray(jvp(gaussians, tangents, camera, cache=cache).rgb)
        total += np.square(moved, dtype=np.float64)
    return total / draws


def residual_variance(gaussians: Gaussians, frames: Sequence[Frame]) -> Array:
    """Mean squared error of the pixels that show each Gaussian, with its blending weights, [N]; 0
    if none does.

    The sums over pixels are gradients of a sum of pixels by the colours, which blend linearly.
    """
    import drjit as dr
    import mitsuba as mi

    sums = np.zeros((2, len(gaussians)))
    grey = as_drjit(_coloured(gaussians, np.zeros(len(gaussians))))
    for frame in frames:
        truth, weight = frame.target()
        rendered = np.asarray(render(gaussians, frame.camera).rgb)
        error = np.square(rendered - gaussians.blended(truth[..., :3])).mean(axis=-1) * weight
        for row, pixels in zip(sums, (error, weight), strict=True):
            sh = mi.TensorXf(padded(grey.sh))
            dr.enable_grad(sh)
            image = render(replace(grey, sh=sh), frame.camera)
            dr.backward(dr.sum(image.rgb.array * mi.Float(padded(np.repeat(pixels.ravel(), 3)))))
            row += np.asarray(dr.grad(sh))[:, 0].mean(axis=-1) / SH_C0
    return sums[0] / np.maximum(sums[1], np.finfo(np.float32).tiny)


def _coloured(gaussians: Gaussians, values: Array) -> Gaussians:
    """The Gaussians in these grey values [N]."""
    return replace(gaussians, sh=sh_from_rgb(np.repeat(values[:, None], 3, axis=1)))


@dataclass(frozen=True)
class Predictor:
    """A fitted model and what its errors are predicted from. variance: [N,P]; residual: [N]."""

    gaussians: Gaussians
    variance: Array
    residual: Array

    def look(self, frame: Frame, seed: int) -> tuple[dict[str, Array], Array, NDArray[np.bool_]]:
        """Errors of one view, in the space in which the Gaussians are blended: each of TERMS,
        [H,W,3], squared RGB; the true error, [H,W,3] RGB; and the pixels that are wholly on the
        rock, [H,W]."""
        # Drawn as colours of about 1, for which float32 is precise.
        largest = max(float(self.residual.max(initial=0)), 1e-30)
        image = render(_coloured(self.gaussians, self.residual / largest), frame.camera)
        alpha = np.maximum(np.asarray(image.alpha), 1e-6)[..., None]
        residual = np.asarray(image.rgb) * (largest / alpha)
        rgb = np.asarray(render(self.gaussians, frame.camera).rgb, np.float64)
        down, right = np.gradient(rgb, axis=(0, 1))
        rng = generator(seed, f"calibration/{frame.name}")
        terms = {
            "parameters": parameter_variance(self.gaussians, frame.camera, self.variance, rng),
            "residual": residual.astype(np.float64),
            "gradient": down**2 + right**2,
        }
        truth, weight = frame.target()
        inside = frame.mask() & (truth[..., 3] > 0.999) & (weight > 0)
        return terms, rgb - self.gaussians.blended(truth[..., :3]), inside


def predictor(
    gaussians: Gaussians, H: Array, frames: Sequence[Frame], settings: NbvSettings
) -> Predictor:
    """`Predictor` of a model that was fitted to these frames. H: [N,P], their information."""
    lam = settings.regularisation(groups(gaussians.sh_degree))
    variance = settings.pixel_noise**2 / (H.astype(np.float64) + lam)
    return Predictor(gaussians, variance, residual_variance(gaussians, frames))


def _fitted_to(
    images: Images, views: Sequence[int], frames: Sequence[Frame], settings: NbvSettings
) -> Predictor:
    """`Predictor` of a model that is fitted to some views of the run (indices in images and
    frames)."""
    cache = ListCache()
    model = fitted(images, views, settings, settings.sh, cache)
    information = np.stack([fisher(model, images.cameras[i], cache=cache) for i in views])
    H = information.sum(axis=0, dtype=np.float64)
    return predictor(model, H, [frames[i] for i in views], settings)


@dataclass(frozen=True)
class Pixels:
    """Terms and signed errors of pixels wholly on the rock, all channels in one row, [n]."""

    terms: dict[str, Array]
    errors: Array

    @staticmethod
    def joined(parts: Iterable[Pixels]) -> Pixels:
        """All pixels of some views, in one."""
        parts = list(parts)
        terms = {name: np.concatenate([part.terms[name] for part in parts]) for name in TERMS}
        return Pixels(terms, np.concatenate([part.errors for part in parts]))


def calibrate_run(
    run: str | Path, progress: Callable[[int, int], None] = lambda done, total: None
) -> list[Path]:
    """Predict errors, calibrate on the run's own views, judge on other views; write
    RUN/diagnostics. Returns the paths.

    - uncertainty.json: "rows" holds for each prediction and each set of views the result of
      `judged`. Sets: "folds", the run's own views, to which the weights were fitted; "test", the
      test views; "held out", frames never trained on.
    - uncertainty.png (`studies.uncertainty_figure`).
    - NAME.errors.exr of a few views: true error and predicted sigma of each channel, linear RGB.

    progress: called as progress(views done, all). Raises InputError as `open_run`, and for a run
    that learns means or estimates exposure, has fewer than 2 FOLDS images, or has seen all views.
    """
    opened = open_run(run)
    settings, seed = opened.settings, opened.settings.seed
    frames, unseen = _views(opened)
    total, done = len(frames) + sum(map(len, unseen.values())), 0

    def measured(found: Predictor, views: Sequence[Frame]) -> Pixels:
        nonlocal done
        parts = []
        for frame in views:
            terms, error, inside = found.look(frame, seed)
            kept = {name: term[inside].ravel() for name, term in terms.items()}
            parts.append(Pixels(kept, error[inside].ravel()))
            done += 1
            progress(done, total)
        return Pixels.joined(parts)

    folds = []
    images = images_of(Scene(opened.dataset, opened.prior, settings), frames)
    for fold in range(FOLDS):
        kept = [i for i in range(len(frames)) if i % FOLDS != fold]
        found = _fitted_to(images, kept, frames, settings)
        folds.append(measured(found, frames[fold::FOLDS]))
    own = Pixels.joined(folds)
    final = predictor(opened.state.gaussians, opened.state.H, frames, settings)
    sets = {"folds": own} | {name: measured(final, views) for name, views in unseen.items()}
    assumed = {"parameters": 1.0, "noise": settings.pixel_noise**2}
    calibrations = {UNCALIBRATED: Calibration(assumed, NORMAL)}
    for name, used in ROWS.items():
        calibrations[name] = fit_calibration({term: own.terms[term] for term in used}, own.errors)
    rows = []
    for name, calibration in calibrations.items():
        for views, pixels in sets.items():
            sigma, rng = (
                calibration.sigma(pixels.terms),
                generator(seed, f"calibration/{name}/{views}"),
            )
            row = {"prediction": name, "views": views, "weights": dict(calibration.weights)}
            rows.append(row | judged(pixels.errors, sigma, calibration.widths, rng))
    record = {
        "run": str(run),
        "policy": settings.policy,
        "views": {"folds": len(frames)} | {name: len(views) for name, views in unseen.items()},
        "rows": rows,
        "versions": versions(),
    }
    out, shown = opened.folder / "diagnostics", next(iter(unseen.values()))
    write_json(out / "uncertainty.json", record)
    maps, files = [], []
    for frame in shown[:: -(-len(shown) // MAPPED)]:
        terms, error, inside = final.look(frame, seed)
        sigma = calibrations["all"].sigma(terms)
        maps.append((frame.name, error, sigma, inside))
        files.append(_write_maps(out, frame, error, sigma))
    uncertainty_figure(out / "uncertainty.png", rows, maps)
    return [out / "uncertainty.json", out / "uncertainty.png", *files]


def _write_maps(folder: Path, frame: Frame, error: Array, sigma: Array) -> Path:
    """Write NAME.errors.exr."""
    path, channels = folder / f"{frame.name}.errors.exr", {}
    for kind, values in (("error", error), ("sigma", sigma)):
        for i, channel in enumerate("RGB"):
            channels[f"{kind}.{channel}"] = values[..., i].astype(np.float32)
    write_exr(path, channels, frame.camera)
    return path


def _views(run: Run) -> tuple[list[Frame], dict[str, tuple[Frame, ...]]]:
    """The training frames, and the sets of other views, by name; none of these is empty."""
    where, settings, frames = run.folder, run.settings, run.taken
    if settings.train.means != "frozen":
        raise InputError(f"{where}: learns means; calibration needs a run with --means frozen")
    if settings.exposure:
        raise InputError(f"{where}: estimates exposure; calibration needs a run without --exposure")
    if len(frames) < 2 * FOLDS:
        raise InputError(
            f"{where}: has {len(frames)} images; calibration leaves out a third of them, "
            f"and needs {2 * FOLDS} or more"
        )
    names, tests = {frame.name for frame in frames}, run.dataset.test_views()
    held_out = tuple(f for f in run.dataset.with_images(names) if f.name not in names)
    unseen = {"test": tests.frames if tests else (), "held out": held_out}
    unseen = {name: views for name, views in unseen.items() if views}
    if not unseen:
        raise InputError(
            f"{where}: was trained on all views there are; "
            "calibration needs some that it has not seen"
        )
    return frames, unseen
