"""Check of poses against pictures: points matched between neighbours, their depth, the outlines of
their masks, or only whether the cameras look at one place."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mgs.camera import Camera
from mgs.data.frames import Frame, in_image, nearest_point
from mgs.data.structure import Matcher

PAIRS = 12  # most pairs of neighbours that are compared
# Matches of a pair that agree with one epipolar geometry, their share of all matches, and number of
# such pairs. Fewer are of repeated patterns.
LEAST_MATCHES, LEAST_SHARE, LEAST_PAIRS = 40, 0.6, 2
WRONG = 0.01  # error over the width of the picture, beyond which poses and pictures do not agree
SOUND = 0.25  # share of the pairs that must be wrong: the error is this quantile over the pairs
MENDED = 0.25  # error under another convention over ours, below which that one is named
ZOOM, SCALE = 2.5, 1200.0  # largest factors tried on focal length, and on lengths over depth
HIDDEN = 1.05  # depth of a point over that of the picture, beyond which the point is hidden
LEAST_SEEN = 0.25  # least share of a depth image's points that a neighbour must see to be compared
# Fewest masks that are compared; error of their outlines, pixels, that is never wrong; and shuffled
# orders of the pictures, half of whose median error is wrong.
LEAST_OUTLINES, OUTLINE, ORDERS = 6, 2.0, 5
PARALLEL = 0.02  # least mean squared sine between the optical axes and their mean direction
SEEN, UNSEEN = 0.9, 0.5  # share of cameras that show where most look: least of right, most of wrong
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenGL's camera axes to OpenCV's, and back
# From a body's axes (x forward, y left, z up) to OpenCV's.
BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])

MATCHED = "points matched in neighbouring pictures"  # end of the evidence of `agreement`

Convention = Callable[[np.ndarray], np.ndarray]

INVERSE = "are the inverse: world-to-camera in place of camera-to-world, or the reverse"

OF_A_BODY = (
    "are of a body whose x axis points forward, not of the camera: multiply them by the pose of "
    "the camera in the body"
)

# Mistakes in what poses mean, and world-to-camera without them, from ours.
CONVENTIONS: tuple[tuple[str, Convention], ...] = (
    ("have the camera axes of OpenCV in place of OpenGL's, or the reverse", lambda W: FLIP @ W),
    (INVERSE, np.linalg.inv),
    (INVERSE, lambda W: FLIP @ np.linalg.inv(W)),
    (OF_A_BODY, lambda W: BODY @ W),
    (OF_A_BODY, lambda W: BODY @ FLIP @ W),
    ("are of mirrored pictures", lambda W: np.diag([-1.0, 1, 1, 1]) @ W),
)

Error = Callable[[Convention, float], float]  # error(convention, zoom) of such cameras, pixels


@dataclass(frozen=True)
class Agreement:
    """How well poses and pictures fit."""

    error: float | None  # quantile SOUND over pairs of neighbours, pixels; None: of directions
    evidence: str  # what was compared
    problem: str = ""  # what is wrong with the poses; empty if they fit


@dataclass(frozen=True)
class DepthScale:
    """Length of 1 by depth images: measured depth over that of triangulated points."""

    metres: float  # median
    spread: float  # half the distance between the quartiles, over the median
    images: int


def agreement(frames: Sequence[Frame], matcher: Matcher, masked: bool = True) -> Agreement | None:
    """Compare poses with what pictures of neighbours in time show: points matched in them, else
    their depth, else the outlines of their masks, else the place that all cameras look at. None
    where nothing can be compared. matcher: of the frames' images. masked: whether the masks were
    made without the poses."""
    places = np.unique(np.linspace(0, max(len(frames) - 2, 0), PAIRS).astype(int)).tolist()
    places = places if len(frames) > 1 else []
    matcher.match((place, place + 1) for place in places)
    pairs, matched = [], []
    for place in places:
        one, other = frames[place], frames[place + 1]
        a, b, count = matcher.between(place, place + 1)
        pairs.append((one, other))
        if len(a) >= max(LEAST_MATCHES, LEAST_SHARE * count):
            matched.append((one.camera, other.camera, a, b))
    limit, verdicts = WRONG * frames[0].camera.width, []
    if len(matched) >= LEAST_PAIRS:
        count = sum(len(points) for _, _, points, _ in matched)

        def by_matches(convention: Convention, zoom: float) -> float:
            each = [np.median(_epipolar_error(*pair, convention, zoom)) for pair in matched]
            return float(np.quantile(each, SOUND, method="higher"))

        verdicts.append(_judged(by_matches, f"{count:,} {MATCHED}", limit))
    if all(frame.depth_path for pair in pairs for frame in pair) and pairs:
        measured = [(one, one.depth(), other, other.depth()) for one, other in pairs]

        def by_depth(convention: Convention, zoom: float) -> float:
            each = [_depth_error(*pair, convention, zoom) for pair in measured]
            return float(np.quantile(each, 0.5, method="lower"))

        what = f"the depth of {len(pairs)} pairs of neighbouring pictures"
        verdicts.append(_judged(by_depth, what, limit, lengths=True))
    if masked and not verdicts and len(outlines := _outlines(frames)) >= LEAST_OUTLINES:
        verdicts.append(_by_outlines(outlines))
    compared = [one for one in verdicts if one]
    wrong = [one for one in compared if one.problem]
    return [*wrong, *compared, _directions([frame.camera for frame in frames])][0]


def _outlines(frames: Sequence[Frame]) -> list[tuple[Camera, np.ndarray]]:
    """Cameras, and corners [N,2] pixels of the convex hulls of their masks; without masks that are
    empty or reach the edge of the picture."""
    import cv2

    outlines = []
    for frame in frames[:: 1 + len(frames) // (2 * PAIRS)]:
        inner = frame.mask()[1:-1, 1:-1] if frame.mask_path else np.zeros((1, 1), bool)
        if inner.any() and inner.sum() == frame.mask().sum():
            y, x = np.nonzero(inner)
            corners = cv2.convexHull(np.column_stack([x, y]).astype(np.int32))[:, 0]
            outlines.append((frame.camera, corners + 1.5))
    return outlines


def _by_outlines(seen: Sequence[tuple[Camera, np.ndarray]]) -> Agreement | None:
    """Agreement of masks: planes through two cameras that touch the object touch both its outlines.
    They do not in another order of the pictures, unless the object is round."""
    n = len(seen)

    def error(convention: Convention, zoom: float, order: Sequence[int] = range(n)) -> float:
        cameras, outlines = [camera for camera, _ in seen], [seen[k][1] for k in order]
        each = [
            _tangent_error(cameras[k], outlines[k], cameras[m], outlines[m], convention, zoom)
            for k in range(n)
            for m in ((k + 1) % n, (k + n // 4) % n)
        ]
        return float(np.median(each))

    rng = np.random.default_rng(0)
    shuffled = np.median([error(_same, 1.0, rng.permutation(n).tolist()) for _ in range(ORDERS)])
    return _judged(error, f"the outlines of {n} masks", max(OUTLINE, float(shuffled) / 2))


def _tangent_error(
    one: Camera, a: np.ndarray, other: Camera, b: np.ndarray, convention: Convention, zoom: float
) -> float:
    """Larger distance, pixels, of the two planes through both cameras that touch the outline a
    [N,2] of one from those that touch the outline b of the other."""
    poses = [convention(camera.world_to_camera) for camera in (one, other)]
    eyes = [-pose[:3, :3].T @ pose[:3, 3] for pose in poses]
    base = (eyes[1] - eyes[0]) / max(float(np.linalg.norm(eyes[1] - eyes[0])), 1e-30)
    rays = []
    for camera, pose, corners in zip((one, other), poses, (a, b), strict=True):
        level = (corners - camera.K[:2, 2]) / (zoom * camera.K[[0, 1], [0, 1]])
        ray = np.column_stack([level, np.ones(len(level))]) @ pose[:3, :3]
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    ahead = np.cross(base, np.cross(rays[0].mean(0), base))
    side = np.cross(base, ahead)
    angles = [np.arctan2(ray @ side, ray @ ahead) for ray in rays]
    errors = []
    for end in (np.argmin, np.argmax):
        i, j = (int(end(angle)) for angle in angles)
        slope = np.linalg.norm(np.cross(rays[0][i], base))
        errors.append(zoom * one.focal * slope * abs(angles[0][i] - angles[1][j]))
    return float(max(errors))


def observed(seen: Sequence[tuple[Camera, np.ndarray, np.ndarray]]) -> Agreement | None:
    """Compare triangulated points [N,3] with the pixels [N,2] where pictures show them, in cameras
    without distortion; None without points."""
    count = sum(len(points) for _, points, _ in seen)
    if not count:
        return None

    def error(convention: Convention, zoom: float) -> float:
        distances = []
        for camera, points, pixels in seen:
            place, _, z = _projected(points, camera, convention(camera.world_to_camera), zoom)
            distances.append(np.where(z > 0, np.linalg.norm(place - pixels, axis=1), np.inf))
        return float(np.median(np.concatenate(distances)))

    return _judged(
        error, f"{count:,} places where pictures show its points", WRONG * seen[0][0].width
    )


def _judged(error: Error, evidence: str, limit: float, lengths: bool = False) -> Agreement | None:
    """Agreement by an error; what mends it, a convention or a focal length, is named, and an error
    beyond the limit, pixels. None if the error is infinite and nothing mends it."""
    ours = error(_same, 1.0)
    if ours < 1:
        return Agreement(ours, evidence)
    mended = [(error(convention, 1.0), name) for name, convention in CONVENTIONS]
    mended = [min(mended, key=lambda pair: pair[0])]
    each, zoom = _searched(lambda zoom: error(_same, zoom), ZOOM)
    mended.append((each, f"fit a focal length {zoom:.2f} times as long: correct it"))
    if lengths:
        each, factor = _searched(lambda factor: error(partial(_scaled, factor=factor), 1.0), SCALE)
        unit = f"fit lengths {factor:.3g} times as long: give poses and depth in one unit"
        mended.append((each, unit))
    measured = ours if np.isfinite(ours) else None
    for each, name in mended:
        if each < MENDED * ours and each <= 2 * min(mended)[0]:
            return Agreement(measured, evidence, name)
    if measured is None:
        return None
    wrong = "do not belong to these pictures: check their order, their names and the lens"
    return Agreement(ours, evidence, wrong if ours > limit else "")


def _searched(error: Callable[[float], float], most: float) -> tuple[float, float]:
    """Least error, and the factor between 1 / most and most that has it."""
    coarse = np.exp(np.arange(-np.log(most), np.log(most), 0.1))
    best = min(coarse, key=error)
    return min(
        (error(factor), float(factor)) for factor in best * np.exp(np.linspace(-0.1, 0.1, 21))
    )


def _scaled(world_to_camera: np.ndarray, factor: float) -> np.ndarray:
    return world_to_camera * np.array([[1, 1, 1, factor]] * 3 + [[1, 1, 1, 1]])


def _same(world_to_camera: np.ndarray) -> np.ndarray:
    return world_to_camera


def _directions(cameras: Sequence[Camera]) -> Agreement | None:
    """Name the convention under which all cameras look at one place, if they do not now; None if
    they do, and if it cannot be told."""
    if len(cameras) < 3 or _seen(cameras, _same) > UNSEEN:
        return None
    fitting = [pair for pair in CONVENTIONS if _seen(cameras, pair[1]) >= SEEN]
    if not fitting:
        return None
    name, _ = min(fitting, key=lambda pair: _tilt(cameras, pair[1]))
    return Agreement(None, "the directions of the cameras", name)


def _tilt(cameras: Sequence[Camera], convention: Convention) -> float:
    """Least singular value of the cameras' right-hand axes, over that of random ones, in tenths: 0
    if all cameras are held level."""
    right = np.stack([convention(camera.world_to_camera)[0, :3] for camera in cameras])
    return float(np.round(np.linalg.svd(right)[1][-1] / np.sqrt(len(cameras) / 3), 1))


def _seen(cameras: Sequence[Camera], convention: Convention) -> float:
    """Share of cameras in whose picture the point nearest to all optical axes is; 0 if they are
    PARALLEL."""
    poses = [convention(camera.world_to_camera) for camera in cameras]
    axes = np.stack([pose[2, :3] for pose in poses])
    mean = axes.mean(0)
    if 1 - mean @ mean < PARALLEL:
        return 0.0
    eyes = [-pose[:3, :3].T @ pose[:3, 3] for pose in poses]
    point = nearest_point(eyes, list(axes))
    each = zip(cameras, poses, strict=True)
    return float(np.mean([_projected(point[None], *one)[1].any() for one in each]))


def _projected(
    points: np.ndarray, camera: Camera, pose: np.ndarray, zoom: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels [N,2] of points [N,3] in a camera with another pose and focal length, whether they lie
    in its picture [N], and their depth [N]."""
    x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
    K = camera.K
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.stack([zoom * K[0, 0] * x / z + K[0, 2], zoom * K[1, 1] * y / z + K[1, 2]], 1)
    return pixels, in_image(camera, pixels, z), z


