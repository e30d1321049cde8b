"""A photographer's data of an exact dataset: images, and the files of the tools that find cameras.

The folder `out` of `make` holds the same rock with errors of real data, in the format of the kind:

- colmap-binary: JPEG files with lens distortion, and a sparse model (sparse/0) in a world that is
  rotated, scaled and moved.
- nerfstudio: the same, as transforms.json, and the points as a PLY file without tracks.
- nerf-synthetic: PNG files with alpha, exact poses in a world of another scale, no points.

It also has the true masks (masks), the true rock in the world of these data (truth.ply), and the
similarity to that world (truth.json). The same seed gives the same files.
"""

import json
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

PIXEL_NOISE = 0.7
"""Standard deviation of a point along each axis, pixels of the camera that found it."""
OUTLIERS = 0.1
"""Share of points from wrong matches: elsewhere on the ray of a camera, with tracks of 2 or 3."""
OUTLIER_RANGE, OUTLIER_ERROR = (0.6, 1.6), (1.0, 3.9)
"""Their depth over the true one, and their reprojection error, pixels."""
MATCH_COSINE, MATCH_SHARE = np.cos(np.radians(45)), 0.7
"""Least cosine between views that share a point, and the share of these views that do."""
POINTS = 160
"""Points tried in each image, with a probability that grows with the squared image gradient."""
POSITION_NOISE, ROTATION_NOISE = 0.0005, np.radians(0.03)
"""Standard deviations of poses: of position over the distance from the rock; rotation, radians."""
DISTORTION = np.array([-0.10, 0.03, 0.001, -0.0007])
"""k1 k2 p1 p2 of the lens."""
CROP = 1.15
"""Focal length over that of the dataset, so that distorted images stay within its images."""
SCALE, SHIFT = 0.37, np.array([2.0, -1.0, 0.5])
"""Units of the new world in a metre, and the dataset's origin in it, units."""
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

    def camera(self, camera: Camera, position: np.ndarray, turn: np.ndarray) -> Camera:
        """Map a camera of the dataset, at another position and turned [3,3]."""
        pose = np.eye(4)
        pose[:3, :3] = turn @ camera.world_to_camera[:3, :3] @ self.rotation.T
        pose[:3, 3] = -pose[:3, :3] @ self.points(position[None])[0]
        return Camera(camera.K, camera.width, camera.height, pose)


@dataclass(frozen=True)
class Points:
    """Triangulated points: place [N,3] in the dataset's world, colour [N,3] uint8, tracks [N,V]
    (which images hold them), and reprojection error [N], pixels."""

    place: np.ndarray
    colour: np.ndarray
    tracks: np.ndarray
    error: np.ndarray


def longer(camera: Camera) -> Camera:
    """The camera of the photographs: with a longer lens."""
    K = camera.K * [[CROP, 1, 1], [1, CROP, 1], [1, 1, 1]]
    return Camera(K, camera.width, camera.height, camera.world_to_camera)


