"""Rocks, procedural and given, and the orbits around them."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from mgs.data.meshes import read_mesh, to_glb
from mgs.seeds import generator
from mgs.synth.orbit import orbit_cameras, orbit_positions, perturb
from mgs.synth.rock import Noise, load_rock, make_rock
from mgs.synth.scene_file import Orbit, Rock

COARSE = Rock(detail=0.08)


def test_noise_is_band_limited_and_normalised():
    points = np.random.default_rng(0).uniform(-50, 50, (20000, 3))
    noise = Noise(np.random.default_rng(1))
    values = noise.octave(points, 1.0)
    assert abs(values.mean()) < 0.05
    assert 0.8 < values.std() < 1.1
    line = np.zeros((4096, 3))
    line[:, 0] = np.arange(4096) / 16
    power = np.abs(np.fft.rfft(noise.octave(line, 2.0))) ** 2
    frequency = np.fft.rfftfreq(4096, 1 / 16)
    assert power[frequency < 0.55].sum() > 0.95 * power.sum()


def test_rock_stands_in_the_ground_at_its_size():
    rock = make_rock(COARSE, generator(0, "rock"))
    assert rock.extents.max() == pytest.approx(COARSE.size)
    assert rock.bounds[0, 2] == pytest.approx(-COARSE.buried * rock.extents[2])
    welded = trimesh.Trimesh(rock.vertices, rock.faces)
    assert welded.is_watertight
    assert welded.volume > 0  # outward faces


def test_rock_is_a_function_of_the_seed():
    a, b, c = (make_rock(COARSE, generator(seed, "rock")) for seed in (1, 1, 2))
    assert to_glb(a) == to_glb(b)
    assert len(a.vertices) != len(c.vertices) or not np.allclose(a.vertices, c.vertices)


def test_glb_round_trip_keeps_geometry_and_colours(tmp_path):
    rock = make_rock(COARSE, generator(0, "rock"))
    (tmp_path / "rock.glb").write_bytes(to_glb(rock))
    back, scale = load_rock(tmp_path / "rock.glb", COARSE)
    assert scale == pytest.approx(1)
    np.testing.assert_allclose(back.vertices, rock.vertices, atol=1e-6)
    np.testing.assert_allclose(back.vertex_normals, rock.vertex_normals, atol=1e-6)
    colours = (mesh.visual.to_color().vertex_colors for mesh in (back, rock))
    np.testing.assert_array_equal(*colours)
    read = read_mesh(tmp_path / "rock.glb")
    np.testing.assert_array_equal(read.vertices, rock.vertices.astype(np.float32))


def test_glb_is_y_up_as_its_format_has_it(tmp_path):
    """In the file itself: what a viewer shows upwards is what stands upwards in the scene."""
    box = trimesh.creation.box([1.0, 2.0, 5.0])
    box.apply_translation([0, 0, 2.5])
    (tmp_path / "box.glb").write_bytes(to_glb(box))
    raw = trimesh.load(tmp_path / "box.glb", force="mesh", process=False)
    np.testing.assert_allclose(raw.bounds, [[-0.5, 0, -1], [0.5, 5, 1]])
    assert raw.volume > 0
    np.testing.assert_array_equal(box.bounds, [[-0.5, -1, 0], [0.5, 1, 5]])  # itself it stays


@pytest.mark.parametrize("up", [None, "y", "z"])
@pytest.mark.parametrize("suffix", ["glb", "obj", "ply"])
def test_given_mesh_is_scaled_and_stood_up(tmp_path, suffix, up):
    """A centimetre-sized box comes out metres tall; up is as given, or by the format."""
    trimesh.creation.box([0.01, 0.02, 0.03]).export(tmp_path / f"box.{suffix}")
    rock, scale = load_rock(tmp_path / f"box.{suffix}", Rock(size=3.0, buried=0.0), up)
    axis = up or ("z" if suffix == "ply" else "y")
    np.testing.assert_allclose(rock.extents, [1, 2, 3] if axis == "z" else [1, 3, 2])
    assert scale == pytest.approx(100)
    assert rock.bounds[0, 2] == pytest.approx(0)


def test_photo_texture_is_kept(tmp_path):
    """The image and where it lies on a scanned mesh: a ball of 5 cm with a photograph around it."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.025)
    uv = np.random.default_rng(0).random((len(ball.vertices), 2))
    photo = Image.fromarray(np.random.default_rng(1).integers(0, 256, (32, 64, 3), np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=photo)
    ball.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    ball.export(tmp_path / "ball.glb")
    rock, scale = load_rock(tmp_path / "ball.glb", Rock())
    assert scale == pytest.approx(1.8 / 0.05, rel=1e-3)
    assert rock.visual.material.baseColorTexture.convert("RGB").tobytes() == photo.tobytes()
    np.testing.assert_allclose(rock.visual.uv, uv, atol=1e-6)


@pytest.mark.parametrize(
    ("suffix", "options"),
    [("glb", {"include_normals": True}), ("obj", {"include_normals": True}), ("ply", {})],
)
def test_a_rock_whose_faces_are_there_twice_has_normals(tmp_path, suffix, options):
    """Faces and their reverse share vertices, where their normals cancel."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    doubled = np.concatenate([ball.faces, ball.faces[:, ::-1], [[0, 0, 1]]])
    twice = trimesh.Trimesh(ball.vertices, doubled, process=False)
    twice.export(tmp_path / f"rock.{suffix}", **options)
    rock, _ = load_rock(tmp_path / f"rock.{suffix}", Rock(), "z")
    assert len(rock.faces) == len(ball.faces)
    np.testing.assert_allclose(np.linalg.norm(rock.vertex_normals, axis=1), 1, atol=1e-6)
    outward = rock.vertices - rock.bounds.mean(0)
    outward = outward / np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.einsum("vk,vk->v", rock.vertex_normals, outward).min() > 0.99


def test_leaving_out_a_face_keeps_the_normals_and_uv_of_the_file(tmp_path):
    rock = make_rock(COARSE, generator(0, "rock"))
    (tmp_path / "rock.glb").write_bytes(to_glb(rock))
    spoilt = rock.copy(include_cache=True)
    normals = spoilt.vertex_normals
    spoilt.faces = np.concatenate([rock.faces, rock.faces[:1], [[0, 0, 1]]])
    spoilt.vertex_normals = normals
    (tmp_path / "spoilt.glb").write_bytes(to_glb(spoilt))
    good, mended = (load_rock(tmp_path / f"{name}.glb", COARSE)[0] for name in ("rock", "spoilt"))
    np.testing.assert_array_equal(mended.vertices, good.vertices)
    np.testing.assert_array_equal(mended.faces, good.faces)
    np.testing.assert_array_equal(mended.visual.uv, good.visual.uv)
    assert set(good.faces[0]) == {0, 1, 2}  # of no other face
    np.testing.assert_array_equal(mended.vertex_normals[3:], good.vertex_normals[3:])


TARGET = np.array([0.3, -0.2, 0.6])
KINDS = ["circle", "rings", "spiral", "hemisphere"]


@pytest.mark.parametrize("kind", KINDS)
def test_every_camera_has_the_target_in_the_middle(kind):
    for camera in orbit_cameras(Orbit(kind=kind), 24, TARGET, 44, 96, 72):
        pixel, z = camera.project(TARGET[None])
        np.testing.assert_allclose(pixel[0], [48, 36], atol=1e-9)
        assert z[0] > 0
        assert camera.world_to_camera[1, 2] < 0  # no camera is upside down


def test_circle_is_the_papers_orbit():
    p = orbit_positions(Orbit(radius=3, altitude=2), 8, TARGET)
    np.testing.assert_allclose(np.linalg.norm(p[:, :2] - TARGET[:2], axis=1), 3)
    np.testing.assert_allclose(p[:, 2], 2)
    azimuth = np.unwrap(np.arctan2(*(p - TARGET).T[1::-1]))
    np.testing.assert_allclose(np.diff(azimuth), np.pi / 4)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_domes_keep_distance_and_elevation(kind):
    p = orbit_positions(Orbit(kind=kind, radius=3, elevations=(10, 60)), 40, TARGET) - TARGET
    np.testing.assert_allclose(np.linalg.norm(p, axis=1), 3)
    elevation = np.degrees(np.arcsin(p[:, 2] / 3))
    assert elevation.min() >= 10 - 1e-9
    assert elevation.max() <= 60 + 1e-9
    assert np.ptp(elevation) > 40
    assert len(np.unique(p.round(6), axis=0)) == 40


@pytest.mark.parametrize("kind", KINDS)
def test_distances_are_taken_in_turn(kind):
    near = orbit_positions(Orbit(kind=kind), 7, TARGET)
    far = orbit_positions(Orbit(kind=kind, distances=(1, 2, 3)), 7, TARGET)
    factors = np.array([1, 2, 3, 1, 2, 3, 1])
    np.testing.assert_allclose(far - TARGET, factors[:, None] * (near - TARGET))
    assert np.array_equal(far[factors == 1], near[factors == 1]), "not a bit of these changes"


def test_hemisphere_is_even():
    p = orbit_positions(Orbit(kind="hemisphere", radius=1, elevations=(0, 90)), 100, np.zeros(3))
    distance = np.linalg.norm(p[:, None] - p[None], axis=-1) + 9 * np.eye(100)
    nearest = distance.min(1)
    assert nearest.max() < 2.5 * nearest.min()


def test_pose_noise_has_the_stated_size():
    cameras = orbit_cameras(Orbit(), 400, TARGET, 44, 96, 72)
    noisy = perturb(cameras, 0.02, 0.5, np.random.default_rng(0))
    moved = np.array([b.position - a.position for a, b in zip(cameras, noisy, strict=True)])
    assert moved.std(0) == pytest.approx([0.02] * 3, rel=0.15)
    poses = [[c.world_to_camera[:3, :3] for c in each] for each in (cameras, noisy)]
    turns = np.array(poses[1]) @ np.array(poses[0]).swapaxes(1, 2)
    angles = np.degrees(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert np.sqrt((angles**2).mean() / 3) == pytest.approx(0.5, rel=0.1)
