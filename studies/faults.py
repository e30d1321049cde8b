"""Faults of images and of priors: pure functions of what they spoil, with their sizes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter, shift
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import mgs
from mgs.colour import linear_from_srgb, srgb_from_linear


@dataclass(frozen=True, kw_only=True, eq=False)
class Captured(mgs.Frame):
    """A frame with its pixels in memory, equal to itself alone. pixels: linear RGB [H,W,3]; rgba:
    the rock alone, premultiplied [H,W,4]; z: depth [H,W], metres; rock: mask [H,W]."""

    pixels: np.ndarray
    rgba: np.ndarray
    z: np.ndarray
    rock: np.ndarray

    __hash__, __eq__ = object.__hash__, object.__eq__

    def rgb(self) -> np.ndarray:
        """Linear RGB [H,W,3]."""
        return self.pixels

    def depth(self) -> np.ndarray:
        """Depth [H,W], metres."""
        return self.z

    def mask(self) -> np.ndarray:
        """Mask of the rock [H,W]."""
        return self.rock

    def target(self) -> tuple[np.ndarray, np.ndarray]:
        """Image of the rock alone [H,W,4], and weights of the pixels [H,W]."""
        return self.rgba, np.ones(self.rgba.shape[:2], np.float32)


def captured(frame: mgs.Frame) -> Captured:
    """A frame of a dataset with its pixels read."""
    rgba, _ = frame.target()
    return Captured(
        **vars(frame), pixels=frame.rgb(), rgba=rgba, z=frame.depth(), rock=frame.mask()
    )


class Fault(NamedTuple):
    """Fault of images or of priors.

    change: function (frame or prior, size, generator) that returns it spoiled. sizes: from small to
    large. words: format of a size with its unit.
    """

    change: Callable[[Any, float, np.random.Generator], Any]
    sizes: tuple[float, ...]
    words: str


def _colours(frame: Captured, change: Callable[[np.ndarray], np.ndarray]) -> Captured:
    """Change linear colours in the image and in the image of the rock alone."""
    alpha = frame.rgba[..., 3:]
    rock = np.clip(change(frame.rgba[..., :3]), 0, None) * (alpha > 0)
    rgba = np.concatenate([rock, alpha], axis=-1, dtype=np.float32)
    pixels = np.clip(change(frame.pixels), 0, None).astype(np.float32)
    return replace(frame, pixels=pixels, rgba=rgba)


def pose_noise(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Pose error. size: degrees about each axis of the camera, and centimetres."""
    pose = frame.camera.world_to_camera.copy()
    turn = Rotation.from_rotvec(np.deg2rad(size) * rng.normal(size=3)).as_matrix()
    pose[:3] = turn @ pose[:3]
    pose[:3, 3] += 0.01 * size * rng.normal(size=3)
    return replace(frame, camera=replace(frame.camera, world_to_camera=pose))


