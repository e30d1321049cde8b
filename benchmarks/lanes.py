"""The core with AVX-512, with registers of half that size, and with AVX2: `python
benchmarks/lanes.py OUT.json`, alone.

Dr.Jit compiles kernels for the processor that it finds. Here it is also told to use registers of
half the size, of which AVX-512 has 32, and to compile for a processor that has 16 of these and no
AVX-512, with its own function for that (`jit_llvm_set_target`), in turn and each in a process of
its own. Measured are the operations of `mgs.bench.core.time_core` for 100,000 Gaussians at 640x480,
and how far images, gradients and Fisher information are from those of the float64 oracle
(`mgs.splat.reference`), of SMALL. Needs a processor with AVX-512.
"""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mgs import runtime
from mgs.bench.core import in_new_process, surface_camera, surface_gaussians, time_core
from mgs.errors import InputError
from mgs.files import write_json
from mgs.provenance import command_line, versions
from mgs.splat import fisher, reference, render

LANES = {"AVX-512": (16, ""), "AVX-512, 8 lanes": (8, ""), "AVX2": (8, "haswell")}
"""Lanes of float32 in a register, and the processor to compile for; "": the one that runs."""

SMALL = 300, 64, 48
"""Gaussians, and width and height of the image, that the oracle draws, too."""

ROUNDS, REPEATS = 4, 9


def set_lanes(count: int, processor: str = "haswell") -> None:
    """Let Dr.Jit compile for registers of 8 lanes of a processor, by LLVM's name for it or "" for
    the one that runs; with a count of 16 it stays as it is. Before the first kernel."""
    if count == 8:
        core = ctypes.CDLL(str(Path(dr.__file__).parent / "libdrjit-core.so"))
        set_target = (
            core._Z19jit_llvm_set_targetPKcS0_j
        )  # the name of the C++ function jit_llvm_set_target
        set_target.argtypes = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint]
        set_target.restype = None
        set_target((processor or runtime.processor()["cpu"]).encode(), b"", count)
    if (found := runtime.processor()["simd_width"]) != count:
        raise InputError(
            f"lanes: kernels have {found} lanes instead of {count}; run this where AVX-512 is"
        )


def measure(lanes: int, processor: str) -> dict[str, float]:
    """Seconds by operation, and the largest errors against the oracle over its largest number."""
    set_lanes(lanes, processor)
    model = surface_gaussians(100_000)
    found = time_core(model, surface_camera(model, 640, 480), REPEATS)
    n, width, height = SMALL
    small = surface_gaussians(n)
    camera = surface_camera(small, width, height)
    exact = reference.render(small, camera)["rgb"], reference.fisher(small, camera)
    ours = np.asarray(render(small, camera).rgb), fisher(small, camera)
    for name, a, b in zip(("image", "fisher"), ours, exact, strict=True):
        found[f"error_{name}"] = float(np.abs(a - b).max() / np.abs(b).max())
    return found


def main(out: Path) -> None:
    """Measure and write."""
    runtime.start()
    made: dict[str, Any] = {
        "command": command_line(),
        "machine": runtime.processor(),
        "versions": versions(),
        "rounds": ROUNDS,
    }
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in LANES}
    for _ in range(ROUNDS):
        for name, (lanes, processor) in LANES.items():
            runs[name].append(in_new_process(measure, lanes, processor))
            print(name, runs[name][-1], flush=True)
    made["fastest"] = {
        name: {key: min(run[key] for run in found) for key in found[0]}
        for name, found in runs.items()
    }
    first = runs["AVX-512"]
    made["ratios"] = {
        name: {
            key: [b[key] / a[key] for a, b in zip(first, found, strict=True)] for key in found[0]
        }
        for name, found in runs.items()
    }
    write_json(out, made)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
