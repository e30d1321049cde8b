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


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Real spherical harmonics of unit directions [N,3] -> [N,(degree+1)^2], in the order and signs
    of 3DGS files."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    basis = [np.full(len(x), SH_C0)]
    if degree > 0:
        c = 0.4886025119029199
        basis += [-c * y, c * z, -c * x]
    if degree > 1:
        # Degree 2, then degree 3.
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree > 2:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return np.stack(basis, 1)


def even_directions() -> NDArray[np.float64]:
    """Unit directions [64,3] of a Fibonacci lattice, at which functions of colour are compared."""
    k = np.arange(64) + 0.5
    z, turn = 1 - k / 32, np.pi * (1 + 5**0.5) * k
    across = np.sqrt(1 - z * z)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), z])
