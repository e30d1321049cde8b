"""Bounded memory: results that are kept while there is room for them, and sequences whose items are made when asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar, overload

Value = TypeVar("Value")

IMAGE_BYTES = 1 << 30
"""Most memory for arrays of one kind that are kept to be used again, bytes. Of images, as targets of a fit, these are 218 of
640x480, or five of 12 megapixels. All others are read or computed again at every use."""


def kept_within(budget: int, make: Callable[[int], Value], size: Callable[[Value], int]) -> Callable[[int], Value]:
    """The function `make`, which keeps its results while their sizes sum to no more than `budget` bytes.

    What comes later is made anew at every call. A fit goes through its images again and again in changing orders: a cache that
    drops what was used longest ago (LRU) would then mostly drop what is needed next.
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
    """A sequence of the results of get(key) for each of `keys`, called anew whenever an item is asked for."""

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
