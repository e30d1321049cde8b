"""Memory: checks that it suffices, bounded caches, and arrays for Dr.Jit."""

import ctypes
import re
import resource
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np

from mgs.errors import InputError

Value = TypeVar("Value")

IMAGE_BYTES = 1 << 30  # of arrays of one kind that are kept for reuse: 218 images of 640x480
VIEW_BYTES = 1 << 29  # of views' information about one model: 122 views of 100,000 Gaussians
KEPT_BYTES = 1 << 29  # of a process, up to which what is freed is kept for reuse, which is faster
LITTLE = 1 << 30  # bytes up to which `check_room` checks nothing, to be quick for small images
MEMORY_FILE = Path("/proc/meminfo")  # Linux's report of the memory that is free without swapping


def check_room(size: float, what: str, instead: str) -> None:
    """Raise InputError if `what` needs more bytes than are free, with what to do `instead`. The
    system would kill the process without a message. Systems that do not report free memory are
    trusted. Memory kept for reuse is released before anything is refused."""
    if size <= LITTLE or size <= _spare():
        return
    release()
    if size > (spare := _spare()):
        need, free = size / 2**30, spare / 2**30
        raise InputError(f"{what} may take {need:,.1f} GiB, {free:,.1f} GiB are free; {instead}")


def release(beyond: int = 0) -> None:
    """Return freed memory, which Dr.Jit and the C library keep for reuse, to the system, if this
    process holds more than `beyond` bytes."""
    if _held(1) <= beyond:
        return
    import drjit as dr

    dr.flush_malloc_cache()
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):  # of glibc only
        trim(0)


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Context manager in which this process gets no more memory than is free, so that a small file
    that claims to be huge cannot exhaust it. Raises InputError, which names the file, if that does
    not suffice. Systems that do not report free memory are trusted."""
    limits = resource.getrlimit(resource.RLIMIT_AS)
    spare = _spare()
    bounded = limits[0] == resource.RLIM_INFINITY and spare < float("inf")
    if bounded:
        most = int(_held(0) + spare)
        resource.setrlimit(resource.RLIMIT_AS, (most, limits[1]))
    try:
        yield
    except MemoryError:
        room = f"more than the {spare / 2**30:,.1f} GiB that are free"
        raise InputError(f"{path}: decoding it takes {room}; give a smaller file") from None
    finally:
        if bounded:
            resource.setrlimit(resource.RLIMIT_AS, limits)


def _held(kind: int) -> float:
    """Bytes of this process: 0, its address space; 1, in memory. Infinity if unknown."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()
    except OSError:
        return float("inf")
    return float(pages[kind]) * resource.getpagesize()


def _spare() -> float:
    """Free memory, bytes; infinity if the system does not report it."""
    try:
        line = re.search(r"MemAvailable:\s*(\d+) kB", MEMORY_FILE.read_text(encoding="ascii"))
    except OSError:
        return float("inf")
    return 1024.0 * int(line[1]) if line else float("inf")


PADDING = 64  # numbers that a kernel may read beyond an array's end: registers of at most 16
ALIGNMENT = 64  # bytes. Dr.Jit compiles another kernel for arrays that are not aligned so


def padded(values: Any, dtype: Any = np.float32) -> np.ndarray:
    """Copy an array into contiguous memory that begins at a multiple of ALIGNMENT and extends
    beyond its end.

    Every array that Dr.Jit takes over from NumPy must be one: it is not copied, and kernels read a
    few numbers beyond the end. The alignment decides which kernel is compiled."""
    values = np.asarray(values)
    memory = np.empty(values.size + PADDING + ALIGNMENT, dtype)
    first = -memory.ctypes.data % ALIGNMENT // memory.itemsize
    copy = memory[first : first + values.size].reshape(values.shape)
    copy[...] = values
    return copy


def adopted(values: Any) -> np.ndarray:
    """A float32 array for Dr.Jit: itself if it lies in memory as `padded` makes it, else a copy."""
    values = np.asarray(values, np.float32)
    memory = values.base
    if (
        isinstance(memory, np.ndarray)
        and memory.flags.c_contiguous
        and values.flags.c_contiguous
        and values.ctypes.data % ALIGNMENT == 0
    ):
        end = memory.ctypes.data + memory.nbytes
        if values.ctypes.data + values.nbytes + PADDING * values.itemsize <= end:
            return values
    return padded(values)


def kept_within(
    budget: int, make: Callable[[Any], Value], size: Callable[[Value], int]
) -> Callable[[Any], Value]:
    """Cache the results of `make` until their sizes sum to `budget` bytes. Later keys are made
    again at each call. A fit uses its images again and again in changing orders, for which an LRU
    cache would mostly drop what is needed next."""
    values: dict[Any, Value] = {}
    held = 0

    def get(key: Any) -> Value:
        nonlocal held
        if key in values:
            return values[key]
        value = make(key)
        needed = size(value)
        if held + needed <= budget:
            values[key] = value
            held += needed
        return value

    return get


class Deferred(Sequence[Value]):
    """Sequence of get(key) for each of `keys`, called whenever an item is accessed."""

    def __init__(self, keys: Sequence[int], get: Callable[[int], Value]) -> None:
        self.keys, self.get = keys, get

    def __len__(self) -> int:
        return len(self.keys)

    @overload
    def __getitem__(self, index: int) -> Value: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Value]: ...
    def __getitem__(self, index: int | slice) -> Value | Sequence[Value]:
        if isinstance(index, slice):
            return Deferred(self.keys[index], self.get)
        return self.get(self.keys[index])
