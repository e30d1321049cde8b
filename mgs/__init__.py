"""mgs: active Gaussian splatting with exact Fisher information, on Mitsuba 3 and Dr.Jit."""

__version__ = "0.1.0"
