"""EWA projection of Gaussians to splats, differentiated by Dr.Jit: footprints as *whitenings*,

    xi = white_x (dx - shear dy),   eta = white_y dy,   alpha = 2^(log2_opacity - xi^2 - eta^2),

in double, rounded to float32 once (docs/splatting.md, Project). Where a splat is drawn, xi and eta
are of order one, so the fourth powers in the Fisher information lose no digits."""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.gaussians import SH_MAX, Gaussians
from mgs.memory import padded
from mgs.rotation import QUAT_MIN
from mgs.splat.constants import COMPENSATION_MIN, EPS2D, FRUSTUM_MARGIN, LOG_SCALE_RANGE, NEAR
from mgs.splat.recording import frozen

LOG2E = 1.4426950408889634


@dataclass
class Splats:
    """N projected Gaussians, Dr.Jit arrays [N]: Float from `project`, Float64 from `project64`."""

    mean_x: Any  # centre, pixels from the corner of the film (`Camera.film`)
    mean_y: Any
    shear: Any  # the whitening (see the module): shear has no unit
    white_x: Any  # 1/px
    white_y: Any
    log2_opacity: Any  # times its compensation if antialiased
    depth: Any  # z-depth of the centre, metres
    red: Any  # colour seen from the camera, linear RGB, at least 0
    green: Any
    blue: Any
    visible: Any = None  # mask of centres before the near plane; elsewhere fields mean nothing
    finite: Any = None  # mask without NaN, infinity or colour coefficient beyond SH_MAX
    mean_x_rest: Any = None  # rounding errors, up to 3e-5 px in 640x480; not differentiated
    mean_y_rest: Any = None
    shear_rest: Any = None

    @property
    def colour(self) -> list[Any]:
        """[red, green, blue]."""
        return [self.red, self.green, self.blue]


def camera_array(camera: Camera) -> Any:
    """The camera as a Dr.Jit array of 23 Float64. Unlike Python numbers, these are not compiled
    into a kernel. Of a crop window it is that of its film. It has the gradients of a `traced`
    camera.

    Layout: rotation (9, row by row) and translation (3) of `world_to_camera`; fx, fy, cx, cy,
    pixels; lower and upper bound of x/z, then of y/z (4, FRUSTUM_MARGIN); camera centre (3),
    metres."""
    camera = camera.film or camera
    if camera.traced is None:
        K, pose, centre = camera.K, camera.world_to_camera, list(camera.position)
    else:
        K, pose = (_entries(tensor) for tensor in camera.traced)
        # The centre is -R^T t.
        centre = [-sum(pose[row, i] * pose[row, 3] for row in range(3)) for i in range(3)]
    # Bounds of x/z: the film, from -cx/fx to (width - cx)/fx, and a margin on each side.
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / fx
    margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / fy
    clamp = [
        -cx / fx - margin_x,
        (camera.width - cx) / fx + margin_x,
        -cy / fy - margin_y,
        (camera.height - cy) / fy + margin_y,
    ]
    numbers = [*pose[:3, :3].ravel(), *pose[:3, 3], fx, fy, cx, cy, *clamp, *centre]
    if camera.traced is not None:
        return dr.concat([mi.Float64(number) for number in numbers])
    # A list: Dr.Jit frees NumPy arrays between kernels, on a thread that waits for Python's lock.
    return mi.Float64([float(number) for number in numbers])


def _entries(tensor: Any) -> np.ndarray:
    """Entries of a square TensorXf, Float64 [1] each, with their gradients, as an array of objects
    of its shape."""
    if not dr.is_tensor_v(tensor):
        flat = mi.Float64(padded(np.ravel(tensor), np.float64))
    else:
        flat = mi.Float64(tensor.array)
    entries = [dr.gather(mi.Float64, flat, mi.UInt32(i)) for i in range(len(flat))]
    size = round(len(flat) ** 0.5)
    square = np.empty((size, size), object)
    for i, entry in enumerate(entries):
        square[divmod(i, size)] = entry
    return square


