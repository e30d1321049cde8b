"""The machine code of the kernels that walk through block lists. `python benchmarks/machine_code.py
OUT.json`

Counted, not measured, so no other load on the machine disturbs it: for each kernel the instructions
of the loop that draws splats, for one (splat, block) pair and one SIMD register of lanes, and among
them the loads from the stack and the stores to it. A call of one of the functions with which Dr.Jit
reads or writes packets counts as one. Each of WAYS is a process of its own, in which libLLVM
compiles the kernels' IR and hands out the assembly.
"""

from __future__ import annotations

import ctypes
import re
import sys
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from variants import in_llvms_order, put

from mgs import runtime
from mgs.bench.core import in_new_process, pairs_in_an_iteration, surface_camera, surface_gaussians
from mgs.bench.roofline import run_kernels
from mgs.bench.work import count_work
from mgs.files import write_json
from mgs.memory import padded
from mgs.provenance import command_line, versions
from mgs.splat import ListCache, as_drjit, kernels
from mgs.splat.projection import camera_array, project, project64
from mgs.splat.walking import pack

WAYS = {
    "as it is": (lambda: None, in_new_process),
    "one splat at a time": (partial(put, TOGETHER=1), in_new_process),
    "pixels mixed by the compiler": (
        partial(put, computed_after=lambda x, before: x),
        in_new_process,
    ),
    "instructions in LLVM's order": (lambda: None, in_llvms_order),
    "all three": (partial(put, TOGETHER=1, computed_after=lambda x, before: x), in_llvms_order),
}
"""By name: what is replaced, and in which kind of process."""

STACK = r"-?\d*\(%r[sb]p\)"
"""An address on the stack."""


def assembly(ir: str) -> str:
    """What libLLVM makes of a kernel for this processor (x86-64). Raises ValueError where it
    refuses."""
    library, pointer = ctypes.CDLL(runtime.find_libllvm().path), ctypes.c_void_p
    for name in ("Info", "", "MC"):
        getattr(library, f"LLVMInitializeX86Target{name}")()
    library.LLVMInitializeX86AsmPrinter()

    def asked(name: str, *arguments: Any) -> Any:
        function = getattr(library, name)
        function.restype = pointer
        return pointer(function(*arguments))

    error, module, target, out = ctypes.c_char_p(), pointer(), pointer(), pointer()
    text, context, triple = (
        ir.encode(),
        asked("LLVMContextCreate"),
        asked("LLVMGetDefaultTargetTriple"),
    )
    held = asked(
        "LLVMCreateMemoryBufferWithMemoryRangeCopy", text, ctypes.c_size_t(len(text)), b"kernel"
    )
    failed = library.LLVMParseIRInContext(context, held, ctypes.byref(module), ctypes.byref(error))
    failed = failed or library.LLVMGetTargetFromTriple(
        triple, ctypes.byref(target), ctypes.byref(error)
    )
    if not failed:
        cpu, features = asked("LLVMGetHostCPUName"), asked("LLVMGetHostCPUFeatures")
        wide = ctypes.string_at(features.value).replace(b"+prefer-256-bit", b"-prefer-256-bit")
        machine = asked("LLVMCreateTargetMachine", target, triple, cpu, wide, 2, 2, 0)
        asked_for = machine, module, 0, ctypes.byref(error), ctypes.byref(out)
        failed = library.LLVMTargetMachineEmitToMemoryBuffer(*asked_for)
    if failed:
        raise ValueError((error.value or b"libLLVM refuses the kernel").decode())
    return ctypes.string_at(asked("LLVMGetBufferStart", out).value).decode()


def loop(code: str) -> list[str]:
    """The instructions of the loop that draws: of those with at least half of all FMAs the
    shortest. Around it lies the loop over the registers of lanes."""
    lines = code.splitlines()
    labels = {
        line.partition(":")[0]: i for i, line in enumerate(lines) if re.match(r"\.LBB\w+:", line)
    }
    jumps = [
        (i, labels.get(match[1], i))
        for i, line in enumerate(lines)
        if (match := re.match(r"\s+j\w+\s+(\.LBB\w+)", line))
    ]
    bodies = [
        [line for line in lines[to : at + 1] if re.match(r"\s+[a-z]", line)]
        for at, to in jumps
        if to < at
    ]
    fmas = [sum("vfm" in line or "vfn" in line for line in body) for body in bodies]
    return min(
        (body for body, count in zip(bodies, fmas, strict=True) if 2 * count >= max(fmas)), key=len
    )


def counts(ir: str) -> dict[str, float]:
    """Instructions of the loop for a pair, and among them those that read the stack and those that
    write there."""
    body, pairs = loop(assembly(ir)), pairs_in_an_iteration(count_work(ir))
    stores = sum(bool(re.search(rf"%[xyz]mm\d+, {STACK}", line)) for line in body)
    loads = sum(bool(re.search(rf"{STACK}[^%]*, %[xyzk]", line)) for line in body)
    return {"instructions": len(body) / pairs, "loads": loads / pairs, "stores": stores / pairs}


def measure(name: str) -> dict[str, dict[str, float]]:
    """The counts of each walk in one of WAYS, in a process of its own."""
    WAYS[name][0]()
    gaussians = surface_gaussians(2000)
    camera = surface_camera(gaussians, 160, 120)
    device, place = as_drjit(gaussians), camera_array(camera)
    splats, splats64 = project(device, place), project64(device, place)
    dr.eval(splats, splats64)
    lists, packed = ListCache().get(camera, splats)
    packed64, tangents = (
        pack(splats64, lists.place),
        kernels.pack_tangents(splats, splats, lists.place),
    )
    out = kernels.forward(lists, packed, False)
    d_out = (mi.Float(padded(np.random.default_rng(0).normal(size=len(out[0])))),)
    background = mi.Color3f(*(dr.opaque(mi.Float, 0.0) for _ in range(3)))
    dr.eval(out, d_out)
    walks = {
        "forward": lambda: kernels.forward(lists, packed, False),
        "forward: alpha and depth": lambda: kernels.forward(lists, packed, True),
        "jvp": lambda: kernels.jvp(lists, packed, tangents),
        "adjoint": lambda: kernels.adjoint(lists, packed, out, d_out, False, 3),
        "exact Fisher": lambda: kernels.fisher(lists, packed, background, False),
        "block Fisher": lambda: kernels.fisher(lists, packed64, background, True),
    }
    found = {}
    for name, call in walks.items():
        each = [
            kernel.ir
            for kernel in run_kernels(call, 1)
            if kernel.ir and kernel.size == len(lists.block)
        ]
        for number, ir in enumerate(each):
            found[f"{name}: walk {number + 1}" if len(each) > 1 else name] = counts(ir)
    return found


def main(out: Path) -> None:
    """Count and write."""
    found = {}
    for name, (_, process) in WAYS.items():
        found[name] = process(measure, name)
        print(name, found[name], flush=True)
    runtime.start()
    write_json(
        out,
        {
            "command": command_line(),
            "machine": runtime.processor(),
            "versions": versions(),
            "counts": found,
        },
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
