"""Lenses as COLMAP's camera models, and resampling: undistortion, reduction, EXIF orientation."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.images import exif_orientation, image_size

Undo = Callable[[np.ndarray, bool], np.ndarray]
"""undo(pixels, smooth): resample an image [H,W] or [H,W,C] to another camera, by interpolation if
`smooth`, else by single pixels (depth)."""

GENERAL = {  # camera models that are cases of a more general one, which takes their place
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL"), "FULL_OPENCV"),
    **dict.fromkeys(("OPENCV", "FULL_OPENCV"), "FULL_OPENCV"),
    **dict.fromkeys(("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "OPENCV_FISHEYE"),
}

FARTHEST = np.tan(np.radians(60))  # largest tangent in an undistorted image; fisheyes are cut
COARSEST = 16  # most pixels of a picture across one of its mask or depth
HALVED = (2, 4, 8)  # factors by which programs reduce pictures, each side rounded up or down
REDUCED = 1.5  # least factor of smaller pictures: undistorted ones may be a little smaller, too
BLOCK = 1 << 20  # pixels that are mapped at once


@dataclass(frozen=True)
class Lens:
    """A camera model of COLMAP with its parameters in COLMAP's order, pixels from the corner."""

    model: str
    parameters: tuple[float, ...]

    @classmethod
    def of(cls, where: str, model: str, K: np.ndarray, values: Mapping[str, float]) -> Lens | None:
        """Lens of a model of COLMAP, K [3,3], and coefficients by COLMAP's names; None for a
        pinhole. Raises InputError, which begins with `where`, for another model, and for a
        coefficient that the model lacks."""
        one = model in ("SIMPLE_RADIAL", "SIMPLE_RADIAL_FISHEYE")  # whose k is k1 of the others
        values = {"k1" if one and k == "k" else k: value for k, value in values.items() if value}
        if not np.isfinite([*values.values()]).all():
            raise InputError(f"{where} has a distortion that is not finite; correct it")
        if "PINHOLE" in model or (model in GENERAL and not values and "FISHEYE" not in model):
            model, names = "PINHOLE", ["fx", "fy", "cx", "cy"]
        else:
            model = GENERAL.get(model, model)
            names = parameter_names(model)
        intrinsic = {"fx": K[0, 0], "fy": K[1, 1], "f": K[0, 0], "cx": K[0, 2], "cy": K[1, 2]}
        if "f" in names and not np.isclose(K[0, 0], K[1, 1]):
            raise InputError(f"{where} has two focal lengths, and {model} has one; correct them")
        if not names or "w" in names:
            cure = "undistort the images first"
            raise InputError(f"{where}: camera model {model} is not supported; {cure}")
        if lacking := [name for name in values if name not in names]:
            cure = "undistort the images"
            raise InputError(f"{where} has {lacking[0]}, which the model {model} lacks; {cure}")
        if model == "PINHOLE":
            return None
        return cls(model, tuple(float({**intrinsic, **values}.get(name, 0)) for name in names))

    def scaled(self, across: float, down: float) -> Lens:
        """Lens of an image that is resized by these factors."""
        factors = {"f": across, "fx": across, "cx": across, "fy": down, "cy": down}
        pairs = zip(parameter_names(self.model), self.parameters, strict=True)
        return Lens(self.model, tuple(factors.get(name, 1.0) * value for name, value in pairs))

    def camera(self, width: int, height: int) -> Any:
        """The camera of pycolmap."""
        from pycolmap import Camera as ColmapCamera

        return ColmapCamera(model=self.model, width=width, height=height, params=self.parameters)


@functools.cache
def parameter_names(model: str) -> list[str]:
    """Names of the parameters of a camera model of COLMAP; none if there is no such model."""
    from pycolmap import Camera as ColmapCamera
    from pycolmap import CameraModelId

    number = CameraModelId.__members__.get(model)
    if number is None or int(number) < 0:
        return []
    text = ColmapCamera.create_from_model_id(1, number, 1.0, 1, 1).params_info
    return [name.strip() for name in text.split(",")]


