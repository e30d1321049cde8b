"""Gains of photographs, before any fit, of the ratios of colours of the surface that they share:
least squares of their logarithms over all pairs (Brown and Lowe 2007, section 6)."""

from collections.abc import Callable, Sequence

import numpy as np

from mgs.data.frames import Frame
from mgs.prior.build import Prior
from mgs.prior.initial import depth_of, seen_colours
from mgs.progress import Stage, report

SAMPLES = 4000  # about the most surface samples compared, evenly spread over the prior's
# Exponent of the cosine between normal and view in a sample's weight: surfaces shine at grazing
# angles, and errors of the surface matter most there. In the demo's dataset, of constant exposure,
# gains of the first 12 frames err by 2 % rms, and by 4 % with equal weights.
SQUARENESS = 4
SATURATED = 0.9  # brightest colour compared, linear RGB: a clipped channel says nothing of its gain
DARK = 1e-3  # least mean brightness of shared samples, linear RGB, for a ratio
RATIO_STD = 0.1  # standard deviation of the log ratio from one sample. A chosen constant.
GAIN_STD = 0.5  # prior standard deviation of a log gain, 0.7 stops


def solve_gains(colours: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Gains of images [V,3], of geometric mean 1 in every channel.

    colours: [V,S,3] linear RGB of S surface samples in V images, NaN where not shown; weights:
    [V,S], 0 to 1. With log gains l, n_ij = sum over samples of w_i w_j, and d_ij the log ratio of
    the weighted mean colours, minimises the sum over pairs of n_ij (l_i - l_j - d_ij)^2 /
    RATIO_STD^2 plus the sum over images of l_i^2 / GAIN_STD^2.
    """
    valid = (np.nan_to_num(colours, nan=np.inf) <= SATURATED).all(axis=2)
    weights = np.where(valid, weights, 0.0)
    values = np.where(valid[..., None], colours, 0.0) * weights[..., None]
    shared = weights @ weights.T
    # Of the colours of i, over the samples that it shares with j.
    sums = np.stack([values[..., c] @ weights.T for c in range(3)], -1)
    means = sums / np.maximum(shared, 1e-12)[..., None]
    lit = (np.minimum(means, means.swapaxes(0, 1)) >= DARK).all(axis=2)
    lit &= ~np.eye(len(means), dtype=bool)
    precision = np.where(lit, shared, 0) / RATIO_STD**2
    ratio = np.log(np.maximum(means, DARK) / np.maximum(means.swapaxes(0, 1), DARK))
    matrix = np.diag(precision.sum(axis=1) + GAIN_STD**-2) - precision
    log_gains = np.linalg.solve(matrix, (precision[..., None] * ratio).sum(axis=1))
    return np.exp(log_gains - log_gains.mean(axis=0))


def without_gain(target: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """A target [...,C] (`target_of`) with its colours divided by the gains [3]; float32."""
    return target / np.append(gain, np.ones(target.shape[-1] - 3)).astype(np.float32)


def exposure_of(prior: Prior) -> Callable[[Sequence[Frame]], np.ndarray]:
    """Return gains(frames): [V,3] by `solve_gains`; every frame is read once. Of a random start
    only the points that came with the cameras are compared. gains raises InputError if a file of a
    frame cannot be read."""
    count = prior.numbers.get("triangulated", len(prior.points))
    some = slice(None, count, max(1, -(-count // SAMPLES)))
    points, normals = prior.points[some], prior.normals[some]
    depth, cache = depth_of(prior), dict[Frame, tuple[np.ndarray, np.ndarray]]()

    def shown(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        colours = np.full((len(points), 3), np.nan)
        seen, rgb = seen_colours(points, normals, frame, depth(frame), prior.depth_tolerance)
        colours[seen] = rgb
        view = frame.camera.position - points
        cosine = np.einsum("sk,sk->s", normals, view) / np.linalg.norm(view, axis=1)
        return colours, np.maximum(cosine, 0) ** SQUARENESS

    def gains(frames: Sequence[Frame]) -> np.ndarray:
        for frame in frames:
            if frame not in cache:  # a frame whose pose was refined is another
                report(Stage.READ, len(cache), len(frames))
                cache[frame] = shown(frame)
        colours, weights = zip(*(cache[frame] for frame in frames), strict=True)
        return solve_gains(np.stack(colours), np.stack(weights))

    return gains
