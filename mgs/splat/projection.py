"""EWA projection in Dr.Jit: N Gaussians -> the per-splat numbers that the kernels read. Plain Dr.Jit, so AD runs through it.

A splat's footprint is kept as a *whitening* of pixel offsets, not as a conic: with (dx, dy) from the splat's centre,

    xi = p (dx - k dy),   eta = e dy,   alpha = 2^(log2_opacity - xi^2 - eta^2).

This is the Cholesky factor of the conic in units of bits. It stays accurate in float32 where the conic cancels (a footprint
of 1:1000), and moments of (xi, eta) are of order one, so fourth-order moments (Fisher) are well conditioned too.

All of it is worked out in double and rounded once: it is O(N) work, and in single precision its errors would be the largest
of the whole renderer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.gaussians import SH_MAX, Gaussians
from mgs.rotation import QUAT_MIN
from mgs.splat.constants import EPS2D, FRUSTUM_MARGIN, LOG_SCALE_RANGE, NEAR

LOG2E = 1.4426950408889634


@dataclass
class Splats:
    """Projected Gaussians, Dr.Jit Float [N] each: means2d (u, v) px; whitening k, p, e; log2_opacity; depth z m; rgb.

    visible: in front of the near plane; elsewhere the other fields are meaningless. finite: no parameter is NaN or infinite,
    no colour coefficient beyond SH_MAX.
    u_rest, v_rest (px), k_rest: what rounding to float32 took from u, v and k (3e-5 px in a 640x480 image; as much at the far
    end of a long slanted footprint); not differentiated.
    """

    u: Any
    v: Any
    k: Any
    p: Any
    e: Any
    log2_opacity: Any
    z: Any
    r: Any
    g: Any
    b: Any
    visible: Any = None
    finite: Any = None
    u_rest: Any = None
    v_rest: Any = None
    k_rest: Any = None

    @property
    def colour(self) -> list[Any]:
        """[r, g, b]."""
        return [self.r, self.g, self.b]


def camera_array(camera: Camera) -> Any:
    """The camera as one Dr.Jit array of 23 doubles, so that a change of camera never recompiles a kernel.

    Layout: rotation (9, row-major), translation (3), fx fy cx cy, the clamp range of x/z and y/z (4), camera position (3).
    """
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * camera.width / fx, FRUSTUM_MARGIN * 0.5 * camera.height / fy
    clamp = [
        -cx / fx - margin_x,
        (camera.width - cx) / fx + margin_x,
        -cy / fy - margin_y,
        (camera.height - cy) / fy + margin_y,
    ]
    pose = camera.world_to_camera
    numbers = [*pose[:3, :3].ravel(), *pose[:3, 3], fx, fy, cx, cy, *clamp, *camera.position]
    return mi.Float64(np.array(numbers, np.float64))


def _unpack(array: Any) -> tuple[Any, Any, list[Any], list[Any], Any]:
    c = [dr.gather(mi.Float64, array, mi.UInt32(i)) for i in range(23)]
    R = [mi.Vector3d(*c[3 * i : 3 * i + 3]) for i in range(3)]
    return R, mi.Vector3d(*c[9:12]), c[12:16], c[16:20], mi.Vector3d(*c[20:23])


def rotation_columns(quats: Any) -> list[Any]:
    """Columns of the rotation of quaternions wxyz (Vector4d of any norm; zero is the identity), three Vector3d."""
    quats = dr.select(turns(quats), quats, mi.Vector4d(1, 0, 0, 0))
    w, x, y, z = quats * dr.rsqrt(dr.squared_norm(quats))
    return [
        mi.Vector3d(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        mi.Vector3d(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        mi.Vector3d(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]


def turns(quats: Any) -> Any:
    """Mask of the quaternions that are not zero."""
    return dr.max(dr.abs(dr.detach(quats))) > QUAT_MIN


def sh_basis(means: Any, camera: Any, coefficients: int) -> list[Any]:
    """Spherical harmonics [K] of the directions from the camera to the means (Vector3d), Float64 [N] each."""
    offset = means - _unpack(camera)[4]
    directions = offset * dr.rsqrt(dr.maximum(dr.squared_norm(offset), 1e-24))
    return dr.sh_eval(directions, round(coefficients**0.5) - 1)


def columns(tensor: Any, dtype: Any) -> Any:
    """Rows of a TensorXf [N, size of dtype] as one Dr.Jit vector array; its adjoint is free of atomics."""
    return dr.gather(dtype, tensor.array, dr.arange(mi.UInt32, tensor.shape[0]), mode=dr.ReduceMode.NoConflicts)


def axes2d(mean: Any, quats: Any, camera: Any) -> tuple[Any, list[Any], Any]:
    """((u, v) px, z m of each mean, z made safe; the axes R e_i of each Gaussian, pixels per metre, Vector2d; visible mask).

    mean: Vector3d; quats: Vector4d.
    """
    R, t, (fx, fy, cx, cy), (x0, x1, y0, y1), _ = _unpack(camera)
    x, y, z = (dr.dot(row, mean) + t[i] for i, row in enumerate(R))
    visible = z > NEAR
    z = dr.select(visible, z, 1)
    x, y, inv_z = x / z, y / z, dr.rcp(z)
    T0, T1 = (R[0] - dr.clip(x, x0, x1) * R[2]) * (fx * inv_z), (R[1] - dr.clip(y, y0, y1) * R[2]) * (fy * inv_z)
    unit = [mi.Vector2d(dr.dot(T0, c), dr.dot(T1, c)) for c in rotation_columns(quats)]
    return (fx * x + cx, fy * y + cy, z), unit, visible


def whitening(axes: list[Any]) -> tuple[Any, Any, Any]:
    """(k, p, e) of the 2D covariance sum_i axis_i axis_i^T + EPS2D I.

    The determinant is a sum of squared minors (Cauchy-Binet), all positive, so nothing cancels however thin the footprint.
    """
    c = sum(a.y * a.y for a in axes) + EPS2D
    b = sum(a.x * a.y for a in axes)
    trace = sum(dr.squared_norm(a) for a in axes)
    minors = [axes[i].x * axes[j].y - axes[i].y * axes[j].x for i, j in ((0, 1), (0, 2), (1, 2))]
    det = sum(m * m for m in minors) + EPS2D * trace + EPS2D * EPS2D
    return b / c, dr.sqrt(0.5 * LOG2E * c / det), dr.sqrt(0.5 * LOG2E / c)


def _rounded(value: Any) -> tuple[Any, Any]:
    """A Float64 as Float, and what rounding took from it (not differentiated)."""
    rounded = mi.Float(value)
    return rounded, mi.Float(dr.detach(value - mi.Float64(rounded)))


def project64(gaussians: Gaussians, camera: Any) -> Splats:
    """Project Gaussians with Dr.Jit TensorXf fields through a `camera_array`; numbers are Float64, and the rests None.

    Source: EWA splatting (Zwicker et al. 2002) as in 3DGS.
    """
    mean, quats = mi.Vector3d(columns(gaussians.means, mi.Vector3f)), mi.Vector4d(columns(gaussians.quats, mi.Vector4f))
    log_scales = mi.Vector3d(columns(gaussians.log_scales, mi.Vector3f))
    logit = mi.Float64(gaussians.logit_opacities.array)
    (u, v, z), unit, visible = axes2d(mean, quats, camera)
    scales = dr.exp(dr.clip(log_scales, *LOG_SCALE_RANGE))
    k, p, e = whitening([a * s for a, s in zip(unit, scales, strict=True)])
    log2_opacity = LOG2E * (dr.minimum(logit, 0) - dr.log(1 + dr.exp(-dr.abs(logit))))
    finite = dr.all(dr.isfinite(mean)) & dr.all(dr.isfinite(quats)) & dr.all(dr.isfinite(log_scales)) & dr.isfinite(logit)
    colour, index = mi.Color3d(0.5), dr.arange(mi.UInt32, len(gaussians))
    coefficients = gaussians.sh.shape[1]
    for i, basis in enumerate(sh_basis(mean, camera, coefficients)):
        sh = dr.gather(mi.Color3f, gaussians.sh.array, index * coefficients + i, mode=dr.ReduceMode.NoConflicts)
        finite &= dr.all(dr.abs(sh) <= SH_MAX)
        colour += basis * mi.Color3d(sh)
    colour = dr.maximum(colour, 0)
    return Splats(u, v, k, p, e, log2_opacity, z, colour.x, colour.y, colour.z, visible, finite)


def project(gaussians: Gaussians, camera: Any) -> Splats:
    """`project64`, rounded to Float. Differentiable in every parameter."""
    s = project64(gaussians, camera)
    (u, u_rest), (v, v_rest), (k, k_rest) = (_rounded(value) for value in (s.u, s.v, s.k))
    p, e, log2_opacity, z, r, g, b = (mi.Float(value) for value in (s.p, s.e, s.log2_opacity, s.z, s.r, s.g, s.b))
    return Splats(u, v, k, p, e, log2_opacity, z, r, g, b, s.visible, s.finite, u_rest, v_rest, k_rest)
