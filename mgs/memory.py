"""Memory: whether there is enough, results that are kept while there is room, sequences whose items
are made when asked for, and arrays for Dr.Jit."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np

from mgs.errors import InputError

Value = TypeVar("Value")

IMAGE_BYTES = 1 << 30
"""Most memory for arrays of one kind that are kept to be used again, bytes. Of images, as targets
of a fit, these are 218 of 640x480, or five of 12 megapixels. All others are read or computed again
at every use."""


LITTLE = 1 << 30
"""Bytes up to which `check_room` does not ask: asking takes some of the time of a small image."""

MEMORY_FILE = Path("/proc/meminfo")
"""Where Linux says how much memory can be taken without swapping."""


def check_room(needed: float, what: str, instead: str) -> None:
    """Raises InputError where so many bytes for `what` are more than the system has to spare, with
    what to do `instead`: it would end the process without a word. Systems that do not say what they
    have to spare are trusted. Memory that Dr.Jit keeps for its next arrays is given back before
    anything is refused."""
    if needed <= LITTLE or needed <= _spare():
        return
    import drjit as dr  # here, since most who need this module need no Dr.Jit

    dr.flush_malloc_cache()
    if needed > (spare := _spare()):
        raise InputError(
            f"{what} may take {needed / 2**30:,.1f} GiB, and {spare / 2**30:,.1f} GiB are free; {instead}"
        )


def _spare() -> float:
    """Bytes that the system has to spare; infinity where it does not say."""
    try:
        found = re.search(r"MemAvailable:\s*(\d+) kB", MEMORY_FILE.read_text(encoding="ascii"))
    except OSError:
        return float("inf")
    return 1024.0 * int(found[1]) if found else float("inf")


PADDING = 64
"""Numbers that a kernel may read beyond the end of an array: it takes as many at once as fit into a
register, 16 at most."""


ALIGNMENT = 64
"""Bytes. Dr.Jit compiles one kernel for arrays whose addresses are multiples of this, and another
where one is not."""


def padded(values: Any, dtype: Any = np.float32) -> np.ndarray:
    """A copy of an array, of this type and contiguous, that begins at a multiple of ALIGNMENT, and
    behind which more of its memory follows.

    Every array that Dr.Jit is to take over from NumPy must be one. Dr.Jit 1.5 does not copy it, and
    its kernels read a few
    numbers beyond the end: where the memory ends there, which depends on sizes and on chance, the
    process dies. And where an
    array happened to begin would decide which of two kernels is needed: with a hundred arrays,
    hardly ever one that was compiled before.
    """
    values = np.asarray(values)
    memory = np.empty(values.size + PADDING + ALIGNMENT, dtype)
    first = -memory.ctypes.data % ALIGNMENT // memory.itemsize
    copy = memory[first : first + values.size].reshape(values.shape)
    copy[...] = values
    return copy


def kept_within(
    budget: int, make: Callable[[int], Value], size: Callable[[Value], int]
) -> Callable[[int], Value]:
    """The function `make`, which keeps its results while their sizes sum to no more than `budget`
    bytes.

    What comes later is made anew at every call. A fit goes through its images again and again in
    changing orders: a cache that drops what was used longest ago (LRU) would then mostly drop what
    is needed next.
    """
    kept: dict[int, Value] = {}
    held = 0

    def get(key: int) -> Value:
        nonlocal held
        if key in kept:
            return kept[key]
        value = make(key)
        if held + size(value) <= budget:
            kept[key] = value
            held += size(value)
        return value

    return get


class Deferred(Sequence[Value]):
    """A sequence of the results of get(key) for each of `keys`, called anew whenever an item is
    asked for."""

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
