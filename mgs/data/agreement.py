"""Check of poses against pictures: the epipolar error of points matched between neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.frames import Frame

PAIRS = 12
"""Most pairs of neighbours that are compared."""

WIDEST = 1000
"""Width, pixels, to which wider pictures are reduced for matching."""

RATIO = 0.75
"""Largest ratio of the distances to the best and the second best match (Lowe 2004)."""

LEAST_MATCHES, LEAST_SHARE, LEAST_PAIRS = 40, 0.6, 2
"""Fewest matches of a pair that agree with one epipolar geometry, and their least share of all
matches, for the pair to count; and fewest such pairs. Fewer are of repeated patterns."""

WRONG = 0.01
"""Error over the width of the picture, beyond which poses and pictures do not agree."""

SOUND = 0.25
"""Share of the pairs that must be wrong: the error is this quantile over the pairs."""

MENDED = 0.25
"""Error under another convention over that under ours, below which that convention is named."""

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenGL's camera axes to OpenCV's, and back."""

BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""From a body's axes (x forward, y left, z up) to OpenCV's."""

CONVENTIONS = {
    "have the camera axes of OpenCV in place of OpenGL's, or the reverse": lambda W: FLIP @ W,
    "are the inverse: world-to-camera in place of camera-to-world, or the reverse": np.linalg.inv,
    "are the inverse, and have the camera axes of OpenCV in place of OpenGL's": (
        lambda W: FLIP @ np.linalg.inv(W)
    ),
    "are of a body whose x axis points forward, not of the camera": lambda W: BODY @ W,
    "are of mirrored pictures": lambda W: np.diag([-1.0, 1, 1, 1]) @ W,
}
"""Mistakes in what poses mean -> world-to-camera without them, from ours."""


@dataclass(frozen=True)
class Agreement:
    """Epipolar error, pixels, of `matches` points matched in `pairs` pairs of pictures: the median
    of a pair, and the quantile SOUND of the pairs.

    problem: what is wrong with the poses, empty if they fit.
    """

    error: float
    matches: int
    pairs: int
    problem: str = ""


def agreement(frames: Sequence[Frame]) -> Agreement | None:
    """Compare poses with what pictures of neighbours in time show; None with too few matches."""
    first = np.unique(np.linspace(0, max(len(frames) - 2, 0), PAIRS).astype(int))
    found = []
    for k in first if len(frames) > 1 else ():
        one, other = frames[k], frames[k + 1]
        points = _matches(one, other)
        if points is not None:
            found.append((one.camera, other.camera, *points))
    if len(found) < LEAST_PAIRS:
        return None

    def error(convention: object = None) -> float:
        every = [np.median(_epipolar_error(*pair, convention)) for pair in found]
        return float(np.quantile(every, SOUND))

    ours, width = error(), frames[0].camera.width
    count = sum(len(points) for _, _, points, _ in found)
    if ours < 1:
        return Agreement(ours, count, len(found))
    errors = {name: error(convention) for name, convention in CONVENTIONS.items()}
    best = min(errors, key=lambda name: errors[name])
    problem = ""
    if errors[best] < MENDED * ours:
        problem = best
    elif ours > WRONG * width:
        problem = "do not belong to these pictures: check their order, their names and the lens"
    return Agreement(ours, count, len(found), problem)


def _matches(one: Frame, other: Frame) -> tuple[np.ndarray, np.ndarray] | None:
    """Pixels [N,2] of the same points in two pictures, by SIFT; None where they are too few."""
    import cv2

    sift, features = cv2.SIFT.create(1000), []
    for frame in (one, other):
        grey = np.round(255 * srgb_from_linear(frame.rgb()).mean(-1)).astype(np.uint8)
        scale = min(1.0, WIDEST / grey.shape[1])
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        points, descriptors = sift.detectAndCompute(grey, None)
        if descriptors is None or len(points) < LEAST_MATCHES:
            return None
        features.append((np.array([point.pt for point in points]), descriptors, scale))
    (a, da, scale_a), (b, db, scale_b) = features
    nearest = cv2.BFMatcher().knnMatch(da, db, k=2)
    good = [
        x for x, y in (two for two in nearest if len(two) == 2) if x.distance < RATIO * y.distance
    ]
    if len(good) < LEAST_MATCHES:
        return None
    a, b = a[[match.queryIdx for match in good]], b[[match.trainIdx for match in good]]
    _, inliers = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, 1.0, 0.99)
    if inliers is None or inliers.sum() < max(LEAST_MATCHES, LEAST_SHARE * len(good)):
        return None
    chosen = inliers.ravel().astype(bool)
    return (a[chosen] + 0.5) / scale_a, (b[chosen] + 0.5) / scale_b


def _epipolar_error(
    one: Camera, other: Camera, a: np.ndarray, b: np.ndarray, convention: object
) -> np.ndarray:
    """Distance, pixels [N], of points matched in two pictures from the epipolar lines of each other
    (Sampson's approximation)."""
    poses = [camera.world_to_camera for camera in (one, other)]
    if callable(convention):
        poses = [convention(pose) for pose in poses]
    relative = poses[1] @ np.linalg.inv(poses[0])
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    F = np.linalg.inv(other.K).T @ cross @ relative[:3, :3] @ np.linalg.inv(one.K)
    a, b = (np.column_stack([points, np.ones(len(points))]) for points in (a, b))
    Fa, Fb = a @ F.T, b @ F
    value = np.abs((b * Fa).sum(1))
    slope = np.sqrt((Fa[:, :2] ** 2).sum(1) + (Fb[:, :2] ** 2).sum(1))
    return np.asarray(value / np.maximum(slope, 1e-30))
