"""Gaussian splatting on Dr.Jit: render, differentiate, and measure information.

`render` draws Gaussians and is differentiable by `dr.backward`; `fisher` gives the information that a view carries about each
Gaussian; a `ListCache` kept between calls makes both faster for cameras seen before. Set a Mitsuba variant before calling them.
"""

from mgs.splat.fisher import ESTIMATORS, fisher, groups
from mgs.splat.render import Image, ListCache, as_drjit, render

__all__ = ["ESTIMATORS", "Image", "ListCache", "as_drjit", "fisher", "groups", "render"]
