"""Would a native kernel be twice as fast? `python benchmarks/native_forward/compare.py`

Composites a view of `mgs bench` (100,000 Gaussians, 640x480) with the kernel of mgs and with
forward.cpp (g++ -O3), from the same block lists, in alternating rounds on two threads.
Prints the medians of the kernels, and of the whole call: mgs's, and mgs's with the other kernel.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import drjit as dr
import numpy as np

from mgs import bench, runtime
from mgs.splat import ListCache, as_drjit, render
from mgs.splat.projection import camera_array, projected

runtime.start()
ROUNDS, CALLS, THREADS = 5, 15, 2
gaussians = bench.surface_gaussians(100_000)
camera, cache = bench.surface_camera(gaussians, 640, 480), ListCache()
model = as_drjit(gaussians)
image = np.asarray(render(model, camera, cache=cache).rgb)
lists, packed = cache.get(camera, projected(model, camera_array(camera)))
pairs = int((np.asarray(lists.end) - np.asarray(lists.start)).sum())
own, whole, native = [], [], []
with tempfile.TemporaryDirectory() as folder:
    for name, values in {"block": lists.block, "start": lists.start, "end": lists.end}.items():
        np.asarray(values).astype(np.int32).tofile(f"{folder}/{name}.bin")
    np.asarray(lists.splat).astype(np.int32).tofile(f"{folder}/splat.bin")
    np.asarray(packed).tofile(f"{folder}/packed.bin")
    np.array([camera.width, camera.height], np.int32).tofile(f"{folder}/size.bin")
    source = Path(__file__).with_name("forward.cpp")
    build = ["g++", "-O3", "-march=native", "-std=c++17", "-pthread", str(source)]
    subprocess.run([*build, "-o", f"{folder}/forward"], check=True)
    run = [f"{folder}/forward", folder, str(THREADS), str(CALLS)]
    for _ in range(ROUNDS):
        for _ in range(CALLS):
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                dr.kernel_history_clear()
                dr.eval(render(model, camera, cache=cache).rgb)
                dr.sync_thread()
                times = {
                    k["size"]: k["execution_time"] for k in dr.kernel_history([dr.KernelType.JIT])
                }
            own.append(times[len(np.asarray(lists.block))])
        whole.append(
            1e3 * bench.median_seconds(lambda: render(model, camera, cache=cache).rgb, CALLS)
        )
        native += map(
            float, subprocess.run(run, check=True, capture_output=True, text=True).stdout.split()
        )
    drawn = np.fromfile(f"{folder}/native.bin", np.float32).reshape(-1, 5, 4, 8)[:, :3]
blocks = np.empty((120, 80, 3, 4, 8), np.float32)
blocks.reshape(-1, 3, 4, 8)[np.asarray(lists.block)] = drawn
theirs = blocks.transpose(0, 3, 1, 4, 2).reshape(480, 640, 3)
decibels = -10 * np.log10(np.square(theirs - image).mean())
mine, call, other = (float(np.median(values)) for values in (own, whole, native))
print(f"{pairs:,} pairs; images agree to {decibels:.0f} dB")
print(f"kernel: {mine:.2f} ms, native {other:.2f} ms ({mine / other:.2f} times)")
print(
    f"call: {call:.2f} ms, with the native kernel {call - mine + other:.2f} ms "
    f"({call / (call - mine + other):.2f} times)",
    file=sys.stdout,
)
