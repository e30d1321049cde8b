"""Images of the rock alone: premultiplied alpha in memory (the rock in front of black), straight
alpha in PNG files. Alpha is the share of a pixel's area that shows the rock, 0 to 1."""

from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from mgs.colour import linear_from_pixels, srgb_from_linear
from mgs.images import read_rgba, write_png


def write_rock_image(path: str | Path, rgba: np.ndarray) -> None:
    """Write linear RGB and alpha, [H,W,4] premultiplied, as 8-bit sRGB PNG, straight alpha."""
    alpha = rgba[..., 3:]
    straight = rgba[..., :3] / np.where(alpha > 0, alpha, 1)
    rgba = np.dstack([srgb_from_linear(straight), np.clip(alpha, 0, 1)])
    write_png(path, np.round(rgba * 255).astype(np.uint8))


def read_rock_image(path: str | Path) -> np.ndarray:
    """Read an sRGB PNG with straight alpha, 8 or 16 bits, as linear RGB premultiplied by alpha, and
    alpha: float32 [H,W,4]. Raises InputError as `mgs.images.read_rgba`."""
    return premultiplied(read_rgba(path))


def premultiplied(pixels: np.ndarray) -> np.ndarray:
    """sRGB with straight alpha [H,W,4], uint8 or uint16 -> linear RGB premultiplied by alpha, and
    alpha, float32."""
    alpha = pixels[..., 3:].astype(np.float32) / np.iinfo(pixels.dtype).max
    colour = linear_from_pixels(pixels[..., :3]) * alpha
    return np.concatenate([colour, alpha], axis=-1, dtype=np.float32)


def boundary(mask: np.ndarray) -> np.ndarray:
    """Pixels on either side of a mask's outline, bool [H,W]: those that differ from one of their
    four neighbours. The edge of the image is no outline."""
    return binary_dilation(mask) ^ binary_erosion(mask, border_value=1)
