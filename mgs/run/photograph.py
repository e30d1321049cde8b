"""Checks of a photograph before a model is fitted to it: object, exposure, blur."""

from __future__ import annotations

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.data.frames import Frame
from mgs.errors import InputError

WHITE, MOST_WHITE = 254 / 255, 0.5
"""A pixel is white from this sRGB value on; largest share of the object that may be."""

BLACK, MOST_BLACK = 2 / 255, 0.95
"""The same of black. Shadows on the Moon are black."""

MOST_BLUR = 0.6
"""Largest blur by Crete et al. (2007), 0 to 1 (`skimage.measure.blur_effect`). Sharp pictures have
0.12 to 0.37, the same blurred by 11 pixels of motion 0.6 to 0.7; tiny ones never reach it."""


def check_photograph(frame: Frame) -> None:
    """Raises InputError where an image does not show the object, is black or white, or blurred."""
    from skimage.measure import blur_effect

    mask, path = frame.mask(), frame.image_path.name
    if not mask.any():
        raise InputError(f"{path}: the object is not in the picture")
    grey = srgb_from_linear(frame.rgb()).mean(axis=-1)
    for name, share, most in (
        ("over", float((grey[mask] >= WHITE).mean()), MOST_WHITE),
        ("under", float((grey[mask] <= BLACK).mean()), MOST_BLACK),
    ):
        if share > most:
            raise InputError(f"{path}: {name}exposed, {100 * share:.0f} % of the object")
    blur = float(blur_effect(grey)) if np.ptp(grey) > 0 else 0.0
    if blur > MOST_BLUR:
        raise InputError(f"{path}: blurred ({blur:.2f}, at most {MOST_BLUR})")
