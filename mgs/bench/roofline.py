"""Where each splatting kernel stands against the limits of this machine: a roofline (Williams,
Waterman and Patterson 2009).

The work of a kernel is counted in its LLVM IR (`mgs.bench.work`) and multiplied by how often its
loop runs, which follows from the block lists. Its time is told by Dr.Jit's own clock. The limits
are measured (`mgs.bench.machine`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.bench.core import (
    WARM_UP,
    gradient,
    pairs_in_an_iteration,
    surface_camera,
    surface_gaussians,
)
from mgs.bench.machine import machine_limits
from mgs.bench.work import Work, count_work
from mgs.camera import Camera
from mgs.gaussians import Gaussians
from mgs.memory import padded
from mgs.splat import ListCache, as_drjit, blocks, fisher, kernels, render
from mgs.splat.blocks import BlockLists
from mgs.splat.projection import camera_array, project, project64
from mgs.splat.walking import AT_ONCE, pack

ROOFS = ("FMA", "division", "instructions", "L1")
"""Limits on a kernel, whatever its data: all its additions and multiplications at the measured rate
of FMAs; its divisions at that of divisions; every vector instruction in the time of an FMA; all its
bytes at the bandwidth of the first cache."""

SUPPLIES = ("L2", "L3", "memory", "addresses")
"""Where the bytes of arrays may come from; "addresses": every number or packet that a lane reads or
writes by itself comes from another line of L3. Only hardware counters could tell where they really
come from."""

BOUND = 0.5
"""A kernel is called bound by a limit that alone takes at least this share of its time."""


@dataclass
class Kernel:
    """One kernel as it was run. kind: "JIT" (compiled), "Memset" (clears memory) or another of
    Dr.Jit's own; size: its lanes, or the bytes cleared; ir: its LLVM IR, empty if not compiled;
    seconds: its time."""

    kind: str
    size: int
    ir: str
    seconds: float


def run_kernels(call: Callable[[], Any], repeats: int) -> list[Kernel]:
    """The kernels that a call starts, in their order, each with the shortest of its times in
    `repeats` calls.

    What the call returns is evaluated within it. WARM_UP calls come before; recorded kernels are so
    replayed when timed.
    """
    runs = []
    for _ in range(WARM_UP + repeats):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(call())
            dr.sync_thread()
            runs.append([_kernel(entry) for entry in dr.kernel_history()])
    for same in zip(*runs[WARM_UP:], strict=True):
        same[0].seconds = min(kernel.seconds for kernel in same)
    return runs[WARM_UP]


def _kernel(entry: dict[str, Any]) -> Kernel:
    """One entry of Dr.Jit's kernel history."""
    ir = entry["ir"].getvalue() if "ir" in entry else ""
    return Kernel(entry["type"].name, entry["size"], ir, 1e-3 * entry["execution_time"])


def trips(length: np.ndarray, width: int) -> tuple[int, int]:
    """How often lanes run their loop that follow lists of these lengths, int [L], summed over
    lanes: those that are busy, and
    all, as a register goes on until its last lane is done. width: lanes of a register."""
    padded = np.pad(length, (0, -len(length) % width)).reshape(-1, width)
    return int(padded.sum()), width * int(padded.max(axis=1).sum())