def image_noise(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Noise of sRGB values. size: standard deviation."""
    noise = rng.normal(0, size, frame.pixels.shape)

    def change(rgb: np.ndarray) -> np.ndarray:
        return linear_from_srgb(np.clip(srgb_from_linear(np.clip(rgb, 0, 1)) + noise, 0, 1))

    return _colours(frame, change)


def exposure(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Varying exposure. size: standard deviation in stops."""
    factor = 2.0 ** rng.normal(0, size)
    return _colours(frame, lambda rgb: np.minimum(rgb * factor, 1))


def motion_blur(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Motion in a random direction. size: length in pixels."""
    angle = rng.uniform(0, 2 * np.pi)
    offsets = np.linspace(-size / 2, size / 2, 2 * int(size) + 1)
    steps = [(t * np.sin(angle), t * np.cos(angle), 0) for t in offsets]
    rgba, pixels = (
        np.mean([shift(one, step, order=1, mode="nearest") for step in steps], axis=0)
        for one in (frame.rgba, frame.pixels)
    )
    return _blurred(frame, pixels, rgba)


def defocus(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Blur. size: standard deviation in pixels."""
    pixels, rgba = (gaussian_filter(one, (size, size, 0)) for one in (frame.pixels, frame.rgba))
    return _blurred(frame, pixels, rgba)


def _blurred(frame: Captured, pixels: np.ndarray, rgba: np.ndarray) -> Captured:
    rock = rgba[..., 3] >= 0.5
    pixels, rgba = pixels.astype(np.float32), rgba.astype(np.float32)
    return replace(frame, pixels=pixels, rgba=rgba, rock=rock)


def missing_depth(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Depth missing in patches; the prior was built before. size: share of the pixels."""
    patches = gaussian_filter(rng.normal(size=frame.z.shape), 4)
    z = np.where(patches < np.quantile(patches, size), 0, frame.z).astype(np.float32)
    return replace(frame, z=z)


def shifted_mask(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Mask moved in a random direction. size: pixels."""
    angle = rng.uniform(0, 2 * np.pi)
    offset = (size * np.sin(angle), size * np.cos(angle))
    return _masked(frame, shift(frame.rgba[..., 3], offset, order=1) >= 0.5)


def wrong_mask(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Mask too large, or, in every second frame, too small. size: pixels."""
    change = binary_dilation if rng.random() < 0.5 else binary_erosion
    return _masked(frame, change(frame.rock, iterations=int(size)))


def _masked(frame: Captured, mask: np.ndarray) -> Captured:
    """The rock cut out of the image by another mask."""
    alpha = mask.astype(np.float32)[..., None]
    rgba = np.concatenate([frame.pixels * alpha, alpha], axis=-1, dtype=np.float32)
    return replace(frame, rock=mask, rgba=rgba)


IMAGE_FAULTS: dict[str, Fault] = {
    "pose noise": Fault(pose_noise, (0.25, 1.0, 4.0), "{:g}° and cm"),
    "image noise": Fault(image_noise, (0.02, 0.1, 0.3), "{:g} of the range"),
    "exposure": Fault(exposure, (0.1, 0.3, 1.0), "{:g} stops"),
    "motion blur": Fault(motion_blur, (2.0, 5.0, 12.0), "{:g} px"),
    "defocus": Fault(defocus, (0.5, 1.5, 4.0), "{:g} px"),
    "missing depth": Fault(missing_depth, (0.2, 0.6, 0.95), "{:.0%}"),
    "shifted mask": Fault(shifted_mask, (1.0, 4.0, 10.0), "{:g} px"),
    "wrong mask": Fault(wrong_mask, (1.0, 3.0, 8.0), "{:g} px"),
}
"""Faults by name."""


def noisy_prior(prior: mgs.Prior, size: float, rng: np.random.Generator) -> mgs.Prior:
    """Noise along the normals. size: standard deviation in spacings."""
    off = size * prior.spacing * rng.normal(size=(len(prior.points), 1))
    return replace(prior, points=prior.points + off * prior.normals)


def smoothed_prior(prior: mgs.Prior, size: float, rng: np.random.Generator) -> mgs.Prior:
    """Over-smoothed surface. size: how many times a point moves to the mean of its 32 nearest."""
    points = prior.points
    near = cKDTree(points).query(points, k=min(32, len(points)))[1]
    for _ in range(int(size)):
        points = points[near].mean(axis=1)
    return replace(prior, points=points)


def holes(prior: mgs.Prior, size: float, rng: np.random.Generator) -> mgs.Prior:
    """Surface missing around a random point. size: share of the surface."""
    n = len(prior.points)
    away = np.linalg.norm(prior.points - prior.points[rng.integers(n)], axis=1)
    kept = away > np.quantile(away, size)
    backed = int(kept[: prior.backed].sum())
    return replace(prior, points=prior.points[kept], normals=prior.normals[kept], backed=backed)


def shifted(prior: mgs.Prior, size: float, rng: np.random.Generator) -> mgs.Prior:
    """Prior moved in a random horizontal direction. size: metres."""
    angle = rng.uniform(0, 2 * np.pi)
    offset = size * np.array([np.cos(angle), np.sin(angle), 0])
    return replace(prior, points=prior.points + offset)


def scaled(prior: mgs.Prior, size: float, rng: np.random.Generator) -> mgs.Prior:
    """Prior scaled about its centre. size: factor."""
    centre = prior.points.mean(0)
    return replace(prior, points=centre + size * (prior.points - centre))


def turned(prior: mgs.Prior, size: float, rng: np.random.Generator) -> mgs.Prior:
    """Prior turned about the vertical through its centre. size: degrees."""
    centre, turn = prior.points.mean(0), Rotation.from_euler("z", size, degrees=True).as_matrix()
    points = centre + (prior.points - centre) @ turn.T
    return replace(prior, points=points, normals=prior.normals @ turn.T)


PRIOR_FAULTS: dict[str, Fault] = {
    "noisy prior": Fault(noisy_prior, (0.5, 2.0, 6.0), "{:g} spacings"),
    "smoothed prior": Fault(smoothed_prior, (2.0, 10.0, 40.0), "{:g} times"),
    "holes": Fault(holes, (0.05, 0.2, 0.5), "{:.0%} of the surface"),
    "shifted prior": Fault(shifted, (0.02, 0.1, 0.4), "{:g} m"),
    "scaled prior": Fault(scaled, (1.02, 1.1, 1.4), "factor {:g}"),
    "turned prior": Fault(turned, (3.0, 15.0, 90.0), "{:g}°"),
}
"""Faults by name."""
