"""Mitsuba sees what `Camera` says: the same pixels, in colour and in depth."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from mgs.camera import Camera, look_at
from mgs.colour import linear_from_srgb
from mgs.errors import InputError
from mgs.seeds import generator
from mgs.synth import arena
from mgs.synth.arena import make_ground, make_stones
from mgs.synth.rock import make_rock
from mgs.synth.scene import Scene, sensor_dict
from mgs.synth.scene_file import Arena, Rock, SceneFile, load_scene_file

K = np.array([[70.0, 0, 30.5], [0, 70.0, 27.25], [0, 0, 1]])


def test_known_point_lands_on_its_pixel():
    """A small bright ball off every axis, an off-centre principal point: the rendered centroid is the projection."""
    camera = Camera(K, 64, 48, look_at([3.0, -1.0, 1.5], [0.1, 0.2, 0.3]))
    point = np.array([0.25, -0.2, 0.45])
    ball = {"type": "sphere", "center": point.tolist(), "radius": 0.05, "light": {"type": "area", "radiance": 1.0}}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, "sensor": sensor_dict(camera), "ball": ball})
    image = np.array(mi.render(scene, spp=256)).sum(-1)
    v, u = np.mgrid[:48, :64] + 0.5
    centroid = np.array([(image * u).sum(), (image * v).sum()]) / image.sum()
    np.testing.assert_allclose(centroid, camera.project(point[None])[0][0], atol=0.05)


def test_colour_and_depth_agree_on_the_silhouette():
    """Path-traced albedo (Mitsuba's sensor) and the depth rays (NumPy camera) see the same rock after the sensor moved."""
    rock = trimesh.creation.icosphere(3, 0.7)
    rock.apply_translation([0.1, 0, 0.5])
    rock.visual = trimesh.visual.ColorVisuals(rock, vertex_colors=np.tile([255, 0, 0, 255], (len(rock.vertices), 1)))
    cameras = [Camera(K, 64, 48, look_at(eye, [0, 0, 0.6])) for eye in ([3, 0, 1.5], [-1, 2.5, 2.0])]
    settings = SceneFile(arena=Arena(colour=(0.3, 0.3, 0.3), stones=0))
    scene = Scene(settings, rock, cameras[0], seed=0)
    for index, camera in enumerate(cameras):
        rendered = scene.render(camera, spp=16, seed=index, denoise=False)
        redness = rendered.rgb[..., 0] / np.maximum(rendered.rgb.sum(-1), 1e-6)
        assert np.mean((redness > 0.7) == rendered.mask) > 0.985
        middle, z = camera.project(np.array([[0.1, 0, 0.5]]))
        u, v = middle[0].astype(int)
        assert rendered.depth[v, u] == pytest.approx(z[0] - 0.7, abs=0.01)


def test_texture_lies_on_the_rock_as_in_the_mesh(monkeypatch):
    """Mitsuba's albedo at each pixel is the colour that the exported mesh has at that point (a flipped v would be noise)."""
    monkeypatch.setattr(arena, "ROWS", 60)  # the ground is not looked at
    monkeypatch.setattr(arena, "TEXELS", 64)
    rock = make_rock(Rock(detail=0.04), generator(0, "rock"))
    camera = Camera(K * [[2], [2], [1]], 128, 96, look_at([3, 1, 1.5], [0, 0, 0.6]))
    scene = Scene(SceneFile(arena=Arena(stones=0)), rock, camera, seed=0)
    albedo = np.array(mi.render(scene.scene, integrator=scene.guides, spp=16, seed=0))[..., :3]
    depth, mask = scene.cast(camera)
    points = camera.unproject(depth)[mask]
    nearest = cKDTree(rock.vertices).query(points)[1]
    expected = linear_from_srgb(rock.visual.to_color().vertex_colors[nearest, :3] / 255)
    assert np.corrcoef(albedo[mask].mean(-1), expected.mean(-1))[0, 1] > 0.7
    assert albedo[mask].mean(0) == pytest.approx(expected.mean(0), rel=0.05)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[rock]\nsiz = 1\n", "unknown key 'rock.siz'"),
        ("[rock]\nsize = -1\n", "rock.size"),
        ("[rock\n", "not valid TOML"),
        ("[orbit]\nkind = 'figure-eight'\n", "orbit.kind"),
        ("[sky]\nturbidity = nan\n", "sky.turbidity"),
    ],
)
def test_bad_scene_files(tmp_path, text, message):
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(InputError, match=message) as error:
        load_scene_file(tmp_path / "s.toml")
    assert "\n" not in str(error.value)


def test_no_stones_where_the_rock_keeps_them_out():
    rock, rng = trimesh.creation.icosphere(subdivisions=1), np.random.default_rng(0)
    ground = make_ground(Arena(), rock, rng)
    assert make_stones(Arena(spread=0.8), rock, ground, rng) is None
    assert make_stones(Arena(spread=2, stones=9), rock, ground, rng) is not None


def test_unknown_scene_names_the_known_ones():
    with pytest.raises(InputError, match="boulder"):
        load_scene_file("boulders")


def test_the_boulder_is_the_default_scene():
    assert load_scene_file("boulder").model_copy(update={"description": ""}) == SceneFile()


def test_the_sensor_of_a_dataset_is_its_scenes(tmp_path):
    from mgs.errors import InputError
    from mgs.files import write_json
    from mgs.synth.scene_file import Sensor, sensor_of

    assert sensor_of(tmp_path) == Sensor()
    write_json(tmp_path / "config.json", {"scene": {"sensor": {"noise": 2.5, "drift": 0.0}}})
    assert sensor_of(tmp_path) == Sensor(noise=2.5, drift=0.0)
    write_json(tmp_path / "config.json", {"scene": {"sensor": {"noise": -1}}})
    with pytest.raises(InputError, match=r"scene\.sensor is damaged"):
        sensor_of(tmp_path)
