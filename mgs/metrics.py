"""PSNR and SSIM of display values (sRGB in [0,1]), over the whole frame and inside the rock mask."""

from __future__ import annotations

import math

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.errors import InputError

PSNR_LIMIT = 100.0
"""dB, reported where two images are equal (8-bit images cannot tell more than 59 dB apart)."""

SSIM_SIGMA = 1.5
"""Pixels, of SSIM's Gaussian window (11 x 11), from Wang et al. 2004."""

SSIM_WINDOW = 11

METRICS = ("psnr", "ssim", "psnr_mask", "ssim_mask")


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio, dB, of display values [H,W,3] in [0,1]; over the pixels of `mask` [H,W] where given.

    At most PSNR_LIMIT; NaN where the mask is empty. Raises InputError where the shapes differ.
    """
    _same_shape(a, b)
    squares = (np.asarray(a, np.float64) - b) ** 2
    if mask is not None:
        squares = squares[mask]
    if squares.size == 0:
        return math.nan
    error = float(squares.mean())
    return PSNR_LIMIT if error <= 10 ** (-PSNR_LIMIT / 10) else -10 * math.log10(error)


def ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of display values [H,W,3] in [0,1], mean over channels.

    With a mask [H,W]: the SSIM map averaged over the mask; NaN where that is empty. Raises InputError where the shapes differ
    or the images are smaller than the window.
    """
    from skimage.metrics import structural_similarity

    _same_shape(a, b)
    if min(a.shape[:2]) < SSIM_WINDOW:
        raise InputError(f"SSIM needs images of at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, not {a.shape[1]}x{a.shape[0]}")
    mean, similarity = structural_similarity(
        np.asarray(a, np.float64),
        np.asarray(b, np.float64),
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=SSIM_SIGMA,
        use_sample_covariance=False,
        full=True,
    )
    if mask is None:
        return float(mean)
    return float(similarity[mask].mean()) if mask.any() else math.nan


def _same_shape(a: np.ndarray, b: np.ndarray) -> None:
    if a.shape != b.shape:
        raise InputError(f"images of {a.shape} and {b.shape} cannot be compared; render at the size of the dataset")


def compare(truth: np.ndarray, rendered: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """The four METRICS of one view: linear RGB [H,W,3] twice, rock mask [H,W]."""
    a, b = srgb_from_linear(truth), srgb_from_linear(rendered)
    return {"psnr": psnr(a, b), "ssim": ssim(a, b), "psnr_mask": psnr(a, b, mask), "ssim_mask": ssim(a, b, mask)}
