"""Make a photographer's data of an exact dataset: images, and the files of the tools that find
cameras. Test data of importers and priors.

The folder `out` of `make` holds the same rock with the errors of real data, in the format of the
kind:

- colmap-text, colmap-binary: JPEG files of a camera that was not held level, with lens distortion;
  a sparse model (sparse/0) in a world that is rotated, scaled and moved. Poses and points have the
  errors stated below.
- nerfstudio: the same photographs and world, as transforms.json with distortion, and the points as
  a PLY file without tracks.
- nerf-synthetic: PNG files with alpha, exact poses in a world of another scale, no points.

It also has what no importer reads: the true masks (masks), the true rock in the world of these data
(truth.ply), and the similarity to that world (truth.json). The same seed gives the same files.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from mgs.camera import Camera, opengl_from_opencv
from mgs.colour import srgb_from_linear
from mgs.data.dataset import Dataset, Frame, load_dataset
from mgs.data.meshes import read_mesh
from mgs.images import LUMA, write_png
from mgs.seeds import generator

# Errors of the data, fixed before the importers were written and not tuned to them.

KEYPOINT_NOISE = 0.5
"""Standard deviation of a keypoint along each axis, pixels. Triangulated points inherit it."""
OUTLIERS = 0.1
"""Share of points with wrong matches, which lie elsewhere on the ray of one of their cameras."""
OUTLIER_RANGE = (0.6, 1.6)
"""Depth of such a point over the true one. Its track has two or three images."""
OUTLIER_ERROR = (1.0, 3.9)
"""Mean reprojection error of such a point, pixels. COLMAP drops points above 4."""
MATCH_ANGLE = 45.0
"""Largest angle between two views that share a feature, degrees."""
MATCH_SHARE = 0.7
"""Share of the images that could hold a feature whose track includes them."""
POINTS = 160
"""Keypoints tried in each image, with a probability that grows with the squared image gradient:
plain parts of the surface have few points or none."""
POSITION_NOISE = 0.0005
"""Standard deviation of an estimated camera position along each axis, over its distance from the
rock."""
ROTATION_NOISE = 0.03
"""Standard deviation of its estimated rotation about each axis, degrees."""
ROLL = 2.0
"""Standard deviation of the roll of a camera, degrees."""
DISTORTION = np.array([-0.10, 0.03, 0.001, -0.0007])
"""k1 k2 p1 p2 of the lens."""
CROP = 1.2
"""Focal length of the photographs over that of the dataset, so that distorted and rolled images
stay within its images."""
QUALITY = 92
"""Quality of the JPEG files."""
SCALE = 0.37
"""Units of the new world in a metre, which no importer knows."""
SHIFT = np.array([2.0, -1.0, 0.5])
"""Origin of the dataset's world in the new one, units."""

HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""Offset of intrinsics: OpenCV has pixel centres at whole numbers, mgs at +0.5."""


@dataclass(frozen=True)
class World:
    """Similarity from the dataset to the written data: scale * rotation @ x + shift."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray

    def points(self, x: np.ndarray) -> np.ndarray:
        """Map points [N,3] of the dataset."""
        return self.scale * x @ self.rotation.T + self.shift

    def camera(self, camera: Camera) -> Camera:
        """Map a camera of the dataset."""
        pose = np.eye(4)
        pose[:3, :3] = camera.world_to_camera[:3, :3] @ self.rotation.T
        pose[:3, 3] = -pose[:3, :3] @ self.points(camera.position[None])[0]
        return Camera(camera.K, camera.width, camera.height, pose)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Rotation matrix, all equally likely."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def small_rotation(degrees: np.ndarray) -> np.ndarray:
    """Rotation matrix about the axis of a vector [3], by its length in degrees."""
    return cv2.Rodrigues(np.radians(degrees))[0]


