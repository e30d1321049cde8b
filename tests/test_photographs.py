"""Photographs without depth: hull, points, both; up, units, masks of the prior; bad input."""

import json
import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import synthetic
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image
from program import command, exit_code, output, said
from refusals import fails, refused
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from test_bad_input import bare

from mgs import Camera, Frame, PriorSettings, initial_gaussians, look_at
from mgs.data.check import check_dataset
from mgs.data.clouds import SparseCloud, read_cloud, views_of, write_cloud
from mgs.data.dataset import Dataset, load_dataset, write_transforms
from mgs.data.importers import import_source
from mgs.data.masks import make_masks
from mgs.data.meshes import Mesh, distances_to_mesh
from mgs.data.shots import Shot, Source
from mgs.data.sources import read_source
from mgs.data.world import World, degrees_between, levelled, unit_up, up_of_cameras
from mgs.errors import InputError, Notice
from mgs.files import read_json, write_json
from mgs.fit import density
from mgs.images import write_exr, write_png
from mgs.prior import hull
from mgs.prior.build import build_prior, load_prior, prior_and_cloud
from mgs.prior.figure import UP, _oblique
from mgs.prior.hull import visual_hull
from mgs.prior.points import _grown, main_cluster, on_surface, reliable, scattered
from mgs.prior.segmentation import Plane
from mgs.prior.surface import shell
from mgs.run.nbv import start_of_fit
from mgs.splat_files import load_gaussians
from mgs.synth.orbit import perturb


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hulls on a coarse grid."""
    monkeypatch.setattr(hull, "COARSE", 16)


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("exact") / "data"
    return synthetic.orbit(root, 24, 96, 72)


SCALE, SHIFT = 0.37, np.array([2.0, -1.0, 0.5])
TURN = Rotation.from_rotvec([1.9, -0.7, 0.4]).as_matrix()
"""Similarity from the orbit to the world of its COLMAP model: SCALE * TURN @ x + SHIFT."""


@pytest.fixture(scope="module")
def colmap(exact: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The orbit and a COLMAP model of it, with errors of poses and points, in another world."""
    import pycolmap

    folder, rng = tmp_path_factory.mktemp("colmap") / "data", np.random.default_rng(0)
    cameras = perturb([frame.camera for frame in exact.frames], 0.0015, 0.03, rng)
    frames = [replace(f, camera=c) for f, c in zip(exact.frames, cameras, strict=True)]
    synthetic.write_colmap(replace(exact, frames=tuple(frames)), folder, True, 2000)
    model = pycolmap.Reconstruction(folder / "sparse/0")
    spoil_points(model, rng)
    model.transform(pycolmap.Sim3d(SCALE, pycolmap.Rotation3d(TURN), SHIFT))
    model.write_binary(folder / "sparse/0")
    return folder


def spoil_points(model, rng: np.random.Generator) -> None:
    """Keep three in five of the points with noise of 0.7 pixels; one in ten is a wrong match.

    A wrong match lies elsewhere on a ray, and has a short track and a large error.
    """
    eyes = {number: image.projection_center() for number, image in model.images.items()}
    for number, point in list(model.points3D.items()):
        views = [(view.image_id, view.point2D_idx) for view in point.track.elements]
        rays = np.stack([point.xyz - eyes[image] for image, _ in views])
        away = np.linalg.norm(rays, axis=1)
        owner = rng.integers(len(views))
        near = rays @ rays[owner] > np.cos(np.radians(45)) * away * away[owner]
        matched = near & (rng.random(len(views)) < 0.7)
        if matched.sum() < 2 or rng.random() > 0.6:
            model.delete_point3D(number)
            continue
        wrong = rng.random() < 0.1
        if wrong:
            matched[np.flatnonzero(matched)[rng.integers(2, 4) :]] = False
        stretch = rng.uniform(0.6, 1.6) if wrong else 1
        noise = 0.7 * away[owner] / model.cameras[1].params[0] * rng.standard_normal(3)
        point.xyz = eyes[views[owner][0]] + stretch * rays[owner] + noise
        point.error = rng.uniform(1, 3.9) if wrong else rng.uniform(0.3, 0.8)
        for k in np.flatnonzero(~matched):
            model.delete_observation(*views[k])


def lattice(count: int, radius: float = 3.0) -> list[Camera]:
    """Cameras on a whole sphere around the rock, which floats: nothing is hidden."""
    eyes = synthetic.CENTRE + radius * synthetic.sphere(count)
    return [synthetic.pinhole(90.0, 96, 72, eye, synthetic.CENTRE) for eye in eyes]


def floating(root: Path, cameras: list[Camera]) -> Dataset:
    dataset = synthetic.write_dataset(root, cameras, depth=False)
    for frame in dataset.frames:
        size = frame.camera.height, frame.camera.width
        directions = frame.camera.unproject(np.ones(size)) - frame.camera.position
        o = (frame.camera.position - synthetic.CENTRE) / synthetic.AXES
        d = directions / synthetic.AXES
        write_png(frame.mask_path, (d @ o) ** 2 > (d * d).sum(-1) * (o @ o - 1))
    return dataset


# The visual hull


