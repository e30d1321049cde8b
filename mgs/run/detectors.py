"""Detectors: numbers of each step that grow as a run goes wrong, and their warnings. Limits are 1.3
to 4 times the largest value of good runs (docs/stability.md), unless a comment says otherwise."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.frames import outlines_apart
from mgs.gaussians import Gaussians
from mgs.metrics import MOST_BLUR

DARK = 1e-3  # linear RGB, added to brightnesses before their ratio is taken
RATIO_QUANTILES = (0.25, 0.5, 0.75)  # quantiles of a view's log ratios
LEAST_SPREAD = 0.1  # added to their range: a fit without residual has no exposure to report
NEIGHBOURS = 3  # number of nearest views with which a view's error is compared
CLOSER = 2.0  # ratio of pixels from which on views count as taken from different distances
OFFSET = 0.03  # largest of a view that is right, unless the farthest views have larger pixels
COVERING_VIEWS = 4  # fewest views of which a good coverage can be expected
MANY_VIEWS = 8  # views that a good run must fit even if more are to come; chosen


@dataclass(frozen=True)
class Before:
    """A captured image compared with the Gaussians before training.

    outline: share of the pixels covered by mask or Gaussians where the two disagree, without the
    rim (`outline_margin`). offset: distance of the centres of the two areas, over the square root
    of the mask's area."""

    outline: float
    offset: float


@dataclass(frozen=True)
class ViewIndicators:
    """A captured image compared with the Gaussians before training, and with the fitted model.

    unexplained: mean squared error in the mask over the variance of the image there, 0 to 1. error:
    its root, linear RGB. srgb_error: mean squared error of sRGB there. ratios: quantiles
    (RATIO_QUANTILES) of the log ratio of image to render. pixels: number compared, or 1. blur: of
    the image alone, pixels."""

    before: Before
    unexplained: float
    error: float
    srgb_error: float = 0.0
    ratios: tuple[float, ...] = (0.0, 0.0, 0.0)
    pixels: int = 1
    blur: float = 0.0


def before_fit(mask: np.ndarray, alpha: np.ndarray, margin: int) -> Before:
    """Compare a view with the Gaussians before training.

    mask: bool [H,W]. alpha: [H,W], drawn from 0.5 up. margin: pixels, as in `outlines_apart`."""
    body = alpha >= 0.5
    return Before(outlines_apart(mask, body, margin), _distance(mask, body))


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    """Distance of two areas' centres over the square root of the first; 1 where one is empty."""
    if not one.any() or not other.any():
        return 1.0
    apart = np.linalg.norm(np.argwhere(one).mean(axis=0) - np.argwhere(other).mean(axis=0))
    return float(apart / np.sqrt(one.sum()))


def outline_margin(start: Gaussians, camera: Camera) -> int:
    """Pixels that a good prior may stand out of the mask: a Gaussian's standard deviation and 1.

    start: the Gaussians before training."""
    _, depth = camera.project(start.means)
    in_front = depth[depth > 0]
    if not len(in_front):
        return 1
    size = float(np.median(np.exp(start.log_scales.max(axis=1))))
    return 1 + math.ceil(size * max(camera.K[0, 0], camera.K[1, 1]) / float(np.median(in_front)))


def view_indicators(
    truth: np.ndarray, counted: np.ndarray, rendered: np.ndarray, before: Before
) -> ViewIndicators:
    """Compare a fitted view with a render of the model.

    counted: bool [H,W], the M pixels that are compared. truth: their colours [M,3], linear RGB.
    rendered: [H,W,3] linear RGB."""
    if not counted.any():
        return ViewIndicators(before, 0.0, 0.0)
    truth, image = truth.astype(np.float64), rendered[counted].astype(np.float64)
    squared, variance = float(np.mean((truth - image) ** 2)), float(truth.var(axis=0).mean())
    brightness = np.log(truth.mean(axis=1) + DARK) - np.log(image.mean(axis=1) + DARK)
    ratios = tuple(np.quantile(brightness, RATIO_QUANTILES).tolist())
    srgb = float(np.mean(np.square(srgb_from_linear(truth) - srgb_from_linear(image))))
    unexplained, pixels = squared / max(variance, 1e-12), int(counted.sum())
    return ViewIndicators(before, unexplained, squared**0.5, srgb, ratios, pixels)


