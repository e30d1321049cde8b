"""Candidate poses of the next pictures, from a file or placed around the object. Files are in the
world of the dataset's files, metres."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

from mgs.camera import Camera, look_at
from mgs.data.clouds import towards
from mgs.data.dataset import finite_number, load_cameras
from mgs.data.frames import Frame, in_image
from mgs.data.meshes import Mesh, distances_to_mesh
from mgs.data.world import UPRIGHT, Thing, World
from mgs.errors import InputError
from mgs.files import read_csv
from mgs.prior.build import Prior
from mgs.progress import report
from mgs.rotation import rotmat_from_quat
from mgs.synth.orbit import orbit_positions
from mgs.synth.scene_file import Orbit

POSITION, TARGET = ("x", "y", "z"), ("target_x", "target_y", "target_z")
QUATERNION = ("qw", "qx", "qy", "qz")
COLUMNS = ("name", *POSITION, *TARGET, *QUATERNION)
"""Columns of a CSV of poses. The quaternion is that of camera to world, with OpenCV axes."""

MOST_POSES = 5000  # candidates: each is drawn, and the legs between all are compared
SAME_PLACE, SAME_VIEW = 1e-3, 1.0  # share of the distance, and degrees: counts as taken
# Points of an image that say how deep it sees at a pixel: at most so far away, over its width, and
# on all sides. Images in which a place is judged by them. Chosen constants.
AROUND, REACH, WITNESSES = 32, 0.2, 2
OWN = 0.3  # distance from the surface, over the radius, within which points are its own. Chosen
# Least share of the surface's area, projected along the view, that faces a pose: less is behind an
# open surface, as a facade. Closed ones have half. Normals by which it is judged. Chosen.
FACING, NORMALS = 0.2, 1000
FELT = 0.05  # least move that is named, over the distance from the object; as an angle, radians

Named = tuple[str, Camera]


@dataclass(frozen=True)
class Site:
    """The object, and the camera that looks at it.

    like: camera whose intrinsics candidates have by default. world: of files of poses. points:
    triangulated from the images [N,3], if they are known. whole: whether they are of a whole scene,
    whose prior has no surface."""

    prior: Prior
    like: Camera
    world: World = UPRIGHT
    points: NDArray[np.float64] | None = None
    whole: bool = False

    @property
    def centre(self) -> NDArray[np.float64]:
        """Middle of the object [3]."""
        return np.asarray(self.prior.points.mean(axis=0), np.float64)

    @property
    def ground(self) -> float:
        """Height of the object's lowest point; of a whole scene, that which 99 % of the points are
        above."""
        if self.whole and self.points is not None:
            return float(np.quantile(self.points[:, 2], 0.01))
        return float(self.prior.mesh.vertices[:, 2].min())

    def clearance(self, eyes: np.ndarray) -> NDArray[np.float64]:
        """Distance of places [M,3] from the prior's mesh, or from the points of a whole scene."""
        if self.whole:
            return np.asarray(cKDTree(self.points).query(eyes)[0])
        return distances_to_mesh(eyes, self.prior.mesh.vertices, self.prior.mesh.faces)

    def camera(self, eye: Sequence[float] | np.ndarray, target: np.ndarray | None = None) -> Camera:
        """A camera at `eye` [3] that looks at `target` [3], by default the middle of the object."""
        pose = look_at(eye, self.centre if target is None else target)
        return Camera(self.like.K, self.like.width, self.like.height, pose)

    def enter(self, thing: Thing) -> Thing:
        """`World.enter` of a camera or a point [3], counted from the dataset's origin or from that
        of the imported data (`towards`)."""
        point = thing.position if isinstance(thing, Camera) else thing
        shift = point - towards(point[None], self.world.origin)[0]
        if shift.any():
            thing = thing.seen_from(shift) if isinstance(thing, Camera) else thing - shift
        return self.world.enter(thing)