def _depth_error(
    one: Frame, near: np.ndarray, other: Frame, far: np.ndarray, convention: Convention, zoom: float
) -> float:
    """Median difference, as pixels at this depth, between the depth `far` of a frame and that of
    the points which `one` sees at depth `near`, less those that are hidden; inf if too few are
    seen."""
    poses = [convention(frame.camera.world_to_camera) for frame in (one, other)]
    step = max(1, int(np.sqrt(near.size / 20_000)))
    row, column = np.nonzero(near[::step, ::step])
    depth, camera = near[::step, ::step][row, column], one.camera
    x = (step * column + 0.5 - camera.K[0, 2]) / (zoom * camera.K[0, 0]) * depth
    y = (step * row + 0.5 - camera.K[1, 2]) / (zoom * camera.K[1, 1]) * depth
    back = np.linalg.inv(poses[0])
    points = np.stack([x, y, depth], 1) @ back[:3, :3].T + back[:3, 3]
    pixels, inside, z = _projected(points, other.camera, poses[1], zoom)
    column, row = pixels[inside].astype(int).T
    z, depth = z[inside], far[row, column]
    usable = (depth > 0) & (z < HIDDEN * depth)
    if usable.sum() < max(LEAST_SEEN * len(points), 1):
        return np.inf
    pixels = zoom * other.camera.focal * np.abs(1 - depth[usable] / z[usable])
    return float(np.median(pixels))


