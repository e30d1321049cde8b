"""The operations of a run on the splat core, and the PSNR that a run measures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from mgs import runtime
from mgs.camera import Camera
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data.dataset import Dataset, Frame
from mgs.fit.fitting import Fit, fit
from mgs.fit.settings import TrainSettings
from mgs.gaussians import Gaussians
from mgs.memory import IMAGE_BYTES, kept_within
from mgs.metrics import colour_corrected, psnr
from mgs.policy.criteria import lam_by_kind
from mgs.prior.build import Prior
from mgs.prior.exposure import exposure_of
from mgs.prior.initial import Colours, colours_of, initial_gaussians, initial_normals
from mgs.run.inputs import prior_digest
from mgs.run.problem import Operations
from mgs.run.settings import NbvSettings
from mgs.splat import ListCache, fisher, groups, render


def operations_of(dataset: Dataset, prior: Prior, settings: NbvSettings) -> Operations:
    """Operations on the splat core; the centre is the prior's centre of mass."""
    cache, means = ListCache(), settings.train.means
    columns, normals = groups(0, means), initial_normals(prior)
    lam = lam_by_kind(settings.regularisation(columns), columns)
    exposure = exposure_of(prior) if settings.exposure else None
    colours = kept_colours(dataset, prior)

    def initial(frames: Sequence[Frame]) -> Gaussians:
        gains = exposure(frames) if exposure else None
        return initial_gaussians(prior, frames, gains=gains, colours=colours)[0]

    def run_fit(
        gaussians: Gaussians,
        start: Gaussians,
        cameras: list[Camera],
        targets: Sequence[np.ndarray],
        train: TrainSettings,
        on_pass: Callable[[int, int], None],
    ) -> Fit:
        return fit(gaussians, cameras, targets, train, on_pass, cache, start, lam, normals)

    def estimate(gaussians: Gaussians, camera: Camera, estimator: str) -> np.ndarray:
        return fisher(gaussians, camera, estimator, cache=cache, means=means, normals=normals)

    def render_view(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        image = render(gaussians, camera, cache=cache)
        return np.asarray(image.rgb), np.asarray(image.alpha)

    return Operations(
        centre=prior.points.mean(axis=0),
        groups=columns,
        initial=initial,
        fit=run_fit,
        fisher=lambda gaussians, camera: estimate(gaussians, camera, settings.estimator),
        estimate=estimate,
        exact=lambda gaussians, camera: fisher(gaussians, camera, cache=cache),
        render=render_view,
        measure=psnr_measure(dataset, cache, settings.exposure),
        exposure=exposure,
        on_surface=len(prior.points),
        up=prior.up,
        prior=prior_digest(prior),
        capture=_capture(dataset) if dataset.on_demand else lambda frame: None,
    )


def _capture(dataset: Dataset) -> Callable[[Frame], None]:
    runtime.start()
    from mgs.synth.capture import capture_of  # needs a variant, and only on-demand datasets need it

    return capture_of(dataset)


def kept_colours(dataset: Dataset, prior: Prior) -> Callable[[Frame], Colours]:
    """`mgs.prior.initial.colours_of` the prior, with results kept within IMAGE_BYTES."""
    of, index = colours_of(prior), {frame.name: i for i, frame in enumerate(dataset.frames)}
    kept = kept_within(
        IMAGE_BYTES,
        lambda i: of(dataset.frames[i]),
        lambda found: sum(part.nbytes for part in found),
    )
    return lambda frame: kept(index[frame.name])


def psnr_measure(
    dataset: Dataset, cache: ListCache, exposure: bool = False
) -> Callable[[Gaussians, list[int]], dict[str, float]]:
    """measure(gaussians, frames taken) -> mean PSNR, dB: `psnr` and `psnr_mask` (inside the rock
    mask) over all views, `held_out_psnr` and `held_out_psnr_mask` over those never trained on,
    `test_psnr` and `test_psnr_mask` over the test views where the dataset has some; frames on
    demand that were not taken have no image, and no part in any of them. With `exposure` the same
    once more with `_corrected` at the end, of renders that are brought to the exposure of the view
    (`mgs.metrics.colour_corrected`). As `mgs.report.evaluation`, without its other metrics, which
    cost more. A mean over no view (all masks empty, none held out) is left out. Raises InputError
    as `Dataset.test_views`.
    """
    tests = dataset.test_views()
    frames = [*dataset.frames, *(tests.frames if tests else ())]
    names = ("psnr", "psnr_mask", *(("psnr_corrected", "psnr_mask_corrected") if exposure else ()))

    def read(index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgba, weight = frames[index].target()
        return srgb_from_linear(rgba[..., :3]), weight > 0, frames[index].mask() & (weight > 0)

    truth = kept_within(IMAGE_BYTES, read, lambda parts: sum(part.nbytes for part in parts))

    def values(
        image: np.ndarray, known: np.ndarray, rock: np.ndarray, rendered: np.ndarray
    ) -> list[float]:
        shown = (
            [rendered, colour_corrected(linear_from_srgb(image), rendered, rock)]
            if exposure
            else [rendered]
        )
        return [psnr(srgb_from_linear(one), image, mask) for one in shown for mask in (known, rock)]

    def measured(gaussians: Gaussians, chosen: Iterable[int]) -> np.ndarray:
        found = [
            values(*truth(i), np.asarray(render(gaussians, frames[i].camera, cache=cache).rgb))
            for i in chosen
        ]
        return np.array(found).reshape(-1, len(names))

    def measure(gaussians: Gaussians, taken: list[int]) -> dict[str, float]:
        shown = [i for i, frame in enumerate(dataset.frames) if i in taken or not frame.on_demand]
        views, test_views = (
            measured(gaussians, shown),
            measured(gaussians, range(len(dataset), len(frames))),
        )
        held_out = views[[i not in taken for i in shown]]
        return (
            _means(views, "", names)
            | _means(held_out, "held_out_", names)
            | _means(test_views, "test_", names)
        )

    return measure


def _means(values: np.ndarray, prefix: str, names: Sequence[str]) -> dict[str, float]:
    """Mean of each column of [V,names] over the views that have it, by name."""
    known = ~np.isnan(values).all(axis=0)
    means = np.nanmean(np.where(known, values, 0), axis=0) if known.any() else values
    return {prefix + name: float(means[i]) for i, name in enumerate(names) if known[i]}
