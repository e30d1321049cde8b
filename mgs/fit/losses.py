"""Losses of a fit, by name: what each pixel value adds, given a render and an image."""

from collections.abc import Callable
from math import gcd
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.errors import row_named
from mgs.metrics import SSIM_SIGMA, SSIM_WINDOW

DSSIM_SHARE = 0.2  # share of the dissimilarity in `l1_dssim` (Kerbl et al. 2023)
SSIM_CONSTANTS = 0.01**2, 0.03**2  # constants of SSIM for values from 0 to 1 (Wang et al. 2004)
HALF = SSIM_WINDOW // 2  # pixels of the window of SSIM on each side of its centre

_window = np.exp(-0.5 * (np.arange(-HALF, HALF + 1) / SSIM_SIGMA) ** 2)
WINDOW = (_window / _window.sum()).tolist()  # weights of the window of SSIM along an axis
STRIP, PACK = 8, 4  # values that one lane makes: of a line, in this many lines side by side
Size = tuple[int, int, int]  # width, height and channels of an image

Loss = Callable[[Any, Any, Any, Size, bool], Any]
"""loss(drawn, pixels, weights, size, linear) -> what each pixel value adds, Float [H*W*C]. Render
and image are linear RGB, or sRGB where `linear` is false, with alpha if there are four channels;
weights are factors of the differences."""


def squared(drawn: Any, pixels: Any, weights: Any, size: Size, linear: bool) -> Any:
    """Squared difference."""
    return dr.square((drawn - pixels) * weights)


def l1_dssim(drawn: Any, pixels: Any, weights: Any, size: Size, linear: bool) -> Any:
    """0.8 |x - y| + 0.2 (1 - SSIM(x, y)) of the images as sRGB (Kerbl et al. 2023). Alpha is not
    encoded. SSIM takes values beyond the border as 0, as the authors' program does."""
    if linear:
        drawn, pixels = _encoded(drawn, size), _encoded(pixels, size)
    x, y = pixels + (drawn - pixels) * weights, pixels
    dissimilar = 1 - similarity(x, y, size)
    return dr.lerp(dr.abs(x - y), dissimilar, DSSIM_SHARE)


LOSSES: dict[str, Loss] = {"squared": squared, "l1-dssim": l1_dssim}

_functions: dict[str, Loss] = {}  # losses that are no row of LOSSES, by `loss_name`


def loss_name(loss: str | Loss) -> str:
    """Name of a loss. A function is kept, since recorded kernels have a loss by its name."""
    if isinstance(loss, str):
        return loss
    name = f"{getattr(loss, '__name__', 'loss')} {id(loss)}"
    _functions.setdefault(name, loss)
    return name


def loss_named(name: str) -> Loss:
    """Loss of a name. Raises InputError, which lists LOSSES, if there is none."""
    return _functions.get(name) or row_named(LOSSES, name, "loss")


def _encoded(values: Any, size: Size) -> Any:
    """Colours, linear RGB, as sRGB. The curve goes on above 1, where a render can be."""
    curve = 1.055 * dr.power(dr.maximum(values, 0.0031308), 1 / 2.4) - 0.055
    encoded = dr.select(values <= 0.0031308, 12.92 * values, curve)
    colour = dr.arange(mi.UInt32, len(values)) % size[2] < 3
    return dr.select(colour, encoded, values)


def similarity(x: Any, y: Any, size: Size) -> Any:
    """Structural similarity of each pixel value (Wang et al. 2004), Float [H*W*C]. Differentiable
    in x."""
    c1, c2 = SSIM_CONSTANTS
    mean_x, xx, xy = dr.custom(_Blur, (x, x * x, x * y), size)
    mean_y, yy = _blurred((y, y * y), size)
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    agreement = (2 * product + c1) * (2 * (xy - product) + c2)
    return agreement / ((squares + c1) * (xx + yy - squares + c2))


class _Blur(dr.CustomOp):
    """`_blurred` as a Dr.Jit AD operation. The window is symmetric, so the derivative is a blur."""

    def eval(self, images: tuple[Any, ...], size: Size) -> Any:
        self.size = size
        return _blurred(images, size)

    def forward(self) -> None:
        self.set_grad_out(_blurred(self.grad_in("images"), self.size))

    def backward(self) -> None:
        self.set_grad_in("images", _blurred(self.grad_out(), self.size))


def _blurred(images: tuple[Any, ...], size: Size) -> tuple[Any, ...]:
    """Images convolved with the window of SSIM, 0 beyond the border. A lane makes STRIP values of
    each of up to PACK neighbouring rows or columns: they share what they read, PACK at a time."""
    width, height, channels = size
    for length, stride in ((width, channels), (height, channels * width)):
        dr.eval(images)
        pack, strips = gcd(stride, PACK), -(-length // STRIP)
        packet = {1: mi.Float, 2: mi.Vector2f, 4: mi.Vector4f}[pack]
        lines = stride // pack  # a step along a line, packets
        lane = dr.arange(mi.Int32, strips * (width * height * channels // (length * pack)))
        line, first = lane % lines, lane // lines % strips * STRIP
        line += lane // (lines * strips) * (lines * length)
        blurred = tuple(dr.empty(mi.Float, len(image)) for image in images)
        for image, out in zip(images, blurred, strict=True):
            places = [first + k for k in range(-HALF, STRIP + HALF)]
            near = [
                dr.gather(packet, image, line + at * lines, (at >= 0) & (at < length))
                for at in places
            ]
            for k in range(STRIP):
                value, at = packet(0), places[k + HALF]
                for weight, part in zip(WINDOW, near[k:], strict=False):
                    value = dr.fma(part, weight, value)
                where = line + at * lines
                dr.scatter(out, value, where, at < length, mode=dr.ReduceMode.NoConflicts)
            dr.eval(out)  # several images in one kernel are three times slower
        images = blurred
    return images
