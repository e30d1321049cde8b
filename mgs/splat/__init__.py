"""Gaussian splatting on Dr.Jit: render, differentiate, and measure information.

`render` draws Gaussians and is differentiable by `dr.backward`; `fisher` gives the information that a view carries about each
Gaussian; a `ListCache` kept between calls makes both faster for cameras seen before. Set a Mitsuba variant before calling them.
Importing this package registers the Mitsuba integrator `mgs_splat` (plugins/mgs_splat.py), which draws the same images.
"""

from mgs.splat.fisher import ESTIMATORS, fisher, groups
from mgs.splat.render import Image, ListCache, as_drjit, render
from mgs.splat.sensor import camera_from_sensor

import mgs.mitsuba_plugins  # isort: skip  # noqa: F401  Last: the plugin imports the names above.

__all__ = ["ESTIMATORS", "Image", "ListCache", "as_drjit", "camera_from_sensor", "fisher", "groups", "render"]
