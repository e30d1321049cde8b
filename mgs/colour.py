"""Colour: linear RGB inside the program and in spherical harmonics, sRGB in PNG files."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi)). As in 3DGS, a colour is 0.5 + SH_C0 sh0


def srgb_from_linear(linear: ArrayLike) -> NDArray[np.float32]:
    """Convert linear RGB of any shape to sRGB (IEC 61966-2-1). Clips to [0,1] first."""
    c = np.clip(np.asarray(linear, np.float32), 0, 1)
    srgb = np.asarray(12.92 * c)
    bright = c > 0.0031308  # around a rock alone all is black, and powers are slow
    srgb[bright] = 1.055 * c[bright] ** (1 / 2.4) - 0.055
    return srgb


def linear_from_srgb(srgb: ArrayLike) -> NDArray[np.float32]:
    """Convert sRGB in [0,1] of any shape to linear RGB (IEC 61966-2-1)."""
    c = np.asarray(srgb, np.float32)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_from_pixels(pixels: np.ndarray) -> NDArray[np.float32]:
    """Convert sRGB pixels of 8 or 16 bits (uint8, uint16) to linear RGB, by a table."""
    most = np.iinfo(pixels.dtype).max
    return linear_from_srgb(np.arange(most + 1, dtype=np.float32) / most)[pixels]
