"""A depth camera with the noise of the Kinect, and the survey's filter. Depth images are [H,W]
z-depth in metres, 0 = no return.

Sources: Nguyen, Izadi and Lovell, 3DIMPVT 2012 (axial and lateral noise); Khoshelham and Elberink,
Sensors 12(2), 2012 (quantisation). Lost returns on grazing surfaces have no published curve; ours
is linear."""

import numpy as np

from mgs.camera import Camera

# Axial noise at depth z: AXIAL_FLOOR + AXIAL_GROWTH (z - AXIAL_START)^2, standard deviation, metres
# (Nguyen et al., eq. 3): 26 mm at 4 m.
AXIAL_FLOOR, AXIAL_GROWTH, AXIAL_START = 0.0012, 0.0019, 0.4
# Lateral noise at angle theta between view and normal: LATERAL_FLOOR + LATERAL_GROWTH theta / (pi/2
# - theta), standard deviation, pixels of an image REFERENCE_WIDTH wide (Nguyen et al., eq. 1).
LATERAL_FLOOR, LATERAL_GROWTH, REFERENCE_WIDTH = 0.8, 0.035, 640
# Depth z comes in steps of QUANTUM z^2, metres: 46 mm at 4 m.
QUANTUM = 2.85e-3  # Khoshelham and Elberink, section 4.2: 2.85e-5 in centimetres
DROP_OUT = (np.radians(65.0), np.radians(85.0))  # angles where none, all are lost
SIGMA_FROM_MAD = 1.4826  # standard deviation over median absolute deviation, normal distribution


def normals_from_depth(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Unit normals [H,W,3], world, towards the camera, of a depth image [H,W]. From differences
    between opposite neighbours; zero where the pixel or one of its four neighbours has no depth."""
    points = camera.unproject(depth)
    padded = np.pad(points, ((1, 1), (1, 1), (0, 0)), mode="edge")
    valid = np.pad(depth > 0, 1)
    across = padded[1:-1, 2:] - padded[1:-1, :-2]
    down = padded[2:, 1:-1] - padded[:-2, 1:-1]
    normal = np.cross(down, across)
    norm = np.linalg.norm(normal, axis=-1)
    beside = valid[1:-1, 2:] & valid[1:-1, :-2] & valid[2:, 1:-1] & valid[:-2, 1:-1]
    whole = beside & (depth > 0) & (norm > 0)
    normal = np.where(whole[..., None], normal / np.where(norm > 0, norm, 1.0)[..., None], 0.0)
    facing = np.einsum("hwk,hwk->hw", normal, camera.position - points)
    return normal * np.where(facing < 0, -1.0, 1.0)[..., None]


def noisy_depth(
    depth: np.ndarray, camera: Camera, rng: np.random.Generator, scale: float = 1.0
) -> np.ndarray:
    """Measurement [H,W] of a true depth image [H,W]; metres, 0 = no return. In order: lateral noise
    (the depth of a pixel nearby), axial noise, quantisation, lost returns. Pixels without a normal
    (silhouettes, image rim) count as grazing. scale: factor on standard deviations and steps; below
    1 it also moves DROP_OUT towards 90 degrees; at 0 the depth is exact."""
    if scale <= 0:
        return depth.copy()
    h, w = depth.shape
    normals = normals_from_depth(depth, camera)
    view = camera.position - camera.unproject(depth)
    length = np.maximum(np.linalg.norm(view, axis=-1), 1e-9)
    angle = np.arccos(np.clip(np.einsum("hwk,hwk->hw", normals, view) / length, 0, 1))
    finite = np.minimum(angle, np.radians(85.0))  # lateral noise is infinite at 90 degrees
    lateral = LATERAL_FLOOR + LATERAL_GROWTH * finite / (np.pi / 2 - finite)
    lateral = scale * lateral * w / REFERENCE_WIDTH
    rows, columns = np.mgrid[:h, :w]
    rows = np.round(rows + lateral * rng.standard_normal((h, w)))
    columns = np.round(columns + lateral * rng.standard_normal((h, w)))
    rows, columns = np.clip(rows, 0, h - 1).astype(int), np.clip(columns, 0, w - 1).astype(int)
    z = depth[rows, columns]
    axial = AXIAL_FLOOR + AXIAL_GROWTH * (z - AXIAL_START) ** 2
    noisy = z + scale * axial * rng.standard_normal((h, w))
    quantum = np.maximum(scale * QUANTUM * z * z, 1e-9)
    noisy = quantum * np.round(noisy / quantum)
    start = np.pi / 2 - min(scale, 1.0) * (np.pi / 2 - DROP_OUT[0])
    end = np.pi / 2 - min(scale, 1.0) * (np.pi / 2 - DROP_OUT[1])
    dropout = rng.random((h, w)) < (angle - start) / (end - start)
    return np.where((z > 0) & (depth > 0) & ~dropout & (noisy > 0), noisy, 0.0)


def depth_noise(depth: np.ndarray) -> float:
    """Standard deviation of the noise in a depth image [H,W], metres; 0 if under 100 pixels can be
    used. Estimated from second differences within rows, to which smooth surfaces contribute
    little."""
    whole = (depth[:, :-2] > 0) & (depth[:, 1:-1] > 0) & (depth[:, 2:] > 0)
    second = (depth[:, :-2] - 2 * depth[:, 1:-1] + depth[:, 2:])[whole]
    if len(second) < 100:
        return 0.0
    # The second difference of independent noise has 1 + 4 + 1 = 6 times its variance.
    return SIGMA_FROM_MAD * float(np.median(np.abs(second))) / np.sqrt(6)


def filter_depth(depth: np.ndarray, sigma: float) -> np.ndarray:
    """Smooth a depth image [H,W], metres, by a 7x7 bilateral filter, which keeps edges and lost
    returns. sigma: standard deviation of the noise, metres; at 0 the image is returned. Source:
    Tomasi and Manduchi 1998, by OpenCV; the first step of KinectFusion (Newcombe et al. 2011)."""
    import cv2

    if sigma <= 0:
        return depth
    smooth = cv2.bilateralFilter(depth.astype(np.float32), 7, 3 * sigma, 2.0)
    return np.where(depth > 0, smooth, 0.0).astype(np.float64)
