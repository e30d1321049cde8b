"""Random scenes for the splat tests, and how a gradient is compared with the true one."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from mgs.camera import Camera, look_at
from mgs.gaussians import Gaussians
from mgs.splat.reference import margins

PARAMETERS = ("means", "log_scales", "quats", "logit_opacities", "sh")

SIZE = (45, 27)
"""Width and height of most scenes, pixels: no multiple of the 8x4 block in either direction."""


def make_camera(
    size=SIZE, focal=50.0, eye=(2.0, 0.4, 1.1), target=(0.0, 0.0, 0.0), centre=None
) -> Camera:
    """Pinhole with unequal focal lengths; centre: principal point, pixels (default: a little off
    the middle)."""
    width, height = size
    cx, cy = centre if centre is not None else (0.52 * width, 0.47 * height)
    return Camera(
        np.array([[focal, 0, cx], [0, 1.1 * focal, cy], [0, 0, 1]]),
        width,
        height,
        look_at(eye, target),
    )


def make_gaussians(
    n, seed, degree=0, log_scales=(-4.0, -1.2), logits=(-4.0, 5.0), spread=0.6, colour=2.5
) -> Gaussians:
    """n random Gaussians around the origin, float32: anisotropic, some nearly opaque, some colours
    clamped at 0."""
    rng = np.random.default_rng([seed, n, degree])
    return Gaussians(
        means=rng.uniform(-spread, spread, (n, 3)).astype(np.float32),
        log_scales=rng.uniform(*log_scales, (n, 3)).astype(np.float32),
        quats=rng.normal(0, 1, (n, 4)).astype(np.float32),
        logit_opacities=rng.uniform(*logits, n).astype(np.float32),
        sh=rng.normal(0, colour / (degree + 1), (n, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def place(camera: Camera, pixels, depths) -> np.ndarray:
    """World points [N,3] that the camera sees at these pixels [N,2] and z-depths [N] (negative:
    behind it)."""
    pixels, z = np.asarray(pixels, np.float64), np.asarray(depths, np.float64)
    x, y = ((pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2] * z[:, None]).T
    pose = camera.camera_to_world
    return np.stack([x, y, z], 1) @ pose[:3, :3].T + pose[:3, 3]


def double(gaussians: Gaussians) -> Gaussians:
    """A float64 copy, for central differences of the oracle."""
    return Gaussians(
        **{f.name: np.array(getattr(gaussians, f.name), np.float64) for f in fields(gaussians)}
    )


def changed(gaussians: Gaussians, **values) -> Gaussians:
    """The Gaussians with some parameters replaced."""
    return replace(
        gaussians, **{name: np.asarray(value, np.float32) for name, value in values.items()}
    )


def calm(make, camera: Camera, seed: int, least: float = 3e-5) -> Gaussians:
    """The first scene make(seed), make(seed + 1000) ... in which no pixel is within `least` of a
    decision."""
    for attempt in range(200):
        gaussians = make(seed + 1000 * attempt)
        if margins(gaussians, camera).min() > least:
            return gaussians
    raise AssertionError("no scene without a pixel near a threshold in 200 attempts")


def compare(gradient, expected) -> tuple[float, float, float]:
    """(relative L2 error, 1 - cosine, signed bias) of a gradient as a vector; the bias is its
    component along `expected`."""
    a, b = np.asarray(gradient, np.float64).ravel(), np.asarray(expected, np.float64).ravel()
    norm = np.linalg.norm(b)
    return (
        float(np.linalg.norm(a - b) / norm),
        float(1 - a @ b / (np.linalg.norm(a) * norm)),
        float((a - b) @ b / norm**2),
    )
