"""Speed against accuracy of the core: image, gradient and Fisher information, against the float64
oracle.

Errors are measured on a scene small enough for the oracle's dense Jacobian; times both there, where
a call is mostly overhead, and at a working size. An error is the largest over all entries, relative
to the largest entry of the oracle; parameters have different units, so each kind of parameter is
compared by itself, and the worst kind counts.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.gaussians import Gaussians
from mgs.memory import padded
from mgs.study.chart.plan import PLANS, Plan
from mgs.study.chart.timing import timed
from mgs.study.sweep import Cell

SMALL = 150, (48, 36)
"""Number of Gaussians, and size of the image, of the scene on which errors are measured."""

CALLS = 5
"""Number of calls that are timed together, since one takes only milliseconds."""


@dataclass(frozen=True)
class Scene:
    """Gaussians of a rock, a camera that they fill, and an image by which gradients are weighted
    [H,W,3]."""

    gaussians: Gaussians
    camera: Camera
    weights: np.ndarray


@functools.cache
def scene(n: int, size: tuple[int, int]) -> Scene:
    """The scene of the core's benchmarks."""
    from mgs.bench.core import surface_camera, surface_gaussians

    gaussians = surface_gaussians(n)
    camera = surface_camera(gaussians, *size)
    weights = (
        np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    )
    return Scene(gaussians, camera, weights)


Call = Callable[[], np.ndarray]


def image(where: Scene) -> Call:
    """The image [H,W,3]."""
    from mgs.splat import ListCache, as_drjit, render

    device, cache = as_drjit(where.gaussians), ListCache()
    return lambda: np.asarray(render(device, where.camera, cache=cache).rgb)


def gradient(where: Scene) -> Call:
    """The gradient of the weighted sum of the image, [N,11]."""
    import mitsuba as mi

    from mgs.bench.core import gradient as parts
    from mgs.splat import ListCache, as_drjit

    device, cache, weights = (
        as_drjit(where.gaussians),
        ListCache(),
        mi.TensorXf(padded(where.weights)),
    )
    n = len(where.gaussians)

    def call() -> np.ndarray:
        return np.concatenate(
            [
                np.asarray(part).reshape(n, -1)
                for part in parts(device, where.camera, weights, cache)
            ],
            1,
        )

    return call


def information(where: Scene, estimator: str, **options: Any) -> Call:
    """Fisher information [N,11], or the blocks [N,11,11]."""
    from mgs.splat import ListCache, as_drjit, fisher

    device, cache = as_drjit(where.gaussians), ListCache()
    return lambda: np.asarray(fisher(device, where.camera, estimator, cache=cache, **options))


def volprim(where: Scene) -> Call:
    """The image [H,W,3] by Mitsuba's own integrator, which traces rays and so differs by design."""
    import mitsuba as mi

    from mgs.bench.core import volprim_scene

    made = volprim_scene(where.gaussians, where.camera)
    return lambda: np.asarray(mi.render(made, spp=1))


def rows_of(plan: Plan) -> dict[str, tuple[str, Callable[[Scene], Call]]]:
    """{name: (what it computes, what makes the call)}."""
    found: dict[str, tuple[str, Callable[[Scene], Call]]] = {
        "render": ("image", image),
        "volprim_rf_basic": ("image", volprim),
        "adjoint": ("gradient", gradient),
        "exact": ("diagonal", partial(information, estimator="exact")),
        "block": ("blocks", partial(information, estimator="block")),
    }
    for k in plan.probes:
        found[f"hutchinson {k}"] = (
            "diagonal",
            partial(information, estimator="hutchinson", probes=k),
        )
    return found


def oracle(what: str, where: Scene) -> np.ndarray:
    """The same in float64 NumPy (`mgs.splat.reference`)."""
    from mgs.splat import reference

    if what == "image":
        return np.asarray(reference.render(where.gaussians, where.camera)["rgb"])
    if what == "gradient":
        J = reference.jacobian(where.gaussians, where.camera)
        return np.einsum("pcnk,pc->nk", J, where.weights.reshape(-1, 3).astype(np.float64))
    function = reference.fisher if what == "diagonal" else reference.fisher_block
    return np.asarray(function(where.gaussians, where.camera))


def error(found: np.ndarray, truth: np.ndarray, what: str) -> float:
    """Largest error over the largest entry of the truth; of gradients and information the worst
    over the kinds of parameters, of blocks after each entry is divided by sqrt(H_ii H_jj)."""
    from mgs.splat import groups

    difference = np.abs(found - truth)
    if what == "image":
        return float(difference.max() / np.abs(truth).max())
    if what == "blocks":
        diagonal = np.sqrt(np.maximum(np.einsum("nii->ni", truth), 0))
        scale = diagonal[:, :, None] * diagonal[:, None, :]
        return float((difference[scale > 0] / scale[scale > 0]).max())
    return float(
        max(difference[:, kind].max() / np.abs(truth[:, kind]).max() for kind in groups(0).values())
    )


def cells(plan: Plan, repeats: int, preset: str) -> list[Cell]:
    """A cell for each row. preset: the name of the plan."""
    return [
        Cell(
            cell_name(name),
            "mgs.study.chart.core:measure",
            {"row": name, "preset": preset, "repeats": repeats},
            alone=True,
        )
        for name in rows_of(plan)
    ]


def cell_name(row: str) -> str:
    """The name of the cell of a row."""
    return f"core/{row.replace(' ', '-')}"


def measure(root: Path, out: Path, row: str, preset: str, repeats: int) -> dict[str, Any]:
    """Error of a row on the small scene, and its times (`timed`) at the working size; small_wall:
    seconds on the small one."""
    from mgs import runtime

    runtime.start()
    plan = PLANS[preset]
    what, make = rows_of(plan)[row]
    small = scene(*SMALL)
    found, on_small = _of_one_call(make(small), repeats)
    _, times = _of_one_call(make(scene(plan.core_gaussians, plan.core_size)), repeats)
    return {
        **times,
        "small_wall": on_small["wall"],
        "error": error(found, oracle(what, small), what),
    }


def _of_one_call(call: Call, repeats: int) -> tuple[np.ndarray, dict[str, float]]:
    """What a call returns, and its times; the reference's are left as they are."""
    results, times = timed(lambda: [call() for _ in range(CALLS)], repeats)
    return results[-1], {
        name: value / (1 if name == "reference" else CALLS) for name, value in times.items()
    }


def rows(plan: Plan, found: dict[str, Any], command: str) -> list[dict[str, Any]]:
    """What every row computes, its times and its error."""
    return [
        {"row": name, "computes": what, **found[cell_name(name)], "command": command}
        for name, (what, _) in rows_of(plan).items()
    ]
