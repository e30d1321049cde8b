"""Makes of an exact dataset what a photographer would have: photographs, and the files of the tools
that find their cameras.

    python tools/photographs.py DATASET OUT --kind colmap-binary     # or colmap-text, nerfstudio,
    nerf-synthetic, rgbd python tools/photographs.py DATASET OUT --kind colmap-binary --exposure 0.3

DATASET is a folder of `mgs synth-orbit`. Its images are rendered, and its cameras and depth are
exact; OUT holds the same rock as a stranger's data do, in the format of the kind:

- colmap-text, colmap-binary: JPEG files of a camera that was not held level, with lens distortion;
a sparse model (sparse/0)
  in a world that is turned, scaled and moved, with poses and points as wrong as the constants below
  say.
- nerfstudio: the same photographs and world, as transforms.json with distortion, and the points as
a PLY file without tracks.
- nerf-synthetic: PNG files with alpha, exact poses in a world of another scale, no points.
- rgbd: PNG files, noisy depth of 16 bits, exact poses in metres.

With --exposure STOPS, the JPEG files of COLMAP and nerfstudio differ in exposure and white balance,
and their EXIF has the times of exposure.

Beside them OUT/masks has the true masks, OUT/truth.ply the true rock in the world of these data,
and OUT/truth.json the similarity that leads from DATASET's world to it, and the gains of the
images. No importer looks at these three. The same seed gives the same files.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image

from mgs.camera import Camera, opengl_from_opencv
from mgs.colour import srgb_from_linear
from mgs.data.dataset import Dataset, Frame, load_dataset
from mgs.data.meshes import read_mesh
from mgs.images import LUMA, write_png
from mgs.seeds import generator
from mgs.survey.depth_sensor import noisy_depth

# How wrong the data are. These numbers were fixed before the chain that reads such data was made,
# and are not tuned to it.

KEYPOINT_NOISE = 0.5
"""Standard deviation of a keypoint's place, pixels along each axis. Points inherit it by
triangulation."""
OUTLIERS = 0.1
"""Share of the points whose tracks are wrong matches: the point lies elsewhere on the ray of one of
its cameras."""
OUTLIER_RANGE = (0.6, 1.6)
"""Depth of such a point over the true one. Its track has two or three images, and an error of
OUTLIER_ERROR."""
OUTLIER_ERROR = (1.0, 3.9)
"""Mean reprojection error of a wrong point, pixels. COLMAP drops what exceeds 4."""
MATCH_ANGLE = 45.0
"""Largest angle between two views in which a feature is recognised, degrees."""
MATCH_SHARE = 0.7
"""Share of the images, of those in which a feature could be recognised, that its track holds: the
others are missing."""
POINTS = 160
"""Keypoints that are tried in each image, drawn with a probability that grows with the square of
the image's gradient: plain parts of the surface have few points or none."""
POSITION_NOISE = 0.0005
"""Standard deviation of a camera's estimated position along each axis, over its distance from the
rock."""
ROTATION_NOISE = 0.03
"""Standard deviation of its estimated rotation about each axis, degrees."""
ROLL = 2.0
"""Standard deviation of the angle by which a camera is not held level, degrees."""
DISTORTION = np.array([-0.10, 0.03, 0.001, -0.0007])
"""k1 k2 p1 p2 of the lens."""
CROP = 1.2
"""Focal length of the photographs over that of the dataset: the distorted and rolled image must not
look beyond its rim."""
QUALITY = 92
"""Of the JPEG files."""
WHITE_BALANCE = 1 / 3
"""With --exposure, how far the gains of red and blue differ from that of green at most, over the
largest exposure."""
SHUTTER = 0.005
"""Time of an exposure with a gain of 1, seconds."""
SCALE = 0.37
"""Units of the new world in a metre: nobody knows it."""
SHIFT = np.array([2.0, -1.0, 0.5])
"""The origin of the dataset's world in the new one, units."""

KINDS = ("colmap-text", "colmap-binary", "nerfstudio", "nerf-synthetic", "rgbd")

HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""OpenCV has pixel centres at whole numbers, mgs at +0.5: the difference of the intrinsics."""


@dataclass(frozen=True)
class World:
    """A similarity: x of the dataset -> scale * rotation @ x + shift of the data that are
    written."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray

    def points(self, x: np.ndarray) -> np.ndarray:
        """[N,3] of the dataset -> [N,3]."""
        return self.scale * x @ self.rotation.T + self.shift

    def camera(self, camera: Camera) -> Camera:
        """The same camera in the new world."""
        pose = np.eye(4)
        pose[:3, :3] = camera.world_to_camera[:3, :3] @ self.rotation.T
        pose[:3, 3] = -pose[:3, :3] @ self.points(camera.position[None])[0]
        return Camera(camera.K, camera.width, camera.height, pose)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A rotation matrix, all equally likely."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def small_rotation(degrees: np.ndarray) -> np.ndarray:
    """The rotation about the axis of a vector [3] by its length."""
    return cv2.Rodrigues(np.radians(degrees))[0]


@dataclass(frozen=True)
class Photograph:
    """A frame as it was photographed. camera: the true one, of the undistorted lens, with its roll;
    distortion: k1 k2 p1 p2."""

    frame: Frame
    camera: Camera
    distortion: np.ndarray

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Where the lens shows points [N,3] of the dataset's world: [N,2] pixels."""
        pose = self.camera.world_to_camera
        rotation = cv2.Rodrigues(pose[:3, :3])[0]
        shown = cv2.projectPoints(
            points[:, None], rotation, pose[:3, 3], self.camera.K, self.distortion
        )[0]
        return shown[
            :, 0
        ]  # projectPoints takes K as it is: pixel centres at +0.5 where K has them there

    def resample(self, image: np.ndarray, method: int = cv2.INTER_CUBIC) -> np.ndarray:
        """An image of the frame, [H,W] or [H,W,C], as the lens shows it."""
        v, u = np.mgrid[: self.camera.height, : self.camera.width].astype(np.float64)
        straight = cv2.undistortPoints(
            np.stack([u, v], -1).reshape(-1, 1, 2), self.camera.K - HALF, self.distortion
        )[:, 0]
        rays = np.column_stack([straight, np.ones(len(straight))])
        turn = self.frame.camera.world_to_camera[:3, :3] @ self.camera.world_to_camera[:3, :3].T
        source = rays @ turn.T @ (self.frame.camera.K - HALF).T
        place = (source[:, :2] / source[:, 2:]).astype(np.float32).reshape(*u.shape, 2)
        return cv2.remap(
            image, place[..., 0], place[..., 1], method, borderMode=cv2.BORDER_REPLICATE
        )


def photograph(frame: Frame, rng: np.random.Generator) -> Photograph:
    """The frame through a distorting lens, by a camera that is not held level."""
    K = frame.camera.K * [[CROP, 1, 1], [1, CROP, 1], [1, 1, 1]]
    turn = np.eye(4)
    turn[:3, :3] = small_rotation(np.array([0, 0, ROLL * rng.standard_normal()]))
    camera = Camera(K, frame.camera.width, frame.camera.height, turn @ frame.camera.world_to_camera)
    return Photograph(frame, camera, DISTORTION)


def estimated(camera: Camera, distance: float, rng: np.random.Generator) -> Camera:
    """A camera as bundle adjustment finds it. distance: to the rock, in the units of the camera's
    world."""
    pose = np.eye(4)
    pose[:3, :3] = (
        small_rotation(ROTATION_NOISE * rng.standard_normal(3)) @ camera.world_to_camera[:3, :3]
    )
    position = camera.position + POSITION_NOISE * distance * rng.standard_normal(3)
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera(camera.K, camera.width, camera.height, pose)


@dataclass(frozen=True)
class Point:
    """A triangulated point: its place [3] in the dataset's world, colour [3] uint8, the images of
    its track and the keypoint in each, pixels [T,2], and the mean reprojection error, pixels."""

    place: np.ndarray
    colour: np.ndarray
    images: np.ndarray
    keypoints: np.ndarray
    error: float


