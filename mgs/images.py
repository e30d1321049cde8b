"""Images on disk: PNG and JPEG in sRGB, OpenEXR in linear numbers."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.errors import InputError
from mgs.files import atomic_path, reading

PNG_BIT_DEPTH = 24
"""Where a PNG holds its number of bits per sample: in the header, the first chunk (PNG specification, section 11.2.1)."""

EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")
"""Pillow's names of pixels that it converts to 8-bit RGBA without loss: grey, palette and RGB, with and without alpha."""

LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of R, G and B in grey (ITU-R BT.601)."""

PNG_LEVEL = 1
"""zlib's level, of 9. Against Pillow's 6: a render takes 62 instead of 236 ms (0.56 Mpixel) and as many bytes, a smooth photo
413 instead of 644 ms (3 Mpixel) and 7 % more, a mask 9 instead of 14 ms and 16 instead of 5 kB."""


def write_png(path: str | Path, image: np.ndarray, *, linear: bool = True) -> None:
    """Write an 8-bit PNG: linear RGB [H,W,3] (converted to sRGB), display values with linear=False, or, as they are, a bool
    mask [H,W] or uint8 sRGB [H,W,3]."""
    from PIL import Image

    if image.dtype == bool:
        pixels = image.astype(np.uint8) * 255
    elif image.dtype == np.uint8:
        pixels = image
    else:
        display = srgb_from_linear(image) if linear else np.clip(image, 0, 1)
        pixels = np.round(display * 255).astype(np.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG", compress_level=PNG_LEVEL)


def _open_image(path: Path) -> tuple[Any, bytes]:
    """A decoded Pillow image and its file's bytes. Raises InputError where it is missing, cannot be read, or is damaged."""
    from PIL import Image, UnidentifiedImageError

    with reading(path, "image"):
        data = path.read_bytes()
    try:
        with Image.open(BytesIO(data)) as image:
            image.load()
    except UnidentifiedImageError:
        raise InputError(f"{path}: not a readable image; give a PNG or JPEG, or write it again if it is damaged") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: not a readable image ({error}); the file is damaged, write it again") from None
    return image, data


def read_values(path: str | Path) -> np.ndarray:
    """An image of one channel, such as depth, as it is: [H,W] uint8 or uint16 (TIFF: int32 or float32 too).

    Raises InputError where it is missing, cannot be read, is damaged, or has other channels.
    """
    path = Path(path)
    image, _ = _open_image(path)
    if image.mode not in ("L", "I;16", "I", "F"):
        raise InputError(f"{path}: not a depth image, its pixels are of kind {image.mode}; give one channel of 16 bits, or EXR")
    return np.asarray(image)


def read_rgba(path: str | Path) -> np.ndarray:
    """PNG, JPEG or another image -> [H,W,4], sRGB and straight alpha (full where it has none).

    uint16 for a PNG of 16 bits per sample, uint8 for all others: full is 65535 or 255.
    Raises InputError where it is missing, cannot be read, is damaged, or is neither grey nor RGB (no CMYK: what its numbers
    look like is known to its colour profile alone).
    """
    import cv2

    path = Path(path)
    image, data = _open_image(path)
    bits = data[PNG_BIT_DEPTH] if image.format == "PNG" else 8
    if image.mode not in EIGHT_BIT_MODES and bits < 16:
        raise InputError(f"{path}: pixels of kind {image.mode} are not supported; convert it to grey or RGB of 8 or 16 bits")
    if bits in (2, 4, 16) and image.mode in ("L", "I", "I;16") and "transparency" in image.info:
        # Pillow and OpenCV both get these wrong; at 1 and 8 bits Pillow is right.
        raise InputError(f"{path}: a grey of {bits} bits that stands for transparent is not supported; convert it to RGBA")
    if bits < 16:
        return np.asarray(image.convert("RGBA"))
    # Pillow keeps only the upper 8 bits of 16-bit colour.
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        raise InputError(f"{path}: not a readable 16-bit PNG; the file is damaged, write it again")
    conversions = {1: cv2.COLOR_GRAY2RGBA, 3: cv2.COLOR_BGR2RGBA, 4: cv2.COLOR_BGRA2RGBA}
    return cv2.cvtColor(pixels, conversions[pixels.shape[2] if pixels.ndim == 3 else 1])


def read_png(path: str | Path) -> np.ndarray:
    """sRGB image of 8 or 16 bits -> linear RGB float32 [H,W,3], alpha ignored. Raises InputError as `read_rgba`."""
    rgba = read_rgba(path)
    return linear_from_srgb(rgba[..., :3].astype(np.float32) / np.iinfo(rgba.dtype).max)


def read_mask(path: str | Path) -> np.ndarray:
    """Mask image -> bool [H,W] (at least half white is inside, alpha ignored). Raises InputError as `read_rgba`."""
    rgba = read_rgba(path)
    return rgba[..., :3] @ LUMA >= 0.5 * np.iinfo(rgba.dtype).max


def write_exr(path: str | Path, channels: dict[str, np.ndarray]) -> None:
    """Write a float32 OpenEXR with one named channel per [H,W] array (linear)."""
    import OpenEXR

    data = {name: np.ascontiguousarray(array, np.float32) for name, array in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary, OpenEXR.File(header, data) as file:
        try:
            file.write(str(temporary))
        except RuntimeError as error:  # how OpenEXR says that the disk is full
            raise InputError(f"{path}: cannot be written ({error}); choose a place you may write to, with room") from None


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """OpenEXR -> {channel: float32 [H,W]}. Raises InputError where it is missing, cannot be read, or is damaged."""
    import OpenEXR

    path = Path(path)
    with reading(path, "EXR file"), path.open("rb") as opened:  # of a file that it cannot open OpenEXR does not say why
        opened.read(1)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: np.asarray(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except (RuntimeError, OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not a readable EXR ({error}); the file is damaged, write it again") from None
