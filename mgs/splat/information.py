"""Fisher information that one view carries about each Gaussian, by one of several estimators (`ESTIMATORS`).

A pixel is taken as the rendered value plus noise of variance 1. The information is then J^T J, where J is the Jacobian of the
rgb image, all pixels and channels, with respect to the parameters.

The P = 3K + 8 columns of a Gaussian: 3K spherical-harmonic coefficients (coefficient by coefficient, r g b in each), 3
log-scales, 4 of the quaternion, 1 opacity logit. The means are frozen and have no columns. Symbols: docs/notation.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.gaussians import LEARNED, Gaussians
from mgs.seeds import derive_seed
from mgs.splat import kernels
from mgs.splat.constants import LOG_SCALE_RANGE
from mgs.splat.kernels import LN2
from mgs.splat.projection import axes2d, camera_array, is_rotation, project64, rows_as_vectors, sh_basis, whitening
from mgs.splat.rendering import ListCache, as_colour, as_drjit, render, splats_and_lists
from mgs.splat.walking import pack, sums_by_splat


def groups(sh_degree: int) -> dict[str, slice]:
    """Columns of each group of parameters ("colour", "scale", "rotation", "opacity"), for colours of this SH degree."""
    k = 3 * (sh_degree + 1) ** 2
    return {"colour": slice(0, k), "scale": slice(k, k + 3), "rotation": slice(k + 3, k + 7), "opacity": slice(k + 7, k + 8)}


def fisher(
    gaussians: Gaussians,
    camera: Camera,
    estimator: str = "exact",
    background: Any = (0.0, 0.0, 0.0),
    cache: ListCache | None = None,
    **options: Any,
) -> np.ndarray:
    """Fisher information that one view carries about each Gaussian: float32 [N,P], or [N,P,P] for the estimator `block`.

    Entries are in (linear RGB / unit of the parameter)^2. The camera's image is not needed: the information depends on the
    model and the pose alone. The array may be a view of a larger one (its rows are padded in memory).
    gaussians, background, cache: as in `render`. estimator: a name in `ESTIMATORS`. options: `probes` and `seed` of
    `hutchinson`; the others have none.
    Raises InputError for an unknown estimator, where `render` does, and for blocks of 2^31 numbers or more.
    """
    if estimator not in ESTIMATORS:
        raise InputError(f"estimator {estimator!r} is unknown; choose one of {', '.join(ESTIMATORS)}")
    gaussians.check_shapes()
    n, size = len(gaussians), groups(gaussians.sh_degree)["opacity"].stop
    if n == 0:
        return np.zeros((0, size, size) if estimator == "block" else (0, size), np.float32)
    if estimator == "block" and n * (size * size + 3) >= 1 << 31:  # each row is written in packets of four numbers
        raise InputError(
            f"fisher: blocks of {n:,} Gaussians of SH degree {gaussians.sh_degree} would take {n * size * size / 2**28:.1f} "
            "GiB, and 8 are the most; take fewer Gaussians, a lower degree, or the estimator `exact`"
        )
    return ESTIMATORS[estimator](as_drjit(gaussians), camera, background, cache, **options)


@dataclass
class Geometry:
    """How pixels depend on a Gaussian's parameters, up to what differs from pixel to pixel; Dr.Jit arrays [N].

    shape: for the 3 log-scales and the 4 numbers of the quaternion, the derivative of ln alpha, as its three coefficients on
    (xi^2, xi eta, eta^2). logit: the derivative of ln alpha by the opacity logit, 1 - opacity. basis: the K values of the
    spherical harmonics. positive: for r, g, b 1, or 0 where the colour is clamped at 0 and has no derivative.
    """

    shape: list[tuple[Any, Any, Any]]
    logit: Any
    basis: list[Any]
    positive: list[Any]


def geometry(gaussians: Gaussians, camera: Any, splats: Any) -> Geometry:
    """The derivatives of the footprint in closed form, in whitened coordinates x = (xi, eta), in which they are of order one.

    With s_i the standard deviation along local axis i and b_i the image of that axis in whitened pixels per metre, ln alpha
    changes with log-scale i by 4 ln2^2 s_i^2 (b_i.x)^2, and with a rotation about local axis k by
    4 ln2^2 (s_i^2 - s_j^2) (b_i.x) (b_j.x), where (i, j, k) is (0, 1, 2) or a cyclic shift of it. A change dq of a quaternion q
    of norm n rotates the local axes by (2/n) Im(conj(q/n) dq).
    gaussians: TensorXf fields; camera: `camera_array`; splats: their projection.
    """
    mean, quats = (
        mi.Vector3d(rows_as_vectors(gaussians.means, mi.Vector3f)),
        mi.Vector4d(rows_as_vectors(gaussians.quats, mi.Vector4f)),
    )
    log_scales = mi.Vector3d(rows_as_vectors(gaussians.log_scales, mi.Vector3f))
    _, unit, _ = axes2d(mean, quats, camera)
    scales = dr.exp(dr.clip(log_scales, *LOG_SCALE_RANGE))
    k, p, e = whitening([a * s for a, s in zip(unit, scales, strict=True)])
    b = [mi.Vector2d(p * (t.x - k * t.y), e * t.y) for t in unit]

    def product(s: Any, i: int, j: int) -> Any:
        x, y = b[i], b[j]
        f = 4 * LN2 * LN2 * s
        return mi.Vector3d(f * x.x * y.x, f * (x.x * y.y + x.y * y.x), f * x.y * y.y)

    free = [(s > LOG_SCALE_RANGE[0]) & (s < LOG_SCALE_RANGE[1]) for s in log_scales]
    by_scale = [dr.select(free[i], product(scales[i] * scales[i], i, i), 0) for i in range(3)]
    turn = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        turn.append(product((scales[i] - scales[j]) * (scales[i] + scales[j]), i, j))
    w, x, y, z = quats * dr.select(is_rotation(quats), 2 / dr.squared_norm(quats), 0)
    X, Y, Z = turn
    by_quat = [-x * X - y * Y - z * Z, w * X - z * Y + y * Z, z * X + w * Y - x * Z, -y * X + x * Y + w * Z]
    transparency = dr.rcp(1 + dr.exp(mi.Float64(gaussians.logit_opacities.array)))
    basis = sh_basis(mean, camera, gaussians.sh.shape[1])
    positive = [dr.select(c > 0, mi.Float(1), 0) for c in (splats.red, splats.green, splats.blue)]
    return Geometry([tuple(m) for m in (*by_scale, *by_quat)], transparency, basis, positive)


def _sums(gaussians: Gaussians, camera: Camera, background: Any, cache: ListCache | None, block: bool) -> tuple[Any, Geometry]:
    """The sums of `kernels.fisher`, arrays [N], and the geometry that turns them into entries of the information."""
    device = camera_array(camera)
    splats, lists, packed = splats_and_lists(gaussians, camera, cache)
    if block:
        exact = project64(gaussians, device)
        dr.eval(exact)
        packed = pack(exact, lists.place)
    placed = kernels.fisher(lists, packed, dr.detach(as_colour(background)), block)
    sums = sums_by_splat(lists, placed, kernels.FISHER_SUMS[block])
    return sums, geometry(gaussians, device, splats)


def _quadratic(m: tuple[Any, Any, Any], n: tuple[Any, Any, Any], q: list[Any]) -> Any:
    """Sum over pixels of |s|^2 (m . phi)(n . phi), phi = (xi^2, xi eta, eta^2), from the five fourth-order moments q."""
    return (
        m[0] * n[0] * q[0]
        + (m[0] * n[1] + m[1] * n[0]) * q[1]
        + (m[0] * n[2] + m[2] * n[0] + m[1] * n[1]) * q[2]
        + (m[1] * n[2] + m[2] * n[1]) * q[3]
        + m[2] * n[2] * q[4]
    )


def exact(gaussians: Gaussians, camera: Camera, background: Any, cache: ListCache | None) -> np.ndarray:
    """The diagonal of J^T J, exactly, for all parameters, in one pass over the image: seven sums per splat, and no Jacobian."""
    (w2, s2, *quartic), g = _sums(gaussians, camera, background, cache, block=False)
    columns_ = [w2 * basis * basis * positive for basis in g.basis for positive in g.positive]
    columns_ += [dr.maximum(_quadratic(m, m, quartic), 0) for m in g.shape]
    columns_.append(g.logit * g.logit * s2)
    return _interleaved(dict(enumerate(columns_)), len(columns_), len(gaussians))


def block(gaussians: Gaussians, camera: Camera, background: Any, cache: ListCache | None) -> np.ndarray:
    """The diagonal blocks of J^T J, [N,P,P], exactly, in one pass over the image: 22 sums per splat."""
    (w2, s2, *rest), g = _sums(gaussians, camera, background, cache, block=True)
    dr.eval(g)  # once, as several kernels may write the blocks
    quartic, quadratic, cross = rest[:5], rest[5:8], [rest[8 + 4 * c : 12 + 4 * c] for c in range(3)]
    colour = [(basis, c) for basis in g.basis for c in range(3)]
    k = len(colour)
    upper: dict[tuple[int, int], Any] = {}
    for i, (basis_i, c) in enumerate(colour):
        scaled = basis_i * g.positive[c]
        for j, (basis_j, d) in enumerate(colour[: i + 1]):
            if c == d:
                upper[j, i] = w2 * scaled * basis_j
        ws, *wsf = cross[c]
        for j, m in enumerate(g.shape):
            upper[i, k + j] = scaled * sum(a * b for a, b in zip(m, wsf, strict=True))
        upper[i, k + 7] = scaled * ws * g.logit
    for i, m in enumerate(g.shape):
        for j in range(i, 7):
            upper[k + i, k + j] = _quadratic(m, g.shape[j], quartic)
        upper[k + i, k + 7] = g.logit * sum(a * b for a, b in zip(m, quadratic, strict=True))
    upper[k + 7, k + 7] = g.logit * g.logit * s2
    size = k + 8
    both = {i * size + j: value for (i, j), value in upper.items()} | {j * size + i: value for (i, j), value in upper.items()}
    flat = _interleaved(both, size * size, len(gaussians))
    return flat.reshape(-1, size, size)


def _gradient(
    gaussians: Gaussians, image_gradient: Any, camera: Camera, background: Any, cache: ListCache | None
) -> np.ndarray:
    """J^T z of an image z, [N,P], by `dr.backward`. image_gradient(rgb) must return z, TensorXf [H,W,3]."""
    with dr.resume_grad():
        learned = {name: dr.copy(dr.detach(getattr(gaussians, name))) for name in LEARNED}
        dr.enable_grad(list(learned.values()))
        rgb = render(Gaussians(dr.detach(gaussians.means), **learned), camera, background, cache).rgb
        dr.backward_from(dr.sum(rgb * image_gradient(dr.detach(rgb)), axis=None))
        columns_ = [np.asarray(dr.grad(value)).reshape(len(gaussians), -1) for value in learned.values()]
    return np.concatenate(columns_, axis=1)


def hutchinson(
    gaussians: Gaussians, camera: Camera, background: Any, cache: ListCache | None, probes: int = 8, seed: int = 0
) -> np.ndarray:
    """Mean of (J^T z)^2 over `probes` images z of independent +1 and -1. Its expectation is diag(J^T J) (Hutchinson 1990).

    Each camera has probes of its own, drawn from `seed` and the camera. With the same ones in every view the errors of
    neighbouring views would be alike, and would add up in a sum over views. Raises InputError for less than one probe.
    """
    if int(probes) != probes or probes < 1:
        raise InputError(f"hutchinson: probes {probes} must be a whole number from 1 up")
    cache = cache or ListCache()
    total = np.zeros((len(gaussians), 0), np.float64)
    for probe in range(int(probes)):
        rng = np.random.default_rng(derive_seed(seed, f"hutchinson/{camera.key.hex()}/{probe}"))
        z = rng.choice(np.array([-1, 1], np.float32), (camera.height, camera.width, 3))
        squared = _gradient(gaussians, lambda _, z=z: mi.TensorXf(z), camera, background, cache).astype(np.float64) ** 2
        total = squared if probe == 0 else total + squared
    return (total / probes).astype(np.float32)


def loss_gradient(gaussians: Gaussians, camera: Camera, background: Any, cache: ListCache | None) -> np.ndarray:
    """The paper's Eq. 7 as it is written: the squared gradient of one scalar "dummy photometric loss" per image.

    The paper does not say which loss. Here it is the mean squared error against mid-grey, L = mean (rgb - 0.5)^2. The result is
    not diag(J^T J), since gradients of different pixels cancel before they are squared.
    """
    return _gradient(gaussians, lambda rgb: (rgb - 0.5) * (2 / len(rgb.array)), camera, background, cache) ** 2


SMALLEST = 1.2e-38
"""Smallest normal float32. Entries smaller than this become 0: threads differ in how they flush denormals, and nothing else
would differ between reruns."""

PACKETS = 32
"""How many packets of four columns one kernel writes. LLVM takes minutes to compile a kernel that writes all 56 x 56 columns of
blocks of SH degree 3."""


def _interleaved(columns_: dict[int, Any], size: int, n: int) -> np.ndarray:
    """NumPy float32 [N, size] from its columns, Dr.Jit arrays [N] by index; columns not given are 0.

    A kernel writes four columns at a time, so rows are padded to a multiple of four; the result is a view without the padding.
    """
    packets = -(-size // 4)
    flat, row = dr.empty(mi.Float, n * packets * 4), dr.arange(mi.UInt32, n) * packets
    for packet in range(packets):
        values = [mi.Float(columns_.get(4 * packet + i, 0)) for i in range(4)]
        normal = mi.Vector4f(*(dr.select(dr.abs(value) < SMALLEST, 0, value) for value in values))
        dr.scatter(flat, normal, row + packet, mode=dr.ReduceMode.NoConflicts)
        if packet % PACKETS == PACKETS - 1:
            dr.eval(flat)
    return np.array(flat, copy=False).reshape(n, -1)[:, :size]


ESTIMATORS: dict[str, Callable[..., np.ndarray]] = {
    "exact": exact,
    "block": block,
    "hutchinson": hutchinson,
    "loss-gradient": loss_gradient,
}
"""What `fisher` calls, by name: (gaussians with Dr.Jit fields, camera, background, cache, **options) -> NumPy [N,P], or [N,P,P]
for `block`. A program may add its own (docs/howto/estimator.md)."""
