"""Gaussian splatting on Dr.Jit: render, differentiate, and measure information.

`render` draws Gaussians, differentiably in both directions, also by the pose and focal length of a
camera (`moved`). `jvp` gives the derivative of an image along a change of the Gaussians. `fisher`
gives the information of a view about each Gaussian. A `ListCache` passed to all calls makes them
faster for cameras seen before. They start Dr.Jit
themselves (`mgs.runtime.start`).

`import mgs.splat.plugins` registers the Mitsuba integrator `mgs_splat` (plugins/mgs_splat.py),
which draws the same images.
"""

from mgs.splat.information import ESTIMATORS, MEANS, fisher, groups
from mgs.splat.mitsuba_sensor import camera_from_sensor
from mgs.splat.projection import moved
from mgs.splat.rendering import Image, ListCache, as_drjit, jvp, render

__all__ = [
    "ESTIMATORS",
    "MEANS",
    "Image",
    "ListCache",
    "as_drjit",
    "camera_from_sensor",
    "fisher",
    "groups",
    "jvp",
    "moved",
    "render",
]