def moved(camera: Camera, motion: Any, zoom: Any = 0.0) -> Camera:
    """Camera that is turned and shifted in its own axes, to differentiate images by its pose.

    motion: Dr.Jit Float or Float64 [6]: rotation vector, radians, then translation, metres, in the
    axes of the camera (x right, y down, z forward); points turn and shift the other way. zoom:
    logarithm of the factor on both focal lengths. Derivatives are exact also where motion is 0."""
    number = [dr.gather(mi.Float64, mi.Float64(motion), mi.UInt32(i)) for i in range(6)]
    w, shift = mi.Vector3d(*number[:3]), mi.Vector3d(*number[3:])
    # Rodrigues: R = 1 + sin(a)/a [w] + (1 - cos(a))/a^2 [w]^2 with a = |w|; near 0 the series.
    square = dr.squared_norm(w)
    near, angle = square < 1e-6, dr.sqrt(dr.select(square < 1e-6, 1, square))
    sine = dr.select(near, 1 - square / 6, dr.sin(angle) / angle)
    cosine = dr.select(near, 0.5 - square / 24, (1 - dr.cos(angle)) / (angle * angle))
    cross = mi.Matrix3d(0, -w.z, w.y, w.z, 0, -w.x, -w.y, w.x, 0)
    # The inverse of the camera's motion moves the points: R^T (x - shift).
    turn = mi.Matrix3d(1) - sine * cross + cosine * (cross @ cross)
    # Points: x -> R^T (x - shift), so t -> R^T (t - shift) and R_old -> R^T R_old.
    # As arrays: Python numbers would compile a kernel for every camera.
    old, K = map(_entries, (camera.world_to_camera, camera.K))
    t = turn @ (mi.Vector3d(*old[:3, 3]) - shift)
    R = turn @ mi.Matrix3d(*old[:3, :3].ravel())
    rows = [x for i in range(3) for x in (R[i, 0], R[i, 1], R[i, 2], t[i])]
    pose = dr.concat([mi.Float64(x) for x in (*rows, 0.0, 0.0, 0.0, 1.0)])
    # Focal lengths times e^zoom; entries 0 and 4 of K are fx and fy.
    factor = dr.exp(mi.Float64(zoom))
    numbers = [factor * x if i in (0, 4) else x for i, x in enumerate(K.ravel())]
    size = camera.width, camera.height
    return Camera(mi.TensorXf64(dr.concat(numbers), (3, 3)), *size, mi.TensorXf64(pose, (4, 4)))


def _numbers(array: Any, first: int, end: int) -> list[Any]:
    """Numbers of a `camera_array`, each as an array of its own, read once for all Gaussians. Each
    is copied, so ask only for those needed."""
    return [dr.gather(mi.Float64, array, mi.UInt32(i)) for i in range(first, end)]


def inverse_sqrt(x: Any) -> Any:
    """1 / sqrt(x) of a Float64. Dr.Jit's own reciprocals (`rcp`, `rsqrt`) have 20 bits on a GPU,
    and a division has 53."""
    return dr.sqrt(1 / x)


