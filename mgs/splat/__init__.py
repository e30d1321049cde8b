"""Gaussian splatting on Dr.Jit: render, differentiate, and measure information.

`render` draws Gaussians, differentiably in both directions, also by the pose and focal length of a
camera (`moved`). `jvp` and `vjp` are products with the Jacobian of an image by the Gaussians.
`fisher` gives the information of a view about each Gaussian, `Information` that of many views about
all of them together. A `ListCache` passed to all calls makes them faster for cameras seen before.
They start Dr.Jit themselves (`mgs.runtime.start`).

`import mgs.splat.plugins` registers the Mitsuba integrator `mgs_splat` (plugins/mgs_splat.py),
which draws the same images."""

from mgs.splat.information import ESTIMATORS, MEANS, fisher, fisher_derivatives, groups
from mgs.splat.jacobian import jvp, vjp
from mgs.splat.mitsuba_sensor import camera_from_sensor
from mgs.splat.posterior import Estimate, Information
from mgs.splat.projection import moved
from mgs.splat.rendering import Image, ListCache, as_drjit, render

__all__ = [
    "ESTIMATORS",
    "MEANS",
    "Estimate",
    "Image",
    "Information",
    "ListCache",
    "as_drjit",
    "camera_from_sensor",
    "fisher",
    "fisher_derivatives",
    "groups",
    "jvp",
    "moved",
    "render",
    "vjp",
]