def kernel_row(name: str, unit: str, kernel: Kernel, lists: BlockLists) -> dict[str, Any]:
    """What is known of one kernel: "name"; "seconds"; "each", the `Work` of a lane for one `unit`:
    of its loop for one iteration; "useful" and "executed", the `Work` of all busy lanes, and of all
    lanes.

    A kernel's first loop follows the block lists where there is a lane for each block,
    `pairs_in_an_iteration`, and all pairs
    count: that a block skips the rest of its list once its pixels are finished is left out, and so
    is the second loop, which then writes zeros. Else it follows the pairs of each splat, AT_ONCE in
    an iteration. Of memory that is cleared only the bytes are known.
    """
    if kernel.kind != "JIT":
        cleared = Work(bytes=kernel.size)
        return _row(name, kernel.seconds, unit, Work(bytes=1), cleared, cleared)
    counted = count_work(kernel.ir)
    lanes = -(-kernel.size // counted.width) * counted.width
    if not counted.loops:
        return _row(
            name,
            kernel.seconds,
            unit,
            counted.straight,
            counted.straight * kernel.size,
            counted.straight * lanes,
        )
    walks = kernel.size == len(lists.block)
    start, end = (lists.start, lists.end) if walks else (lists.slot_start, lists.slot_end)
    length, loop = np.asarray(end).astype(np.int64) - np.asarray(start), counted.loops[0]
    busy, every = trips(
        -(-length // (pairs_in_an_iteration(counted) if walks else AT_ONCE)), counted.width
    )
    useful, executed = (
        counted.straight * kernel.size + loop * busy,
        counted.straight * lanes + loop * every,
    )
    return _row(name, kernel.seconds, unit, loop, useful, executed)


def _row(
    name: str, seconds: float, unit: str, each: Work, useful: Work, executed: Work
) -> dict[str, Any]:
    works = {"each": asdict(each), "useful": asdict(useful), "executed": asdict(executed)}
    return {"name": name, "seconds": seconds, "unit": unit} | works


def step_row(
    name: str, unit: str, count: int, found: list[Kernel], lists: BlockLists
) -> dict[str, Any]:
    """The kernels of a step whose work grows with the `count` of some unit, together: as
    `kernel_row`, with the useful work of a unit for "each", and "own_seconds", the time of what
    Dr.Jit brings compiled: sorts, prefix sums and copies, whose work is not counted."""
    rows = [
        kernel_row(name, "", kernel, lists) for kernel in found if kernel.kind in ("JIT", "Memset")
    ]
    useful, executed = (
        sum((Work(**row[key]) for row in rows), Work()) for key in ("useful", "executed")
    )
    seconds = sum(kernel.seconds for kernel in found)
    own = seconds - sum(row["seconds"] for row in rows)
    return _row(name, seconds, unit, useful * (1 / count), useful, executed) | {"own_seconds": own}


def operation_rows(operation: str, found: list[Kernel], lists: BlockLists) -> list[dict[str, Any]]:
    """A row for each kernel of an operation that walks through block lists: its walks, and the
    adding up of their sums. Kernels that take less than a hundredth of its time are left out."""
    least = 0.01 * sum(kernel.seconds for kernel in found)
    walks = [kernel for kernel in found if kernel.ir and kernel.size == len(lists.block)]
    rows = []
    for kernel in found:
        if kernel.kind not in ("JIT", "Memset") or kernel.seconds < least:
            continue
        what, unit = (
            ("clear memory", "byte")
            if kernel.kind == "Memset"
            else ("add up", f"{AT_ONCE} pairs of a splat")
        )
        if kernel in walks:
            what = "walk" if len(walks) == 1 else f"walk {1 + walks.index(kernel)}"
            together = pairs_in_an_iteration(count_work(kernel.ir))
            unit = "pair" if together == 1 else f"{together} pairs of a block"
        rows.append(
            kernel_row(
                operation if len(found) == 1 else f"{operation}: {what}", unit, kernel, lists
            )
        )
    return rows


def after_loops(found: list[Kernel]) -> list[Kernel]:
    """The kernels behind the last one with a loop: from the sums over pixels to derivatives by
    parameters."""
    last = max(i for i, kernel in enumerate(found) if kernel.ir and count_work(kernel.ir).loops)
    return found[last + 1 :]


def roofline_rows(
    gaussians: Gaussians, camera: Camera, repeats: int, report: Callable[[str], None]
) -> list[dict[str, Any]]:
    """A row for each kernel that draws or differentiates, and one for each step that grows with the
    number of Gaussians or of pixels.

    report(what) is called before each operation.
    """
    device, cache, place = as_drjit(gaussians), ListCache(), camera_array(camera)
    splats, splats64 = project(device, place), project64(device, place)
    dr.eval(device, splats, splats64)
    lists, packed = cache.get(camera, splats)
    packed64, tangents = (
        pack(splats64, lists.place),
        kernels.pack_tangents(splats, splats, lists.place),
    )
    out, whole = kernels.forward(lists, packed, False), kernels.forward(lists, packed, True)
    noise = (
        np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    )
    d_out, d_whole = (
        tuple(mi.Float(padded(np.resize(noise, len(a)))) for a in arrays) for arrays in (out, whole)
    )
    weights, background = (
        mi.TensorXf(noise),
        mi.Color3f(*(dr.opaque(mi.Float, 0.0) for _ in range(3))),
    )
    dr.eval(out, whole, d_out, d_whole, weights)
    walks = {
        "forward": lambda: kernels.forward(lists, packed, False),
        "forward: alpha and depth": lambda: kernels.forward(lists, packed, True),
        "jvp": lambda: kernels.jvp(lists, packed, tangents),
        "adjoint": lambda: kernels.adjoint(lists, packed, out, d_out, False, 3),
        "adjoint: alpha and depth": lambda: kernels.adjoint(
            lists, packed, whole, d_whole, False, 5
        ),
        "exact Fisher": lambda: kernels.fisher(lists, packed, background, False),
        "block Fisher": lambda: kernels.fisher(lists, packed64, background, True),
    }
    steps = {
        "projection": lambda: project(device, place),
        "packing": lambda: pack(splats, lists.place),
        "lists tested, and packing": lambda: cache.get(camera, splats)[1],
        "block lists": lambda: blocks.build(splats, camera.width, camera.height),
    }
    wholes = {
        "pixels row by row": lambda: render(device, camera, cache=cache).rgb,
        "sums to gradient": lambda: gradient(device, camera, weights, cache),
        "sums to exact Fisher": lambda: fisher(device, camera, "exact", cache=cache),
        "sums to block Fisher": lambda: fisher(device, camera, "block", cache=cache),
    }
    rows = []
    for name, call in (walks | steps | wholes).items():
        report(name)
        found = run_kernels(call, repeats)
        if name in walks:
            rows += operation_rows(name, found, lists)
        else:
            of = (
                ("pixel", camera.width * camera.height)
                if name == "pixels row by row"
                else ("Gaussian", len(gaussians))
            )
            rows.append(step_row(name, *of, found if name in steps else after_loops(found), lists))
    return rows


def limit_shares(row: dict[str, Any], limits: dict[str, Any]) -> dict[str, float]:
    """What share of its time a kernel would take if one limit alone held, for each of ROOFS and
    SUPPLIES.

    row: from `kernel_row` or `step_row`; limits: of `machine_limits`. All lanes count, since a
    register works for all.
    """
    work, bandwidth = Work(**row["executed"]), limits["bandwidth"]
    seconds = {
        "FMA": work.flops / limits["flops"] + work.flops64 / limits["flops64"],
        "division": work.divisions / limits["divisions"] + work.divisions64 / limits["divisions64"],
        "instructions": 2 * work.instructions / limits["flops"],
        "L1": (work.bytes + work.state_bytes) / bandwidth["L1"],
    } | {name: work.bytes / bandwidth[name] for name in SUPPLIES[:-1]}
    seconds["addresses"] = work.addresses / limits["addresses"]
    return {name: value / row["seconds"] for name, value in seconds.items()}


def verdict(share: dict[str, float], own: float = 0.0) -> str:
    """Which limit bounds a kernel, as far as the shares of `limit_shares` tell.

    own: the share of its time in what Dr.Jit brings compiled. Where a level would need more than
    the whole time, not all bytes can come from it.
    """
    sorts = "Dr.Jit's sorts and prefix sums"
    if own >= BOUND:
        return sorts
    roof = max(ROOFS, key=lambda name: share[name])
    if share[roof] >= BOUND:
        return roof
    supply = next((name for name in SUPPLIES if share[name] >= BOUND), None)
    if supply is None and own and own + share["addresses"] >= BOUND:  # one after the other
        return f"{sorts}, and addresses"
    if supply is None:
        return f"none; nearest is {max(share, key=lambda name: share[name])}"
    if supply == "addresses":
        return "addresses, if they lie in L3"
    return (
        f"{supply}, if its bytes come from there"
        if share[supply] <= 1
        else f"{supply}, if part of its bytes come from there"
    )


def placed(row: dict[str, Any], limits: dict[str, Any]) -> dict[str, Any]:
    """A row and where it stands: the keys that `bench_roofline` adds."""
    useful, work = Work(**row["useful"]), Work(**row["executed"])
    flops, share = work.flops + work.flops64, limit_shares(row, limits)
    return row | {
        "lanes_active": useful.instructions / work.instructions if work.instructions else 1.0,
        "gflops": flops / row["seconds"] / 1e9,
        "intensity": flops / (work.bytes + work.state_bytes),
        "array_intensity": flops / work.bytes,
        "shares": share,
        "verdict": verdict(share, row.get("own_seconds", 0.0) / row["seconds"]),
    }


def bench_roofline(
    n: int, width: int, height: int, repeats: int, report: Callable[[str], None]
) -> dict[str, Any]:
    """Measure what `mgs bench roofline` prints and writes: n Gaussians in an image of width x
    height pixels.

    report(what) is called before each measurement. Returns "scene"; "limits" of `machine_limits`;
    "kernels", the rows of `roofline_rows`, each with "lanes_active", the share of busy lanes;
    "gflops", operations of all lanes, a second, in single and double precision; "intensity",
    operations a byte of arrays and state, and "array_intensity", of arrays alone; "shares" of
    `limit_shares`; "verdict". Raises InputError where the system does not tell the sizes of its
    caches.
    """
    gaussians = surface_gaussians(n)
    camera = surface_camera(gaussians, width, height)
    limits = machine_limits(report)
    rows = [placed(row, limits) for row in roofline_rows(gaussians, camera, repeats, report)]
    return {
        "scene": {"gaussians": n, "width": width, "height": height, "repeats": repeats},
        "limits": limits,
        "kernels": rows,
    }