def _trend(values: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Part of the views' values [V] that is proportional to the logarithm of their pixels [V]: far
    views fit worse. The slope is a median, so that one wrong view hardly changes it."""
    logs = np.log(pixels)
    near, far = np.nonzero(logs[:, None] - logs >= math.log(CLOSER))
    if not len(near):
        return np.zeros(len(values))
    return np.median((values[near] - values[far]) / (logs[near] - logs[far])) * logs


def _median(values: np.ndarray, pixels: np.ndarray) -> float:
    """Median of the views' values [V], weighted by their pixels [V]."""
    order = np.argsort(values)
    below = np.cumsum(pixels[order]) - pixels[order] / 2
    return float(np.interp(pixels.sum() / 2, below, values[order]))


def _exposure(ratios: np.ndarray) -> float:
    """Largest common shift of a view's quantiles from those of the median view, over their range.

    ratios: [V,3]. A change of exposure shifts all quantiles alike, a highlight or a shadow only
    some: the smallest shift counts, or 0 where the signs differ."""
    shifts = ratios - np.median(ratios, axis=0)
    common = np.where(np.abs(np.sign(shifts).sum(axis=1)) == 3, np.abs(shifts).min(axis=1), 0.0)
    return float((common / (ratios[:, 2] - ratios[:, 0] + LEAST_SPREAD)).max())


def _outlier(errors: np.ndarray, positions: np.ndarray) -> float:
    """Largest error of a view [V] over the largest of its neighbours' (views from near poses have
    the same highlights and shadows), or over the median if larger."""
    away = np.linalg.norm(positions[:, None] - positions, axis=2)
    np.fill_diagonal(away, np.inf)
    near = errors[np.argsort(away, axis=1)[:, :NEIGHBOURS]].max(axis=1)
    return float((errors / np.maximum(np.maximum(near, np.median(errors)), 1e-12)).max())


def step_indicators(
    views: Sequence[ViewIndicators],
    positions: np.ndarray,
    losses: Sequence[float],
    coverage: float,
    gains: Sequence[float],
    drift: float,
    last: bool = True,
) -> dict[str, float]:
    """Numbers of a step by the names in DETECTORS, without those that it cannot tell.

    views: all taken. positions: of their cameras [V,3]. losses: of the start of the fit, then of
    each pass. coverage: Eq. 9, 0 to 1. gains: information gain of every view chosen so far, in
    order. drift: of `means_drift`. last: whether no views are to come."""
    indicators = {"means": drift}
    if len(losses) >= 2 and min(losses) > 0 and np.isfinite(losses).all():
        # Lowest losses: a fit that starts from a fitted model rises first, then falls.
        window, lowest = min(2, len(losses) - 1), np.minimum.accumulate(losses)
        indicators["unconverged"] = float(1 - (lowest[-1] / lowest[-1 - window]) ** (1 / window))
        indicators["worse"] = min(losses[1:]) / losses[0] - 1
    if views:
        indicators["blur"] = float(np.median([view.blur for view in views]))
        pixels = np.array([view.pixels for view in views])
        if last or len(views) >= MANY_VIEWS:
            unexplained = np.array([view.unexplained for view in views])
            indicators["residual"] = _median(unexplained, pixels)
            ratios = np.array([view.ratios for view in views])
            indicators["exposure"] = _exposure(ratios - _trend(ratios[:, 1], pixels)[:, None])
            if len(views) >= COVERING_VIEWS:
                indicators["coverage"] = 1 - coverage
        indicators["prior"] = float(np.median([view.before.outline for view in views]))
        # The second fewest pixels, because the fewest may be those of a wrong mask.
        pixel = float(np.sort(pixels)[:2][-1]) ** -0.5
        indicators["pose"] = max(view.before.offset for view in views) / max(OFFSET, pixel)
        if len(views) > NEIGHBOURS:
            errors = np.log([max(view.srgb_error, 1e-24) for view in views]) / 2
            errors = np.exp(errors - _trend(errors, pixels))
            indicators["outlier"] = _outlier(errors, positions)
    if len(gains) >= 2 and max(gains) > 0:
        indicators["saturated"] = 1 - gains[-1] / max(gains)
    return indicators


def means_drift(means: np.ndarray, start: np.ndarray, std: float) -> float:
    """Root mean square distance of means [N,3] from their start, over `std`, the standard deviation
    of their prior, metres."""
    return float(np.sqrt(np.mean(((means - start) ** 2).sum(axis=1))) / std)


@dataclass(frozen=True)
class Detector:
    """limit: largest value without a warning. words: the warning, with fields of `said`."""

    limit: float
    words: str

    def said(self, value: float) -> str:
        """The warning for a value; share, rest: it and the rest to 1 in per cent; most, least: the
        same of the limit."""
        percent = {"share": value, "rest": 1 - value, "most": self.limit, "least": 1 - self.limit}
        numbers = {name: 100 * number for name, number in percent.items()}
        return self.words.format(value=value, limit=self.limit, **numbers)


DETECTORS: dict[str, Detector] = {
    "unconverged": Detector(
        0.15,  # two training rocks: up to 0.07, and 0.18 with two passes
        "the fit was stopped while its loss still fell by {share:.1f} % a pass (limit "
        "{most:.1f} %); raise `train.passes`",
    ),
    "worse": Detector(
        0.18,  # good runs of many views: up to 0.134, because a step raises other images' losses
        "every pass of the fit had a loss at least {share:.0f} % above its start; lower the "
        "learning rates (`train.rates`)",
    ),
    "blur": Detector(
        MOST_BLUR,
        "the images are blurred by {value:.1f} pixels, that of the median view (limit "
        "{limit:.1f}); take them again, sharp; if that is impossible, import them smaller "
        "(`mgs import --downscale`), by which they lose little",
    ),
    "prior": Detector(
        0.006,
        "the prior's outline and the masks disagree in {share:.1f} % of the covered pixels of the "
        "median view (limit {most:.1f} %); check prior, masks and poses; if there are no masks, "
        "make some (`mgs dataset masks`)",
    ),
    "residual": Detector(
        0.145,
        "the fit leaves {share:.0f} % of the images' variance, inside masks if there are any, "
        "unexplained in the median view (limit {most:.1f} %); raise `train.passes`, check poses "
        "and masks, and that the light stayed",
    ),
    "exposure": Detector(
        0.22,
        "exposure drifts: one image as a whole is brighter or darker than the model fitted to all, "
        "by {share:.0f} % of the spread of its pixels (limit {most:.0f} %); try `exposure`, which "
        "mends little where the light changed: there, use pictures of one light",
    ),
    "pose": Detector(
        1.0,  # good runs: up to 0.96
        "in one view, prior and mask are {value:.1f} times farther apart than the limit, "
        f"{100 * OFFSET:.0f} % of the object's size or a pixel of the farthest views; check its "
        "pose, its mask, and the prior",
    ),
    "outlier": Detector(
        2.25,  # 13 clean fits of rocks and photographs: up to 2.22
        "one view fits badly: its error after the fit is {value:.1f} times that of the views "
        "around it (limit {limit:.2f}); check its pose, mask and image",
    ),
    "means": Detector(
        4.0,  # means that were free on 2 and 4 views moved by 1.3 and 1.7, and did no harm
        "the means have left the prior's surface: they moved by {value:.1f} standard deviations of "
        "their prior (rms; limit {limit:.1f}); lower `train.rates.mean`",
    ),
    "coverage": Detector(
        0.3,
        "only {rest:.0f} % of the prior's Gaussians are observed (limit {least:.0f} %), so the "
        "others are known from the prior alone; take views of the other sides",
    ),
    "saturated": Detector(
        0.9,  # chosen: a tenth
        "gains are saturated: the view just taken gained {rest:.0f} % of the run's largest "
        "information gain (limit {least:.0f} %); further views add little",
    ),
}
"""Detector of each indicator, by its name."""


def alarms(indicators: Mapping[str, float], before: Mapping[str, float] | None = None) -> list[str]:
    """Warnings of a step: for each number that exceeds its limit and did not in the step before."""
    before = before or {}
    return [
        row.said(indicators[name])
        for name, row in DETECTORS.items()
        if indicators.get(name, -np.inf) > row.limit >= before.get(name, -np.inf)
    ]
