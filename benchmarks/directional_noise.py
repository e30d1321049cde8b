"""`directional-i` that assumes more noise: `mgs nbv --policy benchmarks/directional_noise.py:NAME`
takes these.

The criteria assume a noise of 0.02 (`--pixel-noise`), but new images differ from a model that has
not seen them by 0.04 to 0.06 (docs/fit.md). With more noise a few pixels determine less, so near
views, which have more of them, count for more.
"""

from __future__ import annotations

import numpy as np

from mgs.policy.context import PolicyContext
from mgs.policy.criteria import PIXEL_NOISE
from mgs.policy.directional import gains


def _directional_i(context: PolicyContext, noise: float) -> np.ndarray:
    lam = float(context.prior_lam[0]) * (noise / PIXEL_NOISE) ** 2
    return gains(
        context.points,
        lam,
        3,
        0.1,
        context.views(context.taken_frames),
        context.views(context.candidate_frames),
        context.dome(),
    )


def noise_04(context: PolicyContext) -> np.ndarray:
    """A noise of 0.04."""
    return _directional_i(context, 0.04)


def noise_08(context: PolicyContext) -> np.ndarray:
    """A noise of 0.08."""
    return _directional_i(context, 0.08)


def noise_16(context: PolicyContext) -> np.ndarray:
    """A noise of 0.16."""
    return _directional_i(context, 0.16)
