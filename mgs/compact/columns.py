"""Gaussians as columns of numbers that vary smoothly over a surface, and back.

Columns: 3K colours in the axes of `Layout.colours`, 3 log-scales, 3 of a rotation, 1 opacity logit.
A rotation u from its start is p = u_xyz / (1 + u_w), so the quaternion is the start times
(1 - |p|^2, 2 p), which needs no function whose last bit depends on the machine.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mgs.gaussians import SH_MAX, Gaussians
from mgs.splat.constants import LOG_SCALE_RANGE

if TYPE_CHECKING:
    from mgs.prior.build import Prior

LOGITS = (-6.0, 7.0)  # range of opacity logits: 0.0025, below ALPHA_MIN, to 0.9991, above ALPHA_MAX
FINE = 10  # binary digits of a means' grid below the spacing of a prior
UNIT = 20  # binary digits of normals. The grids hide the last bits, in which machines differ.


@dataclass(frozen=True)
class Start:
    """Start of the Gaussians, which sender and receiver both compute from a prior."""

    means: np.ndarray  # [N,3] metres, upright world
    quats: np.ndarray  # [N,4] wxyz of any norm
    layer: np.ndarray  # [N] 1 behind the surface, else 0
    digest: bytes  # hash of the samples
    inset: float  # depth below the mesh, metres


def start_of(prior: "Prior", inset: float) -> Start:
    """Start of the Gaussians of `mgs.prior.initial`. inset: their depth below the mesh, metres."""
    from mgs.prior.initial import BACKING_DEPTH

    grid, backed = np.ldexp(1.0, int(np.frexp(prior.spacing)[1]) - FINE), prior.backed
    points, normals = _whole(prior.points / grid), _whole(np.ldexp(prior.normals, UNIT))
    digest = hashlib.blake2b(digest_size=16)
    for numbers in (points, normals, np.array([backed])):
        digest.update(numbers.astype("<i8").tobytes())
    normals = np.ldexp(normals, -UNIT)
    surface = points * grid - inset * normals
    behind = surface[:backed] - BACKING_DEPTH * prior.spacing * normals[:backed]
    x, y, z = np.concatenate([normals, normals[:backed]]).T
    down = np.abs([1 + z, x, y]).max(0) < 2.0 ** (4 - UNIT)
    quats = np.column_stack([1 + z, np.where(down, 1, -y), x, np.zeros(len(z))])
    means = np.rint(np.concatenate([surface, behind]) / grid) * grid
    layer = (np.arange(len(means)) >= len(surface)).astype(np.int64)
    return Start(means, quats, layer, digest.digest(), inset)


def _whole(values: np.ndarray) -> np.ndarray:
    """Whole numbers near values. No float32 number of a file is at the edge between two."""
    return np.floor(values + 1 / 3)


def groups(coefficients: int) -> dict[str, slice]:
    """Columns by group, for K colour coefficients."""
    k = 3 * coefficients
    colour = {"colour": slice(0, 3), "directional": slice(3, k)}
    return colour | {
        "scale": slice(k, k + 3),
        "rotation": slice(k + 3, k + 6),
        "opacity": slice(k + 6, k + 7),
    }


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of quaternions [N,4]."""
    (w, x, y, z), (p, q, r, s) = a.T, b.T
    return np.column_stack(
        [
            w * p - x * q - y * r - z * s,
            w * q + x * p + y * s - z * r,
            w * r - x * s + y * p + z * q,
            w * s + x * r - y * q + z * p,
        ]
    )


CONJUGATE = np.array([1, -1, -1, -1])


def columns_of(g: Gaussians, quats: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """Columns [N,3K+7] of Gaussians. quats: [N,4] of the start. colours: [3,3] axes, rows."""
    u = product(quats * CONJUGATE, g.quats.astype(np.float64))
    u *= np.where(u[:, :1] < 0, -1, 1) / np.maximum(np.linalg.norm(u, axis=1), 1e-30)[:, None]
    sh = np.einsum("nkc,dc->nkd", g.sh.astype(np.float64), colours).reshape(len(g), -1)
    scales, logits = np.clip(g.log_scales, *LOG_SCALE_RANGE), np.clip(g.logit_opacities, *LOGITS)
    return np.column_stack([sh, scales, u[:, 1:] / (1 + u[:, :1]), logits])


def gaussians_of(
    columns: np.ndarray, means: np.ndarray, quats: np.ndarray, colours: np.ndarray
) -> Gaussians:
    """Gaussians of columns, the inverse of `columns_of`, each number by the same operations in the
    same order on every machine."""
    n, k = len(columns), columns.shape[1] - 7
    axes, scales, p, logits = np.split(columns, [k, k + 3, k + 6], axis=1)
    axes = axes.reshape(n, -1, 3)
    sh = sum(axes[..., d, None] * colours[d] for d in range(3))
    x, y, z = p.T
    turn = np.column_stack([1 - (x * x + y * y + z * z), 2 * x, 2 * y, 2 * z])
    return Gaussians(
        means=means.astype(np.float32),
        log_scales=np.clip(scales, *LOG_SCALE_RANGE).astype(np.float32),
        quats=product(quats, turn).astype(np.float32),
        logit_opacities=np.clip(logits[:, 0], *LOGITS).astype(np.float32),
        sh=np.clip(sh, -SH_MAX, SH_MAX).astype(np.float32),
    )


def gradient_of(
    columns: np.ndarray, quats: np.ndarray, colours: np.ndarray, by: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Gradient [N,3K+7] by the columns. by: gradients by the fields of `gaussians_of`."""
    p = columns[:, -4:-1]
    turn = product(quats * CONJUGATE, by["quats"].astype(np.float64))
    sh = np.einsum("nkc,dc->nkd", by["sh"].astype(np.float64), colours).reshape(len(p), -1)
    rotation = 2 * (turn[:, 1:] - p * turn[:, :1])
    return np.column_stack([sh, by["log_scales"], rotation, by["logit_opacities"]])


def colour_axes(sh: np.ndarray) -> np.ndarray:
    """Axes [3,3] along which the differences between neighbours vary most, one after the other.
    sh: [N,K,3], neighbours together."""
    step = np.diff(sh[:, 0].astype(np.float64), axis=0)
    return np.linalg.eigh(step.T @ step)[1].T[::-1].astype(np.float32).astype(np.float64)
