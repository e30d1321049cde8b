"""EWA projection: from N Gaussians and a camera to N splats, the 2D Gaussians in the image that the
kernels draw.

It is written in ordinary Dr.Jit operations, so Dr.Jit differentiates it by itself, backward and
forward.

A splat's footprint is not kept as a conic (the inverse of its 2D covariance) but as a *whitening*:
a linear map of pixel offsets (dx, dy) from the splat's centre to coordinates (xi, eta) in which the
footprint is a circle,

    xi = white_x (dx - shear dy),   eta = white_y dy,   alpha = 2^(log2_opacity - xi^2 - eta^2).

The map is the Cholesky factor of the conic, scaled so that the exponent is one of 2 instead of e.
For thin footprints (1:1000) the terms of a conic cancel in float32; these do not. And where a splat
is drawn, xi and eta are of order one, so that fourth powers of them, which the Fisher information
sums, lose no digits either.

The projection is computed in double precision and rounded to float32 once. It is work per Gaussian,
not per pixel, so that costs little; in single precision its errors would be the largest of the
whole renderer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.gaussians import SH_MAX, Gaussians
from mgs.memory import padded
from mgs.rotation import QUAT_MIN
from mgs.splat.constants import EPS2D, FRUSTUM_MARGIN, LOG_SCALE_RANGE, NEAR

LOG2E = 1.4426950408889634


@dataclass
class Splats:
    """N projected Gaussians. Every field is a Dr.Jit array [N], Float from `project` and Float64
    from `project64`.

    mean_x, mean_y: centre, pixels from the image's corner. shear (no unit), white_x, white_y
    (1/px): the whitening, see the module's docstring. log2_opacity: base-2 logarithm of the
    opacity. depth: z-depth of the centre, metres.
    red, green, blue: colour seen from the camera, linear RGB, at least 0.
    visible: mask of centres in front of the near plane; where it is False, the fields above mean
    nothing.
    finite: mask of Gaussians with no parameter NaN or infinite and no colour coefficient beyond
    `mgs.gaussians.SH_MAX`.
    mean_x_rest, mean_y_rest (px), shear_rest: what rounding to float32 took away from mean_x,
    mean_y and shear. In a 640x480 image that is up to 3e-5 px, and for the shear as much at the far
    end of a long slanted footprint. Not differentiated.
    """

    mean_x: Any
    mean_y: Any
    shear: Any
    white_x: Any
    white_y: Any
    log2_opacity: Any
    depth: Any
    red: Any
    green: Any
    blue: Any
    visible: Any = None
    finite: Any = None
    mean_x_rest: Any = None
    mean_y_rest: Any = None
    shear_rest: Any = None

    @property
    def colour(self) -> list[Any]:
        """[red, green, blue]."""
        return [self.red, self.green, self.blue]


def camera_array(camera: Camera) -> Any:
    """The camera as one Dr.Jit array of 23 Float64. Numbers in an array are not compiled into a
    kernel, those of Python are.

    Layout: rotation (9, row by row) and translation (3) of `world_to_camera`; fx, fy, cx, cy in
    pixels; lower and upper bound of x/z, then of y/z (4, see `FRUSTUM_MARGIN`); position of the
    camera in the world, metres (3).
    """
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    margin_x, margin_y = (
        FRUSTUM_MARGIN * 0.5 * camera.width / fx,
        FRUSTUM_MARGIN * 0.5 * camera.height / fy,
    )
    clamp = [
        -cx / fx - margin_x,
        (camera.width - cx) / fx + margin_x,
        -cy / fy - margin_y,
        (camera.height - cy) / fy + margin_y,
    ]
    pose = camera.world_to_camera
    numbers = [*pose[:3, :3].ravel(), *pose[:3, 3], fx, fy, cx, cy, *clamp, *camera.position]
    return mi.Float64(padded(numbers, np.float64))


def _numbers(array: Any, first: int, end: int) -> list[Any]:
    """Some numbers of a `camera_array`, each as an array of its own, which a kernel reads once for
    all Gaussians. Each is copied in memory, so only those that are needed are asked for."""
    return [dr.gather(mi.Float64, array, mi.UInt32(i)) for i in range(first, end)]


def rotation_columns(quats: Any) -> list[Any]:
    """Columns of the rotation matrices of quaternions wxyz (Vector4d, any norm; zero is the
    identity): three Vector3d."""
    quats = dr.select(is_rotation(quats), quats, mi.Vector4d(1, 0, 0, 0))
    w, x, y, z = quats * dr.rsqrt(dr.squared_norm(quats))
    return [
        mi.Vector3d(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        mi.Vector3d(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        mi.Vector3d(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]


def is_rotation(quats: Any) -> Any:
    """Mask [N] of the quaternions (Vector4d) that are not zero, to `QUAT_MIN`."""
    return dr.max(dr.abs(dr.detach(quats))) > QUAT_MIN


def sh_basis(means: Any, camera: Any, coefficients: int) -> list[Any]:
    """Values of the K = `coefficients` real spherical harmonics in the directions from the camera
    to the means.

    means: Vector3d, world, metres; camera: `camera_array`. Returns K arrays Float64 [N], in the
    order and signs of 3DGS.
    """
    offset = means - mi.Vector3d(*_numbers(camera, 20, 23))
    directions = offset * dr.rsqrt(dr.maximum(dr.squared_norm(offset), 1e-24))
    return dr.sh_eval(directions, round(coefficients**0.5) - 1)


def rows_as_vectors(tensor: Any, dtype: Any) -> Any:
    """A TensorXf [N, size] as one array of N Dr.Jit vectors of the type `dtype`, which has that
    size.

    Every number is read by one vector alone, and Dr.Jit is told so: the derivative needs no atomic
    additions, whose order would change from run to run.
    """
    return dr.gather(
        dtype, tensor.array, dr.arange(mi.UInt32, tensor.shape[0]), mode=dr.ReduceMode.NoConflicts
    )


def axes2d(mean: Any, quats: Any, camera: Any) -> tuple[Any, list[Any], Any]:
    """Centres and local axes of the Gaussians in the image, by the affine approximation of EWA
    splatting.

    mean: Vector3d, world, metres; quats: Vector4d; camera: `camera_array`. Returns
    (x px, y px, z-depth m) of the centres, with depth 1 where the centre is not visible, so that no
    division fails; the image of each of the three local axes (unit vectors), pixels per metre,
    three Vector2d; the mask of centres in front of the near plane.
    """
    R, t = (
        [mi.Vector3d(*_numbers(camera, 3 * i, 3 * i + 3)) for i in range(3)],
        mi.Vector3d(*_numbers(camera, 9, 12)),
    )
    fx, fy, cx, cy, x0, x1, y0, y1 = _numbers(camera, 12, 20)
    x, y, z = (dr.dot(row, mean) + t[i] for i, row in enumerate(R))
    visible = z > NEAR
    z = dr.select(visible, z, 1)
    x, y, inv_z = x / z, y / z, dr.rcp(z)
    T0, T1 = (
        (R[0] - dr.clip(x, x0, x1) * R[2]) * (fx * inv_z),
        (R[1] - dr.clip(y, y0, y1) * R[2]) * (fy * inv_z),
    )
    unit = [mi.Vector2d(dr.dot(T0, c), dr.dot(T1, c)) for c in rotation_columns(quats)]
    return (fx * x + cx, fy * y + cy, z), unit, visible


def whitening(axes: list[Any]) -> tuple[Any, Any, Any]:
    """(shear, white_x, white_y) of the 2D covariance sum_i axis_i axis_i^T + EPS2D I = [a b; b c],
    px^2.

    axes: the three semi-axes of the Gaussian in the image, pixels, Vector2d.
    The determinant is computed as a sum of squared 2x2 minors of the axes (Cauchy-Binet formula).
    All terms are positive, so that nothing cancels, however thin the footprint. Computed as a c -
    b^2 it would.
    """
    c = sum(a.y * a.y for a in axes) + EPS2D
    b = sum(a.x * a.y for a in axes)
    trace = sum(dr.squared_norm(a) for a in axes)
    minors = [axes[i].x * axes[j].y - axes[i].y * axes[j].x for i, j in ((0, 1), (0, 2), (1, 2))]
    det = sum(m * m for m in minors) + EPS2D * trace + EPS2D * EPS2D
    return b / c, dr.sqrt(0.5 * LOG2E * c / det), dr.sqrt(0.5 * LOG2E / c)


def _with_rest(value: Any) -> tuple[Any, Any]:
    """A Float64 rounded to Float, and the difference that rounding made, a Float too (not
    differentiated)."""
    rounded = mi.Float(value)
    return rounded, mi.Float(dr.detach(value - mi.Float64(rounded)))


def project64(gaussians: Gaussians, camera: Any) -> Splats:
    """Project Gaussians (Dr.Jit TensorXf fields) through a `camera_array`. Float64 fields; the
    three `_rest` fields are None.

    Differentiable in every parameter. Source: EWA splatting (Zwicker et al. 2002) as 3DGS uses it
    (Kerbl et al. 2023).
    """
    mean, quats = (
        mi.Vector3d(rows_as_vectors(gaussians.means, mi.Vector3f)),
        mi.Vector4d(rows_as_vectors(gaussians.quats, mi.Vector4f)),
    )
    log_scales = mi.Vector3d(rows_as_vectors(gaussians.log_scales, mi.Vector3f))
    logit = mi.Float64(gaussians.logit_opacities.array)
    (x, y, depth), unit, visible = axes2d(mean, quats, camera)
    scales = dr.exp(dr.clip(log_scales, *LOG_SCALE_RANGE))
    shear, white_x, white_y = whitening([a * s for a, s in zip(unit, scales, strict=True)])
    log2_opacity = LOG2E * (dr.minimum(logit, 0) - dr.log(1 + dr.exp(-dr.abs(logit))))
    finite = (
        dr.all(dr.isfinite(mean))
        & dr.all(dr.isfinite(quats))
        & dr.all(dr.isfinite(log_scales))
        & dr.isfinite(logit)
    )
    colour, index = mi.Color3d(0.5), dr.arange(mi.UInt32, len(gaussians))
    coefficients = gaussians.sh.shape[1]
    for i, basis in enumerate(sh_basis(mean, camera, coefficients)):
        sh = dr.gather(
            mi.Color3f, gaussians.sh.array, index * coefficients + i, mode=dr.ReduceMode.NoConflicts
        )
        finite &= dr.all(dr.abs(sh) <= SH_MAX)
        colour += basis * mi.Color3d(sh)
    colour = dr.maximum(colour, 0)
    red, green, blue = colour
    return Splats(
        x, y, shear, white_x, white_y, log2_opacity, depth, red, green, blue, visible, finite
    )


def project(gaussians: Gaussians, camera: Any) -> Splats:
    """`project64` with every number rounded to Float, and the `_rest` fields set. Differentiable in
    every parameter."""
    exact = project64(gaussians, camera)
    mean_x, mean_x_rest = _with_rest(exact.mean_x)
    mean_y, mean_y_rest = _with_rest(exact.mean_y)
    shear, shear_rest = _with_rest(exact.shear)
    return Splats(
        mean_x=mean_x,
        mean_y=mean_y,
        shear=shear,
        white_x=mi.Float(exact.white_x),
        white_y=mi.Float(exact.white_y),
        log2_opacity=mi.Float(exact.log2_opacity),
        depth=mi.Float(exact.depth),
        red=mi.Float(exact.red),
        green=mi.Float(exact.green),
        blue=mi.Float(exact.blue),
        visible=exact.visible,
        finite=exact.finite,
        mean_x_rest=mean_x_rest,
        mean_y_rest=mean_y_rest,
        shear_rest=shear_rest,
    )
