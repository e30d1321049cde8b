"""A small RGB-D dataset in closed form: an ellipsoid half buried in a plane."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from mgs import Camera, Frame, PriorSettings, look_at, prior_from_mesh, save_prior
from mgs.data.dataset import Dataset, load_dataset, write_transforms
from mgs.data.meshes import to_glb
from mgs.files import read_json
from mgs.images import write_exr, write_png

CENTRE = np.array([0.1, -0.05, 0.2])
AXES = np.array([0.6, 0.5, 0.45])
"""Centre and semi-axes of the rock, metres; the ground is z = 0."""
GROUND = 4.0
"""Half edge of the square arena, metres; beyond it there is no depth."""


def pinhole(focal: float, width: int, height: int, eye, target=(0, 0, 0)) -> Camera:
    """A camera at `eye` that looks at `target`, its principal point in the middle."""
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(K, width, height, look_at(eye, target))


def sphere(count: int) -> np.ndarray:
    """Points [N,3] of a Fibonacci lattice on the unit sphere."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle, radius = np.pi * (1 + 5**0.5) * np.arange(count), np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)


def orbit_cameras(
    count: int = 8, width: int = 64, height: int = 48, radius: float = 2.6, altitude: float = 1.5
) -> list[Camera]:
    """Cameras on a circle that look at the rock; the focal length is 1.1 image widths."""
    angles = 2 * np.pi * np.arange(count) / count
    eyes = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, altitude)], 1)
    return [pinhole(1.1 * width, width, height, eye, CENTRE) for eye in eyes]


def halved(cameras: list[Camera], across: bool) -> list[Camera]:
    """The same views with half as many pixels across, or half as many down."""
    x, y = (0.5, 1) if across else (1, 0.5)
    K = np.diag([x, y, 1])
    return [Camera(K @ c.K, x * c.width, y * c.height, c.world_to_camera) for c in cameras]


def albedo(points: np.ndarray) -> np.ndarray:
    """Smooth colour of a world point, linear RGB in [0.1, 0.9]."""
    return 0.5 + 0.4 * np.sin(points * [4, 3, 5] + [0, 1, 2])


def level(points: np.ndarray) -> np.ndarray:
    """Scale of the ellipsoid through each point [N,3], less 1: 0 on the rock, negative inside."""
    return np.sqrt((((points - CENTRE) / AXES) ** 2).sum(1)) - 1