@dataclass(frozen=True)
class Photograph:
    """A frame and the camera that took it: with roll, and without the lens distortion."""

    frame: Frame
    camera: Camera

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Project points [N,3] of the dataset's world through the lens: [N,2] pixels."""
        camera, pose = self.camera, self.camera.world_to_camera
        rotation, shift = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3]
        # projectPoints has no pixel convention of its own: K decides.
        shown = cv2.projectPoints(points[:, None], rotation, shift, camera.K, DISTORTION)[0]
        return shown[:, 0]

    def resample(self, image: np.ndarray) -> np.ndarray:
        """Distort an image of the frame, [H,W] or [H,W,C], as the lens shows it."""
        v, u = np.mgrid[: self.camera.height, : self.camera.width].astype(np.float64)
        grid = np.stack([u, v], -1).reshape(-1, 1, 2)
        straight = cv2.undistortPoints(grid, self.camera.K - HALF, DISTORTION)[:, 0]
        rays = np.column_stack([straight, np.ones(len(straight))])
        turn = self.frame.camera.world_to_camera[:3, :3] @ self.camera.world_to_camera[:3, :3].T
        source = rays @ turn.T @ (self.frame.camera.K - HALF).T
        place = (source[:, :2] / source[:, 2:]).astype(np.float32).reshape(*u.shape, 2)
        x, y, border = place[..., 0], place[..., 1], cv2.BORDER_REPLICATE
        return cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=border)


def photograph(frame: Frame, rng: np.random.Generator) -> Photograph:
    """Take a frame by a camera with roll and a distorting lens."""
    K = frame.camera.K * [[CROP, 1, 1], [1, CROP, 1], [1, 1, 1]]
    turn = np.eye(4)
    turn[:3, :3] = small_rotation(np.array([0, 0, ROLL * rng.standard_normal()]))
    camera = Camera(K, frame.camera.width, frame.camera.height, turn @ frame.camera.world_to_camera)
    return Photograph(frame, camera)


def estimated(camera: Camera, distance: float, rng: np.random.Generator) -> Camera:
    """Add the pose errors of bundle adjustment. distance: to the rock, in the units of the
    camera."""
    pose = np.eye(4)
    turn = small_rotation(ROTATION_NOISE * rng.standard_normal(3))
    pose[:3, :3] = turn @ camera.world_to_camera[:3, :3]
    position = camera.position + POSITION_NOISE * distance * rng.standard_normal(3)
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera(camera.K, camera.width, camera.height, pose)


@dataclass(frozen=True)
class Point:
    """A triangulated point: its place [3] in the dataset's world, colour [3] uint8, the images of
    its track, the keypoint in each [T,2], pixels, and the mean reprojection error, pixels."""

    place: np.ndarray
    colour: np.ndarray
    images: np.ndarray
    keypoints: np.ndarray
    error: float


def triangulated(photos: Sequence[Photograph], rng: np.random.Generator) -> list[Point]:
    """Sparse points of the features in the photographs, with the errors stated above."""
    depths = [photo.frame.depth() for photo in photos]
    points: list[Point] = []
    for k, (photo, depth) in enumerate(zip(photos, depths, strict=True)):
        colours = _display(photo.frame.rgb())
        grey = cv2.GaussianBlur((colours @ LUMA).astype(np.float32), (0, 0), 1.0)
        across, down = (cv2.Sobel(grey, cv2.CV_64F, *order) for order in ((1, 0), (0, 1)))
        weight = (across**2 + down**2) * (depth > 0)
        chosen = rng.choice(weight.size, POINTS, replace=False, p=(weight / weight.sum()).ravel())
        world = photo.frame.camera.unproject(depth).reshape(-1, 3)[chosen]
        for place, colour in zip(world, colours.reshape(-1, 3)[chosen], strict=True):
            point = _tracked(place, colour, k, photos, depths, rng)
            if point is not None:
                points.append(point)
    return points


