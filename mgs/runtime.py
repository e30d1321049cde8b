"""Start of Dr.Jit and Mitsuba: find a usable libLLVM, then set Mitsuba's variant unless one is set.
libLLVM older than 19 aborts the process inside a kernel without an exception, so it is checked
before any kernel runs. tools/setup.sh uses this module before anything is installed."""

import contextlib
import ctypes
import glob
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path

from mgs.errors import InputError

VARIANT = "llvm_ad_rgb"  # default variant: compiled by LLVM, differentiable, RGB, single precision
VARIANT_VARIABLE = "MGS_VARIANT"  # names another variant, as cuda_ad_rgb for an NVIDIA GPU
MIN_LLVM = 19  # 14 and 15 cannot compile the minimum and maximum of floats
LIBRARY_VARIABLE = "DRJIT_LIBLLVM_PATH"  # from which Dr.Jit takes the path of libLLVM

_DRJIT_FOLDERS = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib/wsl/lib")
_OTHER_FOLDERS = ("/usr/lib/llvm-*/lib", "/usr/lib64", "/usr/lib", "/usr/local/lib")
_GOOD = (
    f"version {MIN_LLVM} or newer (`apt-get install libllvm{MIN_LLVM}` or "
    f"`conda install -c conda-forge libllvm{MIN_LLVM}`)"
)


@dataclass(frozen=True)
class Libllvm:
    """A loadable libLLVM: its path, or a name that the loader finds, and (major, minor, patch)."""

    path: str
    version: tuple[int, int, int]

    def __str__(self) -> str:
        return f"{'.'.join(map(str, self.version))} ({self.path})"


def load_libllvm(path: str) -> Libllvm:
    """Load a library and read its version. Raises InputError if it does not load or is not libLLVM.
    `find_libllvm` adds the correction to the message."""
    try:
        library = ctypes.CDLL(path)
    except OSError as error:
        absent = "/" in path and not Path(path).exists()
        reason = "no such file" if absent else f"does not load ({error})"
        raise InputError(f"libLLVM {path}: {reason}") from None
    if hasattr(library, "LLVMGetVersion"):  # since LLVM 16
        numbers = [ctypes.c_uint() for _ in range(3)]
        library.LLVMGetVersion(*map(ctypes.byref, numbers))
        major, minor, patch = (number.value for number in numbers)
        return Libllvm(path, (major, minor, patch))
    if not hasattr(library, "LLVMContextCreate"):
        raise InputError(f"libLLVM {path}: is another library, not libLLVM")
    version = re.search(r"libLLVM-(\d+)", os.path.realpath(path))
    return Libllvm(path, (int(version[1]) if version else 15, 0, 0))


def find_libllvm() -> Libllvm:
    """Find the libLLVM to use: Dr.Jit's choice if it is new enough, else the newest on the system.

    Dr.Jit tries the path in DRJIT_LIBLLVM_PATH, `libLLVM.so` by name, and the highest version in
    the system's library folder. If DRJIT_LIBLLVM_PATH is set, only that one is considered. Raises
    InputError if there is no libLLVM of version 19 or newer."""
    explicit = os.environ.get(LIBRARY_VARIABLE)
    candidates = [explicit] if explicit else _candidates()
    problems = []
    for path in candidates:
        try:
            library = load_libllvm(path)
        except InputError as error:
            problems.append(str(error))
            continue
        if library.version[0] >= MIN_LLVM:
            return library
        problems.append(f"libLLVM {path}: is version {library.version[0]}, older than {MIN_LLVM}")
    if explicit:
        named = f"{problems[0]}, but {LIBRARY_VARIABLE} names it"
        raise InputError(f"{named}; unset that, or let it name {_GOOD}")
    raise InputError(f"{problems[0] if problems else 'libLLVM: none found'}; install {_GOOD}")


def _candidates() -> list[str]:
    """Paths of libraries to try: in Dr.Jit's order, then those where it does not look."""
    usual = _installed(_DRJIT_FOLDERS, "libLLVM*.so.*")
    prefixes = {sys.prefix, os.environ.get("CONDA_PREFIX", sys.prefix)}
    more = (*(f"{prefix}/lib" for prefix in sorted(prefixes)), *_OTHER_FOLDERS)
    paths = list(dict.fromkeys(usual + _installed(more, "libLLVM*.so*")))
    try:
        ctypes.CDLL("libLLVM.so")
    except OSError:
        return paths
    return ["libLLVM.so", *paths]


def _installed(folders: tuple[str, ...], pattern: str) -> list[str]:
    """Real paths of files that match, highest version first; as in Dr.Jit, 19 comes before 9."""
    paths = [path for folder in folders for path in glob.glob(f"{folder}/{pattern}")]

    def version(path: str) -> list[tuple[int, int, str]]:
        parts = re.split(r"(\d+)", path)
        return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in parts]

    return [os.path.realpath(path) for path in sorted(paths, key=version, reverse=True)]


