"""Fisher information of a view about each Gaussian, by one of several estimators (`ESTIMATORS`).

A pixel is the rendered value plus noise of variance 1. The information is then J^T J, with the
Jacobian J of the rgb image, all pixels and channels, by the parameters.

A Gaussian has P = 3K + 8 columns: 3K spherical-harmonic coefficients (coefficient by coefficient,
r g b in each), 3 log-scales, 4 of the quaternion, 1 opacity logit; then 0 or 3 of the mean
(`MEANS`). Symbols: docs/notation.md."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mgs.camera import Camera
from mgs.errors import InputError, row_named
from mgs.gaussians import LEARNED, Gaussians
from mgs.memory import check_room, padded
from mgs.splat import kernels
from mgs.splat.derivatives import (
    ByMean,
    Geometry,
    Moments,
    Polynomial,
    by_means,
    geometry,
    mean_product,
    means_product,
    product_sum,
    weighted_sum,
)
from mgs.splat.jacobian import vjp
from mgs.splat.projection import Splats, camera_array, moved, project, project64, projected
from mgs.splat.recording import frozen, one_at_a_time
from mgs.splat.rendering import ListCache, as_colour, as_drjit, by_block, splats_and_lists
from mgs.splat.walking import pack, packet_count, sums_by_splat

MEANS = {"frozen": 0, "free": 3}  # columns of the means: x, y, z in the world, metres
WEIGHT_MAX = 1e12  # of a pixel and channel, and (sigma_rgb / sigma_alpha)^2: sums must fit float32
MAX_SUMS = 1 << 31  # sums of all (splat, block) pairs of a view; kernels index them with 31 bits
BLOCK_BYTES = 1800  # peak memory of blocks per Gaussian, SH degree 0, without pairs; 1,700 measured
EXACT = ("exact", "block")  # estimators with all options of `fisher`


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
    camera: Camera | Sequence[Camera],
    estimator: str = "exact",
    background: Any = (0.0, 0.0, 0.0),
    cache: ListCache | None = None,
    means: str = "frozen",
    alpha_weight: float = 0.0,
    weights: ArrayLike | Sequence[ArrayLike] | None = None,
    chosen: Any = None,
) -> np.ndarray:
    """Fisher information of one view about each Gaussian: float32 [N,P], or [N,P,P] for the
    estimator `block`; of V cameras, [V,N,P] or [V,N,P,P].

    It is the diagonal of J^T W J (or its blocks), where J is the Jacobian of the image, in (linear
    RGB / unit of the parameter)^2. The order of the P parameters is that of docs/notation.md
    (`groups`). The result depends on model and pose alone, not on the camera's image. The array may
    be a view of a larger one (padded rows).

    - gaussians, background, cache: as in `render`.
    - estimator: a name in `ESTIMATORS`.
    - means: "frozen" or "free": 0 or 3 columns of the means, after the others.
    - alpha_weight: (sigma_rgb / sigma_alpha)^2, up to 1e12, if a pixel's alpha is observed beside
      its colour; 0: it is not.
    - weights: W, from 0 to 1e12, of pixels [H,W] (0 leaves one out), or of what broadcasts to
      pixels and channels [H,W,3], as [1, 0, 0] for red alone; [H,W,4] if alpha is observed. Of
      several cameras, one for each.
    - chosen: indices, mask or slice of M Gaussians whose rows are returned, [M,...]; the others
      still hide them. `fisher(gaussians[chosen], ...)` would be of a scene without the others.

    Raises InputError for an unknown estimator; as `render`; for blocks of 2^31 numbers or more, or
    too large for the memory; for unusable means, alpha_weight, weights or indices, or an estimator
    that does not support them; and with means for too many pairs (`MAX_SUMS`)."""
    if not isinstance(camera, Camera):
        model, cache = as_drjit(gaussians), cache or ListCache()
        each = [None] * len(camera) if weights is None else weights
        if len(each) != len(camera):  # type: ignore[arg-type]
            raise InputError(f"fisher: weights must be {len(camera)} arrays, one for each camera")
        if not each:
            raise InputError("fisher: takes one or more cameras")
        how = estimator, background, cache, means, alpha_weight
        pairs = zip(camera, each, strict=True)  # type: ignore[arg-type]
        return np.stack([fisher(model, one, *how, weight, chosen) for one, weight in pairs])
    compute = row_named(ESTIMATORS, estimator, "estimator")
    if dr.grad_enabled(camera.traced):
        raise InputError("fisher: is not differentiated by the camera; use mgs.fisher_derivatives")
    gaussians.check_shapes()
    size = list(groups(gaussians.sh_degree, means).values())[-1].stop
    if not 0 <= alpha_weight <= WEIGHT_MAX:
        raise InputError(f"fisher: alpha_weight {alpha_weight} must be from 0 to {WEIGHT_MAX:.0e}")
    options: dict[str, Any] = {}
    n = len(gaussians)
    if MEANS[means] or alpha_weight or weights is not None or chosen is not None:
        if estimator not in EXACT:
            why = f"the estimator {estimator!r} has no means, alpha_weight, weights or chosen"
            raise InputError(f"fisher: {why}; use {' or '.join(EXACT)}")
        options = {"means": means, "alpha_weight": alpha_weight}
        options["weights"] = weights_of(weights, camera, alpha_weight)
        options["chosen"] = rows = _rows(chosen, len(gaussians))
        n = n if rows is None else len(rows)
    if n == 0:
        return np.zeros((0, size, size) if estimator == "block" else (0, size), np.float32)
    if estimator == "block":
        if n * (size * size + 3) >= 1 << 31:  # rows are written in packets of four numbers
            raise InputError(
                f"fisher: blocks of {n:,} Gaussians of SH degree {gaussians.sh_degree} would take "
                f"{n * size * size / 2**28:.1f} GiB, and 8 are the most; give fewer as `chosen`, "
                "or take a lower degree, or the estimator `exact`"
            )
        check_room(
            n * BLOCK_BYTES * (size / 11) ** 2,
            f"fisher: blocks of {n:,} Gaussians",
            "give fewer as `chosen`, or take the estimator `exact`",
        )
    return compute(as_drjit(gaussians), camera, background, cache, **options)


def weights_of(weights: Any, camera: Camera, alpha_weight: float = 0.0) -> np.ndarray | None:
    """Weights of pixels and channels, [H,W,4]; those of alpha are 1 if not given."""
    if weights is None:
        return None
    shape, values = (camera.height, camera.width), np.asarray(weights)
    channels = 4 if alpha_weight and values.shape[-1:] == (4,) else 3
    full = np.ones((*shape, 4), np.float32)
    try:
        full[..., :channels] = values[..., None] if values.shape == shape else values
        usable = bool(((full >= 0) & (full <= WEIGHT_MAX)).all())
    except (TypeError, ValueError):
        usable = False
    if not usable:
        raise InputError(
            f"fisher: weights of shape {values.shape} must be numbers from 0 to {WEIGHT_MAX:.0e}, "
            f"of pixels {shape} or of pixels and channels {(*shape, 3)}"
        )
    return full


def _rows(chosen: Any, n: int) -> np.ndarray | None:
    """Indices of chosen Gaussians [M]. Raises InputError if they are none of n."""
    try:
        return None if chosen is None else np.atleast_1d(np.arange(n)[chosen])
    except (IndexError, TypeError) as error:
        raise InputError(f"fisher: chosen names no Gaussians of {n:,} ({error})") from None


def _sums(
    gaussians: Gaussians,
    camera: Camera,
    background: Any,
    cache: ListCache | None,
    block: bool,
    means: str = "frozen",
    alpha_weight: float = 0.0,
    weights: np.ndarray | None = None,
    chosen: np.ndarray | None = None,
) -> tuple[Moments, Any, Gaussians, Any, list[ByMean]]:
    """Sums of `kernels.fisher`, camera, chosen Gaussians and their splats for `geometry`, and
    derivatives by the means. means, alpha_weight: as in `fisher`. weights: [H,W,4]. chosen: indices
    [M]."""
    device = camera_array(camera.seen_from(gaussians.origin))
    splats, lists, packed = splats_and_lists(gaussians, camera, cache)
    # The derivative by a mean has a part by colour above degree 0: w g_c, hence w s_c sums.
    moving = means != "frozen"
    cross = block or (moving and gaussians.sh_degree > 0)  # then colour depends on the mean
    count = kernels.fisher_sums(cross, moving, weights is not None)
    # Numbers that a pair stores: sums in packets of four.
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
    roots = None if weights is None else by_block(lists, camera, np.sqrt(weights))
    surround = dr.detach(as_colour(background))
    totals = kernels.fisher(lists, packed, surround, cross, moving, weight, roots)
    sums = sums_by_splat(lists, totals, count)
    if chosen is not None:
        # Rows of the chosen ones: sums were taken with all Gaussians in place.
        index = mi.UInt32(padded(chosen, np.uint32))
        sums = [dr.gather(type(x), x, index) for x in sums]
        gaussians = gaussians.map(lambda v: mi.TensorXf(padded(np.asarray(dr.detach(v))[chosen])))
        splats = projected(gaussians, device)
    # Sums by name: w^2; |s|^2 xi^a eta^b; for each channel w s_c xi^a eta^b.
    # w^2 is the same sum for r, g and b unless channels have weights.
    of_colour = 1 if roots is None else 3
    w2, sums = (sums[:of_colour] * 3)[:3], sums[of_colour:]
    squared, mixed = kernels.fisher_moments(cross, moving)
    channels = [sums[len(squared) + c * len(mixed) :] for c in range(3)] if cross else []
    moments = Moments(
        w2,
        dict(zip(squared, sums, strict=False)),
        [dict(zip(mixed, channel, strict=False)) for channel in channels],
    )
    return moments, device, gaussians, splats, by_means(gaussians, device) if moving else []


def exact(
    gaussians: Gaussians, camera: Camera, background: Any, cache: ListCache | None, **options: Any
) -> np.ndarray:
    """Exact diagonal of J^T J, in one pass over the image: ten sums per splat, no Jacobian. With
    means it takes 16 sums, or 34 above SH degree 0. options: of `_sums`."""
    sums, device, model, splats, by_mean = _sums(
        gaussians, camera, background, cache, False, **options
    )
    parts = dr.detach((model, device, splats))
    size = 3 * gaussians.sh.shape[1] + 8 + len(by_mean)
    return np.asarray(_diagonal(*parts, sums, by_mean))[:, :size]


@frozen(lambda gaussians, camera, splats, sums, by_mean: (*gaussians.recorded, len(by_mean)))
def _diagonal(
    gaussians: Gaussians, camera: Any, splats: Any, sums: Moments, by_mean: list[ByMean]
) -> Any:
    columns = _columns(gaussians, camera, splats, sums, by_mean)
    return _interleaved(dict(enumerate(columns)), len(columns), len(gaussians))


def _columns(
    gaussians: Gaussians, camera: Any, splats: Any, sums: Moments, by_mean: list[ByMean]
) -> list[Any]:
    """Columns of `exact`, differentiable by the camera and the sums."""
    g = geometry(gaussians, camera, splats)
    columns = _colour_columns(g, sums.w2)
    # Log-scales, quaternion: sum of |s|^2 (m_k + M_k^T phi)^2. Opacity: (1 - o)^2 sum |s|^2.
    columns += [dr.maximum(product_sum(m, m, sums.squared), 0) for m in g.shape]
    columns.append(g.logit * g.logit * sums.squared[0, 0])
    # Means: sum over channels of (s_c q + w g_c)^2.
    return columns + [dr.maximum(means_product(mean, mean, sums), 0) for mean in by_mean]


def _colour_columns(g: Geometry, w2: list[Any]) -> list[Any]:
    """Y_k^2 sum w^2 of each coefficient and channel, 0 where the channel is clamped at 0."""
    channels = list(zip(w2, g.positive, strict=True))
    return [each * basis * basis * positive for basis in g.basis for each, positive in channels]


@one_at_a_time
def fisher_of_colours(
    gaussians: Gaussians, camera: Camera, cache: ListCache | None = None
) -> np.ndarray:
    """Columns of the colours of `fisher` by the estimator "exact", the same numbers in less time:
    float32 [N,3K], of more than no Gaussians. Raises InputError as `render`."""
    model = as_drjit(gaussians).map(dr.detach)
    splats, lists, packed = splats_and_lists(model, camera, cache)
    (w2,) = sums_by_splat(lists, kernels.squared_weights(lists, packed), 1)
    device = camera_array(camera.seen_from(model.origin))
    return np.asarray(_colours(model, device, splats, w2))[:, : 3 * model.sh.shape[1]]


@frozen(lambda gaussians, *others: gaussians.recorded)
def _colours(gaussians: Gaussians, camera: Any, splats: Any, w2: Any) -> Any:
    columns = _colour_columns(geometry(gaussians, camera, splats), [w2] * 3)
    return _interleaved(dict(enumerate(columns)), len(columns), len(gaussians))


@one_at_a_time
def fisher_derivatives(
    gaussians: Gaussians,
    camera: Camera,
    background: Any = (0.0, 0.0, 0.0),
    cache: ListCache | None = None,
) -> np.ndarray:
    """Derivatives of `fisher` by the camera, float32 [7,N,P]: by the six numbers of `moved`, per
    radian and metre, then by its `zoom`.

    Of the estimator `exact` with frozen means, in two passes over the image for each. Thresholds
    and depth order are not differentiated, as in `render`; with many Gaussians of a pixel or two,
    differences of moved cameras also have the steps at ALPHA_MIN. Raises InputError as `fisher`."""
    model, size = as_drjit(gaussians).map(dr.detach), groups(gaussians.sh_degree)["opacity"].stop
    if len(gaussians) == 0:
        return np.zeros((7, 0, size), np.float32)
    camera, surround, rows = replace(camera), dr.detach(as_colour(background)), []
    film = (camera.film or camera).seen_from(gaussians.origin)
    device = camera_array(film)
    splats, lists, packed = splats_and_lists(model, camera, cache)
    out = kernels.forward(lists, packed, False)
    totals = kernels.fisher(lists, packed, surround, False, True)
    sums = sums_by_splat(lists, totals, kernels.fisher_sums(False, True))
    for unit in np.eye(7).tolist():
        # Tangents of the camera's numbers, of the splats, and of their sums.
        with dr.resume_grad():
            t = mi.Float64(0.0)
            dr.enable_grad(t)
            array = camera_array(moved(film, dr.concat([t * x for x in unit[:6]]), t * unit[6]))
            dr.forward(t)
            tangent = dr.grad(array)
        tangents = _splat_tangents(model, device, tangent)
        packed_tangents = kernels.pack_tangents(tangents, splats, lists.place)
        d_out = kernels.jvp(lists, packed, packed_tangents)
        totals = kernels.fisher_jvp(lists, packed, packed_tangents, out[0], d_out[0], surround)
        changes = sums_by_splat(lists, totals, kernels.fisher_sums(False, False))
        polynomial = kernels.log_alpha_tangent(tangents, splats)
        change = _diagonal_tangent(model, device, tangent, splats, sums, changes, polynomial)
        rows.append(np.array(change))
    return np.stack(rows)[:, :, :size]


@frozen(lambda gaussians, camera, tangent: gaussians.recorded)
def _splat_tangents(gaussians: Gaussians, camera: Any, tangent: Any) -> Splats:
    """Derivative of the splats along a tangent of the `camera_array`."""
    camera = dr.copy(camera)
    dr.enable_grad(camera)
    dr.set_grad(camera, tangent)
    splats = project(gaussians, camera)
    dr.forward_to(splats, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    return dr.grad(splats)


@frozen(lambda gaussians, *others: gaussians.recorded)
def _diagonal_tangent(
    gaussians: Gaussians,
    camera: Any,
    tangent: Any,
    splats: Any,
    sums: list[Any],
    changes: list[Any],
    polynomial: Polynomial,
) -> Any:
    """Derivative of the columns of `exact` along a tangent of the camera (`_interleaved`).

    sums: of `kernels.fisher` with means. changes: of `kernels.fisher_jvp`. polynomial: tangent of
    ln alpha, which is ln 2 (log2 o' - 2 xi xi' - 2 eta eta')."""
    # xi' and eta' are polynomials of first order in xi and eta.
    half = {power: c / (-2 * kernels.LN2) for power, c in polynomial.items()}
    d_xi = {(-1, 0): half[1, 0], (0, 0): half[2, 0], (-1, 1): half[1, 1]}
    d_eta = {(0, -1): half[0, 1], (0, 0): half[0, 2]}
    squared = dict(zip(kernels.fisher_moments(False, True)[0], sums[1:], strict=True))
    camera, moments = dr.copy(camera), [dr.copy(one) for one in sums[: len(changes)]]
    dr.enable_grad(camera, moments)
    dr.set_grad(camera, tangent)
    dr.set_grad(moments[0], changes[0])
    powers = kernels.fisher_moments(False, False)[0]
    for (a, b), moment, change in zip(powers, moments[1:], changes[1:], strict=True):
        # The sum of |s|^2 xi^a eta^b changes with |s|^2, and by (a xi'/xi + b eta'/eta) of each
        # pixel. d_xi, d_eta: by the powers that they add.
        for factor, by in ((a, d_xi), (b, d_eta)):
            if factor:
                moved_by = {(a + x, b + y): c for (x, y), c in by.items()}
                change = change + factor * weighted_sum(moved_by, squared)
        dr.set_grad(moment, change)
    named = Moments([moments[0]] * 3, dict(zip(powers, moments[1:], strict=True)), [])
    columns = _columns(gaussians, camera, splats, named, [])
    dr.forward_to(columns, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    return _interleaved(dict(enumerate(dr.grad(columns))), len(columns), len(gaussians))


def block(
    gaussians: Gaussians, camera: Camera, background: Any, cache: ListCache | None, **options: Any
) -> np.ndarray:
    """Exact diagonal blocks of J^T J [N,P,P], in one pass over the image: 22 sums per splat, with
    means 34. options: of `_sums`."""
    sums, device, gaussians, splats, by_mean = _sums(
        gaussians, camera, background, cache, True, **options
    )
    g = geometry(gaussians, device, splats)
    dr.eval(g, by_mean)  # several kernels may write the blocks
    colour = [(basis, c) for basis in g.basis for c in range(3)]
    k = len(colour)
    upper: dict[tuple[int, int], Any] = {}
    # Colour x colour: Y_k Y_l sum w^2 of one channel; channels do not mix.
    for i, (basis_i, c) in enumerate(colour):
        # Derivative of the pixel by this coefficient: w Y_k.
        scaled = basis_i * g.positive[c]
        for j, (basis_j, d) in enumerate(colour[: i + 1]):
            if c == d:
                upper[j, i] = sums.w2[c] * scaled * basis_j
        # Colour x footprint: Y_k sum of w s_c (m_j + M_j^T phi). Colour x opacity: Y_k (1 - o) sum
        # w s_c.
        for j, m in enumerate(g.shape):
            upper[i, k + j] = scaled * weighted_sum(m, sums.mixed[c])
        upper[i, k + 7] = scaled * sums.mixed[c][0, 0] * g.logit
        # Colour x mean: Y_k sum of w (s_c q + w g_c).
        for j, mean in enumerate(by_mean):
            total = weighted_sum(mean.log_alpha, sums.mixed[c])
            if mean.colour:
                total += sums.w2[c] * mean.colour[c]
            upper[i, k + 8 + j] = scaled * total
    # Footprint and opacity among themselves: sums of |s|^2 times products of polynomials.
    for i, m in enumerate(g.shape):
        for j in range(i, 7):
            upper[k + i, k + j] = product_sum(m, g.shape[j], sums.squared)
        upper[k + i, k + 7] = g.logit * weighted_sum(m, sums.squared)
    # Opacity x opacity: (1 - o)^2 sum |s|^2.
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
    image. The paper does not state the loss. Here it is the mean squared error against mid-grey,
    mean (rgb - 0.5)^2. The result is not diag(J^T J): gradients of different pixels cancel before
    they are squared."""
    # L = mean (rgb - 0.5)^2, so dL/drgb = 2 (rgb - 0.5) / count.
    slope = lambda rgb: (rgb - 0.5) * (2 / len(rgb.array))  # noqa: E731  dL / drgb
    gradient = vjp(gaussians, slope, camera, background, cache, LEARNED)
    return np.concatenate([g.reshape(len(gaussians), -1) for g in gradient.values()], 1) ** 2


SMALLEST = 1.2e-38  # normal float32; smaller entries become 0, as threads flush them differently
PACKETS = 32  # of four columns that a kernel writes; LLVM takes minutes for all 56 x 56 at degree 3


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
