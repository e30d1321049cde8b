"""Predicted PSNR of the views not taken, for `--stop-psnr`.

The image of a new view is a test of the model before it. Its error is above the mean error of the
images which that model was fitted to. This excess is about proportional to the view's directional
gain (D of `mgs.policy.directional`), so the last views give the factor for the views not taken.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

WINDOW = 3
"""Number of last fits whose new views give the mean excess. Chosen among 2 to 8 on two rocks that
judge nothing."""

LEAST_ERROR = 1e-8
"""Least mean squared error that is predicted, 80 dB."""


def predicted_psnr(entries: Sequence[Mapping[str, float]]) -> float | None:
    """Mean PSNR of the views not taken, dB; None without a new view, or if all are taken.

    entries: of every fit so far. "fitted": mean squared error of the views fitted to; "left": mean
    gain of the views not taken; after the first fit also "new", the error of the new view under the
    model before, and "gain", its gain at that time.
    """
    steps = list(pairwise(entries))[-WINDOW:]
    if not steps or "left" not in entries[-1]:
        return None
    excess = np.mean([after["new"] - before["fitted"] for before, after in steps])
    gain = np.mean([after["gain"] for _, after in steps])
    factor = max(float(excess), 0.0) / max(float(gain), 1e-30)
    error = entries[-1]["fitted"] + factor * entries[-1]["left"]
    return -10 * math.log10(max(error, LEAST_ERROR))
