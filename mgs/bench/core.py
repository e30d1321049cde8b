"""Timings of the splatting kernels: beside Mitsuba's own splatting integrator, and as the work
grows. All times are medians.

Kernels are compiled, and memory is allocated, before anything is timed. Ratios of times are about
the same on other machines; times are not.
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs import runtime
from mgs.bench.machine import peak_flops
from mgs.bench.work import KernelWork, count_work
from mgs.camera import Camera, look_at
from mgs.gaussians import LEARNED, Gaussians, sh_from_rgb
from mgs.memory import padded
from mgs.rotation import quat_from_normals
from mgs.seeds import derive_seed, generator
from mgs.splat import ListCache, as_drjit, fisher, render
from mgs.splat.blocks import BLOCK_X, BLOCK_Y
from mgs.splat.projection import camera_array, project
from mgs.splat.walking import PIXELS, TOGETHER

TARGETS = {
    "forward_warm_speedup": ("at least", 60.0),
    "forward_cold_speedup": ("at least", 25.0),
    "gradient_warm_speedup": ("at least", 60.0),
    "fisher_over_gradient": ("at most", 1.2),
    "block_fisher_over_gradient": ("at most", 2.0),
    "tiny_forward_ms": ("at most", 5.0),
}
"""What this project asks of itself, by the names in "figures" of `bench_splat`: `mgs bench splat`
prints them beside what was measured. *_speedup: time of Mitsuba's integrator over ours;
*_over_gradient: time of the Fisher information over that of image and gradient; tiny_forward_ms:
milliseconds."""

WARM_UP = 2
"""Number of calls before those that are timed: they compile kernels and allocate memory."""


def surface_gaussians(n: int, seed: int = 0) -> Gaussians:
    """n flat Gaussians at random points on the surface of the default rock.

    Their standard deviations are 0.8, 0.8 and 0.2 spacings (the square root of area / n), their
    opacity is 0.73 (logit 1), their colours are random. These are the Gaussians for which the
    TARGETS were set.
    """
    import trimesh

    from mgs.synth.noise import Noise
    from mgs.synth.rock import rock_shape
    from mgs.synth.scene_file import load_scene_file

    mesh, _ = rock_shape(load_scene_file("boulder").rock, Noise(generator(seed, "bench/rock")))
    points, faces = trimesh.sample.sample_surface(mesh, n, seed=derive_seed(seed, "bench/points"))
    spacing = np.sqrt(mesh.area / n)
    return Gaussians(
        means=np.asarray(points, np.float32),
        log_scales=np.tile(np.log(spacing * np.array([0.8, 0.8, 0.2])), (n, 1)).astype(np.float32),
        quats=quat_from_normals(mesh.face_normals[faces]).astype(np.float32),
        logit_opacities=np.full(n, 1.0, np.float32),
        sh=sh_from_rgb(generator(seed, "bench/colours").uniform(0.1, 0.6, (n, 3))),
    )


def surface_camera(gaussians: Gaussians, width: int, height: int) -> Camera:
    """A camera with an image of width x height pixels, 25 degrees above the horizon and three radii
    away from the Gaussians, which fill its image."""
    low, high = gaussians.means.min(axis=0), gaussians.means.max(axis=0)
    centre, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    pose = look_at(centre + 3 * radius * np.array([np.cos(0.44), 0.0, np.sin(0.44)]), centre)
    x, y, z = (gaussians.means @ pose[:3, :3].T + pose[:3, 3]).T
    focal = 0.49 * min(width / np.abs(x / z).max(), height / np.abs(y / z).max())
    return Camera(
        np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), width, height, pose
    )


def turned_cameras(camera: Camera, gaussians: Gaussians, count: int) -> list[Camera]:
    """`count` other cameras: the camera turned about the vertical axis through the middle of the
    Gaussians, in even steps.

    Intrinsics, distance and elevation stay the same, so that the number of (splat, block) pairs is
    similar (within 6 % for 100,000 Gaussians).
    """
    to_centre = np.eye(4)
    to_centre[:3, 3] = -(gaussians.means.min(axis=0) + gaussians.means.max(axis=0)) / 2
    cameras = []
    for angle in 2 * np.pi * np.arange(1, count + 1) / (count + 1):
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose = camera.world_to_camera @ np.linalg.inv(to_centre) @ turn @ to_centre
        cameras.append(Camera(camera.K, camera.width, camera.height, pose))
    return cameras


def median_seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median of the wall-clock seconds of `repeats` calls, after WARM_UP calls that do not count.
    What a call returns is evaluated by Dr.Jit within its time."""
    seconds = []
    for i in range(repeats + WARM_UP):
        start = time.perf_counter()
        dr.eval(call())
        dr.sync_thread()
        if i >= WARM_UP:
            seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def gradient(
    gaussians: Gaussians, camera: Camera, weights: Any, cache: ListCache | None
) -> list[Any]:
    """Render, then differentiate: gradients of a weighted sum of the image with respect to each of
    LEARNED.

    weights: TensorXf [H,W,3]; cache: as `mgs.splat.render`.
    """
    dr.enable_grad([getattr(gaussians, name) for name in LEARNED])
    loss = dr.sum(render(gaussians, camera, cache=cache).rgb * weights, axis=None)
    dr.backward(loss)
    gradients = [dr.grad(getattr(gaussians, name)) for name in LEARNED]
    dr.disable_grad([getattr(gaussians, name) for name in LEARNED])
    return gradients


