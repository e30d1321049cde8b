"""The lens: images of a distorted camera -> those of a pinhole; smaller images; photographs that
lie on their side."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.images import exif_orientation

Undo = Callable[[np.ndarray, bool], np.ndarray]
"""A function undo(pixels, smooth) that resamples an image [H,W] or [H,W,C] to another camera: by
means of neighbouring pixels where smooth is true, and by taking single ones, as depth needs it,
where it is false."""


def undistorter(camera: Camera, distortion: np.ndarray) -> tuple[Camera, Undo]:
    """A pinhole camera that sees no more than a distorted one, and a function that resamples images
    of the latter to it.

    distortion: k1 k2 p1 p2 k3 (k4 k5 k6) of OpenCV's rational model. The function is called as
    undo(pixels, smooth) with pixels [H,W] or [H,W,C]; it interpolates linearly where smooth is
    true, and takes the nearest pixel, as depth needs it, where it is false. Without distortion it
    returns the pixels as they are. OpenCV's pixel centres are whole numbers, and ours are at +0.5;
    the difference is taken into account here. Raises InputError where no valid pixel is left.
    """
    import cv2

    if not distortion.any():
        return camera, lambda pixels, smooth: pixels
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    size = (camera.width, camera.height)
    K, _ = cv2.getOptimalNewCameraMatrix(camera.K - shift, distortion, size, alpha=0.0)
    if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(
            "import: the distortion leaves no valid pixel; check k1 k2 p1 p2 and the focal length"
        )

    @functools.cache
    def maps() -> tuple[np.ndarray, np.ndarray]:
        return cv2.initUndistortRectifyMap(
            camera.K - shift, distortion, None, K, size, cv2.CV_32FC1
        )

    def undo(pixels: np.ndarray, smooth: bool) -> np.ndarray:
        method = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
        return cv2.remap(
            np.ascontiguousarray(pixels), *maps(), method, borderMode=cv2.BORDER_REPLICATE
        )

    return Camera(K + shift, camera.width, camera.height, camera.world_to_camera), undo


def shrunk(camera: Camera, undo: Undo, factor: int) -> tuple[Camera, Undo]:
    """A camera whose pixels are blocks of factor x factor of those of `camera`, and the resampling
    to it after `undo`.

    Smooth images become the means of the blocks, others their middle pixel. Rows and columns that
    fill no block are cut off, at the bottom and on the right. Raises InputError where no block is
    left.
    """
    if factor == 1:
        return camera, undo
    width, height = camera.width // factor, camera.height // factor
    if factor < 1 or not width or not height:
        raise InputError(
            f"import: --downscale {factor} leaves nothing of {camera.width}x{camera.height}; give 1 or more"
        )

    def smaller(pixels: np.ndarray, smooth: bool) -> np.ndarray:
        pixels = undo(pixels, smooth)[: height * factor, : width * factor]
        blocks = pixels.reshape(height, factor, width, factor, *pixels.shape[2:])
        if not smooth:
            return np.ascontiguousarray(blocks[:, factor // 2, :, factor // 2])
        mean = blocks.mean((1, 3), dtype=np.float32)
        return (
            np.round(mean).astype(pixels.dtype) if np.issubdtype(pixels.dtype, np.integer) else mean
        )

    K = camera.K / np.array([[factor, 1, factor], [1, factor, factor], [1, 1, 1]])
    return Camera(K, width, height, camera.world_to_camera), smaller


def stride_for(camera: Camera, most: float) -> int:
    """The least factor for `shrunk` with which an image of the camera has at most so many
    pixels."""
    return int(np.ceil(np.sqrt(camera.width * camera.height / most)))


def fit_to_camera(path: Path, pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """The pixels of an image file, turned as its EXIF says if only that makes it as wide and high
    as its camera.

    COLMAP ignores the mark by which a phone says how it was held, and other programs obey it; the
    size tells which. Raises InputError where the image has another size either way.
    """
    wanted, found = (camera.height, camera.width), pixels.shape[:2]
    if found != wanted and found == wanted[::-1] and (orientation := exif_orientation(path)) >= 5:
        transposed = pixels.swapaxes(0, 1)
        flips = {5: (), 6: (1,), 7: (0, 1), 8: (0,)}[orientation]
        return np.ascontiguousarray(np.flip(transposed, flips))
    if found != wanted:
        raise InputError(
            f"{path}: is {found[1]}x{found[0]}, but its camera is {camera.width}x{camera.height}; resize it or correct w and h"
        )
    return pixels