def _tracked(
    place: np.ndarray,
    colour: np.ndarray,
    k: int,
    photos: Sequence[Photograph],
    depths: list[np.ndarray],
    rng: np.random.Generator,
) -> Point | None:
    """Point of the feature at `place` in photograph k; None if too few images hold it."""
    views = np.stack([photo.camera.position - place for photo in photos])
    distance = np.linalg.norm(views[k])
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    near = views @ views[k] > np.cos(np.radians(MATCH_ANGLE))
    track = []
    for i in map(int, np.flatnonzero(near)):
        if i == k or (_shows(photos[i], depths[i], place) and rng.random() < MATCH_SHARE):
            track.append(i)
    if len(track) < 2 or not _shows(photos[k], depths[k], place):
        return None
    if rng.random() < OUTLIERS:
        kept = np.sort(rng.choice(track, min(len(track), int(rng.integers(2, 4))), replace=False))
        wrong = photos[k].camera.position - views[k] * distance * rng.uniform(*OUTLIER_RANGE)
        keypoints = np.stack([photos[int(i)].pixels(wrong[None])[0] for i in kept])
        return Point(wrong, colour, kept, keypoints, float(rng.uniform(*OUTLIER_ERROR)))
    exact = np.stack([photos[i].pixels(place[None])[0] for i in track])
    noise = KEYPOINT_NOISE * rng.standard_normal(exact.shape)
    step = 1e-4 * distance
    moves = [photos[i].pixels(place + step * np.eye(3)) - exact[j] for j, i in enumerate(track)]
    jacobian = (np.stack(moves) / step).transpose(0, 2, 1).reshape(-1, 3)
    moved = np.linalg.lstsq(jacobian, noise.ravel(), rcond=None)[0]  # triangulation to first order
    residual = (noise.ravel() - jacobian @ moved).reshape(-1, 2)
    error = float(np.linalg.norm(residual, axis=1).mean())
    return Point(place + moved, colour, np.array(track), exact + noise, error)


def _shows(photo: Photograph, depth: np.ndarray, place: np.ndarray) -> bool:
    """Whether a point [3] is in the photograph and nothing is in front of it."""
    (u, v), z = (part[0] for part in photo.frame.camera.project(place[None]))
    x, y = photo.pixels(place[None])[0]
    if not (0 <= x < photo.camera.width and 0 <= y < photo.camera.height and z > 0):
        return False
    row, column = min(int(v), depth.shape[0] - 1), min(int(u), depth.shape[1] - 1)
    return bool(abs(depth[row, column] / z - 1) < 0.01)


def write_photographs(photos: Sequence[Photograph], out: Path) -> None:
    """Write the JPEG files and the true masks."""
    (out / "images").mkdir(parents=True)
    for photo in photos:
        pixels, name = photo.resample(_display(photo.frame.rgb())), photo.frame.name
        Image.fromarray(pixels).save(out / f"images/{name}.jpg", quality=QUALITY)
        mask = photo.resample(photo.frame.mask().astype(np.float32)) >= 0.5
        write_png(out / f"masks/{name}.png", mask)


def estimated_cameras(photos: Sequence[Photograph], world: World, seed: int) -> list[Camera]:
    """Cameras in the new world as bundle adjustment finds them; their distance from the rock is
    estimated by that from their centre."""
    rng = generator(seed, "photographs/poses")
    positions = np.stack([photo.camera.position for photo in photos])
    distances = np.linalg.norm(positions - positions.mean(0), axis=1)
    away = world.scale * float(np.median(distances))
    return [estimated(world.camera(photo.camera), away, rng) for photo in photos]


def write_colmap(
    photos: Sequence[Photograph],
    points: list[Point],
    cameras: list[Camera],
    world: World,
    out: Path,
    binary: bool,
) -> None:
    """Write the sparse model with pycolmap."""
    import pycolmap

    model, first = pycolmap.Reconstruction(), photos[0].camera
    size = {"width": first.width, "height": first.height}
    lens = [first.K[0, 0], first.K[1, 1], first.K[0, 2], first.K[1, 2], *DISTORTION]
    camera = pycolmap.Camera(model="OPENCV", params=lens, camera_id=1, **size)
    model.add_camera_with_trivial_rig(camera)
    keypoints: list[list[np.ndarray]] = [[] for _ in photos]
    places = []
    for point in points:
        places.append([len(keypoints[i]) for i in point.images])
        for i, pixel in zip(point.images, point.keypoints, strict=True):
            keypoints[i].append(pixel)
    for k, photo in enumerate(photos):
        pixels, name = np.array(keypoints[k]).reshape(-1, 2), f"{photo.frame.name}.jpg"
        image = pycolmap.Image(name=name, keypoints=pixels, camera_id=1, image_id=k + 1)
        pose = pycolmap.Rigid3d(cameras[k].world_to_camera[:3])
        model.add_image_with_trivial_frame(image, pose)
    for point, at in zip(points, places, strict=True):
        track = pycolmap.Track()
        for i, index in zip(point.images, at, strict=True):
            track.add_element(int(i) + 1, index)
        added = model.add_point3D(world.points(point.place[None])[0], track, point.colour)
        model.points3D[added].error = point.error
    (out / "sparse/0").mkdir(parents=True)
    (model.write_binary if binary else model.write_text)(out / "sparse/0")


