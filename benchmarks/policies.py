"""Policies that were tried and are no rows of `mgs nbv --policy`: `--policy benchmarks/policies.py:NAME` takes them."""

from __future__ import annotations

import numpy as np

from mgs.active.outlook import Outlook


def linear_look(outlook: Outlook) -> np.ndarray:
    """`directional-i` with colours that change with the direction linearly (SH degree 1, tau 0.1) instead of degree 3."""
    return outlook.gains(outlook.visited, outlook.left, 1, 0.1, True)
