"""One root seed per run; every station derives its own by name, so adding a station changes no other."""

from __future__ import annotations

import hashlib

import numpy as np


def derive_seed(root: int, name: str) -> int:
    """A 32-bit seed for the named station: SHA-256 of root and name, so no two names share a stream."""
    return int.from_bytes(hashlib.sha256(f"{root}/{name}".encode()).digest()[:4], "little")


def generator(root: int, name: str) -> np.random.Generator:
    """NumPy generator for the named station."""
    return np.random.default_rng(derive_seed(root, name))