def time_core(
    gaussians: Gaussians, camera: Camera, repeats: int, blocks: bool = True
) -> dict[str, float]:
    """Seconds of each operation on these Gaussians (NumPy fields).

    forward_cold: render a view that was never seen before, another one in each call, so that its
    block lists must be built. The
    other operations see the same camera again, whose lists are kept: forward_warm, render;
    gradient_warm, `gradient`; fisher_exact and, if `blocks`, fisher_block, `mgs.splat.fisher` with
    these estimators. Also pairs: the number of (splat, block) pairs of the camera; list_bytes:
    memory of its lists, bytes.
    """
    device, cache = as_drjit(gaussians), ListCache()
    new_views = iter(turned_cameras(camera, gaussians, repeats + WARM_UP))
    weights = mi.TensorXf(
        padded(np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)))
    )
    dr.eval(device, weights)
    seconds = {
        "forward_cold": median_seconds(lambda: render(device, next(new_views)).rgb, repeats),
        "forward_warm": median_seconds(lambda: render(device, camera, cache=cache).rgb, repeats),
        "gradient_warm": median_seconds(lambda: gradient(device, camera, weights, cache), repeats),
        "fisher_exact": median_seconds(
            lambda: fisher(device, camera, "exact", cache=cache), repeats
        ),
    }
    if blocks:
        seconds["fisher_block"] = median_seconds(
            lambda: fisher(device, camera, "block", cache=cache), repeats
        )
    lists, _ = cache.get(camera, project(device, camera_array(camera)))
    pairs = float(np.sum(np.asarray(lists.end).astype(np.int64) - np.asarray(lists.start)))
    return seconds | {"pairs": pairs, "list_bytes": float(cache.nbytes)}


def volprim_scene(gaussians: Gaussians, camera: Camera) -> Any:
    """The Gaussians as a scene of Mitsuba's own integrator for them, `volprim_rf_basic`, seen by
    the camera."""
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
    """Seconds of Mitsuba's own integrator for such Gaussians, `volprim_rf_basic`: volprim_forward,
    an image; volprim_gradient, an image and the gradients of its sum."""
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


