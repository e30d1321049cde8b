"""Gaussians as columns of numbers that vary smoothly over a surface, and back.

Columns: 3K colours in the axes of `Header.colours`, 6 of the shape, 1 opacity logit. The shape is
the symmetric matrix M = V diag(log s) V^T in the axes of the start, as (M_xx + M_yy) / 2,
(M_xx - M_yy) / 2, M_zz, M_yz, M_zx, M_xy. A turn between axes of equal scales changes no column.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mgs.gaussians import SH_MAX, Gaussians
from mgs.rotation import rotmat_from_quat
from mgs.splat.constants import LOG_SCALE_RANGE

if TYPE_CHECKING:
    from mgs.prior.build import Prior

LOGITS = (-6.0, 7.0)  # range of opacity logits: 0.0025, below ALPHA_MIN, to 0.9991, above ALPHA_MAX
FINE = 10  # binary digits of a means' grid below the spacing of a prior
UNIT = 20  # binary digits of normals. The grids hide the last bits, in which machines differ.
TINY = 1e-300  # added to a divisor: 0 / TINY is 0
SHAPE = slice(-7, -1)  # columns of scales and rotation
SWEEPS = 5  # sweeps of Jacobi's rotations; after so many nothing is left off the diagonal
# Difference of log-scales below which gradients by a turn are rounding errors. The gradient by M_ij
# is too small there: 0 for equal scales, where M_ij changes the picture but a turn does not.
NEAR = 1e-3


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
    return {"colour": slice(0, 3), "directional": slice(3, k), "shape": slice(k, k + 7)}


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
    sh = np.einsum("nkc,dc->nkd", g.sh.astype(np.float64), colours).reshape(len(g), -1)
    scales, logits = np.clip(g.log_scales, *LOG_SCALE_RANGE), np.clip(g.logit_opacities, *LOGITS)
    turn = rotmat_from_quat(product(quats * CONJUGATE, g.quats.astype(np.float64)))
    m = np.einsum("nij,nj,nkj->nik", turn, scales.astype(np.float64), turn)
    mean, half = (m[:, 0, 0] + m[:, 1, 1]) / 2, (m[:, 0, 0] - m[:, 1, 1]) / 2
    shape = [mean, half, m[:, 2, 2], m[:, 1, 2], m[:, 2, 0], m[:, 0, 1]]
    return np.column_stack([sh, *shape, logits])


def gaussians_of(
    columns: np.ndarray, means: np.ndarray, quats: np.ndarray, colours: np.ndarray
) -> Gaussians:
    """Gaussians of columns, the inverse of `columns_of` but for the order of the scales, each
    number by the same operations in the same order on every machine."""
    n, k = len(columns), columns.shape[1] - 7
    axes = columns[:, :k].reshape(n, -1, 3)
    sh = sum(axes[..., d, None] * colours[d] for d in range(3))
    scales, quats = _eigen(columns[:, k : k + 6], np.broadcast_to(quats, (n, 4)))
    return Gaussians(
        means=means.astype(np.float32),
        log_scales=np.clip(scales, *LOG_SCALE_RANGE).astype(np.float32),
        quats=quats.astype(np.float32),
        logit_opacities=np.clip(columns[:, -1], *LOGITS).astype(np.float32),
        sh=np.clip(sh, -SH_MAX, SH_MAX).astype(np.float32),
    )


def _eigen(shape: np.ndarray, quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues [N,3] of matrices [N,6] of `columns_of`, and quats [N,4] times the rotations to
    the eigenvectors, by Jacobi's method."""
    mean, half, last, *off = shape.T
    values = [mean + half, mean - half, last]  # off[k]: the element of the two other axes
    for k in [0, 1, 2] * SWEEPS:
        i, j = (k + 1) % 3, (k + 2) % 3
        # t = the angle that makes M_ij 0: tan 2t = 2 M_ij / (M_jj - M_ii)
        gap, twice_off = values[j] - values[i], 2 * off[k]
        root = np.sqrt(gap * gap + twice_off * twice_off)
        tan = np.where(gap < 0, -twice_off, twice_off) / (np.abs(gap) + root + TINY)
        cos = 1 / np.sqrt(1 + tan * tan)
        sin = tan * cos
        values[i], values[j] = values[i] - tan * off[k], values[j] + tan * off[k]
        off[i], off[j] = cos * off[i] + sin * off[j], cos * off[j] - sin * off[i]
        off[k] = np.zeros(len(shape))
        turn = np.zeros((len(shape), 4))
        turn[:, 0], turn[:, 1 + k] = 1 + cos, -sin
        quats = product(quats, turn / 2)
    return np.column_stack(values), quats


def gradient_of(
    g: Gaussians, quats: np.ndarray, colours: np.ndarray, by: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Gradient [N,3K+7] by the columns of Gaussians. by: gradients by the fields of g."""
    n, own = len(g), g.quats.astype(np.float64)
    sh = np.einsum("nkc,dc->nkd", by["sh"].astype(np.float64), colours).reshape(n, -1)
    # In the axes of the Gaussian, a turn w about axis k changes M_ij by w (log s_i - log s_j).
    turns = product(own * CONJUGATE, by["quats"].astype(np.float64))[:, 1:] / 2
    m = np.einsum("ni,ij->nij", by["log_scales"].astype(np.float64), np.eye(3))
    scales = g.log_scales.astype(np.float64)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        gap = scales[:, i] - scales[:, j]
        m[:, i, j] = m[:, j, i] = turns[:, k] * gap / (gap**2 + NEAR**2) / 2
    turn = rotmat_from_quat(product(quats * CONJUGATE, own))
    m = np.einsum("nij,njk,nlk->nil", turn, m, turn)
    mean, half = m[:, 0, 0] + m[:, 1, 1], m[:, 0, 0] - m[:, 1, 1]
    shape = [mean, half, m[:, 2, 2], 2 * m[:, 1, 2], 2 * m[:, 2, 0], 2 * m[:, 0, 1]]
    return np.column_stack([sh, *shape, by["logit_opacities"]])


def colour_axes(sh: np.ndarray) -> np.ndarray:
    """Axes [3,3] along which the differences between neighbours vary most, one after the other.
    sh: [N,K,3], neighbours together."""
    step = np.diff(sh[:, 0].astype(np.float64), axis=0)
    return np.asarray(np.linalg.eigh(step.T @ step)[1].T[::-1])
