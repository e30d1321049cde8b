"""Times that can be compared although the machine is busy with other work, now more and now less.

A call is timed several times, and each time a fixed piece of work, the *reference*, is timed just
before it in the same process. What slows the machine down slows both, so their ratio stays, and the
median of the ratios is what the charts show.
They show it as seconds: the ratio times the reference's median over the whole study.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from mgs import runtime
from mgs.memory import padded

REFERENCE_GAUSSIANS, REFERENCE_SIZE, REFERENCE_CALLS = 10_000, (320, 240), 10
"""The reference: so many images of so many Gaussians of a rock, of this width and height, with
their gradients."""

LEAST_SECONDS, MOST_REPEATS = 0.8, 15
"""A call is timed again until its times add up to so many seconds, at most so often."""

Result = TypeVar("Result")


@functools.cache
def _reference() -> Callable[[], Any]:
    """The reference, ready to be called: its Gaussians made and its kernels compiled."""
    runtime.start()
    import mitsuba as mi

    from mgs.bench.core import gradient, surface_camera, surface_gaussians
    from mgs.splat import ListCache, as_drjit

    gaussians = surface_gaussians(REFERENCE_GAUSSIANS)
    camera, device, cache = (
        surface_camera(gaussians, *REFERENCE_SIZE),
        as_drjit(gaussians),
        ListCache(),
    )
    weights = mi.TensorXf(padded(np.ones((camera.height, camera.width, 3))))

    def call() -> None:
        for _ in range(REFERENCE_CALLS):
            for part in gradient(device, camera, weights, cache):
                np.asarray(part)

    call()
    return call


def _clock(call: Callable[[], Result]) -> tuple[Result, float, float]:
    """What a call returns, its wall-clock seconds, and the seconds of all cores that this process
    spent."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def timed(
    call: Callable[[], Result], repeats: int, reference: Callable[[], Any] | None = None
) -> tuple[Result, dict[str, float]]:
    """Call a function once untimed, which compiles its kernels, and then `repeats` times, each
    after the reference; more often where that takes less than LEAST_SECONDS together, since short
    times scatter most.

    It must return NumPy arrays or plain values, so that nothing is left to be computed when it
    returns. Returns the last result; and medians over the repeats: wall and cpu (seconds),
    reference (wall-clock seconds of the reference), ratio (wall over reference), and the extremes
    ratio_low and ratio_high.
    """
    reference = reference or _reference()
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


def with_seconds(rows: Sequence[dict[str, Any]], unit: float) -> list[dict[str, Any]]:
    """Rows with `seconds`, `seconds_low` and `seconds_high`: their ratios times the seconds of the
    reference. Rows without a ratio stay as they are."""
    names = {"seconds": "ratio", "seconds_low": "ratio_low", "seconds_high": "ratio_high"}
    return [
        row | {name: row[ratio] * unit for name, ratio in names.items() if ratio in row}
        for row in rows
    ]
