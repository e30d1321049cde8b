"""Two captures with outliers, noise, parts without points, and a tilted world of unknown scale: a
toy on a table, and the front of a building, seen from one side and without ground."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh

from mgs.camera import Camera, look_at
from mgs.data.dataset import Dataset, Frame, write_transforms
from mgs.data.importers import import_source
from mgs.data.masks import make_masks
from mgs.data.meshes import Mesh, distances_to_mesh, read_mesh, to_glb
from mgs.data.raycast import mesh_depth
from mgs.data.sources import read_source
from mgs.data.up import degrees_between, unit_up
from mgs.files import read_json
from mgs.images import write_exr, write_png
from mgs.prior import hull
from mgs.prior.build import Prior, build_prior
from mgs.prior.settings import PriorSettings

WIDTH, HEIGHT = 128, 96


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Hulls on a grid of half the usual fineness."""
    monkeypatch.setattr(hull, "COARSE", 24)


def toy() -> trimesh.Trimesh:
    """A plush animal 0.45 m high: body, head, ears, legs and arms that are balls, pulled long."""
    parts = [((0, 0, 0.15), (0.14, 0.12, 0.16)), ((0.03, 0, 0.34), (0.1, 0.1, 0.09))]
    parts += [((0.02, side * 0.07, 0.42), (0.02, 0.03, 0.05)) for side in (-1, 1)]
    parts += [((0.12, side * 0.08, 0.05), (0.1, 0.04, 0.05)) for side in (-1, 1)]
    parts += [((0.04, side * 0.13, 0.2), (0.05, 0.05, 0.09)) for side in (-1, 1)]
    balls = []
    for centre, axes in parts:
        ball = trimesh.creation.icosphere(subdivisions=4)
        ball.vertices = ball.vertices * axes + centre
        balls.append(ball)
    return trimesh.util.concatenate(balls)


def table() -> trimesh.Trimesh:
    """A round table top, and the floor of the room under it."""
    top = trimesh.creation.cylinder(0.6, 0.04, sections=64)
    top.vertices += [0, 0, -0.02]
    floor = trimesh.creation.box((6, 6, 0.02))
    floor.vertices += [0, 0, -0.75]
    return trimesh.util.concatenate([top, floor])


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


def orbit(count: int, target: tuple[float, float, float], radius: float) -> list[Camera]:
    """Cameras all around, at two heights in turn."""
    eyes = []
    for k in range(count):
        angle, elevation = 2 * np.pi * k / count, np.radians((25, 45)[k % 2])
        level = radius * np.cos(elevation)
        away = np.array([level * np.cos(angle), level * np.sin(angle), radius * np.sin(elevation)])
        eyes.append(np.array(target) + away)
    return _cameras(eyes, target)


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


def write(
    root: Path,
    thing: trimesh.Trimesh,
    around: trimesh.Trimesh | None,
    cameras: list[Camera],
    grain: float,
) -> None:
    """A dataset of exact images, depth and masks of `thing` among `around`. grain: length of the
    pattern, metres."""
    own = _depth(thing)
    whole = own if around is None else _depth(trimesh.util.concatenate([thing, around]))
    frames = []
    for k, camera in enumerate(cameras):
        depth, name = whole(camera), f"{k:03d}"
        image, mask_path = (root / f"{kind}/{name}.png" for kind in ("images", "masks"))
        frame = Frame(name, camera, float(k), image, root / f"depth/{name}.exr", mask_path)
        colour = albedo(camera.unproject(depth) / grain)
        write_png(image, np.where(depth[..., None] > 0, colour, 0.05))
        write_exr(frame.depth_path, {"Z": depth.astype(np.float32)})
        write_png(mask_path, (depth > 0) & np.isclose(own(camera), depth, rtol=1e-4))
        frames.append(frame)
    (root / "rock.glb").write_bytes(to_glb(thing))
    write_transforms(root, frames)


def _depth(mesh: trimesh.Trimesh) -> Callable[[Camera], np.ndarray]:
    faces = np.asarray(mesh.faces)
    return mesh_depth(Mesh(np.asarray(mesh.vertices, float), faces, np.ones(len(faces), bool)))


@pytest.fixture(scope="module")
def capture(
    photographs: ModuleType, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """A capture by its name, as photographs and a COLMAP model in text; made once."""
    folder = tmp_path_factory.mktemp("captures")

    def made(name: str) -> Path:
        if not (folder / name).is_dir():
            exact = folder / f"{name}-exact"
            if name == "toy":
                write(exact, toy(), table(), orbit(28, (0, 0, 0.2), 1.1), 0.3)
            else:
                write(exact, building(), None, arc(11, (0, 0, 2), 6.5), 1.5)
            photographs.make(exact, folder / name, "colmap-text")
        return folder / name

    return made


def prior_of(source: Path, out: Path, masks: bool) -> tuple[Dataset, Prior, np.ndarray]:
    """The dataset of a capture, its prior, and how far the prior's points are from the true
    surface, metres."""
    found, truth = read_source(source), read_json(source / "truth.json")
    up = found.up_or_estimate()[0]
    assert degrees_between(up, unit_up(truth["up"])) < 2
    dataset = import_source(found, out, masks=source / "masks" if masks else None, up=up)
    prior = build_prior(dataset, PriorSettings(gaussians=1500, backing=0))
    assert trimesh.Trimesh(prior.mesh.vertices, prior.mesh.faces).is_watertight
    true = read_mesh(source / "truth.ply")
    distance = distances_to_mesh(prior.points, true.vertices, true.faces)
    return dataset, prior, distance / truth["scale"]


@pytest.mark.parametrize("masks", [True, False])
def test_a_toy_on_a_table(capture, tmp_path, masks):
    _, prior, distance = prior_of(capture("toy"), tmp_path / "d", masks)
    assert ("plane_normal" in prior.numbers) != masks
    if not masks:
        assert degrees_between(unit_up(prior.numbers["plane_normal"]), prior.up) < 3
    assert distance.mean() < (0.004 if masks else 0.006)  # a pixel is 7 mm
    assert np.quantile(distance, 0.9) < (0.008 if masks else 0.015)
    size = np.ptp(prior.points, axis=0) / read_json(capture("toy") / "truth.json")["scale"]
    assert (size > 0.3).all()
    assert (size < 0.6).all()


def test_the_front_of_a_building(capture, tmp_path):
    """Its wall is a plane that all cameras are in front of, and is not taken for the ground."""
    dataset, prior, distance = prior_of(capture("building"), tmp_path / "d", False)
    assert "plane_normal" not in prior.numbers
    assert distance.mean() < 0.06  # a pixel is 42 mm
    assert np.quantile(distance, 0.9) < 0.15
    scale = read_json(capture("building") / "truth.json")["scale"]
    assert prior.numbers["sampled_area"] / scale**2 > 12  # of 24 square metres
    masked = make_masks(dataset, prior.mesh, 0.1)
    assert all(0.2 < frame.mask().mean() < 0.95 for frame in masked.frames)
