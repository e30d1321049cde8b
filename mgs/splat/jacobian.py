"""Products with the Jacobian J of an image by the parameters of the Gaussians: J v (`jvp`, forward
mode) and z^T J (`vjp`, reverse mode). J itself is never formed."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.gaussians import ARRAYS, Gaussians
from mgs.memory import padded
from mgs.splat.recording import one_at_a_time
from mgs.splat.rendering import Image, ListCache, as_colour, as_drjit, render


@one_at_a_time
def jvp(
    gaussians: Gaussians,
    tangents: Mapping[str, Any],
    camera: Camera | Sequence[Camera],
    background: Any = (0.0, 0.0, 0.0),
    cache: ListCache | None = None,
) -> Image:
    """Derivative of the image along `tangents` of the Gaussians: J v in one pass (forward mode),
    with J the Jacobian of `render`.

    - gaussians, camera, background, cache: as in `render`; their gradients are ignored. For the
      derivative by a pose see `moved`.
    - tangents: d parameter / dt for some t, by name ("means", "log_scales", "quats",
      "logit_opacities", "sh"), NumPy or Dr.Jit of the parameter's shape. Others are constant.

    Returns the derivatives by t of rgb, alpha and depth, of the shapes of `render`. Raises
    InputError as `render`, and for a tangent of an unknown name, of a wrong shape or not finite."""
    model = as_drjit(gaussians)
    tensors = {name: _checked_tangent(model, name, tangent) for name, tangent in tangents.items()}
    with dr.resume_grad():
        copy = model.map(lambda v: dr.copy(dr.detach(v)))
        for name, tangent in tensors.items():
            dr.enable_grad(getattr(copy, name))
            dr.set_grad(getattr(copy, name), tangent)
        image = render(copy, _untraced(camera), dr.detach(as_colour(background)), cache)
        # AllowNoGrad: there may be no tangents.
        dr.forward_to(image, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
        return dr.grad(image)


def _checked_tangent(gaussians: Gaussians, name: str, tangent: Any) -> Any:
    """A tangent as detached TensorXf. Raises InputError as `jvp`."""
    if name not in ARRAYS:
        raise InputError(f"tangents: {name!r} is no parameter; choose from {', '.join(ARRAYS)}")
    shape = tuple(getattr(gaussians, name).shape)
    try:
        with np.errstate(over="ignore"):
            values = np.asarray(dr.detach(tangent), np.float32)
    except (TypeError, ValueError):
        why = f"{name} must be numbers of the parameter's shape, {shape}"
        raise InputError(f"tangents: {why}") from None
    if values.shape != shape:
        why = f"{name} has shape {values.shape}, expected {shape}, that of the parameter"
        raise InputError(f"tangents: {why}")
    if not np.isfinite(values).all():
        first = np.argwhere(~np.isfinite(values))[0][0]
        why = f"{name} is NaN or infinite, first at Gaussian {first}"
        raise InputError(f"tangents: {why}; remove or repair it")
    return mi.TensorXf(padded(values))


def _untraced(camera: Camera | Sequence[Camera]) -> Camera | list[Camera]:
    return replace(camera) if isinstance(camera, Camera) else [replace(one) for one in camera]


@one_at_a_time
def vjp(
    gaussians: Gaussians,
    cotangent: Any,
    camera: Camera | Sequence[Camera],
    background: Any = (0.0, 0.0, 0.0),
    cache: ListCache | None = None,
    by: Sequence[str] = ARRAYS,
) -> dict[str, np.ndarray]:
    """Derivative of sum(z rgb) by the Gaussians: z^T J in one pass (reverse mode), with J the
    Jacobian of the rgb of `render`.

    - gaussians, camera, background, cache: as in `render`; their gradients are ignored.
    - cotangent: z, one number for each of the image's rgb, of its shape; or a function rgb -> z of
      TensorXf, which is not differentiated.
    - by: names of the parameters to differentiate by, as in `jvp`.

    Returns the derivatives by name, float32 of the parameter's shape. Raises InputError as
    `render`, for an unknown name, and for a cotangent of another shape."""
    if unknown := [name for name in by if name not in ARRAYS]:
        raise InputError(f"by: {unknown[0]!r} is no parameter; choose from {', '.join(ARRAYS)}")
    with dr.resume_grad():
        model = as_drjit(gaussians).map(dr.detach)
        values = {name: dr.copy(getattr(model, name)) for name in by}
        dr.enable_grad(list(values.values()))
        variables = replace(model, **values)
        rgb = render(variables, _untraced(camera), dr.detach(as_colour(background)), cache).rgb
        z = cotangent(dr.detach(rgb)) if callable(cotangent) else cotangent
        z = dr.detach(z) if dr.is_array_v(z) else mi.TensorXf(padded(z))
        if tuple(z.shape) != tuple(rgb.shape):
            raise InputError(f"cotangent: has shape {z.shape}, expected {rgb.shape}, the image's")
        if len(model) == 0:
            return {name: np.zeros(value.shape, np.float32) for name, value in values.items()}
        dr.backward_from(dr.sum(rgb * z, axis=None))
        return {name: np.asarray(dr.grad(value)) for name, value in values.items()}