def distorted(image: np.ndarray, camera: Camera, K: np.ndarray) -> np.ndarray:
    """An image with intrinsics K as the lens of `camera` shows it."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    grid = np.stack([u, v], -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(grid, camera.K - HALF, DISTORTION)[:, 0]
    source = np.column_stack([straight, np.ones(len(straight))]) @ (K - HALF).T
    x, y = source[:, :2].astype(np.float32).T.reshape(2, *u.shape)
    return cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def triangulated(frames: tuple[Frame, ...], rng: np.random.Generator) -> Points:
    """Sparse points of the features in the images, with the errors stated above."""
    depths = [frame.depth() for frame in frames]
    eyes = np.stack([frame.camera.position for frame in frames])
    places, colours, owners = [], [], []
    for k, (frame, depth) in enumerate(zip(frames, depths, strict=True)):
        colour = display(frame.rgb())
        grey = cv2.GaussianBlur((colour @ LUMA).astype(np.float32), (0, 0), 1.0)
        across, down = (cv2.Sobel(grey, cv2.CV_64F, *order) for order in ((1, 0), (0, 1)))
        weight = ((across**2 + down**2) * (depth > 0)).ravel()
        chosen = rng.choice(weight.size, POINTS, replace=False, p=weight / weight.sum())
        places.append(frame.camera.unproject(depth).reshape(-1, 3)[chosen])
        colours.append(colour.reshape(-1, 3)[chosen])
        owners += [k] * POINTS
    place, owner = np.concatenate(places), np.array(owners)
    views = eyes - place[:, None]
    away = np.linalg.norm(views, axis=2)
    views /= away[..., None]
    near = np.einsum("nvk,nk->nv", views, views[np.arange(len(place)), owner]) > MATCH_COSINE
    seen = np.stack([shows(f.camera, d, place) for f, d in zip(frames, depths, strict=True)], 1)
    tracks = near & seen & (rng.random(near.shape) < MATCH_SHARE)
    tracks[np.arange(len(place)), owner] = True

    distance = away[np.arange(len(place)), owner]
    wrong = rng.random(len(place)) < OUTLIERS
    ahead = views[np.arange(len(place)), owner] * distance[:, None]
    stretch = np.where(wrong, rng.uniform(*OUTLIER_RANGE, len(place)), 1)
    pixel = distance / longer(frames[0].camera).K[0, 0]
    noise = PIXEL_NOISE * pixel[:, None] * rng.standard_normal(place.shape)
    place = eyes[owner] - stretch[:, None] * ahead + noise
    for n in np.flatnonzero(wrong):
        tracks[n, np.flatnonzero(tracks[n])[rng.integers(2, 4) :]] = False
    error = np.where(
        wrong, rng.uniform(*OUTLIER_ERROR, len(place)), rng.uniform(0.3, 0.8, len(place))
    )
    kept = tracks.sum(1) >= 2
    return Points(place[kept], np.concatenate(colours)[kept], tracks[kept], error[kept])


def shows(camera: Camera, depth: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Whether points [N,3] are in the photograph and nothing is in front of them, bool [N]."""
    (u, v), z = longer(camera).project(place)[0].T, camera.project(place)[1]
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (z > 0)
    column, row = np.clip(camera.project(place)[0], 0, [camera.width - 1, camera.height - 1]).T
    return inside & (np.abs(depth[row.astype(int), column.astype(int)] / z - 1) < 0.01)


def estimated_cameras(dataset: Dataset, world: World, rng: np.random.Generator) -> list[Camera]:
    """Cameras in the new world with the errors of bundle adjustment."""
    eyes = np.stack([frame.camera.position for frame in dataset.frames])
    away = float(np.median(np.linalg.norm(eyes - eyes.mean(0), axis=1)))
    cameras = []
    for frame in dataset.frames:
        position = frame.camera.position + POSITION_NOISE * away * rng.standard_normal(3)
        turn = cv2.Rodrigues(ROTATION_NOISE * rng.standard_normal(3))[0]
        cameras.append(world.camera(longer(frame.camera), position, turn))
    return cameras


def write_photographs(dataset: Dataset, out: Path) -> None:
    """Write the JPEG files and the true masks."""
    (out / "images").mkdir(parents=True)
    for frame in dataset.frames:
        lens, K = longer(frame.camera), frame.camera.K
        pixels = distorted(display(frame.rgb()), lens, K)
        Image.fromarray(pixels).save(out / f"images/{frame.name}.jpg", quality=92)
        mask = distorted(frame.mask().astype(np.float32), lens, K) >= 0.5
        write_png(out / f"masks/{frame.name}.png", mask)


def write_colmap(names: list[str], points: Points, cameras: list[Camera], out: Path) -> None:
    """Write the sparse model with pycolmap. points: in the world of the cameras."""
    import pycolmap

    model, first = pycolmap.Reconstruction(), cameras[0]
    size = {"width": first.width, "height": first.height}
    lens = [first.K[0, 0], first.K[1, 1], first.K[0, 2], first.K[1, 2], *DISTORTION]
    camera = pycolmap.Camera(model="OPENCV", params=lens, camera_id=1, **size)
    model.add_camera_with_trivial_rig(camera)
    for k, (name, posed) in enumerate(zip(names, cameras, strict=True)):
        pixels = posed.project(points.place[points.tracks[:, k]])[0]
        image = pycolmap.Image(name=f"{name}.jpg", keypoints=pixels, camera_id=1, image_id=k + 1)
        pose = pycolmap.Rigid3d(posed.world_to_camera[:3])
        model.add_image_with_trivial_frame(image, pose)
    number = np.cumsum(points.tracks, axis=0) - 1  # of a point among the keypoints of an image
    for n, place in enumerate(points.place):
        track = pycolmap.Track()
        for k in np.flatnonzero(points.tracks[n]):
            track.add_element(int(k) + 1, int(number[n, k]))
        added = model.add_point3D(place, track, points.colour[n])
        model.points3D[added].error = points.error[n]
    (out / "sparse/0").mkdir(parents=True)
    model.write_binary(out / "sparse/0")


