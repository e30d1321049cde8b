"""The Gaussians of a model. Fields are NumPy arrays everywhere except inside `mgs.splat`, where
they are Dr.Jit tensors: Dr.Jit traverses the fields of a plain dataclass."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit

from mgs.colour import SH_C0, linear_from_srgb, srgb_from_linear
from mgs.errors import InputError
from mgs.notebook import cloud, html

MAX_SH_DEGREE = 3  # highest degree of spherical harmonics, as in 3DGS
MAX_GAUSSIANS = 2**25  # 32 bits index their 48 colour coefficients

SH_MAX = 1e6
"""Largest colour coefficient, linear RGB: sums of its squares over pixels stay within float32. The
sun is about 1e5 times as bright as a surface that it lights."""

LEARNED = ("sh", "log_scales", "quats", "logit_opacities")
"""Parameters that are always learned, in the order of their columns in the Fisher information: 3K
(K coefficients for each of r, g, b), 3, 4 and 1. Means are learned on request (`learned`)."""

ARRAYS = ("means", "log_scales", "quats", "logit_opacities", "sh")  # its array fields
MARKS = ("antialiased", "linear", "origin")  # fields of `Gaussians` that are no arrays
KINDS = ("colour", "scale", "rotation", "opacity")  # names of LEARNED in settings and columns


def learned(means: str = "frozen") -> dict[str, str]:
    """Map each learned parameter to its kind, in the order of the columns.

    means: a name in `mgs.splat.MEANS`. Unless it is "frozen", means are learned too and come last,
    as "mean"."""
    return dict(zip(LEARNED, KINDS, strict=True)) | ({} if means == "frozen" else {"means": "mean"})


@dataclass(eq=False, repr=False)
class Gaussians:
    """N Gaussians; float32 NumPy arrays, or inside `mgs.splat` Dr.Jit tensors of the same shapes.

    - means: [N,3] centres in the world, metres.
    - log_scales: [N,3] natural logarithm of the standard deviations along the local axes, metres.
    - quats: [N,4] quaternions w x y z of any norm, from the local axes to the world's.
    - logit_opacities: [N] opacity o as its logit, ln(o / (1 - o)).
    - sh: [N,K,3] colour, in the space of `linear`, as K = (d+1)^2 coefficients of spherical
      harmonics of degree d from 0 to 3, in the order and with the signs of 3DGS: rgb = max(0, 0.5 +
      sum over k of Y_k(direction) sh_k), with the direction from the camera.
    - antialiased: whether opacity falls as the low-pass of the image (`EPS2D`) makes a footprint
      larger (Yu et al. 2024, Mip-Splatting; `antialiased` of gsplat); in 3DGS it stays.
    - linear: whether colours are linear RGB, as light adds up; else sRGB values are blended, as in
      3DGS, most other programs and their files.
    - origin: place in the world, metres, from which means count, in float64. It is not zero for
      files whose coordinates float32 does not resolve, such as UTM.

    `gaussians[10:20]`, `gaussians[mask]` and `gaussians[indices]` are Gaussians again. Two are
    equal if all numbers and marks are."""

    means: Any
    log_scales: Any
    quats: Any
    logit_opacities: Any
    sh: Any
    antialiased: bool = True
    linear: bool = True
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __repr__(self) -> str:
        return f"Gaussians({len(self):,}, SH degree {self.sh_degree})"

    def _repr_html_(self) -> str:
        g = self.map(np.asarray)
        return html(repr(self), [cloud(g.means, g.linear_rgb(g.rgb))])

    def __getitem__(self, index: Any) -> "Gaussians":
        """Select Gaussians by a slice, a mask [N], indices [M] in their order, or one index."""
        rows = [index] if isinstance(index, int | np.integer) else index
        return self.map(lambda array: array[rows])

    def counted_from(self, origin: Sequence[float]) -> "Gaussians":
        """The same Gaussians in a world whose coordinates count from `origin` [3], metres. Those
        without an origin of their own count from there already."""
        if not any(self.origin):
            return self
        x, y, z = np.subtract(self.origin, origin).tolist()
        return replace(self, origin=(x, y, z))

    def map(self, function: Callable[[Any], Any]) -> "Gaussians":
        """Gaussians of the results of a function of each array."""
        return replace(self, **{name: function(getattr(self, name)) for name in ARRAYS})

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Gaussians):
            return NotImplemented
        pairs = [[np.asarray(getattr(one, name)) for one in (self, other)] for name in ARRAYS]
        same = all(getattr(self, name) == getattr(other, name) for name in MARKS)
        return same and all(np.array_equal(mine, theirs) for mine, theirs in pairs)

    __hash__ = None  # type: ignore[assignment]  # its arrays can change

    @property
    def recorded(self) -> tuple[int, ...]:
        """Constants of a recorded kernel: the shape of sh, and `antialiased` and `linear` as 0 or 1
        (see `mgs.splat.recording.frozen`)."""
        return (*self.sh.shape, int(self.antialiased), int(self.linear))

    def blended(self, linear: np.ndarray) -> np.ndarray:
        """Linear RGB of any shape in the space in which these Gaussians are blended."""
        return linear if self.linear else srgb_from_linear(linear)

    def linear_rgb(self, blended: np.ndarray) -> np.ndarray:
        """Linear RGB of any shape from the space in which these Gaussians are blended. sRGB is
        clipped to [0,1]."""
        return blended if self.linear else linear_from_srgb(np.clip(blended, 0, 1))

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def with_degree(self, degree: int) -> "Gaussians":
        """Raise the SH degree of Gaussians with NumPy fields; new coefficients are 0."""
        sh = np.zeros((len(self), (degree + 1) ** 2, 3), np.float32)
        sh[:, : self.sh.shape[1]] = self.sh
        return replace(self, sh=sh)

    @property
    def rgb(self) -> np.ndarray:
        """Colour without its dependence on direction, [N,3], in the space of `linear`."""
        return np.maximum(0.5 + SH_C0 * self.sh[:, 0, :], 0.0)

    @property
    def opacities(self) -> np.ndarray:
        """Opacities [N] in [0,1]. Those of very large logits are rounded to exactly 0 or 1."""
        return expit(self.logit_opacities.astype(np.float64)).astype(np.float32)

    def check(self, where: object = "gaussians") -> "Gaussians":
        """Check shapes and values (NumPy fields only), and return self. Raises InputError as
        `check_shapes`, and if a number is not finite or a colour coefficient exceeds SH_MAX. The
        message begins with `where`, and names the parameter and the first such Gaussian."""
        self.check_shapes(where)
        for name in ARRAYS:
            values = np.asarray(getattr(self, name))
            bad = ~np.isfinite(values) if name != "sh" else ~(np.abs(values) <= SH_MAX)
            if bad.any():
                first = tuple(np.argwhere(bad)[0])
                finite = np.isfinite(values[first])
                what = f"is beyond {SH_MAX:,.0f}" if finite else "is NaN or infinite"
                raise InputError(f"{where}: {name} {what}, first at Gaussian {first[0]}; repair it")
        return self

    def check_shapes(self, where: object = "gaussians") -> None:
        """Raise InputError if the shapes (NumPy or Dr.Jit) are not those of N Gaussians, or N
        exceeds MAX_GAUSSIANS."""
        n = len(self)
        if n > MAX_GAUSSIANS:
            many = f"{n:,} Gaussians are more than kernels index, {MAX_GAUSSIANS:,}"
            raise InputError(f"{where}: {many}; take fewer")
        coefficients = {(d + 1) ** 2 for d in range(MAX_SH_DEGREE + 1)}
        shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "logit_opacities": (n,)}
        for name, shape in shapes.items():
            if (actual := tuple(getattr(self, name).shape)) != shape:
                raise InputError(f"{where}: {name} has shape {actual}, expected {shape}")
        sh = tuple(self.sh.shape)
        if len(sh) != 3 or sh != (n, sh[1], 3) or sh[1] not in coefficients:
            raise InputError(f"{where}: sh has shape {sh}, expected ({n}, 1|4|9|16, 3)")


def sh_from_rgb(rgb: np.ndarray) -> np.ndarray:
    """Spherical harmonics of degree 0 [N,1,3] that have colours [N,3], linear RGB."""
    return ((np.asarray(rgb, np.float32) - 0.5) / SH_C0)[:, None, :].astype(np.float32)
