"""Timings of the splat core."""
