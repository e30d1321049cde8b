"""The Gaussians: parameters and activations.

`Gaussians` is a plain dataclass, so Dr.Jit can carry it as a PyTree; on disk and between stations its fields are NumPy arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.special import expit

from mgs.colour import SH_C0
from mgs.errors import InputError

MAX_SH_DEGREE = 3

MAX_GAUSSIANS = 2**25
"""Most Gaussians of a model: with 48 colour coefficients each, every place in a kernel's buffers is below 2^31."""

SH_MAX = 1e6
"""Largest colour coefficient, linear RGB, of either sign: with it, gradients and Fisher information, which are of the order of
colours squared and summed over pixels, stay far within float32. The sun itself is 1e5 times as bright as what it lights."""

LEARNED = ("sh", "log_scales", "quats", "logit_opacities")
"""Learned parameters, in the order of their columns in the Fisher information: 3K colour, 3, 4, 1. Means are frozen."""


@dataclass(eq=False)
class Gaussians:
    """N Gaussians with appearance; float32 NumPy arrays (or Dr.Jit tensors of the same shapes inside `mgs.splat`).

    `gaussians[10:20]`, `gaussians[mask]` and `gaussians[indices]` are Gaussians again. Two are equal where every number is.

    means [N,3] world, metres; log_scales [N,3] ln metres; quats [N,4] wxyz, any norm; logit_opacities [N];
    sh [N,(d+1)^2,3] spherical-harmonic colour of degree d in 0..3, linear RGB, rgb = 0.5 + sum_k Y_k(direction) sh_k.
    """

    means: Any
    log_scales: Any
    quats: Any
    logit_opacities: Any
    sh: Any

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __getitem__(self, index: Any) -> Gaussians:
        """Some of them, in this order: a slice, a mask [N], indices [M], or one index (M = 1)."""
        chosen = [index] if isinstance(index, int | np.integer) else index
        return Gaussians(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Gaussians):
            return NotImplemented
        pairs = ((np.asarray(getattr(self, f.name)), np.asarray(getattr(other, f.name))) for f in fields(self))
        return all(np.array_equal(mine, theirs) for mine, theirs in pairs)

    __hash__ = None  # type: ignore[assignment]  # its arrays can change

    @property
    def sh_degree(self) -> int:
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def rgb(self) -> np.ndarray:
        """View-independent part of the colour, linear RGB [N,3], clamped at 0."""
        return np.maximum(0.5 + SH_C0 * self.sh[:, 0, :], 0.0)

    @property
    def opacities(self) -> np.ndarray:
        """[N] in [0,1]: the sigmoid of the logits, 0 or 1 where float32 has nothing nearer."""
        return expit(self.logit_opacities.astype(np.float64)).astype(np.float32)

    def check(self) -> Gaussians:
        """Shapes and values of NumPy fields; returns self.

        Raises InputError naming the parameter and the first Gaussian that is NaN, infinite or has a colour beyond SH_MAX.
        """
        self.check_shapes()
        for field in fields(self):
            values = np.asarray(getattr(self, field.name))
            bad = ~np.isfinite(values) if field.name != "sh" else ~(np.abs(values) <= SH_MAX)
            if bad.any():
                first = tuple(np.argwhere(bad)[0])
                what = f"is beyond {SH_MAX:,.0f}" if np.isfinite(values[first]) else "is NaN or infinite"
                raise InputError(f"gaussians: {field.name} {what}, first at Gaussian {first[0]}; remove or repair it")
        return self

    def check_shapes(self) -> None:
        """Raises InputError where the shape of a parameter (NumPy or Dr.Jit) does not fit that of the means, or there are more
        than MAX_GAUSSIANS."""
        n = len(self)
        if n > MAX_GAUSSIANS:
            raise InputError(f"gaussians: {n:,} are more than {MAX_GAUSSIANS:,}, the most that kernels index; take fewer")
        coefficients = {(d + 1) ** 2 for d in range(MAX_SH_DEGREE + 1)}
        shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "logit_opacities": (n,)}
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != shape:
                raise InputError(f"gaussians: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if len(self.sh.shape) != 3 or self.sh.shape[0] != n or self.sh.shape[2] != 3 or self.sh.shape[1] not in coefficients:
            raise InputError(f"gaussians: sh has shape {self.sh.shape}, expected ({n}, 1|4|9|16, 3)")


def sh_from_rgb(rgb: np.ndarray) -> np.ndarray:
    """Linear RGB [N,3] -> degree-0 coefficients [N,1,3]."""
    return ((np.asarray(rgb, np.float32) - 0.5) / SH_C0)[:, None, :].astype(np.float32)
