"""Random numbers: each part of the program derives its own seed from the run's, by name."""

import hashlib

import numpy as np


def derive_seed(root: int, name: str) -> int:
    """32-bit seed of one part of the program: SHA-256 of the root seed and the part's name."""
    return int.from_bytes(hashlib.sha256(f"{root}/{name}".encode()).digest()[:4], "little")


def generator(root: int, name: str) -> np.random.Generator:
    """NumPy random generator of one part of the program, seeded by `derive_seed`."""
    return np.random.default_rng(derive_seed(root, name))