def write_nerfstudio(
    photos: Sequence[Photograph],
    points: list[Point],
    cameras: list[Camera],
    world: World,
    out: Path,
) -> None:
    """Write transforms.json with the lens distortion, and the points as a PLY (x y z and
    colours)."""
    from plyfile import PlyData, PlyElement

    distortion = dict(zip(("k1", "k2", "p1", "p2"), DISTORTION, strict=True))
    header = _lens(photos[0].camera) | distortion | {"ply_file_path": "sparse_pc.ply"}
    frames = [
        _frame(f"images/{photo.frame.name}.jpg", pose)
        for photo, pose in zip(photos, cameras, strict=True)
    ]
    _write_json(out / "transforms.json", header | {"frames": frames})
    places = world.points(np.stack([point.place for point in points]))
    colours = np.stack([point.colour for point in points])
    columns = dict(zip(("x", "y", "z"), places.astype("f4").T, strict=True))
    columns |= dict(zip(("red", "green", "blue"), colours.T, strict=True))
    table = np.empty(len(points), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    PlyData([PlyElement.describe(table, "vertex")]).write(str(out / "sparse_pc.ply"))


def write_nerf_synthetic(dataset: Dataset, world: World, out: Path) -> None:
    """Write transforms_train.json and PNG files with alpha; square pixels, the principal point in
    the centre."""
    frames = []
    for k, frame in enumerate(dataset.frames):
        rgba = frame.target()[0]
        straight = rgba[..., :3] / np.where(rgba[..., 3:] > 0, rgba[..., 3:], 1)
        alpha = np.round(np.clip(rgba[..., 3], 0, 1) * 255).astype(np.uint8)
        (out / "train").mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.dstack([_display(straight), alpha])).save(out / f"train/r_{k}.png")
        write_png(out / f"masks/r_{k}.png", frame.mask())
        frames.append(_frame(f"./train/r_{k}", world.camera(frame.camera), rotation=0.0))
    camera = dataset.frames[0].camera
    angle = 2 * np.arctan(camera.width / 2 / camera.K[0, 0])
    _write_json(out / "transforms_train.json", {"camera_angle_x": float(angle), "frames": frames})


def _lens(camera: Camera) -> dict[str, Any]:
    """Size and intrinsics of a camera in transforms.json."""
    K = camera.K
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    return {"camera_model": "OPENCV", **lens, "w": camera.width, "h": camera.height}


def _frame(path: str, camera: Camera, **more: Any) -> dict[str, Any]:
    """Entry of a frame in transforms.json."""
    pose = opengl_from_opencv(camera.world_to_camera).tolist()
    return {"file_path": path, **more, "transform_matrix": pose}


def _display(linear: np.ndarray) -> np.ndarray:
    """Convert linear RGB to 8-bit sRGB."""
    return np.round(srgb_from_linear(linear) * 255).astype(np.uint8)


def make(root: Path, out: Path, kind: str, seed: int = 0) -> None:
    """Write the data of a kind into a new folder."""
    dataset, rng = load_dataset(root), generator(seed, "photographs")
    out.mkdir(parents=True)
    if kind == "nerf-synthetic":
        world = World(SCALE, np.eye(3), np.zeros(3))
        write_nerf_synthetic(dataset, world, out)
    else:
        world = World(SCALE, random_rotation(rng), SHIFT)
        photos = [photograph(frame, rng) for frame in dataset.frames]
        write_photographs(photos, out)
        points, cameras = triangulated(photos, rng), estimated_cameras(photos, world, seed)
        if kind == "nerfstudio":
            write_nerfstudio(photos, points, cameras, world, out)
        else:
            write_colmap(photos, points, cameras, world, out, kind == "colmap-binary")
    _write_truth(root, world, out)


def _write_truth(root: Path, world: World, out: Path) -> None:
    import trimesh

    if (root / "rock.glb").is_file():
        rock = read_mesh(root / "rock.glb")
        mesh = trimesh.Trimesh(world.points(rock.vertices), rock.faces, process=False)
        mesh.export(out / "truth.ply")
    _write_json(out / "truth.json", {"scale": world.scale, "up": world.rotation[:, 2].tolist()})


def _write_json(path: Path, data: dict) -> None:
    path.write_text(json.dumps(data, indent=1) + "\n")
