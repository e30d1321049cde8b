"""The operations of a run on the splat core."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mgs import runtime
from mgs.camera import Camera
from mgs.data.dataset import Dataset
from mgs.data.frames import Frame
from mgs.evaluation import psnr_measure
from mgs.fit.fitting import Fit, fit
from mgs.fit.settings import TrainSettings
from mgs.gaussians import Gaussians
from mgs.memory import IMAGE_BYTES, KEPT_BYTES, kept_within, release
from mgs.policy.criteria import lam_by_kind
from mgs.prior.build import Prior
from mgs.prior.exposure import exposure_of
from mgs.prior.initial import colours_of, initial_gaussians, initial_normals, pixel_on
from mgs.run.inputs import prior_digest
from mgs.run.live import Live, live_capture
from mgs.run.problem import Operations
from mgs.run.settings import NbvSettings
from mgs.splat import ListCache, fisher, groups, render


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
