"""Images of the rock alone: colour premultiplied by alpha inside the program, straight alpha in PNG
files.

Alpha is the share of a pixel's area that shows the rock, from 0 to 1. Premultiplied colour is the
light that reaches the pixel from the rock, so it is the picture of the rock in front of black.
Straight colour is premultiplied colour divided by alpha.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.images import read_rgba, write_png


def write_rock_image(path: str | Path, rgba: np.ndarray) -> None:
    """Write linear RGB premultiplied by alpha, and alpha, [H,W,4], as an 8-bit PNG: sRGB with
    straight alpha."""
    alpha = rgba[..., 3:]
    straight = rgba[..., :3] / np.where(alpha > 0, alpha, 1)
    write_png(
        path,
        np.round(np.dstack([srgb_from_linear(straight), np.clip(alpha, 0, 1)]) * 255).astype(
            np.uint8
        ),
    )


def read_rock_image(path: str | Path) -> np.ndarray:
    """Linear RGB premultiplied by alpha, and alpha, float32 [H,W,4], from sRGB with straight alpha
    of 8 or 16 bits.

    Raises InputError as `mgs.images.read_rgba`.
    """
    pixels = read_rgba(path)
    return premultiplied(pixels.astype(np.float32) / np.iinfo(pixels.dtype).max)


def premultiplied(rgba: np.ndarray) -> np.ndarray:
    """sRGB with straight alpha [H,W,4] in [0,1] -> linear RGB premultiplied by alpha, and alpha,
    float32 [H,W,4]."""
    alpha = rgba[..., 3:]
    return np.concatenate(
        [linear_from_srgb(rgba[..., :3]) * alpha, alpha], axis=-1, dtype=np.float32
    )


def boundary(mask: np.ndarray) -> np.ndarray:
    """The pixels on either side of a mask's outline, bool [H,W]: the dilation of the mask by a 3x3
    cross, without its erosion.

    They are the pixels that differ from the one above, below, left or right of them. The edge of
    the image is no outline.
    """
    return binary_dilation(mask) ^ binary_erosion(mask, border_value=1)