def cast(
    camera: Camera, rocks: list[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z-depth [H,W] (0: sky), mask [H,W], world points [H,W,3] of ellipsoids (centre, axes)."""
    directions = camera.unproject(np.ones((camera.height, camera.width))) - camera.position
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = -camera.position[2] / directions[..., 2]
        hit = camera.position + ground[..., None] * directions
        depth = np.where((ground > 0) & (np.abs(hit[..., :2]).max(-1) < GROUND), ground, np.inf)
        mask = np.zeros(depth.shape, bool)
        for centre, axes in rocks:
            o, d = (camera.position - centre) / axes, directions / axes
            a, b, c = (d * d).sum(-1), (d @ o), o @ o - 1
            t = (-b - np.sqrt(b * b - a * c)) / a
            nearer = np.isfinite(t) & (t > 0) & (t < depth)
            depth[nearer], mask[nearer] = t[nearer], True
    depth = np.where(np.isfinite(depth), depth, 0.0)
    return depth, mask, camera.unproject(depth)


def rock_mesh(centre: np.ndarray = CENTRE, axes: np.ndarray = AXES) -> trimesh.Trimesh:
    """The ellipsoid as a mesh, world coordinates."""
    mesh = trimesh.creation.icosphere(subdivisions=5)
    mesh.vertices = mesh.vertices * axes + centre
    return mesh


def write_dataset(
    root: Path,
    cameras: list[Camera] | None = None,
    rocks: list[tuple[np.ndarray, np.ndarray]] | None = None,
    *,
    depth: bool = True,
) -> Dataset:
    """Write and load a dataset of the ellipsoids; rock.glb is the first of them."""
    rocks = [(CENTRE, AXES)] if rocks is None else rocks
    frames = []
    for i, camera in enumerate(cameras or orbit_cameras()):
        z, mask, points = cast(camera, rocks)
        name = f"kf_{i:04d}"
        image, mask_path = root / f"images/{name}.png", root / f"masks/{name}.png"
        frame = Frame(name, camera, 0.5 * i, image, mask_path=mask_path)
        write_png(image, np.where(z[..., None] > 0, albedo(points), 0.0))
        write_png(mask_path, mask)
        if depth:
            frame = replace(frame, depth_path=root / f"depth/{name}.exr")
            write_exr(frame.depth_path, {"Z": z})
        frames.append(frame)
    if rocks:
        (root / "rock.glb").write_bytes(to_glb(rock_mesh(*rocks[0])))
    write_transforms(root, frames)
    return load_dataset(root)


def orbit(root: Path, count: int = 12, width: int = 48, height: int = 36) -> Dataset:
    """`write_dataset` with so many cameras on a circle."""
    return write_dataset(root, orbit_cameras(count, width, height))


def write_rock(root: Path, cameras: list[Camera], gaussians: int) -> Dataset:
    """As write_dataset, with the prior of its mesh in its folder `prior`."""
    dataset = write_dataset(root, cameras)
    prior = prior_from_mesh(root / "rock.glb", PriorSettings(gaussians=gaussians))
    save_prior(root / "prior", prior)
    return dataset


def edit(
    root: Path, change: Callable[[dict[str, Any]], object], name: str = "transforms.json"
) -> None:
    """Change a dataset's transforms.json, or another JSON file."""
    data = read_json(root / name)
    change(data)
    (root / name).write_text(json.dumps(data))  # NaN, which write_json refuses, too


def write_colmap(dataset: Dataset, root: Path, binary: bool, count: int = 500) -> None:
    """Export to COLMAP: one camera, and points on the rock and the ground, tracked where seen."""
    import pycolmap

    model = pycolmap.Reconstruction()
    first = dataset.frames[0].camera
    K = first.K
    size = {"width": first.width, "height": first.height}
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    lens = pycolmap.Camera(model="PINHOLE", **size, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(lens)
    rng = np.random.default_rng(0)
    sphere = rng.standard_normal((count, 3))
    rock = CENTRE + AXES * sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    ground = np.pad(rng.uniform(-2, 2, (3 * count // 2, 2)), ((0, 0), (0, 1)))
    outside = (((ground - CENTRE) / AXES) ** 2).sum(1) > 1
    points = np.concatenate([rock[rock[:, 2] > 0], ground[outside]])
    for k, frame in enumerate(dataset.frames, 1):
        pose = pycolmap.Rigid3d(frame.camera.world_to_camera[:3])
        pixels = frame.camera.project(points)[0]
        named = {"name": frame.image_path.name, "camera_id": 1, "image_id": k}
        image = pycolmap.Image(keypoints=pixels, **named)
        model.add_image_with_trivial_frame(image, pose)
    normals = np.where(points[:, 2:] > 0, (points - CENTRE) / AXES**2, [0, 0, 1])
    eyes = [frame.camera.position for frame in dataset.frames]
    facing = np.stack([((eye - points) * normals).sum(1) > 0 for eye in eyes])
    for i, point in enumerate(points):
        track = pycolmap.Track()
        for k in np.flatnonzero(facing[:, i]):
            track.add_element(int(k) + 1, i)
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    (root / "sparse/0").mkdir(parents=True)
    (model.write_binary if binary else model.write_text)(root / "sparse/0")
    (root / "images").symlink_to(dataset.root / "images")


def make_dataset(root, out, scene, seed, size, changes=None, mesh=None):
    """In place of the task of studies that renders a dataset: another ellipsoid for each seed."""
    folder, images = out / "dataset", (size["width"], size["height"])
    if not folder.exists():
        rocks = [(CENTRE, AXES * (1 + 0.1 * (seed % 5)))]
        write_dataset(folder, orbit_cameras(size["frames"], *images), rocks)
        tests = orbit_cameras(size["tests"], *images, altitude=2.0)
        write_dataset(folder / "test", tests, rocks)
    return {"frames": size["frames"]}
