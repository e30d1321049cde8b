"""Reference implementation in plain float64 NumPy, with the names and constants of the kernels:
every Gaussian on every pixel, and derivatives as dense Jacobians, written independently of the
kernels."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit

from mgs.camera import Camera
from mgs.colour import sh_basis
from mgs.gaussians import Gaussians
from mgs.rotation import rotmat_from_quat
from mgs.splat.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    COMPENSATION_MIN,
    EPS2D,
    FRUSTUM_MARGIN,
    LOG_SCALE_RANGE,
    NEAR,
    TRANSMITTANCE_MIN,
)


@dataclass
class Projected:
    """Projected Gaussians."""

    means2d: np.ndarray  # [N,2] px, on the film (`Camera.film`)
    cov2d: np.ndarray  # [N,2,2] px^2, EPS2D included
    depths: np.ndarray  # [N] m, 1 where not visible
    opacities: np.ndarray  # [N], times the compensations
    compensations: np.ndarray  # [N] factor of antialiased Gaussians, else 1
    colours: np.ndarray  # [N,3] linear RGB
    visible: np.ndarray  # [N] bool, in front of the near plane


def project(gaussians: Gaussians, camera: Camera) -> Projected:
    """EWA projection (Zwicker et al. 2002) as in 3DGS (Kerbl et al. 2023). J [N,2,3] is the
    Jacobian of the projection at each mean, T = J R maps metres to pixels."""
    means = np.asarray(gaussians.means, np.float64)
    camera = (camera.film or camera).seen_from(gaussians.origin)
    R, t = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    x, y, z = (means @ R.T + t).T
    visible = z > NEAR
    z = np.where(visible, z, 1.0)
    margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / fx
    margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / fy
    # J with x/z and y/z clamped to the film and its margin.
    tx = np.clip(x / z, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    ty = np.clip(y / z, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    zero = np.zeros_like(z)
    rows = np.stack([fx / z, zero, -fx * tx / z], 1), np.stack([zero, fy / z, -fy * ty / z], 1)
    J = np.stack(rows, 1)
    T = J @ R
    scales = np.exp(np.clip(np.asarray(gaussians.log_scales, np.float64), *LOG_SCALE_RANGE))
    A = T @ (rotmat_from_quat(gaussians.quats) * scales[:, None, :])
    # A = T R_q diag(s), so A A^T is the 2D covariance before the low-pass.
    cov2d = A @ A.transpose(0, 2, 1) + EPS2D * np.eye(2)
    directions = means - camera.position
    directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    sh = np.asarray(gaussians.sh, np.float64)
    # rgb = max(0, 0.5 + sum over k of Y_k sh_k).
    raw = 0.5 + np.einsum("nk,nkc->nc", sh_basis(directions, gaussians.sh_degree), sh)
    opacities = expit(np.asarray(gaussians.logit_opacities, np.float64))
    compensations = np.ones(len(means))
    if gaussians.antialiased:  # |x cross y|^2 of the rows x, y of A is det(A A^T)
        own = (np.cross(A[:, 0], A[:, 1]) ** 2).sum(1)
        compensations = np.maximum(np.sqrt(own / np.linalg.det(cov2d)), COMPENSATION_MIN)
    # Centre: (fx x / z + cx, fy y / z + cy).
    means2d = np.stack([fx * x / z + cx, fy * y / z + cy], 1)
    opacities = opacities * compensations
    return Projected(means2d, cov2d, z, opacities, compensations, np.maximum(raw, 0), visible)


def _pixels(camera: Camera) -> np.ndarray:
    """Centres of the pixels [H*W,2], row by row, on the film."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.stack([u.ravel(), v.ravel()], 1) + camera.corner


