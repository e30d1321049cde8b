"""Gaussian splatting on Dr.Jit: render, differentiate, and measure information.

`render` draws Gaussians, and Dr.Jit can differentiate it in both directions. `jvp` says how an
image changes as the Gaussians change in a given way. `fisher` gives the information that a view
carries about each Gaussian. A `ListCache` kept between calls makes all three faster for cameras
seen before.

`render`, `jvp` and `fisher` start Dr.Jit themselves (`mgs.runtime.start`): importing this package
needs nothing before it. `import mgs.splat.plugins` registers the Mitsuba integrator `mgs_splat`
(plugins/mgs_splat.py), which draws the same images.
"""

from mgs.splat.information import ESTIMATORS, MEANS, fisher, groups
from mgs.splat.mitsuba_sensor import camera_from_sensor
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
    "render",
]
