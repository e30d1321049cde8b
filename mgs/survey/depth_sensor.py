"""A noisy RGB-D camera, and the filter that a survey puts behind it.

The parameters are those published for the Kinect (structured light, 640x480); lengths in metres, angles in radians.
Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012:
axial and lateral noise. Khoshelham and Elberink, "Accuracy and resolution of Kinect depth data", Sensors 12(2), 2012:
quantisation. Drop-outs at grazing angles have no published curve: a ramp, our choice.
"""

from __future__ import annotations

import numpy as np

from mgs.camera import Camera

AXIAL_FLOOR, AXIAL_GROWTH, AXIAL_START = 0.0012, 0.0019, 0.4
"""Axial standard deviation: AXIAL_FLOOR + AXIAL_GROWTH (z - AXIAL_START)^2 metres (Nguyen et al., eq. 3): 26 mm at 4 m."""

LATERAL_FLOOR, LATERAL_GROWTH = 0.8, 0.035
"""Lateral standard deviation: LATERAL_FLOOR + LATERAL_GROWTH theta / (pi/2 - theta) pixels of a 640-wide image (eq. 1)."""

QUANTUM = 2.85e-3
"""Depth step over z^2, per metre (Khoshelham and Elberink, section 4.2: 2.85e-5 in centimetres): 46 mm at 4 m."""

DROP_OUT = (np.radians(65.0), np.radians(85.0))
"""Angle between view and normal at which returns begin to be lost, and at which all are lost (our choice)."""

REFERENCE_WIDTH = 640


def normals_from_depth(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Unit normals [H,W,3], world, towards the camera, from differences over 2 pixels; zero where depth is missing."""
    points = camera.unproject(depth)
    padded = np.pad(points, ((1, 1), (1, 1), (0, 0)), mode="edge")
    valid = np.pad(depth > 0, 1)
    across = padded[1:-1, 2:] - padded[1:-1, :-2]
    down = padded[2:, 1:-1] - padded[:-2, 1:-1]
    normal = np.cross(down, across)
    norm = np.linalg.norm(normal, axis=-1)
    whole = valid[1:-1, 2:] & valid[1:-1, :-2] & valid[2:, 1:-1] & valid[:-2, 1:-1] & (depth > 0) & (norm > 0)
    normal = np.where(whole[..., None], normal / np.where(norm > 0, norm, 1.0)[..., None], 0.0)
    facing = np.einsum("hwk,hwk->hw", normal, camera.position - points)
    return normal * np.where(facing < 0, -1.0, 1.0)[..., None]


def noisy_depth(depth: np.ndarray, camera: Camera, rng: np.random.Generator, scale: float = 1.0) -> np.ndarray:
    """What the sensor measures for a true z-depth [H,W], metres (0 = no return).

    scale multiplies every standard deviation and the quantisation step, and narrows the drop-out ramp towards 90 degrees;
    0 returns the true depth. Order: lateral shift, axial noise, quantisation, drop-outs. Silhouettes and
    the rim of the image, which have no normal, count as grazing.
    """
    if scale <= 0:
        return depth.copy()
    h, w = depth.shape
    normals = normals_from_depth(depth, camera)
    view = camera.position - camera.unproject(depth)
    cosine = np.einsum("hwk,hwk->hw", normals, view) / np.maximum(np.linalg.norm(view, axis=-1), 1e-9)
    angle = np.arccos(np.clip(cosine, 0, 1))
    finite = np.minimum(angle, np.radians(85.0))
    lateral = scale * (LATERAL_FLOOR + LATERAL_GROWTH * finite / (np.pi / 2 - finite)) * w / REFERENCE_WIDTH
    rows, columns = np.mgrid[:h, :w]
    rows = np.clip(np.round(rows + lateral * rng.standard_normal((h, w))), 0, h - 1).astype(int)
    columns = np.clip(np.round(columns + lateral * rng.standard_normal((h, w))), 0, w - 1).astype(int)
    z = depth[rows, columns]
    measured = z + scale * (AXIAL_FLOOR + AXIAL_GROWTH * (z - AXIAL_START) ** 2) * rng.standard_normal((h, w))
    quantum = np.maximum(scale * QUANTUM * z * z, 1e-9)
    measured = quantum * np.round(measured / quantum)
    start = np.pi / 2 - min(scale, 1.0) * (np.pi / 2 - DROP_OUT[0])
    end = np.pi / 2 - min(scale, 1.0) * (np.pi / 2 - DROP_OUT[1])
    lost = rng.random((h, w)) < (angle - start) / (end - start)
    return np.where((z > 0) & (depth > 0) & ~lost & (measured > 0), measured, 0.0)


def depth_noise(depth: np.ndarray) -> float:
    """Standard deviation of a depth image [H,W] from its second differences (robust; a smooth surface contributes little).

    Metres; 0 where fewer than a hundred pixels have neighbours.
    """
    whole = (depth[:, :-2] > 0) & (depth[:, 1:-1] > 0) & (depth[:, 2:] > 0)
    second = (depth[:, :-2] - 2 * depth[:, 1:-1] + depth[:, 2:])[whole]
    return 1.4826 * float(np.median(np.abs(second))) / np.sqrt(6) if len(second) >= 100 else 0.0


def filter_depth(depth: np.ndarray, sigma: float) -> np.ndarray:
    """Bilateral filter (Tomasi and Manduchi 1998, OpenCV; the first step of KinectFusion) over 7x7 pixels.

    depth [H,W] metres, 0 = no return and stays so; sigma: its noise, metres; 0 returns it as it is.
    """
    import cv2

    if sigma <= 0:
        return depth
    smooth = cv2.bilateralFilter(depth.astype(np.float32), 7, 3 * sigma, 2.0)
    return np.where(depth > 0, smooth, 0.0).astype(np.float64)
