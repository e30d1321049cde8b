"""The Gaussians of a model: their parameters, and what these mean.

`Gaussians` is a plain dataclass, which Dr.Jit can take apart by its fields (a PyTree). Its fields
are NumPy arrays everywhere but inside `mgs.splat`, where they are Dr.Jit tensors.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.special import expit

from mgs.colour import SH_C0
from mgs.errors import InputError

MAX_SH_DEGREE = 3
"""Highest degree of spherical harmonics, as in 3DGS."""

MAX_GAUSSIANS = 2**25
"""Most Gaussians of a model. Kernels address their buffers with 32-bit indices: 48 colour
coefficients of each Gaussian stay below 2^31."""

SH_MAX = 1e6
"""Largest magnitude of a colour coefficient, linear RGB. Gradients and Fisher information grow with
the square of colours, summed over pixels; up to this limit they stay far within the range of
float32. It is beyond any real colour: the sun is about 1e5 times as bright as a surface that it
lights."""

LEARNED = ("sh", "log_scales", "quats", "logit_opacities")
"""Names of the parameters that are always learned, in the order of their columns in the Fisher
information. They have 3K (K colour coefficients for each of r, g, b), 3, 4 and 1 columns. The means
are learned only where that is asked for (`learned`)."""

KINDS = ("colour", "scale", "rotation", "opacity")
"""What the LEARNED parameters are called in settings and in columns of the information, in the same
order."""


def learned(means: str = "frozen") -> dict[str, str]:
    """{name of a learned parameter: what it is called in settings and columns}, in the order of the
    columns.

    means: a name in `mgs.splat.MEANS`; unless it is "frozen", the means are learned too and come
    last, called "mean".
    """
    return dict(zip(LEARNED, KINDS, strict=True)) | ({} if means == "frozen" else {"means": "mean"})


@dataclass(eq=False)
class Gaussians:
    """N Gaussians; float32 NumPy arrays, or inside `mgs.splat` Dr.Jit tensors of the same shapes.

    means: [N,3] centres in the world, metres.
    log_scales: [N,3] natural logarithm of the standard deviations along the three local axes,
    metres.
    quats: [N,4] quaternions w x y z of any norm, from the local axes to the world's.
    logit_opacities: [N] opacity o as its logit, ln(o / (1 - o)).
    sh: [N,K,3] colour, linear RGB, as K = (d+1)^2 coefficients of spherical harmonics of a degree d
    from 0 to 3, in the order
    and with the signs of 3DGS: rgb = max(0, 0.5 + sum over k of Y_k(direction) sh_k), with the
    direction from the camera.

    `gaussians[10:20]`, `gaussians[mask]` and `gaussians[indices]` are Gaussians again. Two are
    equal if all numbers are.
    """

    means: Any
    log_scales: Any
    quats: Any
    logit_opacities: Any
    sh: Any

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __getitem__(self, index: Any) -> Gaussians:
        """The Gaussians that are chosen by a slice, a mask [N] or indices [M] (in the order of
        these), or by one index."""
        chosen = [index] if isinstance(index, int | np.integer) else index
        return Gaussians(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Gaussians):
            return NotImplemented
        pairs = (
            (np.asarray(getattr(self, f.name)), np.asarray(getattr(other, f.name)))
            for f in fields(self)
        )
        return all(np.array_equal(mine, theirs) for mine, theirs in pairs)

    __hash__ = None  # type: ignore[assignment]  # its arrays can change

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def with_degree(self, degree: int) -> Gaussians:
        """The same Gaussians (NumPy fields) with the further coefficients of an SH degree that is
        not lower, which are 0."""
        sh = np.zeros((len(self), (degree + 1) ** 2, 3), np.float32)
        sh[:, : self.sh.shape[1]] = self.sh
        return replace(self, sh=sh)

    @property
    def rgb(self) -> np.ndarray:
        """The part of the colour that is the same from all sides, linear RGB [N,3], at least 0."""
        return np.maximum(0.5 + SH_C0 * self.sh[:, 0, :], 0.0)

    @property
    def opacities(self) -> np.ndarray:
        """Opacities [N] in [0,1]: the sigmoid of the logits. Of very large logits it is rounded to
        exactly 0 or 1."""
        return expit(self.logit_opacities.astype(np.float64)).astype(np.float32)

    def check(self) -> Gaussians:
        """Check the shapes and the values, of NumPy fields only. Returns the Gaussians themselves.

        Raises InputError as `check_shapes`, and if a number is NaN or infinite or a colour
        coefficient exceeds SH_MAX; the message names the parameter and the first such Gaussian.
        """
        self.check_shapes()
        for field in fields(self):
            values = np.asarray(getattr(self, field.name))
            bad = ~np.isfinite(values) if field.name != "sh" else ~(np.abs(values) <= SH_MAX)
            if bad.any():
                first = tuple(np.argwhere(bad)[0])
                what = (
                    f"is beyond {SH_MAX:,.0f}"
                    if np.isfinite(values[first])
                    else "is NaN or infinite"
                )
                raise InputError(
                    f"gaussians: {field.name} {what}, first at Gaussian {first[0]}; remove or repair it"
                )
        return self

    def check_shapes(self) -> None:
        """Raises InputError if the shapes (NumPy or Dr.Jit) are not those of N Gaussians, or N
        exceeds MAX_GAUSSIANS."""
        n = len(self)
        if n > MAX_GAUSSIANS:
            raise InputError(
                f"gaussians: {n:,} are more than {MAX_GAUSSIANS:,}, the most that kernels index; take fewer"
            )
        coefficients = {(d + 1) ** 2 for d in range(MAX_SH_DEGREE + 1)}
        shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "logit_opacities": (n,)}
        for name, shape in shapes.items():
            if tuple(getattr(self, name).shape) != shape:
                raise InputError(
                    f"gaussians: {name} has shape {getattr(self, name).shape}, expected {shape}"
                )
        if (
            len(self.sh.shape) != 3
            or self.sh.shape[0] != n
            or self.sh.shape[2] != 3
            or self.sh.shape[1] not in coefficients
        ):
            raise InputError(
                f"gaussians: sh has shape {self.sh.shape}, expected ({n}, 1|4|9|16, 3)"
            )


def sh_from_rgb(rgb: np.ndarray) -> np.ndarray:
    """Colours [N,3], linear RGB -> the spherical harmonics of degree 0 [N,1,3] that have these
    colours from all sides."""
    return ((np.asarray(rgb, np.float32) - 0.5) / SH_C0)[:, None, :].astype(np.float32)