def undistorter(camera: Camera, lens: Lens | None) -> tuple[Camera, Undo]:
    """Pinhole camera inside the view of a lens, of the same size, and the resampling to it. camera:
    its size and pose. Raises InputError if no valid pixel is left."""
    if lens is None:
        return camera, lambda pixels, smooth: pixels
    import cv2

    size = camera.width, camera.height
    K = _inner(lens, *size)
    pixels = _distorted(lens, K, *(np.linspace(0.5, side - 0.5, 65) for side in size))
    if not _is_sound(pixels, lens, K, size):
        why = "the distortion leaves no valid pixel or folds the image over itself"
        raise InputError(f"import: {why}; check the focal length and k1 k2 p1 p2")

    def undo(pixels: np.ndarray, smooth: bool) -> np.ndarray:
        method = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
        pixels, at = np.ascontiguousarray(pixels), _map(lens, K.tobytes(), *size)
        return cv2.remap(pixels, at[..., 0], at[..., 1], method, borderMode=cv2.BORDER_REPLICATE)

    return Camera(K, *size, camera.world_to_camera), undo


def _inner(lens: Lens, width: int, height: int) -> np.ndarray:
    """K [3,3] of the largest pinhole image, on whose borders a pixel of the distorted borders lies,
    and all of whose pixels are valid. It ends at FARTHEST."""
    camera = lens.camera(width, height)
    u, v = (np.linspace(0.5, side - 0.5, min(side, 257)) for side in (width, height))
    limits = []
    for axis, (side, along) in enumerate(((width, v), (height, u))):
        for end, sign in ((0.5, -1), (side - 0.5, 1)):
            border = np.full((len(along), 2), end)
            border[:, 1 - axis] = along
            rays = np.nan_to_num(camera.cam_from_img(border), nan=np.inf)
            back = camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
            off = ~(np.abs(np.nan_to_num(back, nan=np.inf) - border).max(1) < 0.1)
            reach = np.where(off | (sign * rays[:, axis] < 0), np.inf, sign * rays[:, axis])
            limits.append(sign * min(reach.min(), FARTHEST))
    left, right, top, bottom = limits
    with np.errstate(all="ignore"):
        fx, fy = (width - 1) / (right - left), (height - 1) / (bottom - top)
        return np.array([[fx, 0, 0.5 - left * fx], [0, fy, 0.5 - top * fy], [0, 0, 1]])


def _distorted(lens: Lens, K: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Pixels [V,U,2] of a lens that see what the pixels (u, v) of a pinhole K see."""
    x, y = np.meshgrid((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    return lens.camera(1, 1).img_from_cam(rays).reshape(*x.shape, 2)


@functools.lru_cache(maxsize=1)
def _map(lens: Lens, pinhole: bytes, width: int, height: int) -> np.ndarray:
    """Positions float32 [H,W,2] to sample, for OpenCV: pixel centres are whole numbers. Images of
    one lens share it."""
    K, u = np.frombuffer(pinhole).reshape(3, 3), np.arange(width) + 0.5
    places = np.empty((height, width, 2), np.float32)
    rows = max(1, BLOCK // width)
    for top in range(0, height, rows):
        v = np.arange(top, min(top + rows, height)) + 0.5
        places[top : top + rows] = _distorted(lens, K, u, v) - 0.5
    return places


def _is_sound(at: np.ndarray, lens: Lens, K: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether the map from an undistorted image to the distorted one, on a grid at [V,U,2], does
    not fold, lead out of it, or magnify beyond any lens."""
    if not np.isfinite(at).all() or not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        return False
    down, along = np.gradient(at, axis=(0, 1))
    determinant = along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0]
    margin = 0.05 * np.array(size)
    inside = (at >= -margin).all() and (at <= size + margin).all()
    focal = lens.camera(*size).mean_focal_length()
    alike = all(0.1 < value / focal < 10 for value in (K[0, 0], K[1, 1]))
    return bool(alike and inside and (determinant > 0).all())


