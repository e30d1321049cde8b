"""Derivatives of a pixel by the parameters of a Gaussian, and their sums over pixels.

The derivative of channel c of a pixel by any parameter is s_c q + w g_c. Here q, the derivative of
ln alpha, is a polynomial of second order in xi and eta, and g_c is the derivative of the splat's
colour. Their coefficients depend on Gaussian and camera alone. So the Fisher information follows
from moments, sums over pixels of |s|^2 or w s_c times monomials of xi and eta, and from the sum of
w^2 (`mgs.splat.kernels.fisher`).

A polynomial is a dict {(a, b): coefficient of xi^a eta^b}; moments are dicts with the same keys.
Symbols: docs/notation.md."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.gaussians import Gaussians
from mgs.memory import padded
from mgs.splat.constants import COMPENSATION_MIN, LOG_SCALE_RANGE
from mgs.splat.kernels import LN2, POWERS, log_alpha_tangent
from mgs.splat.projection import (
    axes2d,
    is_rotation,
    project64,
    rows_as_vectors,
    sh_basis,
    whitening,
)

Powers = tuple[int, int]
Polynomial = Mapping[Powers, Any]


@dataclass
class Geometry:
    """Derivatives by all parameters of a Gaussian but its mean; Dr.Jit arrays [N]."""

    shape: Sequence[
        Polynomial
    ]  # of ln alpha by 3 log-scales, 4 quaternion entries, even in xi, eta
    logit: Any  # of ln alpha by the opacity logit, 1 - opacity
    basis: list[Any]  # values of the K spherical harmonics
    positive: list[Any]  # for r, g, b: 1, or 0 where the colour is clamped at 0


@dataclass
class ByMean:
    """Derivatives by one coordinate of the mean, per metre."""

    log_alpha: Polynomial  # of ln alpha
    colour: list[Any]  # of r, g, b of the splat; empty for SH degree 0


@dataclass
class Moments:
    """Sums over pixels, Dr.Jit Float64 [N]."""

    w2: list[Any]  # for r, g, b, of w^2, the same unless pixels are weighted
    squared: Polynomial  # moments with |s|^2
    mixed: list[Polynomial]  # for r, g, b, moments with w s_c; empty if not needed


def geometry(gaussians: Gaussians, camera: Any, splats: Any) -> Geometry:
    """Derivatives of the footprint in closed form, in whitened coordinates x = (xi, eta).

    Let s_i be the standard deviation along local axis i, and b_i the image of that axis, whitened
    pixels per metre. The derivative of ln alpha by log-scale i is 4 ln2^2 s_i^2 (b_i.x)^2. That by
    a rotation about local axis k is 4 ln2^2 (s_i^2 - s_j^2) (b_i.x) (b_j.x), with (i, j, k) a
    cyclic shift of (0, 1, 2). A change dq of a quaternion q of norm n rotates the local axes by
    (2/n) Im(conj(q/n) dq).

    If the Gaussians are antialiased, the factor on their opacity changes, too. Both derivatives
    then have a constant: with the pair (i, i) or (i, j) and its s_i^2 or s_i^2 - s_j^2 as s, and
    det S / det(S + EPS2D I) = r, it is s (4 ln2^2 / r sum_k s_k^2 (b_k x b_i) (b_k x b_j) - 2 ln2
    b_i.b_j).

    gaussians: TensorXf fields. camera: `camera_array`. splats: their projection."""
    mean = mi.Vector3d(rows_as_vectors(gaussians.means, mi.Vector3f))
    quats = mi.Vector4d(rows_as_vectors(gaussians.quats, mi.Vector4f))
    log_scales = mi.Vector3d(rows_as_vectors(gaussians.log_scales, mi.Vector3f))
    _, unit, _ = axes2d(mean, quats, camera)
    scales = dr.exp(dr.clip(log_scales, *LOG_SCALE_RANGE))
    # b_i = W t_i: images of the unit axes in whitened pixels per metre.
    # W = [p, -p k; 0, e]: whitened coordinates of a pixel offset.
    k, p, e, share = whitening([a * s for a, s in zip(unit, scales, strict=True)])
    b = [mi.Vector2d(p * (t.x - k * t.y), e * t.y) for t in unit]
    axes = list(zip(b, scales, strict=True))

    def product(s: Any, i: int, j: int) -> Any:
        # f (b_i.x)(b_j.x) with f = 4 ln2^2 s: coefficients of 1, xi^2, xi eta, eta^2.
        x, y, f, constant = b[i], b[j], 4 * LN2 * LN2 * s, mi.Float64(0)
        if gaussians.antialiased:
            # Antialiased: f / r sum over l of (s_l b_l x b_i)(s_l b_l x b_j) - 2 ln2 s b_i.b_j.
            areas = ((v * (c.x * x.y - c.y * x.x), v * (c.x * y.y - c.y * y.x)) for c, v in axes)
            own = f * sum(one * other for one, other in areas) / share
            # At the bound of the compensation its derivative is 0.
            bounded = share <= COMPENSATION_MIN**2
            constant = dr.select(bounded, 0, own - 2 * LN2 * s * dr.dot(x, y))
        return mi.Vector4d(constant, f * x.x * y.x, f * (x.x * y.y + x.y * y.x), f * x.y * y.y)

    # A log-scale changes s_i^2 at the pair (i, i); a clamped one changes nothing.
    free = [(s > LOG_SCALE_RANGE[0]) & (s < LOG_SCALE_RANGE[1]) for s in log_scales]
    by_scale = [dr.select(free[i], product(scales[i] * scales[i], i, i), 0) for i in range(3)]
    # A turn about axis k mixes axes i and j, by the difference of their variances.
    turn = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        turn.append(product((scales[i] - scales[j]) * (scales[i] + scales[j]), i, j))
    # dq turns by (2/n) Im(conj(q/n) dq): the derivative by w is -(x X + y Y + z Z), and so on, all
    # times 2 / n^2; 0 for the zero quaternion, which stays the identity.
    w, x, y, z = quats * dr.select(is_rotation(quats), 2 / dr.squared_norm(quats), 0)
    X, Y, Z = turn
    by_quat = [
        -x * X - y * Y - z * Z,
        w * X - z * Y + y * Z,
        z * X + w * Y - x * Z,
        -y * X + x * Y + w * Z,
    ]
    # d ln o / d logit = 1 - o.
    transparency = 1 / (1 + dr.exp(mi.Float64(gaussians.logit_opacities.array)))
    # Y_k in the direction of the Gaussian; a channel clamped at 0 has no derivative.
    basis = sh_basis(mean, camera, gaussians.sh.shape[1])
    positive = [dr.select(c > 0, mi.Float(1), 0) for c in (splats.red, splats.green, splats.blue)]
    powers = POWERS[0], *POWERS[3:]
    shape = [dict(zip(powers, m, strict=True)) for m in (*by_scale, *by_quat)]
    return Geometry(shape, transparency, basis, positive)


def by_means(gaussians: Gaussians, camera: Any) -> list[ByMean]:
    """Derivatives by the coordinates x, y, z of the means, by forward AD of the projection. They
    include the change of the splat's centre, of its footprint (through the projection's Jacobian)
    and, above SH degree 0, of its colour. gaussians: TensorXf fields. camera: `camera_array`."""
    columns = []
    fixed = gaussians.map(dr.detach)
    # One forward pass of the projection for each of x, y, z.
    for axis in np.eye(3, dtype=np.float32):
        with dr.resume_grad():
            means = dr.copy(fixed.means)
            dr.enable_grad(means)
            dr.set_grad(means, mi.TensorXf(padded(np.tile(axis, (len(gaussians), 1)))))
            splats = project64(replace(fixed, means=means), camera)
            # AllowNoGrad: without antialiasing, the opacity does not depend on the means.
            dr.forward_to(splats, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
            tangents, splats = dr.grad(splats), dr.detach(splats)
        # q: derivative of ln alpha by this coordinate. g_c: that of the colour, 0 for degree 0.
        polynomial = log_alpha_tangent(tangents, splats)
        columns.append(ByMean(polynomial, tangents.colour if gaussians.sh_degree else []))
    return columns


def weighted_sum(p: Polynomial, moments: Polynomial) -> Any:
    """Sum over pixels of a polynomial, from the moments."""
    return sum(coefficient * moments[powers] for powers, coefficient in p.items())


def product_sum(p: Polynomial, q: Polynomial, moments: Polynomial) -> Any:
    """Sum over pixels of the product of two polynomials, from the moments."""
    # Coefficients of the product by power, then each times its moment.
    product: dict[Powers, Any] = {}
    for i, a in enumerate(POWERS):
        for b in POWERS[i:]:
            for first, second in ((a, b), (b, a)) if a != b else ((a, b),):
                if first in p and second in q:
                    power, term = (a[0] + b[0], a[1] + b[1]), p[first] * q[second]
                    product[power] = product[power] + term if power in product else term
    return weighted_sum(product, moments)


def mean_product(mean: ByMean, q: Polynomial, sums: Moments) -> Any:
    """Sum over pixels and channels of the derivative by a mean times s_c q, with q that of a
    parameter of the footprint."""
    # sum over pixels and c of (s_c q_mean + w g_c) s_c q.
    total = product_sum(mean.log_alpha, q, sums.squared)
    for g, mixed in zip(mean.colour, sums.mixed, strict=False):
        total += g * weighted_sum(q, mixed)
    return total


def means_product(a: ByMean, b: ByMean, sums: Moments) -> Any:
    """Sum over pixels and channels of the product of the derivatives by two means."""
    total = product_sum(a.log_alpha, b.log_alpha, sums.squared)
    for g, h, mixed, w2 in zip(a.colour, b.colour, sums.mixed, sums.w2, strict=False):
        # sum over pixels of (s_c q_a + w g)(s_c q_b + w h), without the first term, above.
        total += (
            h * weighted_sum(a.log_alpha, mixed) + g * weighted_sum(b.log_alpha, mixed) + g * h * w2
        )
    return total
