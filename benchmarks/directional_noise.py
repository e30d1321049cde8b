"""`directional-i` that assumes more noise: `mgs nbv --policy benchmarks/directional_noise.py:NAME` takes these.

The criteria assume a noise of 0.02 (`--pixel-noise`), but new images differ from a model that has not seen them by 0.04 to 0.06
(docs/fit.md). With more noise a few pixels determine less, so near views, which have more of them, count for more.
"""

from __future__ import annotations

import numpy as np

from mgs.active.criteria import PIXEL_NOISE
from mgs.active.directional import gains
from mgs.active.outlook import Outlook


def _directional_i(outlook: Outlook, noise: float) -> np.ndarray:
    lam = float(outlook.prior_lam[0]) * (noise / PIXEL_NOISE) ** 2
    return gains(outlook.points, lam, 3, 0.1, outlook.views(outlook.visited), outlook.views(outlook.left), outlook.dome())


def noise_04(outlook: Outlook) -> np.ndarray:
    """A noise of 0.04."""
    return _directional_i(outlook, 0.04)


def noise_08(outlook: Outlook) -> np.ndarray:
    """A noise of 0.08."""
    return _directional_i(outlook, 0.08)


def noise_16(outlook: Outlook) -> np.ndarray:
    """A noise of 0.16."""
    return _directional_i(outlook, 0.16)
