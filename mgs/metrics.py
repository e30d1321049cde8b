"""Quality of a rendered view as an image (PSNR, SSIM of sRGB) and as a surface (alpha, depth), and
blur of a photograph."""

import math

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.errors import InputError
from mgs.images import around

PSNR_LIMIT = 100.0  # dB, also for equal images; rounding to 8 bits is an error of 59 dB
SSIM_SIGMA = 1.5  # standard deviation of the Gaussian window of SSIM, pixels (Wang et al. 2004)
SSIM_WINDOW = 11  # width and height of that window, pixels (Wang et al. 2004)

METRICS = (
    "psnr",
    "ssim",
    "psnr_mask",
    "ssim_mask",
    "psnr_inside",
    "psnr_corrected",
    "psnr_mask_corrected",
)
"""Metrics of `compare`, as in metrics.json; PSNR in dB. `_mask`: over the rock's mask; `_inside`:
over the pixels that the rock covers wholly; `_corrected`: after `colour_corrected`."""

MOST_BLUR = 1.1  # of `blur`, pixels; rendered rocks 0.4 to 0.6, good photographs up to 1.06
LEAST_BEND = 1e-6  # least of squared second differences, over squared first ones
DIRECTIONS = (0, 1), (1, 0), (1, 1), (1, -1)  # rows and columns from pixel to pixel
STRIP = 256  # rows whose differences are held at once

OPAQUE = 0.9  # a pixel wholly on the rock is see-through if the model's alpha is below this

SURFACE_METRICS = ("alpha_mae", "depth_error", "see_through")
"""Metrics of `compare_surface`, as in metrics.json: `depth_error` in metres, the others shares."""


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio of two images, dB: -10 log10 of the mean squared error.

    a, b: [H,W,3] sRGB in [0,1]. mask: [H,W] bool, the pixels that count; None: all. At most
    PSNR_LIMIT; NaN if the mask is empty. Raises InputError if the shapes differ."""
    _check_same_shape(a, b)
    squares = (np.asarray(a, np.float64) - b) ** 2
    if mask is not None:
        squares = squares[mask]
    if squares.size == 0:
        return math.nan
    error = float(squares.mean())
    return PSNR_LIMIT if error <= 10 ** (-PSNR_LIMIT / 10) else -10 * math.log10(error)


def blur(image: np.ndarray, counted: np.ndarray) -> float:
    """Blur of an image, pixels: the standard deviation of the Gaussian that blurs a step as much.

    image: [H,W,3] sRGB in [0,1]. counted: bool [H,W], the pixels that count. 0 where they are all
    equal. For a step I blurred by a Gaussian, the integral of I'^2 is 2 sigma^2 times that of
    I''^2. Motion blurs along one direction, so the largest sigma of four directions counts."""
    sums = np.zeros((len(DIRECTIONS), 2))
    for first in range(0, len(image), STRIP):
        strip = slice(first, first + STRIP + 2)
        grey = np.asarray(image[strip], np.float64).mean(axis=2)
        for k, direction in enumerate(DIRECTIONS):
            sums[k] += _differences(grey, counted[strip], *direction)
    slopes, bends = sums.T
    steps = np.square(DIRECTIONS).sum(axis=1)
    ratios = slopes / np.maximum(8 * np.maximum(bends, LEAST_BEND * slopes), 1e-300)
    return float(np.sqrt((steps * ratios).max()))


def _differences(
    grey: np.ndarray, counted: np.ndarray, rows: int, columns: int
) -> tuple[float, float]:
    """Sums of (c - a)^2 and (a - 2 b + c)^2 over all a, b, c: three pixels in a line that starts in
    the first STRIP rows. At a step of L pixels, I' = (c - a) / 2 L, I'' = (a - 2 b + c) / L^2."""
    height, width = len(grey[: STRIP + 2 * rows]) - 2 * rows, grey.shape[1] - 2 * abs(columns)
    if height <= 0 or width <= 0:
        return 0.0, 0.0
    first = 2 * max(-columns, 0)

    def three(values: np.ndarray) -> list[np.ndarray]:
        starts = [(k * rows, first + k * columns) for k in range(3)]
        return [values[y : y + height, x : x + width] for y, x in starts]

    a, b, c = three(grey)
    inside = np.logical_and.reduce(three(counted))
    return float(np.square(c - a)[inside].sum()), float(np.square(a - 2 * b + c)[inside].sum())


def ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Mean structural similarity of two images (Wang et al. 2004, by scikit-image).

    a, b: [H,W,3] sRGB in [0,1]. mask: [H,W] bool, the pixels of the mean, NaN if empty; None: all
    but the border where the window does not fit. Raises InputError if the shapes differ or the
    images are smaller than the window."""
    return _mean_ssim(*_similarity(a, b), mask)


def _mean_ssim(mean: float, similarity: np.ndarray, mask: np.ndarray | None) -> float:
    if mask is None:
        return mean
    return float(similarity[mask].mean()) if mask.any() else math.nan


def _similarity(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean structural similarity without the border, and that of each pixel and channel [H,W,3]."""
    from skimage.metrics import structural_similarity

    _check_same_shape(a, b)
    if min(a.shape[:2]) < SSIM_WINDOW:
        size = f"at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, not {a.shape[1]}x{a.shape[0]}"
        raise InputError(f"SSIM needs images of {size}")
    lit = ((a != 0) | (b != 0)).any(axis=2)
    lit[a.shape[0] // 2, a.shape[1] // 2] = True  # both images may be black
    box, similarity = around(lit, SSIM_WINDOW), np.ones(a.shape)  # 1 where all around is black
    window = {"gaussian_weights": True, "sigma": SSIM_SIGMA, "use_sample_covariance": False}
    pair = (np.asarray(image[box], np.float64) for image in (a, b))
    _, similarity[box] = structural_similarity(
        *pair, channel_axis=-1, data_range=1.0, full=True, **window
    )
    inner = slice(SSIM_WINDOW // 2, -(SSIM_WINDOW // 2))
    channels = map(np.ascontiguousarray, np.moveaxis(similarity, 2, 0))
    return float(np.mean([one[inner, inner].mean() for one in channels])), similarity


def colour_corrected(truth: np.ndarray, rendered: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Scale each channel of a render to fit the truth in a mask, in least squares.

    truth, rendered: [H,W,3] linear RGB. mask: [H,W] bool. Removes errors of exposure and white
    balance. The gains are taken from the truth, so metrics of the result are named apart. A channel
    that is black in the mask keeps its values."""
    a, b = truth[mask].astype(np.float64), rendered[mask].astype(np.float64)
    squares = (b * b).sum(axis=0)
    gains = np.where(squares > 0, (a * b).sum(axis=0) / np.where(squares > 0, squares, 1), 1.0)
    return (rendered * gains).astype(rendered.dtype)


def _check_same_shape(a: np.ndarray, b: np.ndarray) -> None:
    if a.shape != b.shape:
        both = f"images of {a.shape} and {b.shape} cannot be compared"
        raise InputError(f"{both}; render at the size of the dataset")


def compare_psnr(
    image: np.ndarray,
    rendered: np.ndarray,
    valid: np.ndarray,
    rock: np.ndarray,
    linear: np.ndarray | None = None,
) -> dict[str, float]:
    """PSNR of one view, dB: `psnr` over the valid pixels, `psnr_mask` over the rock's.

    image: [H,W,3], the truth, sRGB. rendered: [H,W,3] linear RGB. valid, rock: [H,W] bool. With
    linear, the truth as linear RGB, also `..._corrected` (`colour_corrected`). Raises InputError as
    `psnr`."""
    masks = {"psnr": None if valid.all() else valid, "psnr_mask": rock}
    picture = srgb_from_linear(rendered)
    values = {name: psnr(image, picture, mask) for name, mask in masks.items()}
    if linear is not None:
        picture = srgb_from_linear(colour_corrected(linear, rendered, rock))
        values |= {f"{name}_corrected": psnr(image, picture, mask) for name, mask in masks.items()}
    return values


def compare(
    truth: np.ndarray, rendered: np.ndarray, mask: np.ndarray, weight: np.ndarray
) -> dict[str, float]:
    """METRICS of one view, over the pixels whose truth is known.

    truth: [H,W,4], linear RGB premultiplied by alpha, and alpha. rendered: [H,W,3] linear RGB.
    mask: [H,W] bool, the rock. weight: [H,W], 0 where the truth is unknown
    (`mgs.data.frames.Frame.target`). Raises InputError as `psnr` and `ssim`."""
    a, b, valid = srgb_from_linear(truth[..., :3]), srgb_from_linear(rendered), weight > 0
    similarity = _similarity(a, b)
    values = compare_psnr(a, rendered, valid, mask & valid, truth[..., :3]) | {
        "ssim": _mean_ssim(*similarity, None if valid.all() else valid),
        "ssim_mask": _mean_ssim(*similarity, mask & valid),
        "psnr_inside": psnr(a, b, (truth[..., 3] >= 1) & valid),
    }
    return {name: values[name] for name in METRICS}


def compare_surface(
    truth: np.ndarray,
    alpha: np.ndarray,
    depth: np.ndarray,
    mask: np.ndarray,
    weight: np.ndarray,
    *,
    fractional: bool,
    true_depth: np.ndarray | None = None,
) -> dict[str, float]:
    """SURFACE_METRICS of one view, those that the data has a truth for; NaN if no pixel counts.

    truth, mask, weight: as in `compare`. alpha, depth: [H,W] of the render, its expected z-depth in
    metres. fractional: whether the truth's alpha is a share of each pixel, not only a mask.
    true_depth: [H,W] metres, 0 where unknown.

    - alpha_mae: mean absolute error of alpha over the known pixels; only if `fractional`.
    - depth_error: median absolute error of depth inside the mask, metres; needs a true depth. A
      pixel where nothing is drawn is infinitely deep; NaN if the median is infinite.
    - see_through: share of the pixels wholly on the rock whose alpha is below OPAQUE."""
    valid = weight > 0
    inside = (truth[..., 3] >= 1) & valid
    metrics = {"see_through": _mean(alpha[inside] < OPAQUE)}
    if fractional:
        metrics["alpha_mae"] = _mean(np.abs(alpha.astype(np.float64) - truth[..., 3])[valid])
    if true_depth is not None:
        rock = mask & valid & (true_depth > 0)
        behind = np.where(alpha > 0, depth.astype(np.float64) - true_depth, np.inf)[rock]
        median = float(np.median(np.abs(behind))) if behind.size else math.nan
        metrics["depth_error"] = median if math.isfinite(median) else math.nan
    return {name: metrics[name] for name in SURFACE_METRICS if name in metrics}


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else math.nan