def read_poses(path: str | Path, site: Site) -> list[Named]:
    """Poses of a transforms.json, or of a CSV with the columns x, y, z, and optionally name, a
    target or a quaternion (COLUMNS). Intrinsics that a file lacks are those of `site.like`.

    Raises InputError as `load_cameras`, and for more than MOST_POSES poses or two of one name. Also
    for a CSV without rows, with unknown, missing or half of the columns, or what is no number."""
    path = Path(path)
    if path.suffix.lower() == ".csv":
        poses = _read_csv(path, site)
    else:
        cameras = load_cameras(path, site.like)
        poses = [(Path(name).stem, site.enter(camera)) for name, camera in cameras]
    if len(poses) > MOST_POSES:
        raise InputError(f"{path}: lists {len(poses):,} poses, more than {MOST_POSES:,}; thin them")
    names = [name for name, _ in poses]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{path}: lists the pose {twice} more than once; rename or remove it")
    return poses


def _read_csv(path: Path, site: Site) -> list[Named]:
    (_, first), *lines = read_csv(path) or [(0, [])]
    columns = [name.strip().lower() for name in first]
    unknown = [name for name in columns if name not in COLUMNS]
    if unknown or not columns:
        what = f"has the column {unknown[0]!r}" if unknown else "is empty"
        must = f"its first line must name columns of {', '.join(COLUMNS)}"
        raise InputError(f"{path}: {what}; {must}")
    for group in (POSITION, TARGET, QUATERNION):
        lacking = [name for name in group if name not in columns]
        if lacking and (group == POSITION or len(lacking) < len(group)):
            raise InputError(f"{path}: lacks the column {lacking[0]}; add it, or correct its name")
    if not lines:
        raise InputError(f"{path}: lists no poses; add a line with x, y and z for each")
    rows = [(f"{path}: line {number}", k, columns, row) for k, (number, row) in enumerate(lines)]
    return [_csv_pose(*row, site) for row in rows]


def _csv_pose(where: str, index: int, columns: list[str], row: list[str], site: Site) -> Named:
    if len(row) != len(columns):
        raise InputError(f"{where} has {len(row)} cells, not {len(columns)}; correct it")
    cells = dict(zip(columns, (cell.strip() for cell in row), strict=True))
    name = cells.pop("name", "") or f"pose_{index:04d}"
    if not name.isprintable():  # which `read_records` would refuse, too
        raise InputError(f"{where}: the name {name!r} cannot be printed; rename it")
    numbers = {key: finite_number(where, key, text) for key, text in cells.items()}
    eye = np.array([numbers[key] for key in POSITION])
    if "qw" not in numbers:
        target = None
        if "target_x" in numbers:
            target = site.enter(np.array([numbers[key] for key in TARGET]))
        try:
            return name, site.camera(site.enter(eye), target)
        except InputError:
            raise InputError(f"{where}: looks at its own position; correct it") from None
    quaternion = np.array([numbers[key] for key in QUATERNION])
    if not quaternion.any():
        raise InputError(f"{where}: its quaternion is zero; correct it")
    pose = np.eye(4)
    pose[:3, :3] = rotmat_from_quat(quaternion).T
    pose[:3, 3] = -pose[:3, :3] @ eye
    camera = Camera(site.like.K, site.like.width, site.like.height, pose)
    return name, site.enter(camera)


def place_poses(
    shape: str, count: int, radius: float, elevations: tuple[float, float], site: Site
) -> list[Named]:
    """About `count` poses around the object, which look at its middle.

    shape: "dome", spread evenly over the elevations; "ring", a circle at their middle; "grid", a
    cubic lattice of the dome's radius. radius: metres. elevations: lowest and highest above the
    middle of the object, degrees. Raises InputError if the lattice has no place between them."""
    low, high = elevations
    if shape == "grid":
        offsets = _lattice(count, radius, elevations)
        if not len(offsets):
            cure = "raise it, or widen them"
            raise InputError(f"grid {count}: has no pose within `elevations`; {cure}")
    else:
        band = elevations if shape == "dome" else ((low + high) / 2,) * 2
        kind = "hemisphere" if shape == "dome" else "rings"
        # Not validated: those of a scene are above its ground.
        orbit = Orbit.model_construct(kind=kind, radius=radius, elevations=band, turns=1)
        offsets = orbit_positions(orbit, count, np.zeros(3))
    digits = len(str(len(offsets) - 1))
    eyes = site.centre + offsets
    return [(f"{shape}_{i:0{digits}d}", site.camera(eye)) for i, eye in enumerate(eyes)]


