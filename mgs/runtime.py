"""Start Dr.Jit: find a libLLVM that works before any kernel runs, then set the variant, unless one is set.

Everything in mgs that computes with Dr.Jit calls `start` first. Dr.Jit loads a libLLVM of the system. Older ones than 19
abort the process in the middle of a kernel ("Cannot select: fminimum"), so the version is asked for first: loading a library
and calling LLVMGetVersion cannot abort. Needs nothing but the standard library until `start`: the set-up uses it before
anything is installed.
"""

from __future__ import annotations

import contextlib
import ctypes
import glob
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path

from mgs.errors import InputError

VARIANT = "llvm_ad_rgb"
MIN_LLVM = 19
"""LLVM 14 and 15 cannot lower float minimum and maximum; 19 and 22 are known to work."""

LIBRARY_VARIABLE = "DRJIT_LIBLLVM_PATH"
_DRJIT_FOLDERS = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib/wsl/lib")
_GOOD = f"version {MIN_LLVM} or newer (`apt-get install libllvm{MIN_LLVM}` or `conda install -c conda-forge libllvm{MIN_LLVM}`)"


@dataclass(frozen=True)
class Libllvm:
    """A libLLVM that loads: what to give to dlopen, and its (major, minor, patch)."""

    path: str
    version: tuple[int, int, int]

    def __str__(self) -> str:
        return f"{'.'.join(map(str, self.version))} ({self.path})"


def load_libllvm(path: str) -> Libllvm:
    """Load a library and ask for its version. Raises InputError (no remedy in it) where it does not load or is no libLLVM."""
    try:
        library = ctypes.CDLL(path)
    except OSError as error:
        reason = "no such file" if "/" in path and not Path(path).exists() else f"does not load ({error})"
        raise InputError(f"libLLVM {path}: {reason}") from None
    if hasattr(library, "LLVMGetVersion"):  # since LLVM 16
        numbers = [ctypes.c_uint() for _ in range(3)]
        library.LLVMGetVersion(*map(ctypes.byref, numbers))
        major, minor, patch = (number.value for number in numbers)
        return Libllvm(path, (major, minor, patch))
    if not hasattr(library, "LLVMContextCreate"):
        raise InputError(f"libLLVM {path}: is another library, not libLLVM")
    named = re.search(r"libLLVM-(\d+)", os.path.realpath(path))
    return Libllvm(path, (int(named[1]) if named else 15, 0, 0))


def find_libllvm() -> Libllvm:
    """The libLLVM to use: Dr.Jit's own choice where it is new enough, otherwise the newest good one on the system.

    Dr.Jit's order: DRJIT_LIBLLVM_PATH, `libLLVM.so`, the highest version in the library folder. A path that the user has
    set is honoured, even with an error. Raises InputError where there is no libLLVM, or none of version 19 or newer.
    """
    explicit = os.environ.get(LIBRARY_VARIABLE)
    candidates = [explicit] if explicit else _candidates()
    problems = []
    for path in candidates:
        try:
            found = load_libllvm(path)
        except InputError as error:
            problems.append(str(error))
            continue
        if found.version[0] >= MIN_LLVM:
            return found
        problems.append(f"libLLVM {path}: is version {found.version[0]}, older than {MIN_LLVM}")
    if explicit:
        raise InputError(f"{problems[0]}, but {LIBRARY_VARIABLE} names it; unset that, or let it name {_GOOD}")
    raise InputError(f"{problems[0] if problems else 'libLLVM: none found'}; install {_GOOD}")


def _candidates() -> list[str]:
    """Libraries in the order in which Dr.Jit and then we would try them, each file once."""
    usual = _installed(_DRJIT_FOLDERS, "libLLVM*.so.*")
    prefixes = {sys.prefix, os.environ.get("CONDA_PREFIX", sys.prefix)}
    more = [f"{prefix}/lib" for prefix in sorted(prefixes)] + [
        "/usr/lib/llvm-*/lib",
        "/usr/lib64",
        "/usr/lib",
        "/usr/local/lib",
    ]
    others = _installed(tuple(more), "libLLVM*.so*")
    try:
        ctypes.CDLL("libLLVM.so")
    except OSError:
        by_name = []
    else:
        by_name = ["libLLVM.so"]
    return by_name + list(dict.fromkeys(usual + others))


