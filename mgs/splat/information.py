"""Fisher information of a view about each Gaussian, by one of several estimators (`ESTIMATORS`).

A pixel is the rendered value plus noise of variance 1. The information is then J^T J, with the
Jacobian J of the rgb image, all pixels and channels, by the parameters.

A Gaussian has P = 3K + 8 columns: 3K spherical-harmonic coefficients (coefficient by coefficient,
r g b in each), 3 log-scales, 4 of the quaternion, 1 opacity logit; then 0 or 3 of the mean
(`MEANS`). Symbols: docs/notation.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError, row_named
from mgs.gaussians import LEARNED, Gaussians
from mgs.memory import check_room
from mgs.splat import kernels
from mgs.splat.derivatives import (
    ByMean,
    Moments,
    by_means,
    geometry,
    mean_product,
    means_product,
    product_sum,
    weighted_sum,
)
from mgs.splat.projection import camera_array, project64
from mgs.splat.recording import frozen, one_at_a_time
from mgs.splat.rendering import ListCache, as_colour, as_drjit, render, splats_and_lists
from mgs.splat.walking import pack, packet_count, sums_by_splat

MEANS = {"frozen": 0, "free": 3}
"""Number of columns of the means: frozen, or free (x, y, z in the world, metres)."""

ALPHA_WEIGHT_MAX = 1e12
"""Largest (sigma_rgb / sigma_alpha)^2, (linear RGB)^2. Beyond it, sums over pixels might leave
the range of float32."""

MAX_SUMS = 1 << 31
"""Most sums of all (splat, block) pairs of a view; kernels index them with 31 bits."""

BLOCK_BYTES = 1800
"""Peak memory of a view's blocks per Gaussian, SH degree 0, without its pairs; 1,700
measured."""

EXACT = ("exact", "block")
"""Estimators that support means and alpha."""


def groups(sh_degree: int, means: str = "frozen") -> dict[str, slice]:
    """Columns of each kind of parameter, for colours of this SH degree: "colour", "scale",
    "rotation", "opacity", and "mean" unless frozen. Raises InputError if `means` is not a name in
    `MEANS`."""
    of_mean, colour = row_named(MEANS, means, "means"), 3 * (sh_degree + 1) ** 2
    sizes = {"colour": colour, "scale": 3, "rotation": 4, "opacity": 1, "mean": of_mean}
    columns, end = {}, 0
    for name, size in sizes.items():
        if size:
            columns[name] = slice(end, end + size)
        end += size
    return columns


@one_at_a_time
def fisher(
    gaussians: Gaussians,
    camera: Camera,
    estimator: str = "exact",
    background: Any = (0.0, 0.0, 0.0),
    cache: ListCache | None = None,
    means: str = "frozen",
    alpha_weight: float = 0.0,
) -> np.ndarray:
    """Fisher information of one view about each Gaussian: float32 [N,P], or [N,P,P] for the
    estimator `block`.

    It is the diagonal of J^T J (or its blocks), where J is the Jacobian of the image, in (linear
    RGB / unit of the parameter)^2. The order of the P parameters is that of docs/notation.md. The
    result depends on model and pose alone, not on the camera's image. The array may be a view of a
    larger one (padded rows).

    - gaussians, background, cache: as in `render`.
    - estimator: a name in `ESTIMATORS`.
    - means: "frozen" or "free": 0 or 3 columns of the means, after the others.
    - alpha_weight: (sigma_rgb / sigma_alpha)^2, up to 1e12, if a pixel's alpha is observed beside
      its colour; 0: it is not.

    Raises InputError for an unknown estimator; as `render`; for blocks of 2^31 numbers or more, or
    too large for the memory; for unusable means or alpha_weight, or an estimator that does not
    support them; and with means for too many pairs (`MAX_SUMS`).
    """
    compute = row_named(ESTIMATORS, estimator, "estimator")
    if dr.grad_enabled(camera.traced):
        raise InputError(
            "fisher: information has no derivative by the camera; take differences of moved cameras"
        )
    gaussians.check_shapes()
    n, size = len(gaussians), list(groups(gaussians.sh_degree, means).values())[-1].stop
    if not 0 <= alpha_weight <= ALPHA_WEIGHT_MAX:
        raise InputError(
            f"fisher: alpha_weight {alpha_weight} must be from 0 to {ALPHA_WEIGHT_MAX:.0e}"
        )
    options: dict[str, Any] = {}
    if MEANS[means] or alpha_weight:
        if estimator not in EXACT:
            raise InputError(
                f"fisher: the estimator {estimator!r} supports neither means nor alpha; "
                f"use {' or '.join(EXACT)}"
            )
        options = {"means": means, "alpha_weight": alpha_weight}
    if n == 0:
        return np.zeros((0, size, size) if estimator == "block" else (0, size), np.float32)
    if estimator == "block":
        if n * (size * size + 3) >= 1 << 31:  # rows are written in packets of four numbers
            raise InputError(
                f"fisher: blocks of {n:,} Gaussians of SH degree {gaussians.sh_degree} would take "
                f"{n * size * size / 2**28:.1f} GiB, and 8 are the most; take fewer Gaussians, "
                "a lower degree, or the estimator `exact`"
            )
        check_room(
            n * BLOCK_BYTES * (size / 11) ** 2,
            f"fisher: blocks of {n:,} Gaussians",
            "take fewer Gaussians, or the estimator `exact`",
        )
    return compute(as_drjit(gaussians), camera, background, cache, **options)


def _sums(
    gaussians: Gaussians,
    camera: Camera,
    background: Any,
    cache: ListCache | None,
    block: bool,
    means: str,
    alpha_weight: float,
) -> tuple[Moments, Any, Any, list[ByMean]]:
    """Sums of `kernels.fisher`, the camera and splats for `geometry`, and derivatives by the means.
    means, alpha_weight: as in `fisher`."""
    device = camera_array(camera.seen_from(gaussians.origin))
    splats, lists, packed = splats_and_lists(gaussians, camera, cache)
    # The derivative by a mean has a part by colour above degree 0: w g_c, hence w s_c sums.
    moving = means != "frozen"
    cross = block or (moving and gaussians.sh_degree > 0)  # then colour depends on the mean
    count = kernels.fisher_sums(cross, moving)
    room = 4 * packet_count(count)
    if len(lists.splat) * room >= MAX_SUMS:
        raise InputError(
            f"view: {len(lists.splat):,} pairs of a Gaussian and a block of pixels are too many "
            f"for Fisher information with means, which takes fewer than {MAX_SUMS // room:,}; "
            "take fewer or smaller Gaussians, or a smaller image"
        )
    if block:
        # Off-diagonal entries cancel, so pixels of blocks are computed in double
        # (`kernels.fisher`).
        exact = project64(gaussians, device)
        dr.eval(exact)
        packed = pack(exact, lists.place)
    weight = dr.opaque(mi.Float, alpha_weight) if alpha_weight else None
    placed = kernels.fisher(lists, packed, dr.detach(as_colour(background)), cross, moving, weight)
    # Sums by name: w^2; |s|^2 xi^a eta^b; for each channel w s_c xi^a eta^b.
    w2, *sums = sums_by_splat(lists, placed, count)
    squared, mixed = kernels.fisher_moments(cross, moving)
    channels = [sums[len(squared) + c * len(mixed) :] for c in range(3)] if cross else []
    moments = Moments(
        w2,
        dict(zip(squared, sums, strict=False)),
        [dict(zip(mixed, channel, strict=False)) for channel in channels],
    )
    return moments, device, splats, by_means(gaussians, device) if moving else []


def exact(
    gaussians: Gaussians,
    camera: Camera,
    background: Any,
    cache: ListCache | None,
    means: str = "frozen",
    alpha_weight: float = 0.0,
) -> np.ndarray:
    """Exact diagonal of J^T J, in one pass over the image: ten sums per splat, no Jacobian.

    With means it takes 16 sums, or 34 above SH degree 0. means, alpha_weight: as in `fisher`.
    """
    sums, device, splats, by_mean = _sums(
        gaussians, camera, background, cache, False, means, alpha_weight
    )
    parts = dr.detach((gaussians, device, splats))
    size = 3 * gaussians.sh.shape[1] + 8 + len(by_mean)
    return np.asarray(_diagonal(*parts, sums, by_mean))[:, :size]


@frozen(lambda gaussians, camera, splats, sums, by_mean: (*gaussians.recorded, len(by_mean)))
def _diagonal(
    gaussians: Gaussians, camera: Any, splats: Any, sums: Moments, by_mean: list[ByMean]
) -> Any:
    """Columns of `exact` (`_interleaved`)."""
    g = geometry(gaussians, camera, splats)
    # Colour: Y_k^2 sum w^2, 0 where the channel is clamped at 0.
    columns = [sums.w2 * basis * basis * positive for basis in g.basis for positive in g.positive]
    # Log-scales, quaternion: sum of |s|^2 (m_k + M_k^T phi)^2. Opacity: (1 - o)^2 sum |s|^2.
    columns += [dr.maximum(product_sum(m, m, sums.squared), 0) for m in g.shape]
    columns.append(g.logit * g.logit * sums.squared[0, 0])
    # Means: sum over channels of (s_c q + w g_c)^2.
    columns += [dr.maximum(means_product(mean, mean, sums), 0) for mean in by_mean]
    return _interleaved(dict(enumerate(columns)), len(columns), len(gaussians))


def block(
    gaussians: Gaussians,
    camera: Camera,
    background: Any,
    cache: ListCache | None,
    means: str = "frozen",
    alpha_weight: float = 0.0,
) -> np.ndarray:
    """Exact diagonal blocks of J^T J [N,P,P], in one pass over the image: 22 sums per splat, with
    means 34. means, alpha_weight: as in `fisher`."""
    sums, device, splats, by_mean = _sums(
        gaussians, camera, background, cache, True, means, alpha_weight
    )
    g = geometry(gaussians, device, splats)
    dr.eval(g, by_mean)  # several kernels may write the blocks
    colour = [(basis, c) for basis in g.basis for c in range(3)]
    k = len(colour)
    upper: dict[tuple[int, int], Any] = {}
    # Colour x colour: Y_k Y_l sum w^2 of one channel; channels do not mix.
    for i, (basis_i, c) in enumerate(colour):
        scaled = basis_i * g.positive[c]
        for j, (basis_j, d) in enumerate(colour[: i + 1]):
            if c == d:
                upper[j, i] = sums.w2 * scaled * basis_j
        # Colour x footprint: Y_k sum of w s_c (m_j + M_j^T phi). Colour x opacity: Y_k (1 - o) sum
        # w s_c.
        for j, m in enumerate(g.shape):
            upper[i, k + j] = scaled * weighted_sum(m, sums.mixed[c])
        upper[i, k + 7] = scaled * sums.mixed[c][0, 0] * g.logit
        # Colour x mean: Y_k sum of w (s_c q + w g_c).
        for j, mean in enumerate(by_mean):
            total = weighted_sum(mean.log_alpha, sums.mixed[c])
            if mean.colour:
                total += sums.w2 * mean.colour[c]
            upper[i, k + 8 + j] = scaled * total
    # Footprint and opacity among themselves: sums of |s|^2 times products of polynomials.
    for i, m in enumerate(g.shape):
        for j in range(i, 7):
            upper[k + i, k + j] = product_sum(m, g.shape[j], sums.squared)
        upper[k + i, k + 7] = g.logit * weighted_sum(m, sums.squared)
    upper[k + 7, k + 7] = g.logit * g.logit * sums.squared[0, 0]
    # Means with footprint and opacity, then among themselves.
    for j, mean in enumerate(by_mean):
        for i, m in enumerate(g.shape):
            upper[k + i, k + 8 + j] = mean_product(mean, m, sums)
        upper[k + 7, k + 8 + j] = mean_product(mean, {(0, 0): g.logit}, sums)
        for i, other in enumerate(by_mean[: j + 1]):
            upper[k + 8 + i, k + 8 + j] = means_product(other, mean, sums)
    size = k + 8 + len(by_mean)
    # Symmetric: the lower triangle is the upper one.
    both = {i * size + j: value for (i, j), value in upper.items()}
    both |= {j * size + i: value for (i, j), value in upper.items()}
    rows = np.asarray(_interleaved(both, size * size, len(gaussians)))
    return rows[:, : size * size].reshape(-1, size, size)


def loss_gradient(
    gaussians: Gaussians, camera: Camera, background: Any, cache: ListCache | None
) -> np.ndarray:
    """The paper's Eq. 7 as written: the squared gradient of one scalar "dummy photometric loss" per
    image.

    The paper does not state the loss. Here it is the mean squared error against mid-grey, mean
    (rgb - 0.5)^2. The result is not diag(J^T J): gradients of different pixels cancel before they
    are squared.
    """
    with dr.resume_grad():
        learned = {name: dr.copy(dr.detach(getattr(gaussians, name))) for name in LEARNED}
        dr.enable_grad(list(learned.values()))
        model = replace(gaussians, means=dr.detach(gaussians.means), **learned)
        rgb = render(model, camera, background, cache).rgb
        # J^T z with z = dL/drgb, held constant.
        z = (dr.detach(rgb) - 0.5) * (2 / len(rgb.array))
        dr.backward_from(dr.sum(rgb * z, axis=None))
        gradients = [np.asarray(dr.grad(value)) for value in learned.values()]
    return np.concatenate([g.reshape(len(gaussians), -1) for g in gradients], axis=1) ** 2


SMALLEST = 1.2e-38
"""Smallest normal float32. Smaller entries become 0, because threads flush denormals
differently."""

PACKETS = 32
"""Packets of four columns that one kernel writes. LLVM takes minutes to compile a kernel that
writes all 56 x 56 columns of SH degree 3."""


def _interleaved(columns: dict[int, Any], size: int, n: int) -> Any:
    """TensorXf [N, size] from columns [N] by index; columns not given are 0. Rows are padded to a
    multiple of four, which a kernel writes at a time."""
    packets = -(-size // 4)
    flat, row = dr.empty(mi.Float, n * packets * 4), dr.arange(mi.UInt32, n) * packets
    for packet in range(packets):
        # Denormals, which threads flush differently, become 0.
        values = [mi.Float(columns.get(4 * packet + i, 0)) for i in range(4)]
        normal = mi.Vector4f(*(dr.select(dr.abs(value) < SMALLEST, 0, value) for value in values))
        dr.scatter(flat, normal, row + packet, mode=dr.ReduceMode.NoConflicts)
        if packet % PACKETS == PACKETS - 1:
            dr.eval(flat)
    return mi.TensorXf(flat, (n, 4 * packets))


ESTIMATORS: dict[str, Callable[..., np.ndarray]] = {
    "exact": exact,
    "block": block,
    "loss-gradient": loss_gradient,
}
"""Estimators by name: (gaussians with Dr.Jit fields, camera, background, cache) -> NumPy [N,P],
or [N,P,P] for `block`. A program may add its own (docs/howto/estimator.md)."""
