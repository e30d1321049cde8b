"""A depth camera with the noise of a real one, and the filter that the survey applies to what it
measures.

The numbers are those published for the Kinect (structured light, images of 640x480):

- axial noise (along the camera's axis) and lateral noise (across it): Nguyen, Izadi and Lovell,
"Modeling Kinect sensor noise
  for improved 3D reconstruction and tracking", 3DIMPVT 2012;
- quantisation: Khoshelham and Elberink, "Accuracy and resolution of Kinect depth data", Sensors
12(2), 2012;
- returns that are lost on grazing surfaces: there is no published curve; ours rises linearly with
the angle.

Depth images are [H,W] z-depth in metres, 0 = no return.
"""

from __future__ import annotations

import numpy as np

from mgs.camera import Camera

AXIAL_FLOOR, AXIAL_GROWTH, AXIAL_START = 0.0012, 0.0019, 0.4
"""Axial noise has the standard deviation AXIAL_FLOOR + AXIAL_GROWTH (z - AXIAL_START)^2 at the
depth z, all in metres (Nguyen
et al., eq. 3): 26 mm at 4 m."""

LATERAL_FLOOR, LATERAL_GROWTH = 0.8, 0.035
"""Lateral noise has the standard deviation LATERAL_FLOOR + LATERAL_GROWTH theta / (pi/2 - theta),
in pixels of an image that is REFERENCE_WIDTH wide, where theta is the angle between the view and
the surface's normal (Nguyen et al., eq. 1)."""

REFERENCE_WIDTH = 640
"""Width in pixels of the images that the lateral noise was measured on."""

QUANTUM = 2.85e-3
"""Depth z is measured in steps of QUANTUM z^2, metres (Khoshelham and Elberink, section 4.2:
2.85e-5 in centimetres): 46 mm at 4 m."""

DROP_OUT = (np.radians(65.0), np.radians(85.0))
"""Angles between the view and the surface's normal, radians: at the first one returns begin to be
lost, from the second one on all are lost. Between them the share of lost returns rises linearly.
Chosen constants."""

SIGMA_FROM_MAD = 1.4826
"""Standard deviation of a normal distribution divided by its median absolute deviation. Estimates
of noise use the median, which a few outliers do not change."""


def normals_from_depth(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Unit normals [H,W,3] of the surface in a depth image [H,W], in the world, turned towards the
    camera.

    They are computed from the differences between the right and left, and the lower and upper
    neighbours of a pixel. A pixel that lacks depth or one of these neighbours has the normal zero.
    """
    points = camera.unproject(depth)
    padded = np.pad(points, ((1, 1), (1, 1), (0, 0)), mode="edge")
    valid = np.pad(depth > 0, 1)
    across = padded[1:-1, 2:] - padded[1:-1, :-2]
    down = padded[2:, 1:-1] - padded[:-2, 1:-1]
    normal = np.cross(down, across)
    norm = np.linalg.norm(normal, axis=-1)
    whole = (
        valid[1:-1, 2:]
        & valid[1:-1, :-2]
        & valid[2:, 1:-1]
        & valid[:-2, 1:-1]
        & (depth > 0)
        & (norm > 0)
    )
    normal = np.where(whole[..., None], normal / np.where(norm > 0, norm, 1.0)[..., None], 0.0)
    facing = np.einsum("hwk,hwk->hw", normal, camera.position - points)
    return normal * np.where(facing < 0, -1.0, 1.0)[..., None]


def noisy_depth(
    depth: np.ndarray, camera: Camera, rng: np.random.Generator, scale: float = 1.0
) -> np.ndarray:
    """What the sensor measures [H,W] where the true depth image is `depth` [H,W]; metres, 0 = no
    return.

    In this order: each pixel shows the depth of a pixel nearby (lateral noise), axial noise is
    added, the depth is rounded to its steps, and returns are lost. Silhouettes and the rim of the
    image, which have no normal, count as grazing surfaces.
    scale: factor on every standard deviation and on the steps. Below 1 it also moves both angles of
    DROP_OUT towards 90 degrees; at 0 the true depth is returned.
    """
    if scale <= 0:
        return depth.copy()
    h, w = depth.shape
    normals = normals_from_depth(depth, camera)
    view = camera.position - camera.unproject(depth)
    cosine = np.einsum("hwk,hwk->hw", normals, view) / np.maximum(
        np.linalg.norm(view, axis=-1), 1e-9
    )
    angle = np.arccos(np.clip(cosine, 0, 1))
    finite = np.minimum(
        angle, np.radians(85.0)
    )  # at 90 degrees the lateral noise would be infinite
    lateral = (
        scale
        * (LATERAL_FLOOR + LATERAL_GROWTH * finite / (np.pi / 2 - finite))
        * w
        / REFERENCE_WIDTH
    )
    rows, columns = np.mgrid[:h, :w]
    rows = np.clip(np.round(rows + lateral * rng.standard_normal((h, w))), 0, h - 1).astype(int)
    columns = np.clip(np.round(columns + lateral * rng.standard_normal((h, w))), 0, w - 1).astype(
        int
    )
    z = depth[rows, columns]
    measured = z + scale * (
        AXIAL_FLOOR + AXIAL_GROWTH * (z - AXIAL_START) ** 2
    ) * rng.standard_normal((h, w))
    quantum = np.maximum(scale * QUANTUM * z * z, 1e-9)
    measured = quantum * np.round(measured / quantum)
    start = np.pi / 2 - min(scale, 1.0) * (np.pi / 2 - DROP_OUT[0])
    end = np.pi / 2 - min(scale, 1.0) * (np.pi / 2 - DROP_OUT[1])
    lost = rng.random((h, w)) < (angle - start) / (end - start)
    return np.where((z > 0) & (depth > 0) & ~lost & (measured > 0), measured, 0.0)


def depth_noise(depth: np.ndarray) -> float:
    """Estimate the standard deviation of the noise in a depth image [H,W], metres.

    It is measured on the second differences of neighbours within a row, to which a smooth surface
    contributes little. 0 if fewer than a hundred pixels have both neighbours.
    """
    whole = (depth[:, :-2] > 0) & (depth[:, 1:-1] > 0) & (depth[:, 2:] > 0)
    second = (depth[:, :-2] - 2 * depth[:, 1:-1] + depth[:, 2:])[whole]
    # The second difference of independent noise has 1 + 4 + 1 = 6 times its variance.
    return (
        SIGMA_FROM_MAD * float(np.median(np.abs(second))) / np.sqrt(6)
        if len(second) >= 100
        else 0.0
    )


def filter_depth(depth: np.ndarray, sigma: float) -> np.ndarray:
    """Smooth a depth image [H,W], metres, by a bilateral filter over 7x7 pixels: noise is averaged,
    edges stay sharp.

    Pixels without return stay so. sigma: standard deviation of the noise, metres; at 0 the image is
    returned as it is.
    Source: Tomasi and Manduchi 1998, by OpenCV; the first step of KinectFusion (Newcombe et al.
    2011).
    """
    import cv2

    if sigma <= 0:
        return depth
    smooth = cv2.bilateralFilter(depth.astype(np.float32), 7, 3 * sigma, 2.0)
    return np.where(depth > 0, smooth, 0.0).astype(np.float64)