def _epipolar_error(
    one: Camera, other: Camera, a: np.ndarray, b: np.ndarray, convention: Convention, zoom: float
) -> np.ndarray:
    """Distance, pixels [N], of points matched in two pictures from the epipolar lines of each other
    (Sampson's approximation); inf where another convention puts them behind the cameras."""
    poses = [convention(camera.world_to_camera) for camera in (one, other)]
    relative = poses[1] @ np.linalg.inv(poses[0])
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    scale = np.diag([1 / zoom, 1 / zoom, 1])  # of rays, by the focal length
    rays, others = (scale @ np.linalg.inv(camera.K) for camera in (one, other))
    F = others.T @ cross @ relative[:3, :3] @ rays
    a, b = (np.column_stack([points, np.ones(len(points))]) for points in (a, b))
    Fa, Fb = a @ F.T, b @ F
    value = np.abs((b * Fa).sum(1))
    # Points on both rays: depth x R a + t = depth' x b. Epipolar lines do not tell the sign.
    behind = np.zeros(len(a), bool)
    if convention is not _same:
        ahead, across = a @ (relative[:3, :3] @ rays).T, b @ others.T
        across, base = np.cross(across, ahead), np.cross(across, [x, y, z])
        depth = -(across * base).sum(1) / np.maximum((across**2).sum(1), 1e-30)
        behind = (depth < 0) | (depth * ahead[:, 2] + z < 0)
    slope = np.sqrt((Fa[:, :2] ** 2).sum(1) + (Fb[:, :2] ** 2).sum(1))
    return np.where(behind, np.inf, value / np.maximum(slope, 1e-30))
