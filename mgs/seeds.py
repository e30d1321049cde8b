"""Random numbers. A run has one root seed, and every part of the program derives its own seed from
it by a name of its own.

So a new part, which draws under a new name, changes the draws of no other.
"""

from __future__ import annotations

import hashlib

import numpy as np


def derive_seed(root: int, name: str) -> int:
    """The seed of one part of the program, 32 bits: from the SHA-256 hash of the root seed and the
    part's name."""
    return int.from_bytes(hashlib.sha256(f"{root}/{name}".encode()).digest()[:4], "little")


def generator(root: int, name: str) -> np.random.Generator:
    """NumPy's random generator for one part of the program, seeded by `derive_seed`."""
    return np.random.default_rng(derive_seed(root, name))
