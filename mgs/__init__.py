"""mgs: active Gaussian splatting with exact Fisher information, on Mitsuba 3 and Dr.Jit.

`import mgs` loads nothing else. Each public name is loaded at its first use. Mitsuba's variant is
set (`llvm_ad_rgb`, if none is set) when something first computes with it.

Functions take and return NumPy arrays. `render` and `jvp` return Dr.Jit tensors, through which
`dr.backward` differentiates; `numpy.asarray` converts them. Gaussians may have NumPy or Dr.Jit
fields wherever they are accepted (`as_drjit`).

Lengths are metres, the world is +Z up, cameras are OpenCV's (x right, y down, z forward), colours
are linear RGB."""

import lazy_loader

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
