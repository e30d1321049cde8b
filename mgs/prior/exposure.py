"""Exposure that differs between photographs: a gain for each image and channel, from what they show
of the same surface.

A camera that sets its exposure and white balance anew multiplies the linear RGB of a whole image by
a gain per channel. Where two images show the same samples of the prior's surface, the ratio of the
mean colours there is the ratio of their gains. The gains of all images together are the
least-squares solution of the ratios of all pairs: gain compensation (Brown and Lowe 2007,
"Automatic Panoramic Image Stitching using Invariant Features", section 6), here of logarithms, so
that it is linear.

This needs nothing but poses, the surface and the images themselves, so the gains are known before a
fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from mgs.data.dataset import Frame
from mgs.prior.initial import depth_of, seen_colours

if TYPE_CHECKING:
    from mgs.prior.build import Prior

SAMPLES = 4000
"""About how many samples of the surface are compared, at most; spread evenly over those of the
prior."""

SQUARENESS = 4
"""A sample counts in an image with this power of the cosine of the angle between its normal and the
view: surfaces shine at
grazing angles, and errors of the surface move them most there. Measured on the dataset of the demo,
whose exposure is constant: the gains of 12 views are wrong by 1 % (rms); by 6 % where all samples
count alike."""

SATURATED = 0.9
"""Brightest colour that is compared, linear RGB: a channel that is clipped at 1 says nothing of its
gain."""

DARK = 1e-3
"""Least mean brightness of samples that two images share, linear RGB, from which a ratio is
taken."""

RATIO_STD = 0.1
"""Standard deviation of the logarithm of the ratio that a single sample gives. A chosen
constant."""

GAIN_STD = 0.5
"""Standard deviation of the logarithm of a gain before any image is seen, 0.7 stops. It decides
only where images share few samples, or none."""


def solve_gains(colours: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The gains of images, [V,3]; in every channel their geometric mean is 1.

    colours: [V,S,3] linear RGB of S samples of the surface as V images show them, NaN where an
    image does not show a sample;
    weights: [V,S], 0 to 1, how much each counts. With l the logarithms of the gains of a channel,
    n_ij the sum over samples of the product of their weights in images i and j, and d_ij the
    logarithm of the ratio of their mean colours under these weights, the sum over pairs of n_ij
    (l_i - l_j - d_ij)^2 / RATIO_STD^2 plus the sum over images of l_i^2 / GAIN_STD^2 is least.
    """
    known = (np.nan_to_num(colours, nan=np.inf) <= SATURATED).all(axis=2)
    weights = np.where(known, weights, 0.0)
    values = np.where(known[..., None], colours, 0.0) * weights[..., None]
    shared = weights @ weights.T
    sums = np.stack(
        [values[..., c] @ weights.T for c in range(3)], -1
    )  # of the colours of i, in what it shares with j
    means = sums / np.maximum(shared, 1e-12)[..., None]
    lit = (np.minimum(means, means.swapaxes(0, 1)) >= DARK).all(axis=2) & ~np.eye(
        len(means), dtype=bool
    )
    precision = np.where(lit, shared, 0) / RATIO_STD**2
    ratio = np.log(np.maximum(means, DARK) / np.maximum(means.swapaxes(0, 1), DARK))
    matrix = np.diag(precision.sum(axis=1) + GAIN_STD**-2) - precision
    found = np.linalg.solve(matrix, (precision[..., None] * ratio).sum(axis=1))
    return np.exp(found - found.mean(axis=0))


def without_gain(target: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """A target [H,W,C], colours and what `mgs.data.dataset.target_of` has beside them, with its
    colours divided by the gains [3] of the three channels; float32."""
    return target / np.append(gain, np.ones(target.shape[-1] - 3)).astype(np.float32)


def exposure_of(prior: Prior) -> Callable[[Sequence[Frame]], np.ndarray]:
    """A function that gives the gains [V,3] of frames by `solve_gains`; it reads every frame once.

    Raises InputError if a file of a frame cannot be read.
    """
    some = slice(None, None, max(1, -(-len(prior.points) // SAMPLES)))
    points, normals = prior.points[some], prior.normals[some]
    depth, known = depth_of(prior), dict[str, tuple[np.ndarray, np.ndarray]]()

    def shown(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """Colours [S,3], NaN where not seen, and weights [S]."""
        colours = np.full((len(points), 3), np.nan)
        seen, rgb = seen_colours(points, normals, frame, depth(frame), prior.depth_tolerance)
        colours[seen] = rgb
        view = frame.camera.position - points
        cosine = np.einsum("sk,sk->s", normals, view) / np.linalg.norm(view, axis=1)
        return colours, np.maximum(cosine, 0) ** SQUARENESS

    def gains(frames: Sequence[Frame]) -> np.ndarray:
        for frame in frames:
            if frame.name not in known:
                known[frame.name] = shown(frame)
        colours, weights = zip(*(known[frame.name] for frame in frames), strict=True)
        return solve_gains(np.stack(colours), np.stack(weights))

    return gains
