"""The operations of a run on the splat core, and the PSNR that a run measures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from mgs import runtime
from mgs.camera import Camera
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data.dataset import Dataset
from mgs.data.frames import Frame, as_captured
from mgs.fit.fitting import Fit, fit
from mgs.fit.settings import TrainSettings
from mgs.gaussians import Gaussians
from mgs.memory import IMAGE_BYTES, KEPT_BYTES, kept_within, release
from mgs.metrics import colour_corrected, psnr
from mgs.policy.criteria import lam_by_kind
from mgs.prior.build import Prior
from mgs.prior.exposure import exposure_of
from mgs.prior.initial import colours_of, initial_gaussians, initial_normals, pixel_on
from mgs.run.inputs import prior_digest
from mgs.run.live import Live, live_capture
from mgs.run.problem import Operations
from mgs.run.settings import NbvSettings
from mgs.splat import ListCache, as_drjit, fisher, groups, render


def operations_of(
    dataset: Dataset, prior: Prior, settings: NbvSettings, live: Live | None = None
) -> Operations:
    """Operations on the splat core; the centre is the prior's centre of mass.

    live: how images of an on-demand dataset are captured that is not rendered.
    """
    cache, means = ListCache(), settings.train.means
    columns, normals = groups(settings.sh, means), initial_normals(prior)
    lam = lam_by_kind(settings.regularisation(columns), columns)
    exposure = exposure_of(prior) if settings.exposure else None
    colours = kept_within(
        IMAGE_BYTES, colours_of(prior), lambda found: sum(part.nbytes for part in found)
    )
    pixel = pixel_on(prior, dataset.cameras)

    def initial(frames: Sequence[Frame]) -> Gaussians:
        gains = exposure(frames) if exposure else None
        how = pixel, gains, colours, settings.train.antialiased
        return initial_gaussians(prior, frames, *how)[0].with_degree(settings.sh)

    def run_fit(
        gaussians: Gaussians,
        start: Gaussians,
        cameras: list[Camera],
        targets: Sequence[np.ndarray],
        train: TrainSettings,
        on_pass: Callable[[int, int], None],
    ) -> Fit:
        release(KEPT_BYTES)  # what scores took, and then what the fit took
        found = fit(gaussians, cameras, targets, train, on_pass, cache, start, lam, normals)
        release(KEPT_BYTES)
        return found

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
        ground=float((prior.mesh.vertices @ np.array(prior.up)).min()),
        prior=prior_digest(prior),
        capture=_capture(dataset, prior, live),
    )


def _capture(dataset: Dataset, prior: Prior, live: Live | None) -> Callable[[Frame], Frame]:
    """`Operations.capture` of a dataset: complete, rendered, or captured live."""
    if not dataset.on_demand:
        return lambda frame: frame
    if not (dataset.root / "config.json").is_file():
        return live_capture(dataset, prior, live)
    runtime.start()
    from mgs.synth.capture import capture_of  # needs a variant, and only rendered datasets need it

    return capture_of(dataset)


def psnr_measure(
    dataset: Dataset, cache: ListCache, exposure: bool = False
) -> Callable[[Gaussians, list[int]], dict[str, float]]:
    """Returns measure(gaussians, frames taken) -> mean PSNR, dB, by the names of `psnr_over`.

    `test_psnr...` over the test views. A dataset without test views: `psnr...` over all views that
    have an image, `held_out_psnr...` over those not taken. A mean over no view is left out. Raises
    InputError as `Dataset.test_views`.
    """
    tests = dataset.test_views()
    frames = dataset.frames if tests is None else tests.frames
    of = psnr_over(frames, cache, exposure)

    def measure(gaussians: Gaussians, taken: list[int]) -> dict[str, float]:
        if tests is not None:
            return _means(of(gaussians, range(len(frames))), "test_")
        shown = [i for i, frame in enumerate(frames) if i in taken or not frame.on_demand]
        views = of(gaussians, shown)
        held_out = {key: v[[i not in taken for i in shown]] for key, v in views.items()}
        return _means(views) | _means(held_out, "held_out_")

    return measure


def psnr_over(
    frames: Sequence[Frame], cache: ListCache, exposure: bool = False
) -> Callable[[Gaussians, Sequence[int]], dict[str, np.ndarray]]:
    """Returns a function (gaussians, indices of frames) -> PSNR of each of these views, dB.

    `psnr`; `psnr_mask`, in the rock mask. With `exposure` also `..._corrected`, of renders at the
    exposure of the view (`mgs.metrics.colour_corrected`).
    """
    names = ("psnr", "psnr_mask", *(("psnr_corrected", "psnr_mask_corrected") if exposure else ()))

    def read(index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgba, weight = as_captured(frames[index]).target()
        return srgb_from_linear(rgba[..., :3]), weight > 0, frames[index].mask() & (weight > 0)

    truth = kept_within(IMAGE_BYTES, read, lambda parts: sum(part.nbytes for part in parts))

    def compared(index: int, rendered: np.ndarray) -> list[float]:
        image, known, rock = truth(index)
        shown = [rendered]
        if exposure:
            shown.append(colour_corrected(linear_from_srgb(image), rendered, rock))
        srgb = [srgb_from_linear(one) for one in shown]
        return [psnr(one, image, mask) for one in srgb for mask in (known, rock)]

    def measured(gaussians: Gaussians, chosen: Sequence[int]) -> dict[str, np.ndarray]:
        model, rows = as_drjit(gaussians), []
        with ThreadPoolExecutor(1) as beside:  # compares a view while the next one is rendered
            for i in chosen:
                drawn = render(model, as_captured(frames[i]).camera, cache=cache).rgb
                # A copy: another thread must not free memory of Dr.Jit (`evaluate_model`).
                rows.append(beside.submit(compared, i, np.array(drawn)))
        table = np.array([row.result() for row in rows]).reshape(-1, len(names))
        return dict(zip(names, table.T, strict=True))

    return measured


def _means(values: Mapping[str, np.ndarray], prefix: str = "") -> dict[str, float]:
    """Mean of each array over the views that have it, if there are some; names with a prefix."""
    known = {key: column[~np.isnan(column)] for key, column in values.items()}
    return {prefix + key: float(column.mean()) for key, column in known.items() if len(column)}