def triangulated(photos: Sequence[Photograph], rng: np.random.Generator) -> list[Point]:
    """The sparse points that features in the photographs give, with the errors that the constants
    of this file state."""
    depths = [photo.frame.depth() for photo in photos]
    points: list[Point] = []
    for k, (photo, depth) in enumerate(zip(photos, depths, strict=True)):
        colours = np.round(srgb_from_linear(photo.frame.rgb()) * 255).astype(np.uint8)
        grey = cv2.GaussianBlur((colours @ LUMA).astype(np.float32), (0, 0), 1.0)
        weight = (
            cv2.Sobel(grey, cv2.CV_64F, 1, 0) ** 2 + cv2.Sobel(grey, cv2.CV_64F, 0, 1) ** 2
        ) * (depth > 0)
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
    """The point that the feature at `place`, found in photograph k, becomes; None where too few
    images hold it."""
    views = np.stack([photo.camera.position - place for photo in photos])
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    near = views @ views[k] > np.cos(np.radians(MATCH_ANGLE))
    track = [
        i
        for i in map(int, np.flatnonzero(near))
        if i == k or (_shows(photos[i], depths[i], place) and rng.random() < MATCH_SHARE)
    ]
    if len(track) < 2 or not _shows(photos[k], depths[k], place):
        return None
    if rng.random() < OUTLIERS:
        kept = np.sort(rng.choice(track, min(len(track), int(rng.integers(2, 4))), replace=False))
        wrong = photos[k].camera.position - views[k] * np.linalg.norm(
            photos[k].camera.position - place
        ) * rng.uniform(*OUTLIER_RANGE)
        keypoints = np.stack([photos[int(i)].pixels(wrong[None])[0] for i in kept])
        return Point(wrong, colour, kept, keypoints, float(rng.uniform(*OUTLIER_ERROR)))
    exact = np.stack([photos[i].pixels(place[None])[0] for i in track])
    noise = KEYPOINT_NOISE * rng.standard_normal(exact.shape)
    step = 1e-4 * np.linalg.norm(photos[k].camera.position - place)
    jacobian = (
        np.stack(
            [photos[i].pixels(place + step * np.eye(3)) - exact[j] for j, i in enumerate(track)]
        )
        / step
    )
    jacobian = jacobian.transpose(0, 2, 1).reshape(-1, 3)
    moved = np.linalg.lstsq(jacobian, noise.ravel(), rcond=None)[0]  # least squares, to first order
    residual = (noise.ravel() - jacobian @ moved).reshape(-1, 2)
    return Point(
        place + moved,
        colour,
        np.array(track),
        exact + noise,
        float(np.linalg.norm(residual, axis=1).mean()),
    )


def _shows(photo: Photograph, depth: np.ndarray, place: np.ndarray) -> bool:
    """Whether a point [3] is in the photograph, and nothing is in front of it."""
    (u, v), z = (part[0] for part in photo.frame.camera.project(place[None]))
    x, y = photo.pixels(place[None])[0]
    inside = 0 <= x < photo.camera.width and 0 <= y < photo.camera.height and z > 0
    return bool(
        inside
        and abs(depth[min(int(v), depth.shape[0] - 1), min(int(u), depth.shape[1] - 1)] / z - 1)
        < 0.01
    )


def exposures(count: int, stops: float, seed: int) -> np.ndarray:
    """Gains [count,3] of images: an exposure of up to so many stops more or less, and a white
    balance, both evenly spread."""
    rng = generator(seed, "photographs/exposure")
    exposure, balance = (
        rng.uniform(-stops, stops, (count, 1)),
        WHITE_BALANCE * rng.uniform(-stops, stops, (count, 3)),
    )
    return 2.0 ** (exposure + balance * [1, 0, 1])


def write_photographs(photos: Sequence[Photograph], out: Path, gains: np.ndarray | None) -> None:
    """The JPEG files and the true masks. gains: [V,3] of the images, linear RGB; None: all 1, and
    no EXIF."""
    (out / "images").mkdir(parents=True)
    for k, photo in enumerate(photos):
        rgb, exif = photo.frame.rgb(), Image.Exif()
        if gains is not None:
            rgb = rgb * gains[k].astype(np.float32)
            exif.get_ifd(ExifTags.IFD.Exif).update({
                ExifTags.Base.ExposureTime: SHUTTER * float(gains[k, 1]), ExifTags.Base.FNumber: 2.8,
                ExifTags.Base.ISOSpeedRatings: 100,
            })  # fmt: skip
        pixels = photo.resample(
            np.round(np.clip(srgb_from_linear(rgb), 0, 1) * 255).astype(np.uint8)
        )
        Image.fromarray(pixels).save(
            out / f"images/{photo.frame.name}.jpg", quality=QUALITY, exif=exif
        )
        write_png(
            out / f"masks/{photo.frame.name}.png",
            photo.resample(photo.frame.mask().astype(np.float32)) >= 0.5,
        )