def way_to(camera: Camera, images: Sequence[Frame], site: Site, unit: str) -> str:
    """Words by which a person finds a pose: the way from the nearest image, towards another if any.
    Lengths are in metres, or of another unit in percent of that image's distance from the object.
    """
    eyes = np.stack([frame.camera.position for frame in images]) - camera.position
    away = np.linalg.norm(eyes, axis=1)
    near = int(away.argmin())
    where, words = f"from {images[near].name}", list[str]()
    opposite = eyes @ eyes[near] < -away * away[near] / 2
    if opposite.any():
        where += f" towards {images[int(np.where(opposite, away, np.inf).argmin())].name}"
    start, end = images[near].camera.position - site.centre, camera.position - site.centre
    far = float(np.linalg.norm(start))
    turn = np.arctan2(start[0] * end[1] - start[1] * end[0], start[:2] @ end[:2])
    if abs(turn) >= FELT:
        side = "right" if turn > 0 else "left"
        words.append(f"{abs(np.degrees(turn)):.0f}° round the object to the {side}")
    nearer = far - np.linalg.norm(end), "", "nearer", "farther"
    for length, of, up, down in (
        nearer,
        (end[2] - start[2], " of the distance", "higher", "lower"),
    ):
        if abs(length) >= FELT * far:
            size = f"{abs(length):.1f} m" if unit == "m" else f"{abs(length) / far:.0%}{of}"
            words.append(f"{size} {up if length > 0 else down}")
    return f"{where}: {', '.join(words) or 'hardly a step'}"


def _lattice(count: int, radius: float, elevations: tuple[float, float]) -> NDArray[np.float64]:
    """Points of a cubic lattice, about `count`, [M,3]."""
    low, high = np.sin(np.radians(elevations))
    volume = 2 * np.pi / 3 * radius**3 * max(high - low, 0.01)
    step = (volume / count) ** (1 / 3)
    line = step * np.arange(-math.ceil(radius / step), math.ceil(radius / step) + 1)
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    far = np.linalg.norm(points, axis=1)
    rise = points[:, 2] / np.maximum(far, 1e-12)
    return points[(far > 0) & (far <= radius) & (rise >= low) & (rise <= high)]


def inside(mesh: Mesh, points: np.ndarray) -> NDArray[np.bool_]:
    """Whether points [M,3] are inside a mesh, bool [M]: its winding number is above 1/2. The
    winding number sums the signed solid angles of the faces over 4 pi (Van Oosterom and Strackee
    1983), so a mesh with holes has an inside too."""
    within = np.zeros(len(points), bool)
    corners = mesh.vertices[mesh.faces]
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    for k in np.flatnonzero(((points > low) & (points < high)).all(axis=1)):
        a, b, c = np.moveaxis(corners - points[k], 1, 0)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        volume = np.einsum("fk,fk->f", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("fk,fk->f", p, q) for p, q in ((a, b), (b, c), (c, a)))
        angle = np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
        within[k] = angle.sum() / (2 * np.pi) > 0.5
    return within


def hidden(
    eyes: np.ndarray, taken: Sequence[Camera], points: np.ndarray | None
) -> NDArray[np.bool_]:
    """Whether places [M,3] lie behind a wall: behind the points [N,3] around them in every image
    that has them in view, WITNESSES or more. An object in front hides a place in some images."""
    judges, behind = np.zeros((2, len(eyes)), int)
    if points is None:
        return judges > 0
    for done, camera in enumerate(taken):
        report("looking for walls", done, len(taken))
        (pixels, depth), (places, far) = camera.project(points), camera.project(eyes)
        seen, here = in_image(camera, pixels, depth), in_image(camera, places, far)
        if seen.sum() < AROUND or not here.any():
            continue
        apart, near = cKDTree(pixels[seen]).query(places[here], AROUND)
        right, below = np.moveaxis(pixels[seen][near] > places[here][:, None], 2, 0)
        close = apart < REACH * camera.width
        sides = [(close & (right == x) & (below == y)).any(1) for x in (0, 1) for y in (0, 1)]
        views = np.flatnonzero(here)[np.all(sides, 0)]
        judges[views] += 1
        middle = np.nanmedian(np.where(close, depth[seen][near], np.nan)[np.all(sides, 0)], axis=1)
        behind[views] += middle < far[views]
    return (judges >= WITNESSES) & (behind == judges)