def start() -> None:
    """Set Mitsuba's variant, or check the one that is set. Further calls cost nothing.

    Set is the one that MGS_VARIANT names, else VARIANT. Raises InputError if the variant is not
    differentiable RGB in single precision; for one of LLVM if no libLLVM of version 19 or newer is
    found, or if Dr.Jit cannot use this processor with it; for one of CUDA if Dr.Jit finds no GPU.
    """
    variant = os.environ.get(VARIANT_VARIABLE) or VARIANT
    if "mitsuba" not in sys.modules and variant.startswith("llvm"):
        _choose_libllvm()
    if "HOME" not in os.environ:  # Dr.Jit would print a line and compile every kernel anew
        os.environ.setdefault("DRJIT_CACHE_DIR", os.path.expanduser("~/.drjit"))
    import mitsuba as mi

    if mi.variant() in _checked:
        return
    if mi.variant() is None:
        _set_variant(variant)
    _prepare_variant()
    _checked.add(mi.variant())


_checked: set[str] = set()  # variants that `start` has accepted in this process


def _set_variant(name: str) -> None:
    import drjit as dr
    import mitsuba as mi

    where = f"{VARIANT_VARIABLE}={name}"
    if name not in mi.variants():
        choice = f"choose {VARIANT} or cuda_ad_rgb"
        raise InputError(f"{where}: Mitsuba has no such variant; {choice}")
    if name.startswith("llvm"):
        _choose_libllvm()
        _check_libllvm()
    elif name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise InputError(f"{where}: Dr.Jit finds no NVIDIA GPU; unset it to use the processor")
    mi.set_variant(name)
    resolver = mi.file_resolver()  # would find plugins/*.so of the current folder first
    resolver.clear()
    resolver.append(os.path.dirname(str(mi.__file__)))


def _choose_libllvm() -> None:
    """Point Dr.Jit to a usable libLLVM."""
    library = find_libllvm()
    if "/" in library.path:
        os.environ[LIBRARY_VARIABLE] = library.path


ORDER_OPTION = b"-enable-misched=false"  # of LLVM: keeps the order of a kernel's instructions


def _keep_order() -> None:
    """Keep LLVM's machine scheduler from reordering instructions; results do not change. It would
    spill registers: up to a seventh more instructions (docs/splatting.md)."""
    with contextlib.suppress(InputError, AttributeError, OSError):
        library = ctypes.CDLL(find_libllvm().path)
        arguments = (ctypes.c_char_p * 2)(b"mgs", ORDER_OPTION)
        library.LLVMParseCommandLineOptions(len(arguments), arguments, None)


def _check_libllvm() -> None:
    import drjit as dr

    version = dr.detail.llvm_version()
    if version[0] < 0:
        needs = "it needs x86-64 with AVX and FMA, or ARM64"
        raise InputError(f"Dr.Jit cannot use libLLVM {find_libllvm()} on this processor; {needs}")
    if version[0] < MIN_LLVM:
        early = f"Dr.Jit was started with libLLVM {version[0]} before mgs could choose"
        raise InputError(f"{early}; let {LIBRARY_VARIABLE} name {_GOOD}")


def _prepare_variant() -> None:
    import drjit as dr
    import mitsuba as mi

    differentiable = dr.is_jit_v(mi.Float) and dr.is_diff_v(mi.Float)
    if not (differentiable and mi.is_rgb and dr.type_v(mi.Float) == dr.VarType.Float32):
        other = f"Mitsuba's variant {mi.variant()} is set, and mgs needs differentiable RGB in"
        raise InputError(f"{other} single precision; take {VARIANT} (the default) or cuda_ad_rgb")
    if dr.backend_v(mi.Float) == dr.JitBackend.LLVM:
        _check_libllvm()
        _keep_order()


def processor() -> dict[str, str | int]:
    """Processor as Dr.Jit sees it, after `start`: "variant", "cpu" (LLVM's name), "simd_width"
    (float32 lanes) and "threads". "cpu" and "simd_width" are "unknown" if Dr.Jit does not tell."""
    import drjit as dr
    import mitsuba as mi

    core = ctypes.CDLL(str(Path(str(dr.__file__)).with_name("libdrjit-core.so")))
    facts: dict[str, str | int] = {"variant": mi.variant(), "threads": dr.thread_count()}
    facts |= {"cpu": "unknown", "simd_width": "unknown"}
    # C++ names of jit_llvm_target_cpu() and jit_llvm_vector_width().
    with contextlib.suppress(AttributeError):
        core._Z19jit_llvm_target_cpuv.restype = ctypes.c_char_p
        facts["cpu"] = core._Z19jit_llvm_target_cpuv().decode()
        facts["simd_width"] = core._Z21jit_llvm_vector_widthv()
    return facts


def check_kernel() -> None:
    """Run a kernel that old versions of LLVM cannot compile. Raises InputError if wrong."""
    import drjit as dr
    import mitsuba as mi

    smallest = dr.minimum(mi.Float(1, 2, 3), mi.Float(2))
    if smallest.numpy().tolist() != [1, 2, 2]:
        raise InputError(f"Dr.Jit gives wrong numbers with this libLLVM; install {_GOOD}")
