"""What this machine reaches at most, measured: floating-point operations and divisions a second,
and bytes a second from each cache. All with Dr.Jit's number of threads.

No call that is timed is so short that starting it would count. Of several calls the fastest counts,
since a limit is wanted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.errors import InputError

CACHES = Path("/sys/devices/system/cpu/cpu0/cache")
"""Where Linux says how large the caches are."""

REPEATS = 15
"""Calls of each measurement. The first ones compile and allocate; the fastest counts."""

WIDEST = 64
"""Bytes of the widest SIMD register of today's processors."""

SECONDS = 0.005
"""A measurement of bandwidth takes at least this long, by an estimate of 20 GB/s."""


def cache_sizes() -> dict[str, int]:
    """Bytes of "L1" (data), "L2" and "L3", those of one core, or shared. Raises InputError where
    the system does not tell."""
    sizes = {}
    for index in sorted(CACHES.glob("index*")):
        level, kind, size = (
            (index / name).read_text().strip() for name in ("level", "type", "size")
        )
        if kind != "Instruction":
            sizes[f"L{level}"] = int(size.rstrip("K")) * 1024
    if not {"L1", "L2", "L3"} <= sizes.keys():
        raise InputError(
            f"{CACHES}: no sizes of three caches; the roofline needs Linux on a processor that tells them"
        )
    return sizes


def kernel_seconds(call: Callable[[], Any]) -> float:
    """Seconds of the last kernel that a call starts, by Dr.Jit's own clock, without the time to
    record it: the fastest of REPEATS calls."""
    seconds = []
    for _ in range(REPEATS):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(call())
            dr.sync_thread()
            seconds.append(1e-3 * dr.kernel_history([dr.KernelType.JIT])[-1]["execution_time"])
    return min(seconds)


def operation_rate(
    operation: Callable[[Any], Any], real: Any, lanes: int = 1 << 16, rounds: int = 64
) -> float:
    """How often a second an operation is done, in 8 independent chains for each SIMD lane, on
    registers.

    operation: a function of a number of type `real` (mi.Float or mi.Float64). A quarter of these
    lanes Dr.Jit often gives all to one thread.
    """

    def body(i: Any, chains: list[Any]) -> Any:
        for _ in range(16):
            chains = [operation(value) for value in chains]
        return i + 1, chains

    x = dr.arange(real, lanes) * (1 / lanes) + 1
    dr.eval(x)
    start = [x + i for i in range(8)]
    seconds = kernel_seconds(
        lambda: sum(dr.while_loop((mi.UInt32(0), start), lambda i, _: i < rounds, body)[1])
    )
    return 8 * 16 * lanes * rounds / seconds


def peak_flops(real: Any = None) -> float:
    """Floating-point operations a second of FMAs, each of which is two. real: their type, mi.Float
    if not given."""
    real = real or mi.Float
    scale = dr.opaque(real, 0.999)
    return 2 * operation_rate(lambda value: dr.fma(value, scale, scale), real)


def division_rate(real: Any) -> float:
    """Divisions a second of numbers of type `real`."""
    one = dr.opaque(real, 1.5)
    return operation_rate(lambda value: one / value, real, rounds=4)


def local_bandwidth(size: int, lanes: int = 1 << 12, rounds: int = 64) -> float:
    """Bytes a second, read and written, of a local array of at most `size` bytes: every number of
    it is read, multiplied and written back, again and again. It lies in the first cache if it is
    smaller than that.

    This is how kernels keep the state of their loops, and it takes whole registers, as NumPy's
    loops do not on all processors.
    """
    count = size // WIDEST
    scale, end = dr.opaque(mi.Float, 0.999), dr.opaque(mi.UInt32, rounds)
    x = dr.arange(mi.Float, lanes) * (1 / lanes)
    dr.eval(x)

    def body(i: Any, numbers: Any) -> Any:
        for k in range(count):
            numbers[k] = numbers[k] * scale
        return i + 1, numbers

    def call() -> Any:
        start = dr.zeros(mi.UInt32, lanes), dr.alloc_local(mi.Float, count, value=x)
        return dr.while_loop(start, lambda i, _: i < end, body)[1][0]

    return 2 * 4 * count * lanes * rounds / kernel_seconds(call)


def stream_bandwidth(size: int) -> float:
    """Bytes a second, read and written, of two arrays that together have `size` bytes for each
    thread: b += a, again and again.

    One call of NumPy does this many times, in a loop in C, so the cost of the call does not count.
    """
    n, threads = size // 8, dr.thread_count()
    rounds = max(round(20e9 * SECONDS / (12 * n)), 1)
    arrays = [(np.ones(n, np.float32), np.zeros(n, np.float32)) for _ in range(threads)]

    def add(pair: tuple[np.ndarray, np.ndarray]) -> None:
        np.add.reduce(np.broadcast_to(pair[0], (rounds, n)), axis=0, out=pair[1])

    seconds = []
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(REPEATS):
            start = time.perf_counter()
            list(pool.map(add, arrays))
            seconds.append(time.perf_counter() - start)
    return 12 * n * rounds * threads / min(seconds)


def address_rate(size: int, lanes: int = 1 << 18) -> float:
    """Numbers a second that are read at random addresses of an array of `size` bytes for each
    thread, in a kernel in which each lane makes 16 such reads that do not wait for one another."""
    count, reads = size * dr.thread_count() // 4, 16
    array, seed = dr.arange(mi.Float, count), dr.opaque(mi.UInt32, 1)
    dr.eval(array)

    def call() -> Any:
        lane = dr.arange(mi.UInt32, lanes) * reads + seed
        at = (
            dr.mul_hi((lane + i) * 2654435769, mi.UInt32(count)) for i in range(reads)
        )  # a multiplicative hash (Knuth)
        return sum(dr.gather(mi.Float, array, index) for index in at)

    return reads * lanes / kernel_seconds(call)


def machine_limits(report: Callable[[str], None]) -> dict[str, Any]:
    """All limits of this machine; report(what) is called before each group of measurements.

    "flops", "flops64": FMAs count twice; "divisions", "divisions64"; "bandwidth": bytes a second
    from "L1", "L2", "L3" and "memory"; "addresses": numbers a second, read at random addresses of
    an array that L3 holds; "working_set": the bytes for each thread with which each bandwidth was
    measured (addresses use that of L3); "cache_bytes" of `cache_sizes`.
    """
    sizes, threads = cache_sizes(), dr.thread_count()
    sets = {
        "L1": sizes["L1"] // 2,
        "L2": sizes["L2"] // 2,
        "L3": min(4 * sizes["L2"], sizes["L3"] // 2 // threads),
        "memory": 4 * sizes["L3"] // threads,
    }
    report("peak arithmetic")
    rates = {
        "flops": peak_flops(), "flops64": peak_flops(mi.Float64),
        "divisions": division_rate(mi.Float), "divisions64": division_rate(mi.Float64),
    }  # fmt: skip
    report("bandwidth of the caches and of memory")
    bandwidth = {"L1": local_bandwidth(sets["L1"])} | {
        name: stream_bandwidth(sets[name]) for name in ("L2", "L3", "memory")
    }
    rates["addresses"] = address_rate(sets["L3"])
    return rates | {"bandwidth": bandwidth, "working_set": sets, "cache_bytes": sizes}