def refusals(
    poses: Sequence[Named],
    taken: Sequence[Camera],
    site: Site,
    safe_distance: float = 0.0,
    elevations: tuple[float, float] | None = None,
) -> list[str]:
    """Why each candidate cannot be flown; empty if it can.

    safe_distance: least `Site.clearance`, metres. elevations: lowest and highest above the middle
    of the object, degrees."""
    eyes, centre = np.stack([camera.position for _, camera in poses]), site.centre
    offset = eyes - centre
    far = np.linalg.norm(offset, axis=1)
    rise = np.degrees(np.arcsin(np.clip(offset[:, 2] / np.maximum(far, 1e-12), -1, 1)))
    low, high = elevations or (-90.0, 90.0)
    beyond = (rise < low - 1e-6) | (rise > high + 1e-6)
    walls, near = site.points, np.zeros(len(poses), bool)
    if safe_distance > 0:  # measuring takes seconds
        near = site.clearance(eyes) < safe_distance
    reasons: dict[str, Any] = {}
    if site.whole and walls is not None:  # its mesh is a ball that says nothing
        reasons["beyond what the images show"] = _beyond(eyes, taken, walls, safe_distance)
    else:
        reasons["inside the object"] = inside(site.prior.mesh, eyes)
        if walls is not None:  # an object alone hides no place: its far side is what to suggest
            own = OWN * np.linalg.norm(site.prior.points - centre, axis=1).max()
            walls = walls[cKDTree(site.prior.points).query(walls)[0] > own]
    normals = site.prior.normals[:: -(-len(site.prior.normals) // NORMALS)]
    towards_eye = normals @ offset.T
    back = np.maximum(towards_eye, 0).sum(0) < FACING * np.abs(towards_eye).sum(0)
    keys = [camera.world_to_camera.tobytes() for _, camera in poses]
    reasons |= {
        f"nearer to it than {safe_distance:.3g}": near,
        "behind a surface that faces one way": back,
        "behind what the images show": hidden(eyes, taken, walls),
        f"not between {low:g} and {high:g} degrees": beyond,
        "taken already": _are_taken(poses, taken, far),
        "the same as one before": [keys.index(key) < k for k, key in enumerate(keys)],
    }
    return [next((why for why, hit in reasons.items() if hit[k]), "") for k in range(len(poses))]


def _beyond(
    eyes: np.ndarray, taken: Sequence[Camera], points: np.ndarray, margin: float
) -> NDArray[np.bool_]:
    """Whether places [M,3] lie outside the convex hull of the points [N,3] and the cameras, or
    within `margin` of a face of points alone, as a ceiling."""
    corners = np.concatenate([points, [camera.position for camera in taken]])
    hull = ConvexHull(corners, qhull_options="QJ")
    depth = -hull.equations[:, :3] @ eyes.T - hull.equations[:, 3:]
    least = np.where(hull.simplices < len(points), margin, 0).min(axis=1)
    return np.asarray((depth < least[:, None]).any(axis=0))


def _are_taken(
    poses: Sequence[Named], taken: Sequence[Camera], far: np.ndarray
) -> NDArray[np.bool_]:
    eyes = np.stack([camera.position for camera in taken])
    ahead = np.stack([camera.world_to_camera[2, :3] for camera in taken])
    hits = np.zeros(len(poses), bool)
    for k, (_, camera) in enumerate(poses):
        close = np.linalg.norm(eyes - camera.position, axis=1) <= SAME_PLACE * far[k]
        turned = ahead @ camera.world_to_camera[2, :3] >= np.cos(np.radians(SAME_VIEW))
        hits[k] = (close & turned).any()
    return hits