def rotation_columns(quats: Any) -> list[Any]:
    """Columns of the rotation matrices of quaternions wxyz, three Vector3d. Any norm; zero is the
    identity."""
    # Unit quaternion, then the columns of its rotation matrix.
    quats = dr.select(is_rotation(quats), quats, mi.Vector4d(1, 0, 0, 0))
    w, x, y, z = quats * inverse_sqrt(dr.squared_norm(quats))
    return [
        mi.Vector3d(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        mi.Vector3d(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        mi.Vector3d(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]


def is_rotation(quats: Any) -> Any:
    """Mask [N] of quaternions (Vector4d) that are not zero, to `QUAT_MIN`."""
    return dr.max(dr.abs(dr.detach(quats))) > QUAT_MIN


def sh_basis(means: Any, camera: Any, coefficients: int) -> list[Any]:
    """Real spherical harmonics in the directions from the camera to the means: K = `coefficients`
    arrays Float64 [N], in the order and signs of 3DGS. means: Vector3d, world, metres. camera:
    `camera_array`."""
    # Unit direction from the camera's centre (numbers 20 to 22) to each mean.
    offset = means - mi.Vector3d(*_numbers(camera, 20, 23))
    directions = offset * inverse_sqrt(dr.maximum(dr.squared_norm(offset), 1e-24))
    return dr.sh_eval(directions, round(coefficients**0.5) - 1)


def rows_as_vectors(tensor: Any, dtype: Any) -> Any:
    """A TensorXf [N, size] as N Dr.Jit vectors of type `dtype`. NoConflicts is right because every
    number is read by one vector alone. The derivative then needs no atomic additions, whose order
    would change from run to run."""
    return dr.gather(
        dtype, tensor.array, dr.arange(mi.UInt32, tensor.shape[0]), mode=dr.ReduceMode.NoConflicts
    )


def axes2d(mean: Any, quats: Any, camera: Any) -> tuple[Any, list[Any], Any]:
    """Centres and local axes of Gaussians in the image, by the affine approximation of EWA
    splatting.

    mean: Vector3d, world, metres. quats: Vector4d. camera: `camera_array`.
    Returns (x px, y px, z-depth m) of the centres, with depth 1 where not visible, to avoid
    divisions by 0; the images of the three unit axes, pixels per metre, Vector2d; and the mask of
    centres in front of the near plane."""
    R = [mi.Vector3d(*_numbers(camera, 3 * i, 3 * i + 3)) for i in range(3)]
    t = mi.Vector3d(*_numbers(camera, 9, 12))
    fx, fy, cx, cy, x0, x1, y0, y1 = _numbers(camera, 12, 20)
    # Camera coordinates R m + t; x and y then become x/z and y/z.
    x, y, z = (dr.dot(row, mean) + t[i] for i, row in enumerate(R))
    visible = z > NEAR
    z = dr.select(visible, z, 1)
    x, y, inv_z = x / z, y / z, 1 / z
    # Rows of T = J R with J = [fx/z, 0, -fx x/z^2; 0, fy/z, -fy y/z^2], the Jacobian of the
    # projection; in it x/z and y/z are clamped to the film and its margin. Image of axis r: T r.
    T0 = (R[0] - dr.clip(x, x0, x1) * R[2]) * (fx * inv_z)
    T1 = (R[1] - dr.clip(y, y0, y1) * R[2]) * (fy * inv_z)
    unit = [mi.Vector2d(dr.dot(T0, c), dr.dot(T1, c)) for c in rotation_columns(quats)]
    return (fx * x + cx, fy * y + cy, z), unit, visible


def whitening(axes: list[Any]) -> tuple[Any, Any, Any, Any]:
    """(shear, white_x, white_y) of the 2D covariance sum_i axis_i axis_i^T + EPS2D I, px^2, and
    the share of its determinant without EPS2D, 0 to 1.

    axes: the three semi-axes of the Gaussian in the image, pixels, Vector2d.
    The determinant is a sum of squared 2x2 minors of the axes (Cauchy-Binet formula). All terms are
    positive, so nothing cancels, however thin the footprint."""
    # Sigma = [a b; b c] = sum of axis axis^T + EPS2D I, of which only b, c and trace are needed.
    c = sum(a.y * a.y for a in axes) + EPS2D
    b = sum(a.x * a.y for a in axes)
    trace = sum(dr.squared_norm(a) for a in axes)
    minors = [axes[i].x * axes[j].y - axes[i].y * axes[j].x for i, j in ((0, 1), (0, 2), (1, 2))]
    # det(A A^T) = sum of squared minors = own; det Sigma = own + EPS2D trace + EPS2D^2. k = b / c,
    # p^2 = c / (2 ln 2 det Sigma), e^2 = 1 / (2 ln 2 c).
    own = sum(m * m for m in minors)
    det = own + EPS2D * trace + EPS2D * EPS2D
    return b / c, dr.sqrt(0.5 * LOG2E * c / det), dr.sqrt(0.5 * LOG2E / c), own / det


def _with_rest(value: Any) -> tuple[Any, Any]:
    """A Float64 rounded to Float, and the rounding error as a Float (not differentiated)."""
    rounded = mi.Float(value)
    return rounded, mi.Float(dr.detach(value - mi.Float64(rounded)))


def project64(gaussians: Gaussians, camera: Any) -> Splats:
    """Project Gaussians (TensorXf fields) through a `camera_array`: Float64 fields, no rests.
    Differentiable in every parameter. Source: EWA splatting (Zwicker et al. 2002) as in 3DGS (Kerbl
    et al. 2023)."""
    mean = mi.Vector3d(rows_as_vectors(gaussians.means, mi.Vector3f))
    quats = mi.Vector4d(rows_as_vectors(gaussians.quats, mi.Vector4f))
    log_scales = mi.Vector3d(rows_as_vectors(gaussians.log_scales, mi.Vector3f))
    logit = mi.Float64(gaussians.logit_opacities.array)
    (x, y, depth), unit, visible = axes2d(mean, quats, camera)
    # Semi-axes in the image, pixels: s_i times the image of axis i.
    scales = dr.exp(dr.clip(log_scales, *LOG_SCALE_RANGE))
    # Sigma = sum over i of (s_i t_i) (s_i t_i)^T + EPS2D I.
    axes = [a * s for a, s in zip(unit, scales, strict=True)]
    shear, white_x, white_y, share = whitening(axes)
    # log2 of 1 / (1 + e^-l), as min(l, 0) - ln(1 + e^-|l|), which neither overflows nor cancels.
    log2_opacity = LOG2E * (dr.minimum(logit, 0) - dr.log(1 + dr.exp(-dr.abs(logit))))
    if gaussians.antialiased:
        # log2 of the compensation sqrt(det S / det(S + EPS2D I)).
        log2_opacity += 0.5 * LOG2E * dr.log(dr.maximum(share, COMPENSATION_MIN**2))
    # The caller names what is not finite (`ListCache.get`).
    finite = dr.all(dr.isfinite(mean)) & dr.all(dr.isfinite(quats))
    finite &= dr.all(dr.isfinite(log_scales)) & dr.isfinite(logit)
    colour, index = mi.Color3d(0.5), dr.arange(mi.UInt32, len(gaussians))
    # rgb = max(0, 0.5 + sum over k of Y_k(direction) sh_k).
    coefficients = gaussians.sh.shape[1]
    for i, basis in enumerate(sh_basis(mean, camera, coefficients)):
        sh = dr.gather(
            mi.Color3f, gaussians.sh.array, index * coefficients + i, mode=dr.ReduceMode.NoConflicts
        )
        finite &= dr.all(dr.abs(sh) <= SH_MAX)
        colour += basis * mi.Color3d(sh)
    r, g, b = dr.maximum(colour, 0)
    return Splats(x, y, shear, white_x, white_y, log2_opacity, depth, r, g, b, visible, finite)


def project(gaussians: Gaussians, camera: Any) -> Splats:
    """`project64` rounded to Float, with rests. Differentiable in every parameter."""
    exact = project64(gaussians, camera)
    mean_x, mean_x_rest = _with_rest(exact.mean_x)
    mean_y, mean_y_rest = _with_rest(exact.mean_y)
    shear, shear_rest = _with_rest(exact.shear)
    names = ("white_x", "white_y", "log2_opacity", "depth", "red", "green", "blue")
    return replace(
        exact,
        mean_x=mean_x,
        mean_y=mean_y,
        shear=shear,
        mean_x_rest=mean_x_rest,
        mean_y_rest=mean_y_rest,
        shear_rest=shear_rest,
        **{name: mi.Float(getattr(exact, name)) for name in names},
    )


@frozen(lambda gaussians, camera: gaussians.recorded)
def projected(gaussians: Gaussians, camera: Any) -> Splats:
    """`project`, recorded. Not differentiable."""
    return project(gaussians, camera)