def test_the_hull_of_a_convex_body_seen_from_all_sides_is_that_body(tmp_path, monkeypatch):
    monkeypatch.setattr(hull, "COARSE", 24)
    dataset = floating(tmp_path / "d", lattice(30))
    found = visual_hull(dataset.frames)
    body = trimesh.Trimesh(found.mesh.vertices, found.mesh.faces, process=False)
    volume = 4 / 3 * np.pi * synthetic.AXES.prod()
    assert body.is_watertight
    assert 0.95 < body.volume / volume < 1.05  # outlines of whole pixels lie slightly inside
    assert np.abs(synthetic.level(found.mesh.vertices)).max() < 0.2
    assert found.numbers["hull_fills_least"] > 0.97
    for frame in dataset.frames:
        column, row = np.floor(frame.camera.project(found.mesh.vertices)[0]).astype(int).T
        assert binary_dilation(frame.mask(), iterations=1)[row, column].all()
    monkeypatch.setattr(hull, "MOST_PIXELS", 96 * 72 // 4)
    blocks = visual_hull(dataset.frames).mesh.vertices
    away = distances_to_mesh(blocks, found.mesh.vertices, found.mesh.faces)
    assert 0 < away.max() < 1.5 * 3.0 / 90  # pixels
    monkeypatch.undo()
    monkeypatch.setattr(hull, "COARSE", 24)
    monkeypatch.setattr(hull, "IMAGE_BYTES", 30 * 96 * 72)  # of all 30 masks together, 4 a pixel
    assert np.array_equal(visual_hull(dataset.frames).mesh.vertices, blocks)


def test_sizes_in_masks_of_uneven_pixels_are_metres(tmp_path):
    """The object's radius about its centre, the edge of the grid, and a random start's ball."""
    sizes = []
    for across in (True, False):
        data = floating(tmp_path / f"{across}", synthetic.halved(lattice(8), across))
        radii = [hull._view(f, hull.MOST_PIXELS)(synthetic.CENTRE[None])[0] for f in data.frames]
        start = scattered(data, PriorSettings(gaussians=500))[0]
        sizes.append([*radii, hull._bounds(data.frames)[1], np.ptp(start.vertices)])
    pixel = 2 * 3.0 / 90
    assert sizes[0] == pytest.approx(sizes[1], abs=pixel)
    assert sizes[0][:8] == pytest.approx(np.full(8, 0.5), abs=0.1)


def test_the_hull_keeps_each_piece_inside_the_masks(tmp_path, monkeypatch):
    """A cap above a stone: neither is dropped."""
    monkeypatch.setattr(hull, "COARSE", 32)
    low, high = np.array([0, 0, 0.2]), np.array([0.1, 0, 0.9])
    rocks = [(low, np.array([0.4, 0.3, 0.15])), (high, np.array([0.3, 0.3, 0.1]))]
    dataset = synthetic.write_dataset(tmp_path, synthetic.orbit_cameras(16, 128, 96), rocks)
    found = visual_hull(dataset.frames)
    assert found.numbers["hull_fills_least"] > 0.9
    pieces = trimesh.Trimesh(found.mesh.vertices, found.mesh.faces).split()
    assert sorted(round(piece.centroid[2], 1) for piece in pieces) == [0.2, 0.9]


def test_the_hull_keeps_thin_parts_that_are_most_of_the_object(tmp_path, monkeypatch):
    """Three rods through a small stone, as a tripod: smoothing alone takes them away."""
    monkeypatch.setattr(hull, "COARSE", 24)
    middle, thin = np.array([0, 0, 0.5]), 0.035
    axes = np.full((3, 3), thin) + (0.5 - thin) * np.eye(3)
    rods = [(middle, axis) for axis in [*axes, np.full(3, 0.06)]]
    dataset = synthetic.write_dataset(tmp_path, synthetic.orbit_cameras(16, 128, 96), rods)
    found = visual_hull(dataset.frames)
    assert found.numbers["hull_fills_masks"] > 0.8
    assert np.ptp(found.mesh.vertices, axis=0) == pytest.approx(1, abs=0.1)


def test_slightly_wrong_poses_cut_no_thin_part_away(tmp_path, monkeypatch):
    """A stone with a torch: each pose, a pixel or two wrong, cuts a bit of the torch away."""
    monkeypatch.setattr(hull, "COARSE", 24)
    stone, torch = np.array([0, 0, 0.35]), np.array([0.1, 0, 0.8])
    parts = [(stone, np.array([0.4, 0.3, 0.3])), (torch, np.array([0.06, 0.06, 0.3]))]
    exact = synthetic.write_dataset(tmp_path, synthetic.orbit_cameras(40, 128, 96), parts)
    cameras = perturb([f.camera for f in exact.frames], 0.01, 0.15, np.random.default_rng(0))
    frames = [replace(f, camera=c) for f, c in zip(exact.frames, cameras, strict=True)]
    views, overlaps = [hull._view(frame, hull.MOST_PIXELS) for frame in exact.frames], []
    for fitting in (0.0, hull.FITTING):
        monkeypatch.setattr(hull, "FITTING", fitting)
        found = visual_hull(frames)
        overlaps.append(np.median(hull._fit(views, found.mesh)[1]))
    assert found.mesh.vertices[:, 2].max() > 1.05
    assert overlaps[0] < 0.9
    assert overlaps[1] > 0.94


def test_masks_that_do_not_fit_are_one_line_that_names_a_frame(tmp_path):
    dataset = floating(tmp_path / "d", lattice(12))
    others = visual_hull([*dataset.frames[:7], *dataset.frames[8:]])
    for where in (slice(5), slice(36, 40)):
        wrong = np.zeros((72, 96), bool)
        wrong[where, where] = True
        write_png(dataset.frames[7].mask_path, wrong)
        with pytest.warns(Notice, match="mask of kf_0007 .* --exclude kf_0007"):
            left = visual_hull(dataset.frames)
        assert np.array_equal(left.mesh.vertices, others.mesh.vertices)
    # With scattered pixels the grid reaches beyond all images, where no mask is against a point.
    for k, frame in enumerate(dataset.frames):
        write_png(frame.mask_path, np.random.default_rng(k).random((72, 96)) < 0.01)
    cure = "leave it out with `mgs import --exclude kf_00"
    fails(f"share no point in space.* {cure}", visual_hull, dataset.frames)


# Points


@pytest.mark.parametrize("masks", [True, False])
def test_real_clouds_give_the_rock(exact, colmap, tmp_path, masks):
    source = read_source(colmap)
    up, _ = source.up_or_estimate()
    folder = exact.root / "masks" if masks else None
    dataset = import_source(source, tmp_path / "d", masks=folder, up=up)
    settings = PriorSettings(gaussians=600, backing=0)
    prior, cloud = prior_and_cloud(dataset, settings)
    rock = synthetic.rock_mesh()
    points = (prior.world.leave(prior.points) - SHIFT) @ TURN / SCALE
    distance = distances_to_mesh(points, rock.vertices, rock.faces)
    assert prior.numbers["from"] == "points"
    assert ("hull_cell" in prior.numbers) == masks
    assert trimesh.Trimesh(prior.mesh.vertices, prior.mesh.faces).is_watertight
    assert distance.mean() < (0.015 if masks else 0.025)
    assert np.quantile(distance, 0.9) < (0.035 if masks else 0.06)
    assert len(cloud.rock_points) > 150
    assert degrees_between(prior.world.up, unit_up(TURN[:, 2])) < 3
    assert np.array_equal(prior.points, build_prior(dataset, settings).points)

    sparse = read_cloud(dataset.root / "sparse.ply")
    assert sparse.track.min() >= 2
    kept = reliable(sparse)
    assert 0.4 < kept.mean() < 0.95
    assert sparse.error[kept].max() < 1.2
    assert sparse.track[kept].min() >= 3


def test_a_front_seen_from_one_side_is_closed_behind_and_is_no_ground(tmp_path):
    """A wall of 6 x 4 m with two pillars; every camera is in front of its plane."""
    rng, cameras = np.random.default_rng(0), []
    wall = np.column_stack([rng.uniform(-3, 3, 1500), np.zeros(1500), rng.uniform(0, 4, 1500)])
    wall[:, 1] -= 0.3 * (np.abs(np.abs(wall[:, 0]) - 1) < 0.2)
    for angle in np.radians(np.linspace(-40, 40, 11)):
        eye = [6.5 * np.sin(angle), -6.5 * np.cos(angle), 1.7]
        cameras.append(synthetic.pinhole(150.0, 128, 96, eye, [0, 0, 2]))
    frames = [Frame(f"{k}", camera, k, tmp_path) for k, camera in enumerate(cameras)]
    write_cloud(tmp_path / "sparse.ply", SparseCloud(wall + rng.normal(0, 0.005, wall.shape)))
    dataset = Dataset(tmp_path, tuple(frames))
    settings = PriorSettings(gaussians=1000, backing=0, poisson_depth=6)
    prior = build_prior(dataset, settings, source="points")
    assert trimesh.Trimesh(prior.mesh.vertices, prior.mesh.faces).is_watertight
    assert "plane_normal" not in prior.numbers
    away = np.minimum(np.abs(prior.points[:, 1]), np.abs(prior.points[:, 1] + 0.3))
    assert np.quantile(away, 0.9) < 0.2
    assert prior.numbers["sampled_area"] > 12
    assert _oblique(UP, prior.normals.mean(0))[2] @ [0, -1, 0] > 0.8


def test_points_that_poisson_does_not_close_get_a_shell(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise InputError("prior: no closed surface")

    monkeypatch.setattr("mgs.prior.photographs.closed_poisson", refuse)
    ball = np.random.default_rng(0).normal(size=(1500, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    eyes = [(5 * np.cos(a), 5 * np.sin(a), z) for a, z in product(range(6), (-2.0, 2.0))]
    cameras = [synthetic.pinhole(150.0, 128, 96, eye, [0, 0, 0]) for eye in eyes]
    write_cloud(tmp_path / "sparse.ply", SparseCloud(ball))
    dataset = Dataset(tmp_path, tuple(Frame(f"{k}", c, k, tmp_path) for k, c in enumerate(cameras)))
    with pytest.warns(Notice, match="the prior is what is near them"):
        prior = build_prior(dataset, PriorSettings(gaussians=1000, backing=0), source="points")
    assert "poisson_depth" not in prior.numbers
    spacing = prior.numbers["cloud_spacing"]
    for mesh, volume in (
        (prior.mesh, 4 / 3 * np.pi),
        (shell(ball, spacing, Plane(np.array([0.0, 0, 1]), 0.0, 0.01, 0.1)), 2 / 3 * np.pi),
    ):
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
        assert solid.is_watertight
        assert volume < solid.volume < 1.6 * volume  # filled
        above = ball[ball[:, 2] > mesh.vertices[:, 2].min()]
        assert distances_to_mesh(above, mesh.vertices, mesh.faces).max() < 2 * spacing
    assert abs(mesh.vertices[:, 2].min()) < 1e-9


def test_points_of_any_ply_can_be_given(tmp_path, capsys):
    root = synthetic.write_dataset(tmp_path / "d", depth=False).root
    far = np.random.default_rng(0).uniform(5, 6, (300, 3))
    trimesh.PointCloud(far).export(tmp_path / "far.ply")
    given = ["prior", root, "--gaussians", "300", "--poisson-depth", "5", "--points"]
    assert exit_code(*given, tmp_path / "far.ply") == 2
    assert "only 0 of 300 points lie inside the masks" in said(capsys)[1]
    assert (root / "prior-refused.png").is_file()
    assert not (root / "prior").exists()
    near = synthetic.rock_mesh().vertices[::8]
    trimesh.PointCloud(near[near[:, 2] > 0]).export(tmp_path / "near.ply")
    command(*given, tmp_path / "near.ply")
    prior = load_prior(root / "prior")
    assert prior.numbers["from"] == "points"
    assert np.abs(synthetic.level(prior.points)).mean() < 0.03


def test_a_point_alone_or_off_the_surface_is_found():
    rng = np.random.default_rng(0)
    sheet = np.column_stack([rng.uniform(0, 1, (800, 2)), 0.002 * rng.standard_normal(800)])
    strays = np.array([[0.5, 0.5, 0.05], [3.0, 3.0, 0.0]])
    kept = on_surface(np.concatenate([sheet, strays]))
    assert kept[:800].mean() > 0.97
    assert not kept[800:].any()


def test_a_cluster_of_uneven_density_is_one_and_scattered_points_are_not_of_it():
    rng = np.random.default_rng(1)
    dense, thin = rng.uniform(0, 1, (1500, 3)), rng.uniform([0.95, 0, 0], [2, 1, 1], (300, 3))
    other = rng.uniform([6, 0, 0], [6.5, 0.5, 0.5], (600, 3))
    scattered = rng.uniform([-20, -20, 40], [20, 20, 80], (100, 3))
    points = np.concatenate([dense, thin, other, scattered])
    inside, clusters = main_cluster(points, np.ones(len(points)))
    assert clusters >= 2
    assert inside[:1800].mean() > 0.95
    assert not inside[1800:].any()


def test_a_cloud_without_views_is_taken_to_be_seen_by_the_nearest_cameras():
    cameras = lattice(40)
    normals = np.random.default_rng(2).standard_normal((200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    views = views_of(SparseCloud(synthetic.CENTRE + 0.5 * normals), cameras)
    assert np.allclose(np.linalg.norm(views, axis=1), 1)
    assert np.einsum("nk,nk->n", views, normals).min() > 0.5


def test_a_cloud_survives_its_file_and_of_points_in_one_place_one_is_kept(tmp_path):
    rng = np.random.default_rng(3)
    points, views, error = rng.random((9, 3)), rng.random((9, 3)), rng.random(9)
    cloud = SparseCloud(points, views, rng.integers(2, 9, 9).astype(float), error)
    write_cloud(tmp_path / "c.ply", cloud)
    read = read_cloud(tmp_path / "c.ply")
    for name in ("points", "views", "track", "error"):
        assert np.allclose(getattr(read, name), getattr(cloud, name), atol=1e-6)
    # Some programs write a vertex for each corner of each face.
    points = rng.random((50, 3)).astype(np.float32)
    thrice = np.concatenate([points, points[::-1], points])
    write_cloud(tmp_path / "c.ply", SparseCloud(thrice, track=np.arange(150.0)))
    read = read_cloud(tmp_path / "c.ply")
    assert np.array_equal(read.points, points)
    assert np.array_equal(read.track, np.arange(50))


# Up and units


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1))
@example([0.0, 2.0**-24, -1.0])
@example([0.0, 3.1e-6, -1.0])
@example([0.0, 0.0, -1.0])
def test_upright_is_the_rotation_that_turns_up_to_z(vector):
    up = unit_up(vector)
    ahead = [0, 0, 1] if abs(up[1]) > np.sqrt(0.5) else [0, 1, 0]  # the bearing of a flight plan
    turn = levelled(up)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_allclose(turn @ up, [0, 0, 1], atol=1e-9)
    along = turn @ ahead
    assert abs(along[0]) < 1e-9 < along[1]
    assert np.array_equal(levelled((0.0, 0.0, 1.0)), np.eye(3))


def turned(rng: np.random.Generator) -> np.ndarray:
    """A random rotation [3,3], from the upright world to another one."""
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return turn * np.linalg.det(turn)


def held(angle: float, altitude: float, roll: float, turn: np.ndarray) -> Camera:
    """A camera on a circle of 3 m that looks at the origin of a turned world. roll: degrees."""
    pose = look_at([3 * np.cos(angle), 3 * np.sin(angle), altitude], [0, 0, 0])
    pose[:3] = Rotation.from_euler("z", roll, degrees=True).as_matrix() @ pose[:3]
    pose[:3, :3] = pose[:3, :3] @ turn.T
    return Camera(np.diag([50.0, 50.0, 1.0]), 64, 48, pose)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), altitude=st.floats(0.2, 5), arc=st.floats(1.0, 6.28))
def test_up_is_found_in_a_turned_world_of_cameras_held_nearly_level(seed, altitude, arc):
    rng = np.random.default_rng(seed)
    turn = turned(rng)
    cameras = [held(angle, altitude, rng.normal(0, 2), turn) for angle in np.linspace(0, arc, 20)]
    assert degrees_between(up_of_cameras(cameras), unit_up(turn[:, 2])) < 5


@pytest.mark.parametrize("quarter", [1, 3])
@pytest.mark.parametrize("arc", [3.0, 6.28])
def test_up_of_pictures_that_lie_on_their_side(arc, quarter):
    """As a phone's that was held upright, and whose EXIF is lost."""
    rng = np.random.default_rng(0)
    turn = turned(rng)
    places = zip(np.linspace(0, arc, 20), rng.uniform(1, 2.5, 20), strict=True)
    cameras = [held(*place, rng.normal(90 * quarter, 4), turn) for place in places]
    assert degrees_between(up_of_cameras(cameras), unit_up(turn[:, 2])) < 5


@pytest.mark.parametrize("lines", [2, 3])
def test_a_survey_from_above_looks_down(lines):
    """Lines there and back: the axes that point up in the pictures cancel."""
    turn, cameras = turned(np.random.default_rng(0)), []
    for line, at in product(range(lines), range(6)):
        pose, heading = np.eye(4), (-1) ** line
        pose[:3, :3] = np.diag([heading, -heading, -1]) @ turn.T
        pose[:3, 3] = -pose[:3, :3] @ turn @ [line, at, 5 + 0.01 * at]
        cameras.append(Camera(np.diag([50.0, 50.0, 1.0]), 64, 48, pose))
    assert degrees_between(up_of_cameras(cameras), unit_up(turn[:, 2])) < 2


@pytest.mark.parametrize("tag", [3, 6, 8])
def test_up_is_that_of_the_picture_as_it_was_held(tag, tmp_path):
    """Cameras of stored pictures that EXIF turns, as COLMAP has them."""
    shots = []
    for k, angle in enumerate(np.linspace(0, 5, 8)):
        camera = held(angle, 1, {3: 180, 6: -90, 8: 90}[tag], np.eye(3))
        exif = Image.Exif()
        exif[0x0112] = tag
        path = tmp_path / f"{k}.jpg"
        Image.new("RGB", (64, 48)).save(path, exif=exif)
        shots.append(Shot(f"{k}", camera, None, k, path))
    assert degrees_between(Source("COLMAP", shots).up_or_estimate()[0], (0, 0, 1)) < 1


def test_the_unit_scales_cameras_and_points_to_metres(colmap, coarse_priors, tmp_path, capsys):
    command("import", colmap, "--out", tmp_path / "metres", "--unit", str(1 / SCALE))
    command("import", colmap, "--out", tmp_path / "raw", "--up", "0,0,2")
    assert "up (0, 0, 1), as --up says; lengths in units" in said(capsys)[0]
    raw, metres = load_dataset(tmp_path / "raw"), load_dataset(tmp_path / "metres")
    assert (raw.unit, metres.unit) == ("unit", "m")
    for one, other in zip(raw.frames, metres.frames, strict=True):
        own = metres.world.leave(other.camera)
        assert np.allclose(one.camera.position / SCALE, own.position)
    points = [read_cloud(tmp_path / name / "sparse.ply").points for name in ("raw", "metres")]
    assert np.allclose(points[0] / SCALE, points[1], atol=1e-5)


def test_lengths_of_unknown_unit_are_not_called_metres(tmp_path, capsys):
    dataset = synthetic.write_dataset(tmp_path, depth=False)
    write_transforms(tmp_path, dataset.frames, World(unit="unit"))
    command("prior", tmp_path, "--gaussians", "300", "--up", "0,1,0")
    out = said(capsys)[0]
    assert "prior from hull: the dataset has masks" in out
    assert "unit²" in out
    assert "m²" not in out
    assert load_prior(tmp_path / "prior").world.up == (0.0, 1.0, 0.0)


# Photographs of a phone


@pytest.mark.parametrize("given", [True, False])
def test_a_smaller_image_is_the_mean_of_its_blocks_and_rays_stay(
    exact, tmp_path, monkeypatch, given
):
    """Also by default, where images have more pixels than a fit resolves."""
    arguments = ["import", exact.root, "--out", tmp_path / "d"]
    assert exit_code(*arguments, "--downscale", "100") == 2
    monkeypatch.setattr("mgs.data.importers.MOST_PIXELS", 96 * 72 // 16 - 1)
    command(*arguments, *(["--downscale", "5"] if given else []))
    whole, small = exact.frames[0], load_dataset(tmp_path / "d").frames[0]
    assert (small.camera.width, small.camera.height) == (19, 14)
    pixels, reduced = (np.asarray(Image.open(f.image_path), float) for f in (whole, small))
    assert np.abs(reduced[4, 6] - pixels[20:25, 30:35].mean((0, 1))).max() <= 0.5
    assert small.depth()[4, 6] == whole.depth()[22, 32]
    assert small.mask().shape == (14, 19)
    # The centre of a block is the middle of its pixels.
    near, far = whole.camera.unproject(np.ones((72, 96))), small.camera.unproject(np.ones((14, 19)))
    assert np.allclose(near[22, 32], far[4, 6])


def test_a_phone_held_upright(exact, tmp_path):
    """The files lie on their sides and say so; cameras are those of the upright photographs."""
    turned = tmp_path / "src"
    records = read_json(exact.root / "transforms.json")
    (turned / "images").mkdir(parents=True)
    turns = Image.Transpose
    back = (turns.TRANSPOSE, turns.ROTATE_90, turns.TRANSVERSE, turns.ROTATE_270)
    for k, (frame, record) in enumerate(zip(exact.frames, records["frames"], strict=True)):
        del record["depth_file_path"], record["mask_path"]
        exif = Image.Exif()
        exif[0x0112] = 5 + k % 4
        with Image.open(frame.image_path) as image:
            image.transpose(back[k % 4]).save(turned / f"images/{frame.name}.png", exif=exif)
    write_json(turned / "transforms.json", records)
    copy = import_source(read_source(turned), tmp_path / "copy")
    for one, other in zip(exact.frames, copy.frames, strict=True):
        assert np.array_equal(one.rgb(), other.rgb())


# Masks of the prior


def test_masks_are_made_of_the_prior(exact, colmap, tmp_path, coarse_priors):
    command("import", colmap, "--out", tmp_path / "d")
    command("prior", tmp_path / "d", "--gaussians", "300")
    command("dataset", "masks", tmp_path / "d")
    made = load_dataset(tmp_path / "d")
    pairs = [(a.mask(), b.mask()) for a, b in zip(made.frames, exact.frames, strict=True)]
    assert np.mean([(a & b).sum() / (a | b).sum() for a, b in pairs]) > 0.85
    with Image.open(tmp_path / "d/masks.png") as sheet:
        assert sheet.size == (6 * 240, 4 * 180)
    assert exit_code("dataset", "masks", tmp_path / "d") == 2


def test_a_world_in_which_nothing_would_be_drawn_is_one_line(tmp_path, capsys):
    """A prior has no unit, but the kernels draw nothing that is nearer than 0.01."""
    synthetic.write_dataset(tmp_path / "src", depth=False)
    command("import", tmp_path / "src", "--out", tmp_path / "d", "--unit", "0.002")
    command("prior", tmp_path / "d", "--gaussians", "300")
    message = "from it, and nothing nearer than 0.01 is drawn; import the data with `unit`"
    out = tmp_path / "run"
    assert message in refused(capsys, ["nbv", tmp_path / "d", "--out", out, "--budget", 1], out)


def test_poses_alone_are_fitted_from_random_points(tmp_path, capsys):
    bare(tmp_path / "d")
    command("prior", tmp_path / "d", "--gaussians", "300")
    assert "300, in and around a ball" in capsys.readouterr().out
    fitted = ["fit", tmp_path / "d", "--passes", "2", "--out", tmp_path / "run"]
    assert "let means be free" in refused(capsys, [*fitted, "--means", "frozen"], tmp_path / "run")
    command(*fitted)
    command("eval", tmp_path / "run")
    capsys.readouterr()
    command("report", tmp_path / "run", "--out", tmp_path / "report")
    assert re.search(r"^ fit +10 ", capsys.readouterr().out, re.MULTILINE)
    settings = read_json(tmp_path / "run/config.json")["settings"]
    train = settings["train"]
    assert (settings["seeds"], settings["budget"], settings["sh"]) == (10, 0, 0)
    assert (train["means"], train["decay"], train["loss"]) == ("free", 0.02, "l1-dssim")
    indicators = json.loads((tmp_path / "run/steps.jsonl").read_text())["indicators"]
    assert "residual" in indicators
    assert not indicators.keys() & {"prior", "pose", "coverage"}
    frames = load_dataset(tmp_path / "d").frames
    start, seen = initial_gaussians(load_prior(tmp_path / "d/prior"), frames)
    assert seen.mean() > 0.9
    assert np.allclose(start.opacities, 0.1)


def test_random_points_are_fewer_than_those_of_the_cameras(colmap, tmp_path, monkeypatch):
    """Unless these are few. Too many hide the scene."""
    dataset = import_source(read_source(colmap), tmp_path / "d")
    monkeypatch.setattr("mgs.prior.points.PIXELS", 1)
    assert scattered(dataset, PriorSettings())[4]["n"] == 10_000
    monkeypatch.setattr("mgs.prior.points.GAUSSIANS", 100)
    many = scattered(dataset, PriorSettings())[4]
    assert many["n"] == round(1.1 * many["triangulated"])
    asked = scattered(dataset, PriorSettings(gaussians=5000))[4]
    assert (asked["n"], asked["triangulated"]) == (5000, many["triangulated"])


def test_photographs_without_masks_are_fitted_whole_from_their_points(
    colmap, tmp_path, capsys, coarse_priors
):
    """Not from the surface of the object, which cannot explain what is around it."""
    command("import", colmap, "--out", tmp_path / "d")
    command("prior", tmp_path / "d", "--gaussians", "300")
    capsys.readouterr()
    fitted = ["fit", tmp_path / "d", "--passes", "2", "--exposure"]
    command(*fitted, "--gaussians", "400", "--out", tmp_path / "whole")
    printed = capsys.readouterr().out
    assert "start: 364 points of the cameras and 36 random ones" in printed
    assert f"prior: built in the run; not used: {tmp_path / 'd/prior'}" in printed
    prior, cloud = load_prior(tmp_path / "whole/prior"), read_cloud(tmp_path / "d/sparse.ply")
    own = prior.world.leave(prior.points[:364])
    assert cKDTree(cloud.points).query(own)[0].max() < 1e-5
    command(*fitted, "--prior", tmp_path / "d/prior", "--out", tmp_path / "object")
    for name, sh in (("whole", 0), ("object", 1)):
        assert read_json(tmp_path / name / "config.json")["settings"]["sh"] == sh
    bare(tmp_path / "bare")
    arguments = ["fit", tmp_path / "bare", "--exposure", "--out", tmp_path / "run"]
    assert "has no surface on which to compare" in refused(capsys, arguments, tmp_path / "run")


def test_depth_beside_photographs_without_masks_leaves_the_fit_whole(colmap, tmp_path, monkeypatch):
    """The surface of the object in their middle gave 7 dB of a scene with its ground."""
    data = import_source(read_source(colmap), tmp_path / "d")
    assert start_of_fit(data, None, None, {}).source == "random"
    deep = replace(data, frames=tuple(replace(f, depth_path=f.image_path) for f in data.frames))
    assert start_of_fit(deep, None, None, {}) == start_of_fit(data, None, None, {})
    monkeypatch.setattr(Frame, "depth", lambda frame: np.zeros(frame.rgb().shape[:2]))
    (tmp_path / "d/sparse.ply").unlink()
    assert start_of_fit(deep, None, None, {}).source is None


WALL = 3.0
"""Radius of the round room, metres, about the origin."""


def write_room(root, away=0.3):
    """RGB-D images without masks from so far from the middle of a room, outwards, or inwards where
    that is negative."""
    frames = []
    for i, towards in enumerate(synthetic.sphere(14)):
        camera = synthetic.pinhole(30, 48, 36, away * towards, towards)
        rays = camera.unproject(np.ones((36, 48))) - camera.position
        along = rays @ camera.position
        beyond = WALL**2 - camera.position @ camera.position
        square = (rays**2).sum(-1)
        z = (np.sqrt(along**2 + square * beyond) - along) / square
        paths = root / f"images/kf_{i:04d}.png", root / f"depth/kf_{i:04d}.exr"
        write_png(paths[0], synthetic.albedo(camera.unproject(z)))
        write_exr(paths[1], {"Z": z})
        frames.append(Frame(f"kf_{i:04d}", camera, 0.5 * i, paths[0], depth_path=paths[1]))
    write_transforms(root, frames)
    return load_dataset(root)


def test_a_room_with_depth_starts_whole_from_its_walls(tmp_path, capsys):
    """It was refused: what all cameras look at lies behind them, where there is no depth."""
    data = write_room(tmp_path / "room")
    start = start_of_fit(data, None, None, {})
    assert start.source == "random"
    assert start.train["density"] == "split"
    line = refused(capsys, ["prior", data.root], tmp_path / "none")
    assert "a whole scene is fitted without a prior (`mgs fit`)" in line
    _, points, normals, _, numbers = scattered(data, PriorSettings(gaussians=400))
    on_wall = np.abs(np.linalg.norm(points, axis=1) - WALL) < 0.02 * WALL
    assert numbers["triangulated"] == on_wall[:364].sum() == 364  # 1 / 1.1 of all
    assert (normals[:364] * points[:364]).sum(1).max() < 0
    command("fit", data.root, "--passes", 2, "--out", tmp_path / "run")
    assert load_prior(tmp_path / "run/prior").kind == "random"
    lattice = "grid=300", "radius=4.5", "elevations=-60,80"
    asked = [item for setting in lattice for item in ("--set", setting)]
    words = output(capsys, "suggest", tmp_path / "run", *asked, "--out", tmp_path / "next")
    left = read_json(tmp_path / "next/suggestions.json")["ranking"]
    away = [np.linalg.norm(np.array(view["transform_matrix"])[:3, 3]) for view in left]
    assert "beyond what the images show" in words
    assert 0 < max(away) < WALL - 1  # half of the least distance of an image from the wall
    assert any(view["elevation"] < 0 for view in left)
    poses, plan = tmp_path / "poses.csv", tmp_path / "next.waypoints"
    poses.write_text("x,y,z,target_x,target_y,target_z\n-1,0,0,-3,0,0\n1,0,0,3,0,0\n")
    asked = ["--poses", poses, "--views", 2, "--plan", plan, "--origin", "47,8,400"]
    asked += ["--set", "flight.clearance=2"]
    assert "crosses" not in output(capsys, "suggest", tmp_path / "run", *asked)
    home = float(plan.read_text().splitlines()[1].split()[10])
    assert home == pytest.approx(400 - WALL, abs=0.1)
    synthetic.edit(data.root, lambda d: [f.pop("depth_file_path") for f in d["frames"]])
    line = refused(capsys, ["fit", data.root, "--out", tmp_path / "bare"], tmp_path / "bare")
    assert "a whole scene needs points, which `mgs import` triangulates" in line


def test_a_room_is_fitted_whole_if_its_cameras_look_inwards(tmp_path, capsys):
    """It was refused, as no ground or object is near what they look at."""
    data = write_room(tmp_path / "room", -2.5)
    assert start_of_fit(data, None, None, {}).source == "random"
    _, points, *_ = scattered(data, PriorSettings(gaussians=400))
    assert (np.abs(np.linalg.norm(points, axis=1) - WALL) < 0.02 * WALL).sum() >= 364
    command("fit", data.root, "--passes", 1, "--out", tmp_path / "run")
    words = output(capsys, "suggest", data.root, "--gaussians", 400, "--dome", 8)
    assert "1: from kf_00" in words, "a folder was refused"
    below = ["--dome", 9, "--set", "elevations=-60,-20", "--set", "radius=1"]
    assert "-60" not in output(capsys, "suggest", tmp_path / "run", *below)


def test_an_object_in_masks_starts_with_few_gaussians_that_are_split(
    tmp_path, coarse_priors, capsys
):
    synthetic.write_dataset(tmp_path / "d", depth=False)
    fitted = ["fit", tmp_path / "d", "--passes", 4, "--gaussians"]
    kinds = ("split", 500, 228), ("fixed", 500, 500), ("split", 10, 10)
    for kind, asked, start in kinds:
        out = tmp_path / f"{kind}{asked}"
        command(*fitted, asked, "--density", kind, "--out", out)
        prior, model = load_prior(out / "prior"), load_gaussians(out / "gaussians.ply")
        assert read_json(out / "config.json")["settings"]["train"]["density"] == kind
        assert len(prior.points) + prior.backed == start
        assert 0.9 * asked < len(model) <= asked
    line = refused(capsys, [*fitted, 10**12, "--out", tmp_path / "many"], tmp_path / "many")
    assert "ask for fewer Gaussians" in line


def test_a_fit_with_adaptive_density_is_a_run_as_3dgs(tmp_path, capsys, monkeypatch):
    bare(tmp_path / "d")
    command("prior", tmp_path / "d", "--gaussians", "300")
    for name, value in (("FROM", 0), ("STEPS", 10)):
        monkeypatch.setattr(density, f"ADAPTION_{name}", value)
    fitted = ["fit", tmp_path / "d", "--density", "adaptive", "--out", tmp_path / "run"]
    line = refused(capsys, [*fitted, "--set", "train.most_gaussians=0"], tmp_path / "run")
    assert "train.most_gaussians = 0: must be at least 1" in line
    more = "--passes 3 --set train.most_gaussians=310 --set train.rates.mean=0.01"
    command(*fitted, *more.split())
    settings = read_json(tmp_path / "run/config.json")["settings"]
    train = settings["train"]
    assert (settings["sh"], train["means"], train["optimiser"]) == (3, "free", "adam")
    assert (train["rates"]["mean"], train["rates"]["scale"]) == (0.01, 5e-3)
    assert train["alpha_weight"] == 0
    model = load_gaussians(tmp_path / "run/gaussians.ply")
    assert not model.antialiased
    assert 0 < len(model) <= 310
    assert len(model) != 300
    command("eval", tmp_path / "run")


def test_test_views_get_masks_too_and_the_place_of_the_origin_stays(tmp_path):
    bare(tmp_path / "d")
    synthetic.edit(tmp_path / "d", lambda data: data.update(place="47,8,430"))
    bare(tmp_path / "d/test")
    ball = trimesh.creation.icosphere(2, 0.4)
    mesh = Mesh(ball.vertices, ball.faces, np.ones(len(ball.faces), bool))
    made = make_masks(load_dataset(tmp_path / "d"), mesh)
    assert read_json(tmp_path / "d/transforms.json")["place"] == "47,8,430"
    tests = load_dataset(tmp_path / "d/test")
    assert all(0 < frame.mask().mean() < 0.9 for frame in tests.frames)
    assert not any("no masks" in line for line in check_dataset(made).problems)
    frames = [replace(frame, mask_path=None) for frame in tests.frames]
    write_transforms(tests.root, frames)
    assert any("test views have no masks" in line for line in check_dataset(made).problems)


def test_a_part_with_few_points_belongs_to_the_object_above_the_ground():
    """Few points in shade are no cluster of their own; other things, farther off, stay out."""
    rng = np.random.default_rng(0)
    lit = rng.uniform([0, 0, 0], [1, 1, 1], (800, 3))
    shade = rng.uniform([1, 0, 0], [1.3, 1, 0.02], (40, 3))
    elsewhere = rng.uniform([2, 0, 0], [2.2, 0.2, 0.2], (60, 3))
    lonely = np.array([[0.5, 0.5, 1.4]])
    points = np.concatenate([lit, shade, elsewhere, lonely])
    grown = _grown(points, np.arange(len(points)) < 800)
    assert grown[:800].all()
    assert grown[800:840].mean() > 0.95
    assert not grown[840:].any()