def fitted(camera: Camera, lens: Lens | None, image: Path) -> tuple[Camera, Lens | None]:
    """Camera and lens of an image file: scaled where the file `is_reduced` by at least REDUCED,
    else as they are."""
    own, whole = image_size(image), (camera.width, camera.height)
    if (own[0] > own[1]) != (whole[0] > whole[1]) and exif_orientation(image) >= 5:
        own = own[::-1]  # as it is looked at
    if max(whole) < REDUCED * max(own) or not is_reduced(own, whole):
        return camera, lens
    across, down = np.divide(own, whole).tolist()
    K = camera.K * [[across, 1, across], [1, down, down], [1, 1, 1]]
    return Camera(K, *own, camera.world_to_camera), lens and lens.scaled(across, down)


def is_reduced(size: tuple[int, int], whole: tuple[int, int]) -> bool:
    """Whether a size is a larger one reduced by one factor, to a pixel."""
    factors = max(whole) / max(size), *HALVED
    sides = list(zip(whole, size, strict=True))
    return size != whole and any(
        k >= 1 and all(abs(side / k - one) < 1 for side, one in sides) for k in factors
    )


def shrunk(
    camera: Camera, factor: int, undo: Undo = lambda pixels, smooth: pixels
) -> tuple[Camera, Undo]:
    """Camera whose pixels are blocks of factor x factor pixels, and the resampling to it after
    `undo`: means of the blocks, or middle pixels if not smooth. Incomplete blocks at the bottom and
    on the right are cut off. Raises InputError if no block is left."""
    if factor == 1:
        return camera, undo
    if not 1 <= factor <= min(camera.width, camera.height):
        size, most = f"{camera.width}x{camera.height}", min(camera.width, camera.height)
        raise InputError(f"import: downscale {factor} leaves nothing of {size}; give 1 to {most}")
    width, height = camera.width // factor, camera.height // factor

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


def cut(camera: Camera, undo: Undo, rim: int) -> tuple[Camera, Undo]:
    """Camera without `rim` pixels on each side, and the resampling to it after `undo`."""
    if rim == 0:
        return camera, undo

    def inner(pixels: np.ndarray, smooth: bool) -> np.ndarray:
        return np.ascontiguousarray(undo(pixels, smooth)[rim:-rim, rim:-rim])

    K = camera.K - rim * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    size = camera.width - 2 * rim, camera.height - 2 * rim
    return Camera(K, *size, camera.world_to_camera), inner


def shrunk_to(camera: Camera, most: float) -> tuple[Camera, Undo]:
    """`shrunk` by the least factor that leaves at most `most` pixels."""
    return shrunk(camera, int(np.ceil(np.sqrt(camera.width * camera.height / most))))


def read_fitting(
    read: Callable[[Path], np.ndarray],
    path: Path,
    camera: Camera,
    turned: bool = False,
    resized: bool = False,
    stored: int = 1,
) -> np.ndarray:
    """Pixels of an image file, turned by its EXIF orientation if `turned`, or if only that fits its
    camera's size. resized: one of another size and the same proportions gives the nearest pixels,
    if it is not smaller by more than COARSEST. stored: EXIF orientation of a file that has none and
    lies on its side. Raises InputError, before anything is decoded, if neither size fits."""
    size, real = (camera.width, camera.height), image_size(path)
    orientation = exif_orientation(path) if turned or real == size[::-1] != size else 1
    if orientation == 1 and stored >= 5 and (real[0] > real[1]) != (size[0] > size[1]):
        orientation = stored
    whole = real[::-1] if orientation >= 5 else real
    similar = is_reduced(size, whole) or is_reduced(whole, size)
    if size != whole and not (resized and similar and COARSEST * max(whole) >= max(size)):
        why = f"is {real[0]}x{real[1]}, but its camera is {camera.width}x{camera.height}"
        raise InputError(f"{path}: {why}; give pictures, masks and depth of their cameras' size")
    pixels = read(path)
    flips = {2: (1,), 3: (0, 1), 4: (0,), 6: (1,), 7: (0, 1), 8: (0,)}.get(orientation, ())
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    pixels = np.flip(pixels, flips)
    if size != whole:
        sides = zip(size, whole, strict=True)
        columns, rows = ((2 * np.arange(one) + 1) * side // (2 * one) for one, side in sides)
        pixels = pixels[rows[:, None], columns]
    return np.ascontiguousarray(pixels)
