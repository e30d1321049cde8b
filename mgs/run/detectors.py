"""Signs that a run is going wrong: small numbers from each step, the value beyond which each is
said, and the words.

Every sign is larger where things are worse. `mgs nbv` prints a line when a sign goes beyond its
limit, and keeps all of them in steps.jsonl. A fit that diverges ends the run with a line of its own
(`mgs.fit.stopping`), and means that are frozen have no drift. The limits are chosen by good runs of
`mgs nbv` (of colours alone) and of `mgs stress --preset quick` (docs/stability.md): 1.4 to 4 times
the largest value that was seen there, or, where a comment says so, by something else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from mgs.camera import Camera
from mgs.gaussians import Gaussians
from mgs.metrics import masked_squares

DARK = 1e-3
"""Linear RGB, added to brightnesses before they are compared: in the dark, a ratio says nothing."""


COVERING_VIEWS = 4
"""Fewest views of which a good coverage can be expected: two or three do not see all sides of a
rock, however good they are."""


@dataclass(frozen=True)
class Before:
    """What one captured image says of the Gaussians before any training.

    outline: of the pixels that either the rock's mask or the Gaussians cover, the share where they
    disagree, the rim left out (`outline_margin`). offset: distance between the centres of the two
    areas, over the square root of the mask's area.
    exposure: median over the pixels of the logarithm of the image's brightness over the render's.
    The render has the mean colours of the seeds' images; it is grey where none of them looked,
    which a median forgives in less than half of the pixels.
    """

    outline: float
    offset: float
    exposure: float


@dataclass(frozen=True)
class ViewSigns:
    """What one captured image says of the fitted model, and said before.

    unexplained: mean squared error inside the rock's mask over the variance of the image there: 0
    is a perfect fit, 1 is no
    better than a single colour. error: root of that mean squared error, linear RGB.
    """

    before: Before
    unexplained: float
    error: float


def before_fit(
    target: np.ndarray, mask: np.ndarray, rendered: np.ndarray, alpha: np.ndarray, margin: int
) -> Before:
    """The signs of a view and the Gaussians before any training.

    target: [H,W,4], colour and weight, or more (`mgs.data.dataset.target_of`); mask: bool [H,W];
    rendered: [H,W,3] linear RGB
    and alpha [H,W], which count as drawn from 0.5 up. margin: pixels, of `outline_margin`: a pixel
    disagrees if it is drawn and farther than that outside the mask, or not drawn and farther
    inside.
    """
    drawn = alpha >= 0.5
    either = int((mask | drawn).sum())
    outside = ~binary_dilation(mask, iterations=margin)
    inside = binary_erosion(mask, iterations=margin, border_value=1)
    wrong = int(((drawn & outside) | (inside & ~drawn)).sum())
    both = mask & drawn & (target[..., 3] > 0)
    truth, colour = (
        image[both][:, :3].astype(np.float64).mean(axis=1) for image in (target, rendered)
    )
    ratios = np.log(truth + DARK) - np.log(colour + DARK)
    return Before(
        wrong / max(either, 1),
        _distance(mask, drawn),
        float(np.median(ratios)) if len(ratios) else 0.0,
    )


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    """Between the centres of two areas, over the square root of the first one; 1 where either is
    empty."""
    if not one.any() or not other.any():
        return 1.0
    apart = np.linalg.norm(np.argwhere(one).mean(axis=0) - np.argwhere(other).mean(axis=0))
    return float(apart / np.sqrt(one.sum()))


def outline_margin(start: Gaussians, camera: Camera) -> int:
    """How far the outline of a good prior may be from the mask, pixels: Gaussians on the rim stand
    out by about their standard
    deviation, and the mask has whole pixels. start: the Gaussians before any training."""
    _, depth = camera.project(start.means)
    in_front = depth[depth > 0]
    if not len(in_front):
        return 1
    size = float(np.median(np.exp(start.log_scales.max(axis=1))))
    return 1 + math.ceil(size * camera.K[0, 0] / float(np.median(in_front)))


def view_signs(
    target: np.ndarray, mask: np.ndarray, rendered: np.ndarray, before: Before
) -> ViewSigns:
    """The signs of a view that was fitted. rendered: of the fitted model; all else as in
    `before_fit`."""
    counted = mask & (target[..., 3] > 0)
    if not counted.any():
        return ViewSigns(before, 0.0, 0.0)
    truth, drawn = target[counted][:, :3].astype(np.float64), rendered[counted].astype(np.float64)
    squared, variance = float(np.mean((truth - drawn) ** 2)), float(truth.var(axis=0).mean())
    return ViewSigns(before, squared / max(variance, 1e-12), squared**0.5)


def residual(views: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> float | None:
    """Root mean square difference inside the masks, linear RGB; None where no pixel counts.

    views: (render [H,W,3], target [H,W,4 or more] with weights, mask [H,W]) of each.
    """
    squares = np.concatenate([masked_squares(*view) for view in views])
    return float(np.sqrt(squares.mean())) if len(squares) else None


def step_signs(
    views: Sequence[ViewSigns],
    losses: Sequence[float],
    coverage: float,
    gains: Sequence[float],
    drift: float,
) -> dict[str, float]:
    """The signs of a step, by the names in DETECTORS; those that this step cannot tell are left
    out.

    views: of every view taken. losses: of the model that the fit started from, then of each pass.
    coverage: Eq. 9, 0 to 1.
    gains: information gain of every view chosen so far, in order. drift: of `means_drift`.
    """
    signs = {"means": drift}
    if len(losses) >= 2 and min(losses) > 0 and np.isfinite(losses).all():
        # A fit that starts from a fitted model rises first: coming back to where it began is no
        # sign of more to come.
        window, lowest = min(2, len(losses) - 1), np.minimum.accumulate(losses)
        signs["unconverged"] = float(1 - (lowest[-1] / lowest[-1 - window]) ** (1 / window))
        signs["worse"] = min(losses[1:]) / losses[0] - 1
    if views:
        errors = np.array([view.error for view in views])
        exposures = np.array([view.before.exposure for view in views])
        signs["residual"] = float(np.median([view.unexplained for view in views]))
        signs["prior"] = float(np.median([view.before.outline for view in views]))
        signs["exposure"] = float(np.abs(exposures - np.median(exposures)).max())
        signs["pose"] = max(view.before.offset for view in views)
        if len(views) >= COVERING_VIEWS:
            signs["coverage"] = 1 - coverage
        if len(views) >= 3:
            signs["outlier"] = float(errors.max() / max(np.median(errors), 1e-12))
    if len(gains) >= 2 and max(gains) > 0:
        signs["saturated"] = 1 - gains[-1] / max(gains)
    return signs


def means_drift(means: np.ndarray, start: np.ndarray, log_scales: np.ndarray) -> float:
    """How far means [N,3] are from where they started, rms, over the median of the Gaussians'
    largest standard deviation then (log_scales [N,3])."""
    if np.array_equal(means, start):
        return 0.0
    size = float(np.median(np.exp(log_scales.max(axis=1))))
    return float(np.sqrt(np.mean(((means - start) ** 2).sum(axis=1))) / size)


@dataclass(frozen=True)
class Detector:
    """limit: of a sign, beyond which it is said. words(value, limit): what is said."""

    limit: float
    words: Callable[[float, float], str]


DETECTORS: dict[str, Detector] = {
    "unconverged": Detector(
        0.15,  # good runs of few and small images: up to 0.11, in the first fits with one more view
        lambda v, limit: (
            f"the fit was stopped while its loss still fell by {100 * v:.1f} % a pass (limit {100 * limit:.1f} %); "
            "raise --passes, and --warm-passes for the fits after the first"
        ),
    ),
    "worse": Detector(
        0.05,  # chosen: a warm fit of a good run lowers its loss
        lambda v, limit: (
            f"every pass of the fit had a loss at least {100 * v:.0f} % above that of the model it began with; lower the rates"
        ),
    ),
    "prior": Detector(
        0.005,
        lambda v, limit: (
            f"the prior's outline and the masks disagree: in the median view, in {100 * v:.1f} % of the pixels that either "
            f"covers (limit {100 * limit:.1f} %, rim left out); check prior, masks and poses"
        ),
    ),
    "residual": Detector(
        0.15,
        lambda v, limit: (
            f"after the fit, {100 * v:.0f} % of the images' variance inside the masks is left unexplained in the median view "
            f"(limit {100 * limit:.0f} %)"
        ),
    ),
    "exposure": Detector(
        0.15,
        lambda v, limit: (
            f"exposure drifts: one image is {np.exp(v):.2f} times brighter or darker than the others, judged by the prior's "
            f"colours (limit {np.exp(limit):.2f})"
        ),
    ),
    "pose": Detector(
        0.03,
        lambda v, limit: (
            f"in one view, prior and mask are {100 * v:.1f} % of the rock's size apart (limit {100 * limit:.1f} %); check its "
            "pose, its mask, and the prior"
        ),
    ),
    "outlier": Detector(
        2.5,
        lambda v, limit: (
            f"one view fits badly: its error after the fit is {v:.1f} times the median view's (limit {limit:.1f}); check its "
            "pose, mask and image"
        ),
    ),
    "means": Detector(
        3.0,  # means that were free on 2 and 4 views moved by 1.0 and 1.3, and did no harm
        lambda v, limit: (
            f"the means have left the prior's surface: they moved by {v:.1f} standard deviations of a Gaussian (rms; limit "
            f"{limit:.1f})"
        ),
    ),
    "coverage": Detector(
        0.2,
        lambda v, limit: (
            f"only {100 * (1 - v):.0f} % of the prior's Gaussians are observed (limit {100 * (1 - limit):.0f} %): information "
            "about the others is that of the prior"
        ),
    ),
    "saturated": Detector(
        0.9,  # chosen: a tenth
        lambda v, limit: (
            f"gains are saturated: the view just taken gained {100 * (1 - v):.0f} % of the run's largest information gain "
            f"(limit {100 * (1 - limit):.0f} %)"
        ),
    ),
}
"""By the name of the sign."""


def alarms(signs: Mapping[str, float], before: Mapping[str, float] | None = None) -> list[str]:
    """What to say after a step: a sentence for each sign that is beyond its limit now, and was not
    in the step before."""
    before = before or {}
    return [
        row.words(signs[name], row.limit)
        for name, row in DETECTORS.items()
        if signs.get(name, -np.inf) > row.limit >= before.get(name, -np.inf)
    ]
