"""Times that can be compared although the machine is busy with other work.

Each timed call follows a fixed piece of work, the *reference*. What slows the machine slows both.
Charts show seconds: the median ratio times the reference's median seconds over the whole study.
"""

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mgs import runtime
from mgs.memory import padded

REFERENCE = 10_000, 320, 240
"""Gaussians, width and height of the reference, which renders REFERENCE_CALLS times with gradients.
"""

REFERENCE_CALLS = 10

LEAST_SECONDS, MOST_REPEATS = 0.8, 15
"""A call is repeated until its times add up to so many seconds, at most so often."""

Result = TypeVar("Result")


@functools.cache
def reference_of(count: int, width: int, height: int) -> Callable[[], Any]:
    """The reference of this size, with its kernels compiled."""
    runtime.start()
    import mitsuba as mi

    from mgs.splat import ListCache, as_drjit
    from studies.bench import gradient, surface_camera, surface_gaussians

    gaussians, cache = surface_gaussians(count), ListCache()
    camera, device = surface_camera(gaussians, width, height), as_drjit(gaussians)
    weights = mi.TensorXf(padded(np.ones((camera.height, camera.width, 3))))

    def call() -> None:
        for _ in range(REFERENCE_CALLS):
            for part in gradient(device, camera, weights, cache):
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
