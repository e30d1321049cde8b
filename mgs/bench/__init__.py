"""Timings of the splatting kernels on this machine."""