def _half_square(d: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """1/2 d^T cov^-1 d for each row d of [P,2]; cov: [2,2]."""
    return 0.5 * ((d @ np.linalg.inv(cov)) * d).sum(1)


def composite(
    projected: Projected, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Front-to-back alpha compositing of M visible Gaussians on P = H*W pixels. Returns order [M],
    visible Gaussians by depth, equal depths by index; alpha [P,M] after all thresholds (0 where not
    drawn); T [P,M], transmittance in front of each splat; clipped [P,M], mask where alpha exceeds
    ALPHA_MAX."""
    index = np.flatnonzero(projected.visible)
    order = index[np.argsort(projected.depths[index].astype(np.float32), kind="stable")]
    pixels = _pixels(camera)
    alpha = np.zeros((len(order), len(pixels))).T  # transposed, as one splat is written at a time
    transmittance = np.zeros_like(alpha)
    clipped = np.zeros_like(alpha, bool)
    T = np.ones(len(pixels))
    live = np.ones(len(pixels), bool)
    for i, j in enumerate(order):
        # alpha = o exp(-d^T Sigma^-1 d / 2), 0 below ALPHA_MIN, at most ALPHA_MAX.
        power = -_half_square(pixels - projected.means2d[j], projected.cov2d[j])
        raw = projected.opacities[j] * np.exp(power)
        a = np.where(raw >= ALPHA_MIN, np.minimum(raw, ALPHA_MAX), 0.0)
        # A pixel is finished before the splat that would leave TRANSMITTANCE_MIN or less.
        live &= (a == 0) | (T * (1 - a) > TRANSMITTANCE_MIN)
        a = np.where(live, a, 0.0)
        alpha[:, i], transmittance[:, i], clipped[:, i] = a, T, raw > ALPHA_MAX
        T = T * (1 - a)
    return order, alpha, transmittance, clipped


def render(
    gaussians: Gaussians, camera: Camera, background=(0.0, 0.0, 0.0)
) -> dict[str, np.ndarray]:
    """rgb [H,W,3] over the background, alpha [H,W], depth [H,W] = sum of alpha T z / alpha (0 where
    alpha is 0)."""
    projected = project(gaussians, camera)
    order, alpha, T, _ = composite(projected, camera)
    # C = sum of w c + T_end background.
    weights = alpha * T
    total = weights.sum(1)
    rgb = weights @ projected.colours[order] + (1 - total)[:, None] * np.array(background, float)
    depth = weights @ projected.depths[order] / np.where(total > 0, total, 1.0)
    shape = (camera.height, camera.width)
    return {
        "rgb": rgb.reshape(*shape, 3),
        "alpha": total.reshape(shape),
        "depth": depth.reshape(shape),
    }


def margins(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Smallest relative error of the alphas that could change a decision at each pixel [H,W].

    Decisions: whether alpha is below ALPHA_MIN; whether it is above ALPHA_MAX, where its derivative
    jumps; whether the pixel is finished (a relative error of the alphas makes one of T that is sum
    alpha / (1 - alpha) times as large); and which of two drawn splats is in front (0 if float32 may
    round their depths to the same number)."""
    p = project(gaussians, camera)
    order, alpha, _, _ = composite(p, camera)
    pixels = _pixels(camera)
    least = np.full(len(pixels), np.inf)
    T, amplification, live = np.ones(len(pixels)), np.zeros(len(pixels)), np.ones(len(pixels), bool)
    for i, j in enumerate(order):
        # Relative distance of alpha from ALPHA_MIN and from ALPHA_MAX.
        log_raw = np.log(p.opacities[j]) - _half_square(pixels - p.means2d[j], p.cov2d[j])
        near = np.minimum(np.abs(log_raw - np.log(ALPHA_MIN)), np.abs(log_raw - np.log(ALPHA_MAX)))
        least = np.where(live, np.minimum(least, near), least)
        a = np.where(log_raw >= np.log(ALPHA_MIN), np.minimum(np.exp(log_raw), ALPHA_MAX), 0)
        # d ln T = -sum alpha / (1 - alpha) d ln alpha.
        amplification = amplification + a / (1 - a)
        after = np.log(T * (1 - a) / TRANSMITTANCE_MIN)
        near = np.abs(after) / np.maximum(amplification, 1)
        least = np.where(live & (a > 0), np.minimum(least, near), least)
        live &= (a == 0) | (after > 0)
        T = np.where(live, T * (1 - a), T)
        before = order[i - 1]
        if i and 0 < p.depths[j] - p.depths[before] < 1e-6 * p.depths[j]:
            least = np.where((alpha[:, i] > 0) & (alpha[:, i - 1] > 0), 0.0, least)
    return least.reshape(camera.height, camera.width)


def _moved(gaussians: Gaussians, name: str, step: np.ndarray) -> Gaussians:
    """A float64 copy with `step` added to one parameter of every Gaussian."""
    copy = gaussians.map(lambda array: np.array(array, np.float64))
    return replace(copy, **{name: getattr(copy, name) + step})


def _projection_jacobian(
    gaussians: Gaussians, camera: Camera, means: bool, step: float = 1e-5
) -> tuple[np.ndarray, ...]:
    """Central differences of `project` by the 3 log-scales, the 4 entries of the quaternion and, if
    `means`, x, y, z of the mean, so m is 0 or 3: of means2d [N,7+m,2], cov2d [N,7+m,2,2], colours
    [N,7+m,3] and the logarithm of the compensations [N,7+m]."""
    moves = [("log_scales", row) for row in np.eye(3)] + [("quats", row) for row in np.eye(4)]
    moves += [("means", row) for row in np.eye(3) if means]
    # Central differences of everything a pixel depends on, for each column.
    derivatives = []
    for name, direction in moves:
        up, down = (
            project(_moved(gaussians, name, sign * step * direction), camera) for sign in (+1, -1)
        )
        changes = (
            up.means2d - down.means2d,
            up.cov2d - down.cov2d,
            up.colours - down.colours,
            np.log(up.compensations / down.compensations),
        )
        derivatives.append([change / (2 * step) for change in changes])
    return tuple(np.stack(columns, 1) for columns in zip(*derivatives, strict=True))


def jacobian(
    gaussians: Gaussians,
    camera: Camera,
    background: Any = (0.0, 0.0, 0.0),
    means: str = "frozen",
    alpha_weight: float = 0.0,
) -> np.ndarray:
    """Dense Jacobian of the rgb image [H*W, 3, N, P]. For toy scenes only. Columns: those of
    `mgs.gaussians.LEARNED`, then 0 or 3 of the means. means, alpha_weight: as in
    `mgs.splat.fisher`. With an alpha_weight there are four channels, the last one alpha times its
    square root, composited as a colour that all Gaussians share."""
    projected = project(gaussians, camera)
    order, alpha, T, clipped = composite(projected, camera)
    weights = alpha * T
    n, K = len(gaussians), (gaussians.sh_degree + 1) ** 2
    eye = camera.seen_from(gaussians.origin).position
    directions = np.asarray(gaussians.means, np.float64) - eye
    directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    basis = sh_basis(directions, gaussians.sh_degree)
    # Alpha as a fourth colour sqrt(alpha_weight) of all Gaussians, in front of 0.
    extra = int(alpha_weight > 0)
    colours = np.concatenate([projected.colours, np.full((n, extra), np.sqrt(alpha_weight))], 1)
    contribution = weights[:, :, None] * colours[order]
    surround = np.append(background, np.zeros(extra))
    image = contribution.sum(1) + (1 - weights.sum(1))[:, None] * surround
    # S: the pixel minus all down to and including this splat.
    behind = image[:, None, :] - np.cumsum(contribution, 1)
    pixels = _pixels(camera)
    transparency = expit(-np.asarray(gaussians.logit_opacities, np.float64))
    d_means2d, d_cov2d, d_colours, d_log = _projection_jacobian(gaussians, camera, means == "free")
    J = np.zeros((len(pixels), 3 + extra, n, 3 * K + 1 + d_cov2d.shape[1]))
    for i, j in enumerate(order):
        under = np.flatnonzero(alpha[:, i])  # on other pixels the splat changes nothing
        # Colours: w Y_k, 0 where clamped at 0.
        for c in np.flatnonzero(projected.colours[j] > 0):
            J[under, c, j, c : 3 * K : 3] = weights[under, i, None] * basis[j]
        # D = c T - S / (1 - alpha).
        D = colours[j] * T[under, i, None] - behind[under, i] / (1 - alpha[under, i, None])
        dalpha = np.where(clipped[under, i], 0.0, alpha[under, i])
        # ln alpha = ln o - d^T Sigma^-1 d / 2 with d = pixel - mean: with e = Sigma^-1 d its
        # derivative is e.d(mean) + e^T d(Sigma) e / 2, plus that of ln compensation.
        e = (pixels[under] - projected.means2d[j]) @ np.linalg.inv(projected.cov2d[j])
        dlog = [
            e @ d_mean + ((e @ d_cov) * e).sum(1) / 2 + d
            for d_mean, d_cov, d in zip(d_means2d[j], d_cov2d[j], d_log[j], strict=True)
        ]
        # d ln alpha / d logit = 1 - o.
        dlog.insert(7, np.full(len(e), transparency[j]))
        J[under, :, j, 3 * K :] = D[:, :, None] * (dalpha[:, None] * np.stack(dlog, 1))[:, None, :]
        # Means also change the colour, through its direction: w dc.
        J[under, :3, j, 3 * K + 8 :] += weights[under, i, None, None] * d_colours[j, 7:].T
    return J


def fisher(
    gaussians: Gaussians, camera: Camera, background: Any = (0.0, 0.0, 0.0), **options: Any
) -> np.ndarray:
    """diag(J^T J) over pixels and channels [N,P]. options: of `jacobian`."""
    return (jacobian(gaussians, camera, background, **options) ** 2).sum((0, 1))


def fisher_block(
    gaussians: Gaussians, camera: Camera, background: Any = (0.0, 0.0, 0.0), **options: Any
) -> np.ndarray:
    """Diagonal blocks of J^T J [N,P,P]. options: of `jacobian`."""
    J = jacobian(gaussians, camera, background, **options)
    # Sum over pixels and channels of J_a J_b, for each Gaussian.
    rows = J.reshape(J.shape[0] * J.shape[1], *J.shape[2:])
    return np.matmul(rows.transpose(1, 2, 0), rows.transpose(1, 0, 2))


def removal_cost(
    gaussians: Gaussians, camera: Camera, background: Any = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Squared change of the image when one Gaussian is left out [N]: sum over pixels and channels
    of (alpha D)^2."""
    projected = project(gaussians, camera)
    order, alpha, T, _ = composite(projected, camera)
    contribution = (alpha * T)[:, :, None] * projected.colours[order]
    remaining = (1 - (alpha * T).sum(1))[:, None]
    image = contribution.sum(1) + remaining * np.array(background, float)
    behind = image[:, None, :] - np.cumsum(contribution, 1)
    # alpha D = w c - alpha S / (1 - alpha).
    change = contribution - (alpha / (1 - alpha))[:, :, None] * behind
    cost = np.zeros(len(gaussians))
    cost[order] = (change**2).sum((0, 2))
    return cost
