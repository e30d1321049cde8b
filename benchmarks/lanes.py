"""The core with AVX-512 and with AVX2, in turn: `python benchmarks/lanes.py OUT.json`. Let nothing else run.

Dr.Jit compiles kernels for the processor that it finds. Here it is also told to compile them for one that has registers of half
the size and no AVX-512, with its own function for that (`jit_llvm_set_target`), in a process of its own. Measured are the
operations of `mgs.bench.core.time_core` for 100,000 Gaussians at 640x480, and how far images, gradients and Fisher information
are from those of the float64 oracle (`mgs.splat.reference`), of SMALL. Needs a processor with AVX-512.
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

LANES = {"AVX-512": 16, "AVX2": 8}
"""Lanes of float32 in a register."""

SMALL = 300, 64, 48
"""Gaussians, and width and height of the image, that the oracle draws, too."""

ROUNDS, REPEATS = 4, 9


def set_lanes(count: int) -> None:
    """Let Dr.Jit compile for AVX2 where `count` is 8; with 16 it stays as it is. Before the first kernel."""
    if count == 8:
        core = ctypes.CDLL(str(Path(dr.__file__).parent / "libdrjit-core.so"))
        set_target = core._Z19jit_llvm_set_targetPKcS0_j  # the name of the C++ function jit_llvm_set_target
        set_target.argtypes = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint]
        set_target.restype = None
        set_target(b"haswell", b"", count)
    if (found := runtime.processor()["simd_width"]) != count:
        raise InputError(f"lanes: kernels have {found} lanes instead of {count}; run this where AVX-512 is")


def measure(lanes: int) -> dict[str, float]:
    """Seconds by operation, and the largest errors against the oracle over its largest number."""
    set_lanes(lanes)
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
    made: dict[str, Any] = {"command": command_line(), "machine": runtime.processor(), "versions": versions(), "rounds": ROUNDS}
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in LANES}
    for _ in range(ROUNDS):
        for name, lanes in LANES.items():
            runs[name].append(in_new_process(measure, lanes))
            print(name, runs[name][-1], flush=True)
    made["lanes"] = {
        name: {key: float(np.median([run[key] for run in found])) for key in found[0]} for name, found in runs.items()
    }
    first, second = runs.values()
    ratios = {key: [b[key] / a[key] for a, b in zip(first, second, strict=True)] for key in made["lanes"]["AVX2"]}
    made["ratios"] = {key: [min(r), float(np.median(r)), max(r)] for key, r in ratios.items()}
    write_json(out, made)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