def write_nerfstudio(names: list[str], points: Points, cameras: list[Camera], out: Path) -> None:
    """Write transforms.json with the lens distortion, and the points as a PLY."""
    from plyfile import PlyData, PlyElement

    first = cameras[0]
    K, header = first.K, dict(zip(("k1", "k2", "p1", "p2"), DISTORTION, strict=True))
    header |= {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    header |= {"camera_model": "OPENCV", "w": first.width, "h": first.height}
    frames = [
        frame_record(f"images/{name}.jpg", camera)
        for name, camera in zip(names, cameras, strict=True)
    ]
    write_json(
        out / "transforms.json", header | {"ply_file_path": "sparse_pc.ply", "frames": frames}
    )
    kinds = [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = [(*place, *colour) for place, colour in zip(points.place, points.colour, strict=True)]
    PlyData([PlyElement.describe(np.array(rows, kinds), "vertex")]).write(
        str(out / "sparse_pc.ply")
    )


def write_nerf_synthetic(dataset: Dataset, world: World, out: Path) -> None:
    """Write transforms_train.json and PNG files with alpha."""
    frames = []
    for k, frame in enumerate(dataset.frames):
        rgba = frame.target()[0]
        straight = rgba[..., :3] / np.where(rgba[..., 3:] > 0, rgba[..., 3:], 1)
        alpha = np.round(np.clip(rgba[..., 3], 0, 1) * 255).astype(np.uint8)
        (out / "train").mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.dstack([display(straight), alpha])).save(out / f"train/r_{k}.png")
        camera = world.camera(frame.camera, frame.camera.position, np.eye(3))
        frames.append(frame_record(f"./train/r_{k}", camera))
    camera = dataset.frames[0].camera
    angle = 2 * np.arctan(camera.width / 2 / camera.K[0, 0])
    write_json(out / "transforms_train.json", {"camera_angle_x": float(angle), "frames": frames})


def frame_record(path: str, camera: Camera) -> dict[str, Any]:
    """Entry of a frame in transforms.json."""
    pose = opengl_from_opencv(camera.world_to_camera).tolist()
    return {"file_path": path, "transform_matrix": pose}


def display(linear: np.ndarray) -> np.ndarray:
    """Convert linear RGB to 8-bit sRGB."""
    return np.round(srgb_from_linear(linear) * 255).astype(np.uint8)


def make(root: Path, out: Path, kind: str, seed: int = 0) -> None:
    """Write the data of a kind into a new folder."""
    import trimesh

    dataset, rng = load_dataset(root), generator(seed, "photographs")
    out.mkdir(parents=True)
    if kind == "nerf-synthetic":
        world = World(SCALE, np.eye(3), np.zeros(3))
        write_nerf_synthetic(dataset, world, out)
    else:
        q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        world = World(SCALE, q * np.linalg.det(q), SHIFT)
        write_photographs(dataset, out)
        found, cameras = triangulated(dataset.frames, rng), estimated_cameras(dataset, world, rng)
        points = Points(world.points(found.place), found.colour, found.tracks, found.error)
        write = write_nerfstudio if kind == "nerfstudio" else write_colmap
        write([frame.name for frame in dataset.frames], points, cameras, out)
    rock = read_mesh(root / "rock.glb")
    mesh = trimesh.Trimesh(world.points(rock.vertices), rock.faces, process=False)
    mesh.export(out / "truth.ply")
    write_json(out / "truth.json", {"scale": world.scale, "up": world.rotation[:, 2].tolist()})


def write_json(path: Path, data: dict) -> None:
    path.write_text(json.dumps(data, indent=1) + "\n")