def write_colmap(
    photos: Sequence[Photograph],
    points: list[Point],
    world: World,
    out: Path,
    seed: int,
    binary: bool,
) -> None:
    """The sparse model, by pycolmap."""
    import pycolmap

    rng, model = generator(seed, "photographs/poses"), pycolmap.Reconstruction()
    first = photos[0].camera
    lens = [first.K[0, 0], first.K[1, 1], first.K[0, 2], first.K[1, 2], *DISTORTION]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model="OPENCV", width=first.width, height=first.height, params=lens, camera_id=1
        )
    )
    keypoints: list[list[np.ndarray]] = [[] for _ in photos]
    places = []
    for point in points:
        places.append([len(keypoints[i]) for i in point.images])
        for i, pixel in zip(point.images, point.keypoints, strict=True):
            keypoints[i].append(pixel)
    for k, photo in enumerate(photos):
        camera = world.camera(photo.camera)
        pose = pycolmap.Rigid3d(
            estimated(camera, world.scale * _distance(photos), rng).world_to_camera[:3]
        )
        held = np.array(keypoints[k]).reshape(-1, 2)
        image = pycolmap.Image(
            name=f"{photo.frame.name}.jpg", keypoints=held, camera_id=1, image_id=k + 1
        )
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
    photos: Sequence[Photograph], points: list[Point], world: World, out: Path, seed: int
) -> None:
    """transforms.json with the lens's distortion, and the points as nerfstudio writes them: x y z
    and colours, no tracks."""
    from plyfile import PlyData, PlyElement

    rng, camera = generator(seed, "photographs/poses"), photos[0].camera
    header = {
        "camera_model": "OPENCV", "fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2],
        "w": camera.width, "h": camera.height, **dict(zip(("k1", "k2", "p1", "p2"), DISTORTION, strict=True)),
        "ply_file_path": "sparse_pc.ply",
    }  # fmt: skip
    poses = [
        estimated(world.camera(photo.camera), world.scale * _distance(photos), rng)
        for photo in photos
    ]
    frames = [
        {
            "file_path": f"images/{photo.frame.name}.jpg",
            "transform_matrix": opengl_from_opencv(pose.world_to_camera).tolist(),
        }
        for photo, pose in zip(photos, poses, strict=True)
    ]
    _write_json(out / "transforms.json", header | {"frames": frames})
    columns = [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    table = np.empty(len(points), columns)
    places = world.points(np.stack([point.place for point in points]))
    colours = np.stack([point.colour for point in points])
    for k in range(3):
        table["xyz"[k]], table[("red", "green", "blue")[k]] = places[:, k], colours[:, k]
    PlyData([PlyElement.describe(table, "vertex")]).write(str(out / "sparse_pc.ply"))


def write_nerf_synthetic(dataset: Dataset, world: World, out: Path) -> None:
    """transforms_train.json and PNG files with alpha; one focal length, square pixels, the
    principal point in the middle."""
    frames = []
    for k, frame in enumerate(dataset.frames):
        rgba = frame.target()[0]
        straight = rgba[..., :3] / np.where(rgba[..., 3:] > 0, rgba[..., 3:], 1)
        pixels = np.dstack([srgb_from_linear(straight), rgba[..., 3]])
        (out / "train").mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.round(np.clip(pixels, 0, 1) * 255).astype(np.uint8)).save(
            out / f"train/r_{k}.png"
        )
        write_png(out / f"masks/r_{k}.png", frame.mask())
        pose = opengl_from_opencv(world.camera(frame.camera).world_to_camera).tolist()
        frames.append({"file_path": f"./train/r_{k}", "rotation": 0.0, "transform_matrix": pose})
    camera = dataset.frames[0].camera
    angle = 2 * np.arctan(camera.width / 2 / camera.K[0, 0])
    _write_json(out / "transforms_train.json", {"camera_angle_x": float(angle), "frames": frames})


