"""Allocation of bits: steps c / sqrt(h), with h what errors cost (docs/bytes.md), so that every
rounding costs c^2 / 12 (reverse water-filling, Cover and Thomas 2006, 10.3.3), and order of the
packets."""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from mgs.compact.coder import FINER, LARGEST
from mgs.compact.container import Key
from mgs.compact.tree import BANDS

ROUND = 0.35  # added before magnitudes are cut to whole steps: below 1/2, since zeros are cheap
FLOOR = 1e-12  # least share of a column's largest h: steps stay finite where no image shows a thing


def sensitivity(gradients: np.ndarray, band: np.ndarray) -> np.ndarray:
    """Squared change of the images by each kind of coefficient, h [BANDS,C].

    gradients: [V,N,C] of sum(z image) by the coefficients, with z independent signs in each of V
    views: the mean square over a band is that of the norm of its columns of J (Hutchinson's
    estimator), which the diagonal of J^T J alone does not give, since neighbours overlap.
    band: [N]. Bands without a coefficient get the mean of the others.
    """
    total = np.square(gradients).sum(0)
    count = np.bincount(band, minlength=BANDS)[:, None]
    sums = np.stack([np.bincount(band, column, BANDS) for column in total.T], 1)
    h = np.where(count > 0, sums / np.maximum(count, 1), sums.sum(0) / len(band))
    return np.asarray(np.maximum(h, FLOOR * h.max(0)) + 1e-30)


def rounded(values: np.ndarray, steps: np.ndarray, layers: int) -> list[np.ndarray]:
    """Whole numbers of steps [N,C] for each layer: those of the last, without their last digits to
    base FINER. steps: those of the last layer."""
    signs, whole = np.sign(values), np.floor(np.abs(values) / steps + ROUND)
    most = np.minimum(whole, LARGEST).astype(np.int64)
    parts = [most // FINER ** (layers - 1 - layer) for layer in range(layers)]
    return [signs.astype(np.int64) * part for part in parts]


def gain(values: np.ndarray, shown: list[np.ndarray], h: np.ndarray) -> np.ndarray:
    """Decrease of the expected error by each layer, [layers,N,C]. shown: values [N,C] that a reader
    of the layers up to each one has. h: squared change of the images by a unit [N,C]."""
    errors = [h * np.square(values - part) for part in [np.zeros_like(values), *shown]]
    return np.stack([a - b for a, b in pairwise(errors)])


def in_order(gains: Mapping[Key, float], sizes: Mapping[Key, int]) -> list[Key]:
    """Packets by decrease of the expected error per byte, the largest first. A layer comes after
    the one before it, and a tile's positions before the rest of the tile: they count with its first
    colours, without which they show nothing."""

    def rate(key: Key) -> float:
        return gains.get(key, 0.0) / sizes[key]

    rates: dict[Key, float] = {}
    for key in sorted(sizes, key=lambda key: (key[0] > 0, key[1] != "position", key[2])):
        tile, group, layer = key
        if group == "position":
            colour = tile, "colour", 0
            both = sizes[key] + sizes.get(colour, 0)
            shown = gains.get(key, 0.0) + gains.get(colour, 0.0)
            rates[key] = np.inf if tile == 0 else shown / both
            continue
        before = [(tile, "position", 0), (tile, group, layer - 1)]
        rates[key] = min([rate(key), *(rates[one] for one in before if one in rates)])
    return sorted(sizes, key=lambda key: (-rates[key], key[2], key[1] != "position"))
