"""A capture with outliers, noise, parts without points, and a tilted world of unknown scale: the
front of a building, seen from one side and without ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from mgs.camera import Camera, look_at
from mgs.data.dataset import write_transforms
from mgs.data.frames import Frame
from mgs.data.importers import import_source
from mgs.data.masks import make_masks
from mgs.data.meshes import Mesh, distances_to_mesh, read_mesh, to_glb
from mgs.data.raycast import mesh_depth
from mgs.data.sources import read_source
from mgs.data.up import degrees_between, unit_up
from mgs.files import read_json
from mgs.images import write_exr, write_png
from mgs.prior import hull
from mgs.prior.build import build_prior
from mgs.prior.settings import PriorSettings

WIDTH, HEIGHT = 128, 96


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Hulls on a grid of half the usual fineness."""
    monkeypatch.setattr(hull, "COARSE", 24)


def building() -> trimesh.Trimesh:
    """A front 6 m wide and 4 m high that faces -y: wall, windows, two columns, porch, cornice."""
    boxes = [((6, 0.6, 4), (0, 0.3, 2)), ((6.4, 0.9, 0.3), (0, 0.15, 4.1))]
    boxes += [((1.6, 0.7, 0.3), (0, -0.3, 2.3))]
    boxes += [((0.8, 0.2, 1.2), (x, -0.1, z)) for x in (-2.1, 2.1) for z in (1.1, 3)]
    parts = [
        trimesh.creation.box(size, trimesh.transformations.translation_matrix(place))
        for size, place in boxes
    ]
    for x in (-0.65, 0.65):
        column = trimesh.creation.cylinder(0.14, 2.2, sections=32)
        column.vertices += [x, -0.5, 1.1]
        parts.append(column)
    return trimesh.util.concatenate(parts)


def albedo(x: np.ndarray) -> np.ndarray:
    """Colour of points [...,3]: a pattern that fades, so that whole parts have no features."""
    strength = 0.45 * np.clip(0.8 + np.sin(1.7 * x[..., :1] + 2.3 * x[..., 2:]), 0, 1)
    pattern = np.sign(np.sin(19 * x) * np.sin(23 * x[..., [1, 2, 0]] + 1))
    return 0.5 + strength * pattern


def arc(count: int, target: tuple[float, float, float], distance: float) -> list[Camera]:
    """Cameras at the height of a head, on an arc of 80 degrees in front (-y) of the target."""
    angles = np.radians(np.linspace(-40, 40, count))
    eyes = [
        np.array([target[0] + distance * np.sin(a), target[1] - distance * np.cos(a), 1.7])
        for a in angles
    ]
    return _cameras(eyes, target)


def _cameras(eyes: list[np.ndarray], target: tuple[float, float, float]) -> list[Camera]:
    K = np.array([[1.2 * WIDTH, 0, WIDTH / 2], [0, 1.2 * WIDTH, HEIGHT / 2], [0, 0, 1]])
    return [Camera(K, WIDTH, HEIGHT, look_at(eye, target)) for eye in eyes]


def write(root: Path, thing: trimesh.Trimesh, cameras: list[Camera], grain: float) -> None:
    """A dataset of exact images, depth and masks. grain: length of the pattern, metres."""
    faces = np.asarray(thing.faces)
    drawn = mesh_depth(Mesh(np.asarray(thing.vertices, float), faces, np.ones(len(faces), bool)))
    frames = []
    for k, camera in enumerate(cameras):
        depth, name = drawn(camera), f"{k:03d}"
        image, mask_path = (root / f"{kind}/{name}.png" for kind in ("images", "masks"))
        frame = Frame(name, camera, float(k), image, root / f"depth/{name}.exr", mask_path)
        colour = albedo(camera.unproject(depth) / grain)
        write_png(image, np.where(depth[..., None] > 0, colour, 0.05))
        write_exr(frame.depth_path, {"Z": depth.astype(np.float32)})
        write_png(mask_path, depth > 0)
        frames.append(frame)
    (root / "rock.glb").write_bytes(to_glb(thing))
    write_transforms(root, frames)


def test_the_front_of_a_building(photographs, tmp_path):
    """Its wall is a plane that all cameras are in front of, and is not taken for the ground."""
    write(tmp_path / "exact", building(), arc(11, (0, 0, 2), 6.5), 1.5)
    source = tmp_path / "building"
    photographs.make(tmp_path / "exact", source, "colmap-text")
    found, truth = read_source(source), read_json(source / "truth.json")
    up = found.up_or_estimate()[0]
    assert degrees_between(up, unit_up(truth["up"])) < 2
    dataset = import_source(found, tmp_path / "d", up=up)
    prior = build_prior(dataset, PriorSettings(gaussians=1500, backing=0))
    assert trimesh.Trimesh(prior.mesh.vertices, prior.mesh.faces).is_watertight
    assert "plane_normal" not in prior.numbers
    true, scale = read_mesh(source / "truth.ply"), truth["scale"]
    distance = distances_to_mesh(prior.points, true.vertices, true.faces) / scale
    assert distance.mean() < 0.06  # a pixel is 42 mm
    assert np.quantile(distance, 0.9) < 0.15
    assert prior.numbers["sampled_area"] / scale**2 > 12  # of 24 square metres
    masked = make_masks(dataset, prior.mesh)
    assert all(0.2 < frame.mask().mean() < 0.95 for frame in masked.frames)