def _installed(folders: tuple[str, ...], pattern: str) -> list[str]:
    """Files that match in the folders, highest version first (numbers compared as numbers, as Dr.Jit does), links resolved."""
    paths = [path for folder in folders for path in glob.glob(f"{folder}/{pattern}")]

    def version(path: str) -> list[tuple[int, int, str]]:
        return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in re.split(r"(\d+)", path)]

    return [os.path.realpath(path) for path in sorted(paths, key=version, reverse=True)]


def start() -> None:
    """Make sure that a Mitsuba variant is set which mgs can compute with; what is set already stays.

    Where none is set, sets `llvm_ad_rgb` on a libLLVM that works. Calling it again costs nothing.
    Raises InputError where the variant that is set is not differentiable RGB (`scalar_rgb`, `llvm_ad_spectral`, ...), where no
    libLLVM of version 19 or newer is found, or where Dr.Jit cannot use this processor with it.
    """
    if "mitsuba" not in sys.modules:
        _choose_libllvm()
    import mitsuba as mi

    if mi.variant() in _checked:
        return
    if mi.variant() is None:
        _choose_libllvm()
        _check_libllvm()
        mi.set_variant(VARIANT)
    else:
        _check_variant()
    _checked.add(mi.variant())


_checked: set[str] = set()
"""Variants that have been looked at in this process."""


def _choose_libllvm() -> None:
    """Let Dr.Jit load a libLLVM that works. Raises InputError as `find_libllvm`."""
    library = find_libllvm()
    if "/" in library.path:
        os.environ[LIBRARY_VARIABLE] = library.path


def _check_libllvm() -> None:
    """Raises InputError where Dr.Jit has loaded no libLLVM, or an old one."""
    import drjit as dr

    used = dr.detail.llvm_version()
    if used[0] < 0:
        raise InputError(
            f"Dr.Jit cannot use libLLVM {find_libllvm()} on this processor; it needs x86-64 with AVX and FMA, or ARM64"
        )
    if used[0] < MIN_LLVM:
        raise InputError(
            f"Dr.Jit was started with libLLVM {used[0]} before mgs could choose; let {LIBRARY_VARIABLE} name {_GOOD}"
        )


def _check_variant() -> None:
    """Raises InputError where the variant that is set cannot run the kernels of mgs."""
    import drjit as dr
    import mitsuba as mi

    if not (dr.is_jit_v(mi.Float) and dr.is_diff_v(mi.Float) and mi.is_rgb and dr.type_v(mi.Float) == dr.VarType.Float32):
        raise InputError(
            f"Mitsuba's variant {mi.variant()} is set, and mgs needs differentiable RGB in single precision; "
            f"call mitsuba.set_variant('{VARIANT}') before mgs, or set none"
        )
    if dr.backend_v(mi.Float) == dr.JitBackend.LLVM:
        _check_libllvm()


def processor() -> dict[str, str | int]:
    """What kernels run on, after `start`: processor name as LLVM knows it, SIMD width in float32 lanes, threads of Dr.Jit."""
    import drjit as dr

    core = ctypes.CDLL(str(Path(str(dr.__file__)).with_name("libdrjit-core.so")))
    facts: dict[str, str | int] = {"threads": dr.thread_count(), "cpu": "unknown", "simd_width": "unknown"}
    with contextlib.suppress(AttributeError):  # C++ names: jit_llvm_target_cpu(), jit_llvm_vector_width()
        core._Z19jit_llvm_target_cpuv.restype = ctypes.c_char_p
        facts["cpu"] = core._Z19jit_llvm_target_cpuv().decode()
        facts["simd_width"] = core._Z21jit_llvm_vector_widthv()
    return facts


def check_kernel() -> None:
    """Run the smallest kernel that old LLVMs cannot compile. Raises InputError where its result is wrong."""
    import drjit as dr
    import mitsuba as mi

    smallest = dr.minimum(mi.Float(1, 2, 3), mi.Float(2))
    if smallest.numpy().tolist() != [1, 2, 2]:
        raise InputError(f"Dr.Jit gives wrong numbers with this libLLVM; install {_GOOD}")
