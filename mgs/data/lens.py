"""Resampling of images: undistortion, reduction in size, and EXIF orientation."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.images import exif_orientation, image_size

Undo = Callable[[np.ndarray, bool], np.ndarray]
"""undo(pixels, smooth): resample an image [H,W] or [H,W,C] to another camera, by interpolation if
`smooth`, else by single pixels (depth)."""


def undistorter(camera: Camera, distortion: np.ndarray) -> tuple[Camera, Undo]:
    """Pinhole camera inside the view of a distorted one, and the resampling to it.

    distortion: k1 k2 p1 p2 k3 (k4 k5 k6) of OpenCV's rational model. OpenCV's pixel centres are
    whole numbers and ours are at +0.5, which is taken into account. Raises InputError if no valid
    pixel is left.
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
    if _folds(camera.K - shift, distortion, K, size):
        raise InputError(
            "import: the distortion folds the image over itself; check k1 k2 p1 p2 and the focal "
            "length"
        )

    @functools.cache
    def maps() -> tuple[np.ndarray, np.ndarray]:
        return cv2.initUndistortRectifyMap(
            camera.K - shift, distortion, None, K, size, cv2.CV_32FC1
        )

    def undo(pixels: np.ndarray, smooth: bool) -> np.ndarray:
        method = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
        pixels = np.ascontiguousarray(pixels)
        return cv2.remap(pixels, *maps(), method, borderMode=cv2.BORDER_REPLICATE)

    return Camera(K + shift, camera.width, camera.height, camera.world_to_camera), undo


def _folds(
    K: np.ndarray, distortion: np.ndarray, pinhole: np.ndarray, size: tuple[int, int]
) -> bool:
    """Whether the map from an undistorted image to the distorted one folds, leads out of it, or
    magnifies beyond any lens.

    pinhole, K: [3,3] of the two images, with OpenCV's pixel centres. size: width and height.
    """
    import cv2

    u, v = (np.linspace(0, side - 1, 65) for side in size)
    x, y = np.meshgrid((u - pinhole[0, 2]) / pinhole[0, 0], (v - pinhole[1, 2]) / pinhole[1, 1])
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, distortion)[0]
    at = pixels.reshape(*x.shape, 2)
    down, along = np.gradient(at, axis=(0, 1))
    turned = along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0]
    margin = 0.05 * np.array(size)
    inside = (at >= -margin).all() and (at <= size + margin).all()
    alike = 0.1 < pinhole[0, 0] / K[0, 0] < 10 and 0.1 < pinhole[1, 1] / K[1, 1] < 10
    return not (alike and inside and (turned > 0).all())


def shrunk(
    camera: Camera, factor: int, undo: Undo = lambda pixels, smooth: pixels
) -> tuple[Camera, Undo]:
    """Camera whose pixels are blocks of factor x factor pixels, and the resampling to it after
    `undo`: means of the blocks, or middle pixels if not smooth.

    Incomplete blocks at the bottom and on the right are cut off. Raises InputError if no block is
    left.
    """
    if factor == 1:
        return camera, undo
    width, height = camera.width // factor, camera.height // factor
    if factor < 1 or not width or not height:
        raise InputError(
            f"import: downscale {factor} leaves nothing of {camera.width}x{camera.height}; "
            "give 1 or more"
        )

    def smaller(pixels: np.ndarray, smooth: bool) -> np.ndarray:
        pixels = undo(pixels, smooth)[: height * factor, : width * factor]
        blocks = pixels.reshape(height, factor, width, factor, *pixels.shape[2:])
        if not smooth:
            return np.ascontiguousarray(blocks[:, factor // 2, :, factor // 2])
        mean = blocks.mean((1, 3), dtype=np.float32)
        whole = np.issubdtype(pixels.dtype, np.integer)
        return np.round(mean).astype(pixels.dtype) if whole else mean

    K = camera.K / np.array([[factor, 1, factor], [1, factor, factor], [1, 1, 1]])
    return Camera(K, width, height, camera.world_to_camera), smaller


def shrunk_to(camera: Camera, most: float) -> tuple[Camera, Undo]:
    """`shrunk` by the least factor that leaves at most `most` pixels."""
    return shrunk(camera, int(np.ceil(np.sqrt(camera.width * camera.height / most))))


def read_fitting(read: Callable[[Path], np.ndarray], path: Path, camera: Camera) -> np.ndarray:
    """Pixels of an image file, turned by its EXIF orientation if only that fits its camera's size.

    COLMAP ignores EXIF orientation and other programs apply it; the size shows which. Raises
    InputError, before anything is decoded, if neither size fits.
    """
    wanted, found = (camera.width, camera.height), image_size(path)
    orientation = exif_orientation(path) if found == wanted[::-1] != wanted else 1
    if found != wanted and orientation < 5:
        raise InputError(
            f"{path}: is {found[0]}x{found[1]}, but its camera is {camera.width}x{camera.height}; "
            "resize it or correct w and h"
        )
    pixels = read(path)
    if orientation < 5:
        return pixels
    flips = {5: (), 6: (1,), 7: (0, 1), 8: (0,)}[orientation]
    return np.ascontiguousarray(np.flip(pixels.swapaxes(0, 1), flips))
