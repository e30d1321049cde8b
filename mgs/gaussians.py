"""The Gaussians: parameters, activations and the 3DGS PLY layout.

`Gaussians` is a plain dataclass, so Dr.Jit can carry it as a PyTree; on disk and between stations its fields are NumPy arrays.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError
from scipy.special import expit

from mgs.conventions import SH_C0
from mgs.errors import InputError
from mgs.files import atomic_path

MAX_SH_DEGREE = 3

MAX_GAUSSIANS = 2**25
"""Most Gaussians of a model: with 48 colour coefficients each, every place in a kernel's buffers is below 2^31."""

SH_MAX = 1e6
"""Largest colour coefficient, linear RGB, of either sign: with it, gradients and Fisher information, which are of the order of
colours squared and summed over pixels, stay far within float32. The sun itself is 1e5 times as bright as what it lights."""

LEARNED = ("sh", "log_scales", "quats", "logit_opacities")
"""Learned parameters, in the order of their columns in the Fisher information: 3K colour, 3, 4, 1. Means are frozen."""

LINEAR_COMMENT = "mgs: colours are linear RGB"
"""Header comment of our PLY files. The layout itself has no field for it, and other tools train in display space (sRGB)."""


@dataclass
class Gaussians:
    """N Gaussians with appearance; float32 NumPy arrays (or Dr.Jit tensors of the same shapes inside `mgs.splat`).

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


def _ply_names(coefficients: int) -> list[str]:
    """Property names of the 3DGS layout for a number of SH coefficients per channel."""
    rest = 3 * (coefficients - 1)
    return (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(rest)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )


def write_ply(path: str | Path, gaussians: Gaussians) -> None:
    """Write a binary 3DGS PLY (opens in any splat viewer); f_rest is channel-major, colours stay linear RGB."""
    g, n = gaussians, len(gaussians)
    names = _ply_names(g.sh.shape[1])
    rest = np.transpose(g.sh[:, 1:, :], (0, 2, 1)).reshape(n, -1)
    columns = np.concatenate(
        [g.means, np.zeros((n, 3)), g.sh[:, 0, :], rest, np.reshape(g.logit_opacities, (n, 1)), g.log_scales, g.quats], axis=1
    ).astype(np.float32)
    vertices = np.empty(n, dtype=[(name, "f4") for name in names])
    for i, name in enumerate(names):
        vertices[name] = columns[:, i]
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")], comments=[LINEAR_COMMENT]).write(str(temporary))


def ply_colour_space(path: str | Path) -> str:
    """The space in which a readable 3DGS PLY's colours are blended: "linear" for our files, "srgb" for other tools'."""
    with Path(path).open("rb") as file:
        for line in file:
            if line.strip() == f"comment {LINEAR_COMMENT}".encode():
                return "linear"
            if line.strip() == b"end_header":
                break
    return "srgb"


def read_ply(path: str | Path) -> Gaussians:
    """Read any standard 3DGS PLY (binary or ascii, SH degree 0 to 3), by property name.

    Raises InputError where the file is missing, is not a PLY, lacks a property, or holds values that `Gaussians.check`
    refuses.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: {'not a file' if path.exists() else 'no such file'}; give a 3DGS PLY")
    try:
        ply = PlyData.read(str(path))
    except (PlyParseError, ValueError, OverflowError, MemoryError) as error:
        raise InputError(f"{path}: not a readable 3DGS PLY ({error}); export it again") from None
    if "vertex" not in ply:
        raise InputError(f"{path}: not a 3DGS PLY, it has no vertices; export it with a splatting tool")
    vertices = ply["vertex"].data
    present = set(vertices.dtype.names)
    rest = sum(re.fullmatch("f_rest_[0-9]+", name) is not None for name in present)
    coefficients = 1 + rest // 3
    if rest % 3 or coefficients not in (1, 4, 9, 16):
        raise InputError(f"{path}: {rest} f_rest properties fit no SH degree from 0 to 3; expected 0, 9, 24 or 45")
    missing = [name for name in _ply_names(coefficients) if name not in present and name not in ("nx", "ny", "nz")]
    if missing:
        raise InputError(f"{path}: not a 3DGS PLY, property {missing[0]!r} is missing; export it with a splatting tool")
    lists = [name for name in _ply_names(coefficients) if name in present and vertices.dtype[name].kind == "O"]
    if lists:
        raise InputError(f"{path}: not a 3DGS PLY, property {lists[0]!r} is a list; export it with a splatting tool")

    def stack(*names: str) -> np.ndarray:
        with np.errstate(over="ignore"):  # becomes infinite, which is refused below
            return np.stack([np.asarray(vertices[name], np.float32) for name in names], 1)

    n = len(vertices)
    sh = stack("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :]
    if rest:
        higher = stack(*(f"f_rest_{i}" for i in range(rest))).reshape(n, 3, coefficients - 1)
        sh = np.concatenate([sh, np.transpose(higher, (0, 2, 1))], axis=1)
    gaussians = Gaussians(
        means=stack("x", "y", "z"),
        log_scales=stack("scale_0", "scale_1", "scale_2"),
        quats=stack("rot_0", "rot_1", "rot_2", "rot_3"),
        logit_opacities=stack("opacity").ravel(),
        sh=np.ascontiguousarray(sh),
    )
    try:
        return gaussians.check()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
