"""Times that can be compared although the machine is busy with other work.

Each timed call follows a fixed piece of work, the *reference*. What slows the machine slows both.
Charts show seconds: the median ratio times the reference's median seconds over the whole study.
"""

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs import Camera, Gaussians, ListCache, as_drjit, look_at, render, runtime
from mgs.gaussians import LEARNED, sh_from_rgb
from mgs.memory import padded
from mgs.rotation import quat_from_normals
from mgs.seeds import derive_seed, generator

REFERENCE = 10_000, 320, 240
"""Gaussians, width and height of the reference, which renders REFERENCE_CALLS times with gradients.
"""

REFERENCE_CALLS = 10

LEAST_SECONDS, MOST_REPEATS = 0.8, 15
"""A call is repeated until its times add up to so many seconds, at most so often."""

Result = TypeVar("Result")


def surface_gaussians(n: int) -> Gaussians:
    """Sample n flat Gaussians on the surface of the default rock, the scene of the timings.

    Their standard deviations are 0.8, 0.8 and 0.2 spacings (the square root of area / n). Their
    opacity is 0.73 (logit 1), their colours are random.
    """
    import trimesh

    mesh = _rock()
    points, faces = trimesh.sample.sample_surface(mesh, n, seed=derive_seed(0, "bench/points"))
    spacing = np.sqrt(mesh.area / n)
    return Gaussians(
        means=np.asarray(points, np.float32),
        log_scales=np.tile(np.log(spacing * np.array([0.8, 0.8, 0.2])), (n, 1)).astype(np.float32),
        quats=quat_from_normals(mesh.face_normals[faces]).astype(np.float32),
        logit_opacities=np.full(n, 1.0, np.float32),
        sh=sh_from_rgb(generator(0, "bench/colours").uniform(0.1, 0.6, (n, 3))),
    )


@cache
def _rock() -> Any:
    """Mesh of the default rock. It takes seconds, and tests use it often."""
    from mgs.synth.rock import Noise, rock_shape
    from mgs.synth.scene_file import load_scene_file

    return rock_shape(load_scene_file("boulder").rock, Noise(generator(0, "bench/rock")))[0]


def surface_camera(gaussians: Gaussians, width: int, height: int) -> Camera:
    """Camera 25 degrees above the horizon and three radii away, whose image the Gaussians fill."""
    low, high = gaussians.means.min(axis=0), gaussians.means.max(axis=0)
    centre, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    pose = look_at(centre + 3 * radius * np.array([np.cos(0.44), 0.0, np.sin(0.44)]), centre)
    x, y, z = (gaussians.means @ pose[:3, :3].T + pose[:3, 3]).T
    focal = 0.49 * min(width / np.abs(x / z).max(), height / np.abs(y / z).max())
    return Camera(
        np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), width, height, pose
    )


def gradient(
    gaussians: Gaussians, camera: Camera, weights: Any, cache: ListCache | None
) -> list[Any]:
    """Gradients of sum(image * weights) with respect to each of LEARNED.

    weights: TensorXf [H,W,3]. cache: as in `mgs.splat.render`.
    """
    dr.enable_grad([getattr(gaussians, name) for name in LEARNED])
    loss = dr.sum(render(gaussians, camera, cache=cache).rgb * weights, axis=None)
    dr.backward(loss)
    gradients = [dr.grad(getattr(gaussians, name)) for name in LEARNED]
    dr.disable_grad([getattr(gaussians, name) for name in LEARNED])
    return gradients


@cache
def reference_of(count: int, width: int, height: int) -> Callable[[], Any]:
    """The reference of this size, with its kernels compiled."""
    runtime.start()
    gaussians, lists = surface_gaussians(count), ListCache()
    camera, device = surface_camera(gaussians, width, height), as_drjit(gaussians)
    weights = mi.TensorXf(padded(np.ones((camera.height, camera.width, 3))))

    def call() -> None:
        for _ in range(REFERENCE_CALLS):
            for part in gradient(device, camera, weights, lists):
                np.asarray(part)

    call()
    return call


def _clock(call: Callable[[], Result]) -> tuple[Result, float, float]:
    """Result of a call, its seconds, and the seconds of all cores of this process."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def timed(
    call: Callable[[], Result],
    repeats: int,
    reference: Callable[[], Any] | tuple[int, ...] = REFERENCE,
) -> tuple[Result, dict[str, float]]:
    """Call a function once untimed, which compiles its kernels, and then `repeats` times or more.

    The function must return NumPy arrays or plain values, so that nothing is left to compute.
    reference: a function, or the size of `reference_of`.
    Returns its result, and medians: wall and cpu, seconds; reference, seconds; ratio, wall over
    reference, with its extremes ratio_low and ratio_high.
    """
    reference = reference if callable(reference) else reference_of(*reference)
    result = call()
    walls, cpus, references = list[float](), list[float](), list[float]()
    while len(walls) < repeats or (sum(walls) < LEAST_SECONDS and len(walls) < MOST_REPEATS):
        references.append(_clock(reference)[1])
        result, wall, cpu = _clock(call)
        walls.append(wall)
        cpus.append(cpu)
    ratios = np.array(walls) / references
    return result, {
        "wall": float(np.median(walls)),
        "cpu": float(np.median(cpus)),
        "reference": float(np.median(references)),
        "ratio": float(np.median(ratios)),
        "ratio_low": float(ratios.min()),
        "ratio_high": float(ratios.max()),
    }


def peak_megabytes() -> float:
    """Most memory that this process has held, megabytes. `getrusage` would include the parent's."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1.024e-3