def write_rgbd(dataset: Dataset, out: Path, seed: int) -> None:
    """transforms.json with noisy depth in millimetres (16-bit PNG), and PNG files; masks are
    written, but not named in it."""
    rng, camera, frames = generator(seed, "photographs/depth"), dataset.frames[0].camera, []
    for frame in dataset.frames:
        write_png(out / f"images/{frame.name}.png", frame.rgb())
        write_png(out / f"masks/{frame.name}.png", frame.mask())
        (out / "depth").mkdir(exist_ok=True)
        millimetres = np.round(1000 * noisy_depth(frame.depth(), frame.camera, rng))
        cv2.imwrite(
            str(out / f"depth/{frame.name}.png"), np.clip(millimetres, 0, 65535).astype(np.uint16)
        )
        pose = opengl_from_opencv(frame.camera.world_to_camera).tolist()
        record = {
            "file_path": f"images/{frame.name}.png",
            "depth_file_path": f"depth/{frame.name}.png",
        }
        frames.append(record | {"transform_matrix": pose})
    K = camera.K
    lens = {
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "w": camera.width,
        "h": camera.height,
    }
    _write_json(out / "transforms.json", {"camera_model": "OPENCV", **lens, "frames": frames})


def make(root: Path, out: Path, kind: str, seed: int = 0, stops: float = 0.0) -> None:
    """Write the data of a kind into a new folder. stops: of COLMAP and nerfstudio's images, by how
    much exposure differs."""
    dataset, rng = load_dataset(root), generator(seed, "photographs")
    out.mkdir(parents=True)
    world = World(SCALE, random_rotation(rng), SHIFT)
    if kind == "nerf-synthetic":
        world = World(SCALE, np.eye(3), np.zeros(3))
    if kind == "rgbd":
        world = World(1.0, np.eye(3), np.zeros(3))
    gains = None
    writers: dict[str, Callable[[], None]] = {
        "nerf-synthetic": lambda: write_nerf_synthetic(dataset, world, out),
        "rgbd": lambda: write_rgbd(dataset, out, seed),
    }
    if kind in writers:
        writers[kind]()
    else:
        photos = [photograph(frame, rng) for frame in dataset.frames]
        gains = exposures(len(photos), stops, seed) if stops else None
        write_photographs(photos, out, gains)
        points = triangulated(photos, rng)
        if kind == "nerfstudio":
            write_nerfstudio(photos, points, world, out, seed)
        else:
            write_colmap(photos, points, world, out, seed, kind == "colmap-binary")
    _write_truth(
        root,
        world,
        out,
        {}
        if gains is None
        else {f.name: g.tolist() for f, g in zip(dataset.frames, gains, strict=True)},
    )


def _write_truth(root: Path, world: World, out: Path, gains: dict[str, list[float]]) -> None:
    import trimesh

    if (root / "rock.glb").is_file():
        rock = read_mesh(root / "rock.glb")
        trimesh.Trimesh(world.points(rock.vertices), rock.faces, process=False).export(
            out / "truth.ply"
        )
    similarity = {
        "scale": world.scale,
        "rotation": world.rotation.tolist(),
        "shift": world.shift.tolist(),
    }
    _write_json(
        out / "truth.json", similarity | {"up": world.rotation[:, 2].tolist(), "gains": gains}
    )


def _distance(photos: Sequence[Photograph]) -> float:
    """About how far the cameras are from the rock, metres: from the point nearest to all of them,
    seen from outside."""
    positions = np.stack([photo.camera.position for photo in photos])
    return float(np.median(np.linalg.norm(positions - positions.mean(0), axis=1)))


def _write_json(path: Path, data: dict) -> None:
    path.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description="Make the data that a photographer would have, of an exact dataset."
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kind", choices=KINDS, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--exposure",
        type=float,
        default=0.0,
        metavar="STOPS",
        help="let exposure differ by up to STOPS",
    )
    given = parser.parse_args()
    if given.exposure and given.kind in ("nerf-synthetic", "rgbd"):
        parser.error(f"--exposure is for photographs of colmap and nerfstudio, not {given.kind}")
    make(given.dataset, given.out, given.kind, given.seed, given.exposure)
