"""Start Dr.Jit and Mitsuba: find a libLLVM that works, then set Mitsuba's variant unless one is set
already.

Everything in mgs that computes with Dr.Jit calls `start` first. Dr.Jit compiles its kernels with a
libLLVM of the system. With a version older than 19 the process ends in the middle of a kernel
("Cannot select: fminimum"), and there is no exception to
catch. So the version is looked at before any kernel runs: loading a library and calling its
LLVMGetVersion is harmless.

Except for `start` and what comes after it, this module needs only Python's standard library:
tools/setup.sh uses it before anything is installed.
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
"""The variant that `start` sets: compiled by LLVM, with automatic differentiation, in RGB and
single precision."""

MIN_LLVM = 19
"""Least major version of libLLVM. 14 and 15 cannot compile the minimum and maximum of floats; 19
and 22 are known to work."""

LIBRARY_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""Environment variable from which Dr.Jit takes the path of libLLVM."""

_DRJIT_FOLDERS = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib/wsl/lib")
_GOOD = f"version {MIN_LLVM} or newer (`apt-get install libllvm{MIN_LLVM}` or `conda install -c conda-forge libllvm{MIN_LLVM}`)"


@dataclass(frozen=True)
class Libllvm:
    """A libLLVM that can be loaded. path: a path, or a name that the system's loader finds;
    version: (major, minor, patch)."""

    path: str
    version: tuple[int, int, int]

    def __str__(self) -> str:
        return f"{'.'.join(map(str, self.version))} ({self.path})"


def load_libllvm(path: str) -> Libllvm:
    """Load a library and ask it for its version. Raises InputError if it does not load or is not
    libLLVM.

    The message does not say how to mend it: `find_libllvm` adds that.
    """
    try:
        library = ctypes.CDLL(path)
    except OSError as error:
        reason = (
            "no such file"
            if "/" in path and not Path(path).exists()
            else f"does not load ({error})"
        )
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
    """The libLLVM to use: the one that Dr.Jit would choose if it is new enough, otherwise the
    newest other one on the system.

    Dr.Jit tries, in this order: the path in DRJIT_LIBLLVM_PATH, `libLLVM.so` by name, the highest
    version in the system's folder of libraries. If DRJIT_LIBLLVM_PATH is set, only that one is
    looked at, because the user chose it. Raises InputError if there is no libLLVM of version 19 or
    newer.
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
        raise InputError(
            f"{problems[0]}, but {LIBRARY_VARIABLE} names it; unset that, or let it name {_GOOD}"
        )
    raise InputError(f"{problems[0] if problems else 'libLLVM: none found'}; install {_GOOD}")


def _candidates() -> list[str]:
    """Paths of libraries to try, each file once: first in Dr.Jit's order, then those in folders
    where Dr.Jit does not look."""
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
    """Paths of the files in the folders that match the pattern, highest version first, with
    symbolic links resolved.

    As in Dr.Jit, numbers within names are compared as numbers: 19 comes before 9.
    """
    paths = [path for folder in folders for path in glob.glob(f"{folder}/{pattern}")]

    def version(path: str) -> list[tuple[int, int, str]]:
        return [
            (1, int(part), "") if part.isdigit() else (0, 0, part)
            for part in re.split(r"(\d+)", path)
        ]

    return [os.path.realpath(path) for path in sorted(paths, key=version, reverse=True)]


def start() -> None:
    """Make sure that Mitsuba has a variant that mgs can compute with. One that is set already
    stays; otherwise sets VARIANT.

    Calling it again costs nothing. Raises InputError if the variant that is set is not
    differentiable RGB in single precision (`scalar_rgb` and `llvm_ad_spectral` are not), if no
    libLLVM of version 19 or newer is found, or if Dr.Jit cannot use this processor with it.
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
    _keep_order()
    _checked.add(mi.variant())


_checked: set[str] = set()
"""Names of the variants that `start` has found good in this process."""


def _choose_libllvm() -> None:
    """Point Dr.Jit, by its environment variable, to a libLLVM that works. Raises InputError as
    `find_libllvm`."""
    library = find_libllvm()
    if "/" in library.path:
        os.environ[LIBRARY_VARIABLE] = library.path


ORDER_OPTION = b"-enable-misched=false"
"""Option of LLVM with which it keeps the order of a kernel's instructions."""


def _keep_order() -> None:
    """Tell the libLLVM that Dr.Jit uses to leave the order of instructions as it is. One that does
    not know the option, or was told before, says nothing and goes on as it was. What kernels
    compute does not depend on it.

    The kernels of `mgs.splat` are long pieces of straight code, written so that one pixel is
    finished before the next one needs registers. LLVM's machine scheduler would mix the pixels
    again, and keep on the stack what no longer fits into registers: up to a seventh more
    instructions (docs/splatting.md, What was tried).
    """
    with contextlib.suppress(InputError, AttributeError, OSError):
        library = ctypes.CDLL(find_libllvm().path)
        arguments = (ctypes.c_char_p * 2)(b"mgs", ORDER_OPTION)
        library.LLVMParseCommandLineOptions(len(arguments), arguments, None)


def _check_libllvm() -> None:
    """Raises InputError if Dr.Jit has loaded no libLLVM, or one that is too old."""
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
    """Raises InputError if the variant that is set cannot run the kernels of mgs."""
    import drjit as dr
    import mitsuba as mi

    if not (
        dr.is_jit_v(mi.Float)
        and dr.is_diff_v(mi.Float)
        and mi.is_rgb
        and dr.type_v(mi.Float) == dr.VarType.Float32
    ):
        raise InputError(
            f"Mitsuba's variant {mi.variant()} is set, and mgs needs differentiable RGB in single precision; "
            f"call mitsuba.set_variant('{VARIANT}') before mgs, or set none"
        )
    if dr.backend_v(mi.Float) == dr.JitBackend.LLVM:
        _check_libllvm()


def processor() -> dict[str, str | int]:
    """What kernels run on; call `start` before. "cpu": LLVM's name of the processor; "simd_width":
    number of float32 lanes; "threads": of Dr.Jit. The first two are "unknown" if Dr.Jit does not
    tell."""
    import drjit as dr

    core = ctypes.CDLL(str(Path(str(dr.__file__)).with_name("libdrjit-core.so")))
    facts: dict[str, str | int] = {
        "threads": dr.thread_count(),
        "cpu": "unknown",
        "simd_width": "unknown",
    }
    with contextlib.suppress(
        AttributeError
    ):  # C++ names: jit_llvm_target_cpu(), jit_llvm_vector_width()
        core._Z19jit_llvm_target_cpuv.restype = ctypes.c_char_p
        facts["cpu"] = core._Z19jit_llvm_target_cpuv().decode()
        facts["simd_width"] = core._Z21jit_llvm_vector_widthv()
    return facts


def check_kernel() -> None:
    """Run a small kernel of the kind that old versions of LLVM cannot compile. Raises InputError if
    its result is wrong."""
    import drjit as dr
    import mitsuba as mi

    smallest = dr.minimum(mi.Float(1, 2, 3), mi.Float(2))
    if smallest.numpy().tolist() != [1, 2, 2]:
        raise InputError(f"Dr.Jit gives wrong numbers with this libLLVM; install {_GOOD}")