def flops_per_pair(call: Callable[[], Any], lanes: int) -> float:
    """Floating-point operations of a call for each (splat, block) pair, counted in the LLVM IR of
    the kernels that walk through
    block lists: those with this number of lanes, that of the image's blocks, in their first loops.
    An FMA counts as two."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.eval(call())
        found = [
            entry for entry in dr.kernel_history([dr.KernelType.JIT]) if entry["size"] == lanes
        ]
    total = 0.0
    for counted in (count_work(entry["ir"].getvalue()) for entry in found):
        for work in counted.loops[:1]:
            total += (work.flops + work.flops64) / pairs_in_an_iteration(counted)
    return total


def pairs_in_an_iteration(walk: KernelWork) -> int:
    """How many (splat, block) pairs the first loop of a walk draws in one iteration. A walk that
    stores sums draws one; it is known by its second loop, which writes zeros."""
    return 1 if len(walk.loops) > 1 else TOGETHER


def bench_splat(
    n: int, width: int, height: int, repeats: int, report: Callable[[str], None]
) -> dict[str, Any]:
    """Measure what `mgs bench splat` prints and writes: n Gaussians in an image of width x height
    pixels.

    report(what) is called before each measurement. Returns "scene"; "seconds" of each operation;
    "figures", those of TARGETS; "pairs" (splat, block); "pixel_splat_pairs_per_second";
    "peak_gflops_measured" and "share_of_peak" that the kernels reach; "list_megabytes" of a
    camera's block lists; "peak_memory_megabytes" of the process before Mitsuba's integrator is
    loaded.
    """
    gaussians = surface_gaussians(n)
    camera = surface_camera(gaussians, width, height)
    report("splatting")
    own = time_core(gaussians, camera, repeats)
    report("a tiny image")
    tiny = surface_gaussians(1000)
    tiny_device, tiny_camera, cache = as_drjit(tiny), surface_camera(tiny, 64, 48), ListCache()
    tiny_seconds = median_seconds(lambda: render(tiny_device, tiny_camera, cache=cache).rgb, 20)
    memory = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / 1e3
    report("Mitsuba's volprim_rf_basic")
    peer = time_volprim(gaussians, camera, max(repeats // 3, 3))
    report("peak arithmetic")
    peak = peak_flops()
    device, lanes = as_drjit(gaussians), -(-width // BLOCK_X) * -(-height // BLOCK_Y)
    forward = flops_per_pair(lambda: render(device, camera).rgb, lanes)
    exact = flops_per_pair(lambda: fisher(device, camera), lanes)
    pixels = own["pairs"] * PIXELS
    ratios = {
        "forward_warm_speedup": peer["volprim_forward"] / own["forward_warm"],
        "forward_cold_speedup": peer["volprim_forward"] / own["forward_cold"],
        "gradient_warm_speedup": peer["volprim_gradient"] / own["gradient_warm"],
        "fisher_over_gradient": own["fisher_exact"] / own["gradient_warm"],
        "block_fisher_over_gradient": own["fisher_block"] / own["gradient_warm"],
        "tiny_forward_ms": 1e3 * tiny_seconds,
    }
    return {
        "scene": {"gaussians": n, "width": width, "height": height, "repeats": repeats},
        "seconds": {k: v for k, v in (own | peer).items() if k not in ("pairs", "list_bytes")},
        "figures": ratios,
        "pairs": int(own["pairs"]),
        "pixel_splat_pairs_per_second": {
            "forward": pixels / own["forward_warm"],
            "fisher_exact": 2 * pixels / own["fisher_exact"],
        },
        "peak_gflops_measured": peak / 1e9,
        "share_of_peak": {
            "forward": forward * own["pairs"] / own["forward_warm"] / peak,
            "fisher_exact": exact * own["pairs"] / own["fisher_exact"] / peak,
        },
        "list_megabytes": own["list_bytes"] / 1e6,
        "peak_memory_megabytes": memory,
    }


def bench_scaling(
    repeats: int, report: Callable[[str], None], most: int = 1_000_000
) -> list[dict[str, Any]]:
    """Measure `scaling_point` along four sweeps; returns a record for each point. most: largest
    number N of Gaussians.

    gaussians: N grows, at 640x480. pixels: the image grows, at N = 100,000. both: N and the number
    of pixels grow together, with 640x480 at 100,000; a Gaussian then keeps its number of pairs, and
    only the number of all (splat, block) pairs grows.
    threads: one, and all. A record holds "sweep", "n", "pixels", "threads" and what `scaling_point`
    returns. report(what) is called before each point.
    """
    threads = dr.thread_count()
    numbers = [n for n in (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000) if n <= most]
    points = [("gaussians", n, 640, 480, threads) for n in numbers]
    base = min(100_000, most)
    points += [
        ("pixels", base, w, h, threads)
        for w, h in ((160, 120), (320, 240), (640, 480), (1280, 960))
    ]
    points += [
        ("both", n, round(640 * (n / 1e5) ** 0.5), round(480 * (n / 1e5) ** 0.5), threads)
        for n in numbers
    ]
    points += [("threads", base, 640, 480, t) for t in sorted({1, threads})]
    records = []
    for sweep, n, width, height, count in points:
        report(f"{n:,} Gaussians, {width}x{height}, {count} thread{'' if count == 1 else 's'}")
        where = {"sweep": sweep, "n": n, "pixels": width * height, "threads": count}
        records.append(where | in_new_process(scaling_point, n, width, height, count, repeats))
    return records


def scaling_point(
    n: int, width: int, height: int, threads: int, repeats: int, blocks: bool = True
) -> dict[str, float]:
    """What `time_core` returns, with this many threads, and peak_bytes: the most memory that Dr.Jit
    has held in this process."""
    dr.set_thread_count(threads)
    gaussians = surface_gaussians(n)
    seconds = time_core(gaussians, surface_camera(gaussians, width, height), repeats, blocks)
    return seconds | {"peak_bytes": float(dr.detail.malloc_watermark(dr.JitBackend.LLVM))}


def in_new_process(
    call: Callable[..., Any], *arguments: Any, initializer: Callable[[], None] = runtime.start
) -> Any:
    """Call a function in a new process, after `initializer`, and return its result, so that nothing
    is left over from earlier
    calls: no memory, no recorded kernel, no block list. The functions and the arguments must be
    picklable."""
    spawn = multiprocessing.get_context("spawn")  # Dr.Jit's threads do not survive a fork
    with ProcessPoolExecutor(1, spawn, initializer=initializer) as pool:
        return pool.submit(call, *arguments).result()
