"""Time the splatting kernels and Mitsuba's own splatting integrator, `volprim_rf_basic`.

The scene is a rock of surface Gaussians in an image of 640x480 pixels. Kernels are compiled and
memory is allocated before anything is timed: let nothing else run meanwhile. Times are medians.
Ratios of times are about the same on other machines; times are not.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs import Camera, Gaussians, ListCache, as_drjit, fisher, render, runtime
from mgs.files import check_new_file, write_json
from mgs.memory import padded
from mgs.provenance import versions
from mgs.reports.tables import markdown
from studies.frame.program import Study, Work, at_least, study_of
from studies.frame.timing import gradient, peak_megabytes, surface_camera, surface_gaussians

WARM_UP = 2
"""Untimed calls before the timed ones: they compile kernels and allocate memory."""


def median_seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median wall-clock seconds of `repeats` calls, after WARM_UP untimed ones.

    The result of each call is evaluated within its time.
    """
    seconds = []
    for i in range(repeats + WARM_UP):
        start = time.perf_counter()
        dr.eval(call())
        dr.sync_thread()
        if i >= WARM_UP:
            seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def time_core(gaussians: Gaussians, camera: Camera, repeats: int) -> dict[str, float]:
    """Time each operation on these Gaussians (NumPy fields); seconds by name.

    forward_cold builds the block lists of the view in each call, and the others keep them:
    forward_warm renders, gradient_warm is `gradient`, fisher_exact and fisher_block are
    `mgs.splat.fisher`.
    """
    device, cache = as_drjit(gaussians), ListCache()
    weights = mi.TensorXf(
        padded(np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)))
    )
    dr.eval(device, weights)
    calls: dict[str, Callable[[], Any]] = {
        "forward_cold": lambda: render(device, camera).rgb,
        "forward_warm": lambda: render(device, camera, cache=cache).rgb,
        "gradient_warm": lambda: gradient(device, camera, weights, cache),
        "fisher_exact": lambda: fisher(device, camera, "exact", cache=cache),
        "fisher_block": lambda: fisher(device, camera, "block", cache=cache),
    }
    return {name: median_seconds(call, repeats) for name, call in calls.items()}


def volprim_scene(gaussians: Gaussians, camera: Camera) -> Any:
    """Mitsuba scene of the Gaussians, with the integrator `volprim_rf_basic`."""
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    forward = camera.world_to_camera[2, :3]
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volprim_rf_basic"},
            "sensor": {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.K[0, 0]))),
                "fov_axis": "x",
                "to_world": mi.ScalarTransform4f().look_at(
                    camera.position, camera.position + forward, [0, 0, 1]
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width,
                    "height": camera.height,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                },
            },
            "gaussians": {
                "type": "ellipsoids",
                "centers": mi.TensorXf(padded(gaussians.means)),
                "scales": mi.TensorXf(padded(np.exp(gaussians.log_scales))),
                "quaternions": mi.TensorXf(padded(quats[:, [1, 2, 3, 0]])),
                "opacities": mi.TensorXf(padded(gaussians.opacities[:, None])),
                "sh_coeffs": mi.TensorXf(padded(gaussians.sh.reshape(len(gaussians), -1))),
            },
        }
    )


def time_volprim(gaussians: Gaussians, camera: Camera, repeats: int) -> dict[str, float]:
    """Time Mitsuba's integrator: volprim_forward, an image; volprim_gradient, an image and the
    gradients of its sum; seconds."""
    scene = volprim_scene(gaussians, camera)
    parameters = mi.traverse(scene)
    names = ["gaussians.data", "gaussians.opacities", "gaussians.sh_coeffs"]

    def backward() -> list[Any]:
        dr.enable_grad([parameters[name] for name in names])
        parameters.update()
        dr.backward(dr.sum(mi.render(scene, parameters, spp=1), axis=None))
        return [dr.grad(parameters[name]) for name in names]

    primal = median_seconds(lambda: mi.render(scene, spp=1), repeats)
    return {"volprim_forward": primal, "volprim_gradient": median_seconds(backward, repeats)}


def bench_splat(n: int, width: int, height: int, repeats: int) -> dict[str, Any]:
    """Measure what the program prints: n Gaussians in an image of width x height pixels.

    Returns "scene"; "seconds" of each operation; "ratios", time of Mitsuba's integrator over ours
    (..._speedup) and of the Fisher information over that of image and gradient; and
    "peak_memory_megabytes" of the process before Mitsuba's integrator is loaded.
    """
    gaussians = surface_gaussians(n)
    camera = surface_camera(gaussians, width, height)
    own = time_core(gaussians, camera, repeats)
    memory = peak_megabytes()
    peer = time_volprim(gaussians, camera, max(repeats // 3, 3))
    ratios = {
        "forward_warm_speedup": peer["volprim_forward"] / own["forward_warm"],
        "forward_cold_speedup": peer["volprim_forward"] / own["forward_cold"],
        "gradient_warm_speedup": peer["volprim_gradient"] / own["gradient_warm"],
        "fisher_over_gradient": own["fisher_exact"] / own["gradient_warm"],
        "block_fisher_over_gradient": own["fisher_block"] / own["gradient_warm"],
    }
    return {
        "scene": {"gaussians": n, "width": width, "height": height, "repeats": repeats},
        "seconds": own | peer,
        "ratios": ratios,
        "peak_memory_megabytes": memory,
    }


def write(work: Work) -> list[Path]:
    """Print the measurements; with --json, write them with the command, machine and versions."""
    options = work.options
    if options.json is not None:
        check_new_file(options.json)  # before minutes of measuring
    runtime.start()
    result = bench_splat(options.gaussians, 640, 480, options.repeats)
    seconds = [(key.replace("_", " "), f"{1e3 * s:.1f}") for key, s in result["seconds"].items()]
    ratios = [(key.replace("_", " "), f"{ratio:.3g}") for key, ratio in result["ratios"].items()]
    print(markdown(("operation", "milliseconds"), seconds))
    print(markdown(("ratio", "measured"), ratios))
    print(f"peak memory {result['peak_memory_megabytes']:.0f} MB")
    if options.json is None:
        return []
    made = {"command": work.command, "machine": runtime.processor(), "versions": versions()}
    write_json(options.json, result | made)
    return [options.json]


STUDY = Study(
    "bench",
    __doc__,
    write,
    options={
        "--json": {"type": Path, "help": "Write all measurements to this file."},
        "--gaussians": {"type": at_least(1000), "default": 100_000, "help": "Default: 100,000."},
        "--repeats": {
            "type": at_least(3),
            "default": 9,
            "help": "Calls of each operation; the median counts. Default: 9.",
        },
    },
)

if __name__ == "__main__":
    study_of("bench")()
