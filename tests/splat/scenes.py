"""Random scenes for the splat tests, and comparisons."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np

from mgs.camera import Camera, look_at
from mgs.gaussians import ARRAYS, Gaussians
from mgs.splat import as_drjit

from . import reference
from .reference import margins

SIZE = (45, 27)
"""Width and height of most scenes, pixels: no multiple of the 8x4 block in either direction."""


def make_camera(
    size=SIZE, focal=50.0, eye=(2.0, 0.4, 1.1), target=(0.0, 0.0, 0.0), centre=None
) -> Camera:
    """Pinhole with unequal focal lengths; centre: principal point, pixels (default: a little off
    the middle)."""
    width, height = size
    cx, cy = centre if centre is not None else (0.52 * width, 0.47 * height)
    K = np.array([[focal, 0, cx], [0, 1.1 * focal, cy], [0, 0, 1]])
    return Camera(K, width, height, look_at(eye, target))


def cameras_around(gaussians: Gaussians, angles, width=40, height=32) -> list[Camera]:
    """Cameras at these azimuths, radians, that see all of a surface of `studies.bench`."""
    from studies.frame.timing import surface_camera

    first = surface_camera(gaussians, width, height)
    distance = np.linalg.norm(first.position)
    eyes = [distance * np.array([np.cos(a), np.sin(a), 0.4]) for a in angles]
    return [Camera(first.K, width, height, look_at(eye, [0, 0, 0.4])) for eye in eyes]


def make_gaussians(
    n,
    seed,
    degree=0,
    log_scales=(-4.0, -1.2),
    logits=(-4.0, 5.0),
    spread=0.6,
    colour=2.5,
    antialiased=True,
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
        antialiased=antialiased,
    )


def make_clamped(seed, degree=0, n=16, antialiased=True, **style) -> Gaussians:
    """As make_gaussians, with a wide Gaussian whose alpha reaches ALPHA_MAX if not antialiased, and
    one of clamped colours."""
    style = {"log_scales": (-4.0, -1.0), "antialiased": antialiased} | style
    g = make_gaussians(n, seed, degree, **style)
    g.means[0], g.log_scales[0], g.logit_opacities[0] = 0, (-0.5, -0.8, -0.3), 20
    g.sh[1] = 0
    g.sh[1, 0] = (-4, 2, -4)
    return g


def place(camera: Camera, pixels, depths) -> np.ndarray:
    """World points [N,3] seen at these pixels [N,2] and z-depths [N] (negative: behind)."""
    pixels, z = np.asarray(pixels, np.float64), np.asarray(depths, np.float64)
    x, y = ((pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2] * z[:, None]).T
    pose = camera.camera_to_world
    return np.stack([x, y, z], 1) @ pose[:3, :3].T + pose[:3, 3]


def double(gaussians: Gaussians) -> Gaussians:
    """A float64 copy, for central differences of the reference."""
    return gaussians.map(lambda array: np.array(array, np.float64))


def difference(gaussians, tangents, camera, background, step=1e-6) -> dict[str, np.ndarray]:
    """Derivative of the reference's images along tangents, by a central difference."""
    ends = []
    for sign in (+1, -1):
        moved = double(gaussians)
        for name, tangent in tangents.items():
            setattr(moved, name, getattr(moved, name) + sign * step * tangent.astype(np.float64))
        ends.append(reference.render(moved, camera, background))
    return {name: (ends[0][name] - ends[1][name]) / (2 * step) for name in ends[0]}


def changed(gaussians: Gaussians, **values) -> Gaussians:
    """The Gaussians with some parameters replaced."""
    single = {name: np.asarray(value, np.float32) for name, value in values.items()}
    return replace(gaussians, **single)


def with_gradients(gaussians: Gaussians, names=ARRAYS) -> Gaussians:
    """A Dr.Jit copy with gradients enabled for some parameters."""
    model = as_drjit(gaussians)
    for name in names:
        setattr(model, name, dr.copy(getattr(model, name)))
        dr.enable_grad(getattr(model, name))
    return model


def gradients_of(model: Gaussians, names=ARRAYS) -> dict[str, np.ndarray]:
    return {name: np.asarray(dr.grad(getattr(model, name))) for name in names}


@contextmanager
def thread_count(count: int) -> Iterator[None]:
    """Run kernels with this number of threads, on any processor."""
    before, own = dr.thread_count(), os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    dr.set_thread_count(count)
    try:
        yield
    finally:
        os.sched_setaffinity(0, own)
        dr.set_thread_count(before)


def in_own_process(code: str, *arguments: str, **environment: str) -> str:
    """Output of Python code that runs in the folder `tests`."""
    from program import python

    code = "from mgs import runtime\n" + code
    done = python(code, *arguments, env=environment, cwd=Path(__file__).parents[1])
    assert done.returncode == 0, done.stderr
    return done.stdout


def calm(make, camera: Camera, seed: int, least: float = 3e-5) -> Gaussians:
    """The first of make(seed), make(seed + 1000), ... without a pixel this near to a decision."""
    for attempt in range(200):
        gaussians = make(seed + 1000 * attempt)
        if margins(gaussians, camera).min() > least:
            return gaussians
    raise AssertionError("no scene without a pixel near a threshold in 200 attempts")


def relative_error(found, expected) -> float:
    """L2 norm of the difference over that of `expected`."""
    a, b = np.asarray(found, np.float64).ravel(), np.asarray(expected, np.float64).ravel()
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))
