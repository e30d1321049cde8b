"""Mitsuba sees what `Camera` says: the same pixels, in colour and in depth."""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from refusals import fails
from scipy.spatial import cKDTree

from mgs import Camera, look_at
from mgs.colour import linear_from_srgb
from mgs.files import write_json
from mgs.seeds import generator
from mgs.synth.arena import make_ground, make_stones
from mgs.synth.rock import make_rock
from mgs.synth.rock_layer import RockLayer, continued, lattice, render_layers, with_coverage
from mgs.synth.scene import MitsubaScene, sensor_dict, whole_grid
from mgs.synth.scene_file import Arena, Rock, SceneFile, Sensor, load_scene_file, sensor_of

K = np.array([[70.0, 0, 30.5], [0, 70.0, 27.25], [0, 0, 1]])

pytestmark = pytest.mark.usefixtures("coarse_arena")


def test_known_point_lands_on_its_pixel():
    """A small bright ball off every axis, and an off-centre principal point."""
    camera = Camera(K, 64, 48, look_at([3.0, -1.0, 1.5], [0.1, 0.2, 0.3]))
    point = np.array([0.25, -0.2, 0.45])
    light = {"type": "area", "radiance": 1.0}
    ball = {"type": "sphere", "center": point.tolist(), "radius": 0.05, "light": light}
    scene = {"type": "scene", "integrator": {"type": "direct"}, "ball": ball}
    scene["sensor"] = sensor_dict(camera)
    image = np.array(mi.render(mi.load_dict(scene), spp=256)).sum(-1)
    v, u = np.mgrid[:48, :64] + 0.5
    centroid = np.array([(image * u).sum(), (image * v).sum()]) / image.sum()
    np.testing.assert_allclose(centroid, camera.project(point[None])[0][0], atol=0.05)


def test_texture_lies_on_the_rock_as_in_the_mesh():
    """Mitsuba's albedo is the colour of the exported mesh there; a flipped v would be noise."""
    rock = make_rock(Rock(detail=0.04), generator(0, "rock"))
    camera = Camera(K * [[2], [2], [1]], 128, 96, look_at([3, 1, 1.5], [0, 0, 0.6]))
    scene = MitsubaScene(SceneFile(arena=Arena(stones=0)), rock, camera, seed=0)
    albedo = render_layers(scene.scene, scene.guides, spp=16, seed=0)[0][..., 3:6]
    depth, mask = scene.cast(camera)
    points = camera.unproject(depth)[mask]
    nearest = cKDTree(rock.vertices).query(points)[1]
    expected = linear_from_srgb(rock.visual.to_color().vertex_colors[nearest, :3] / 255)
    assert np.corrcoef(albedo[mask].mean(-1), expected.mean(-1))[0, 1] > 0.7
    assert albedo[mask].mean(0) == pytest.approx(expected.mean(0), rel=0.05)


@pytest.fixture(scope="module")
def ball(coarse_arena):
    """A red ball of radius 0.7 around (0.1, 0, 0.5) on grey ground, and a camera."""
    rock = trimesh.creation.icosphere(5, 0.7)
    rock.apply_translation([0.1, 0, 0.5])
    colours = np.tile([255, 0, 0, 255], (len(rock.vertices), 1))
    rock.visual = trimesh.visual.ColorVisuals(rock, vertex_colors=colours)
    settings = SceneFile(arena=Arena(colour=(0.3, 0.3, 0.3), stones=0))
    camera = Camera(K, 64, 48, look_at([3, 0, 1.5], [0, 0, 0.6]))
    return MitsubaScene(settings, rock, camera, seed=0), camera


def test_colour_and_depth_agree_on_the_silhouette(ball):
    """Mitsuba's sensor and the depth rays (NumPy camera) see the same rock after a move."""
    scene, first = ball
    for camera in (first, Camera(K, 64, 48, look_at([-1, 2.5, 2.0], [0, 0, 0.6]))):
        rendered = scene.render(camera, spp=16, seed=0, denoise=False)
        redness = rendered.rgb[..., 0] / np.maximum(rendered.rgb.sum(-1), 1e-6)
        assert np.mean((redness > 0.7) == rendered.mask) > 0.985
        middle, z = camera.project(np.array([[0.1, 0, 0.5]]))
        u, v = middle[0].astype(int)
        assert rendered.depth[v, u] == pytest.approx(z[0] - 0.7, abs=0.01)


def test_the_image_is_that_of_the_inner_integrator_and_the_rock_a_part_of_it(ball):
    scene, _ = ball
    aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    for integrator, inner, spp in ((scene.path, scene.path.inner, 6), (scene.guides, aov, 8)):
        image, rock, share = render_layers(scene.scene, integrator, spp, seed=4)
        alone = np.array(mi.render(scene.scene, integrator=inner, spp=spp, seed=4))
        np.testing.assert_allclose(image[..., -alone.shape[-1] :], alone, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(rock[share == 1], image[share == 1])
        assert not rock[share == 0].any()
        assert (share == 1).sum() > 100
        assert set(np.unique(np.round(share * spp, 4))) == set(range(spp + 1))
    seven = render_layers(scene.scene, scene.guides, 7, seed=4)[0]
    np.testing.assert_array_equal(seven, image)  # rounded up to 8


def test_the_image_does_not_depend_on_the_number_of_threads(ball):
    """35 samples: a pixel's share no packet, so that another thread may add the rest of them."""
    scene, _ = ball
    images, threads = [], dr.thread_count()
    for count in (1, threads, 7):
        dr.set_thread_count(count)
        images.append(np.dstack(render_layers(scene.scene, scene.guides, 35, seed=0)))
    dr.set_thread_count(threads)
    assert np.array_equal(images[0], images[1])
    assert np.array_equal(images[0], images[2])


def test_samples_are_rounded_up_as_the_sampler_rounds_them():
    kind = sensor_dict(Camera(K, 64, 48, np.eye(4)))["sampler"]
    for spp in (*range(1, 70), 1000):
        taken = mi.load_dict(kind | {"sample_count": spp}).sample_count()
        assert whole_grid(spp) == taken == whole_grid(taken)


def test_light_of_rock_and_of_all_else_adds_up_to_the_image(ball):
    """The layer of the ground, by the same random numbers, is the rest of the image."""
    scene, _ = ball
    image, rock, _ = render_layers(scene.scene, scene.path, 8, seed=1)
    ground = next(shape for shape in scene.scene.shapes() if shape.id() == "ground")
    _, rest, share = render_layers(scene.scene, RockLayer(scene.path.inner, ground), 8, seed=1)
    no_sky = share + render_layers(scene.scene, scene.path, 8, seed=1)[2] == 1
    assert no_sky.sum() > 1000
    np.testing.assert_allclose((rock + rest)[no_sky], image[no_sky], rtol=1e-5, atol=1e-7)


def test_coverage_is_the_area_that_the_outline_cuts_off(ball):
    """A ball's outline is an ellipse, whose area in each pixel is known from 100 x 100 points."""
    scene, camera = ball
    mask = scene.cast(camera)[1]
    alpha = scene.coverage(camera, mask, mask.astype(np.float32))
    offset = (np.arange(100) + 0.5) / 100
    v, u = np.mgrid[:48, :64]
    expected = np.zeros((48, 64))
    centre = np.array([0.1, 0, 0.5]) - camera.position
    for du, dv in itertools.product(offset, offset):
        x, y = (u + du - K[0, 2]) / K[0, 0], (v + dv - K[1, 2]) / K[1, 1]
        rays = np.stack([x, y, np.ones_like(x)], -1) @ camera.world_to_camera[:3, :3]
        expected += (rays @ centre) ** 2 > (rays**2).sum(-1) * (centre @ centre - 0.7**2)
    rim = (expected > 0) & (expected < 1e4)
    # The ground hides the ball's foot; there the outline is another.
    upper = np.arange(48)[:, None] < camera.project(np.array([[0.1, 0, 0.5]]))[0][0, 1]
    assert (rim & upper).sum() > 50
    assert np.abs(alpha - expected / 1e4)[upper & (alpha < 1) | rim & upper].max() < 0.03
    np.testing.assert_array_equal(np.round(alpha * 255), alpha * 255)
    assert (alpha[mask] > 0).all()
    assert (alpha[~mask] < 1).all()
    np.testing.assert_array_equal(lattice(255)[127], 0.5)  # a pixel of the mask is never empty
    nowhere = scene.coverage(camera, np.zeros_like(mask), np.zeros(mask.shape, np.float32))
    np.testing.assert_array_equal(nowhere, 0)


def test_a_rock_of_one_colour_keeps_it():
    """Light and its continuation are colour times coverage, whatever samples met it."""
    colour, coverage = np.array([0.1, 0.2, 0.4], np.float32), np.zeros((6, 7), np.float32)
    coverage[1:5, 2:6], coverage[0, 2:6] = 1, 0.25
    share = np.random.default_rng(0).binomial(4, coverage).astype(np.float32) / 4
    assert (share[0, 2:6] == 0).any()
    expected = coverage[..., None] * colour
    found = with_coverage(share[..., None] * colour, share, coverage)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    everywhere = np.broadcast_to(colour, expected.shape)
    np.testing.assert_allclose(continued(expected, coverage), everywhere, atol=1e-5)


@pytest.mark.slow
def test_a_specular_rock_shines_where_it_mirrors_the_sun_and_nowhere_else():
    """A ball's highlight lies where its normal halves the angle between sun and camera."""
    camera = Camera(K, 64, 48, look_at([3, 0, 1.5], [0, 0, 0.6]))
    images = {}
    for specular in (0.0, 0.5):
        rock = trimesh.creation.icosphere(4, 0.7)
        rock.apply_translation([0, 0, 0.7])
        settings = SceneFile(rock=Rock(specular=specular, roughness=0.2), arena=Arena(stones=0))
        scene = MitsubaScene(settings, rock, camera, seed=0)
        images[specular] = scene.render(camera, spp=16, seed=0, denoise=False)
    seen = images[0.0].mask & images[0.5].mask
    diffuse = images[0.0].rgb[seen].mean(-1)
    gained = images[0.5].rgb[seen].mean(-1) - diffuse
    sky = SceneFile().sky
    elevation, azimuth = np.radians([sky.sun_elevation, sky.sun_azimuth])
    flat = np.cos(elevation)
    sun = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    points = camera.unproject(images[0.0].depth)[seen]
    normal, view = (points - [0, 0, 0.7]) / 0.7, camera.position - points
    half = sun + view / np.linalg.norm(view, axis=1, keepdims=True)
    cosine = (normal * half).sum(1) / np.linalg.norm(half, axis=1)
    assert gained[cosine > np.cos(np.radians(3))].mean() > diffuse.mean()
    assert abs(np.median(gained[cosine < np.cos(np.radians(30))])) < 0.1 * diffuse.mean()


def test_the_rock_alone_is_the_image_inside_and_its_own_colour_at_the_rim(ball):
    """At its rim the denoised layer is far nearer to many samples than image times mask."""
    scene, camera = ball
    rendered = scene.render(camera, 8, 0, denoise=True)
    many = [scene.render(camera, 64, 10 + i, denoise=False).rock for i in range(4)]
    truth = np.mean(many, axis=0)
    rgb, alpha = rendered.rock[..., :3], rendered.rock[..., 3]
    rim = (alpha > 0) & (alpha < 1)
    error = np.sqrt(((rgb - truth[..., :3])[rim] ** 2).mean())
    by_mask = np.sqrt(((rendered.rgb * rendered.mask[..., None] - truth[..., :3])[rim] ** 2).mean())
    assert error < 0.4 * by_mask
    assert not rgb[alpha == 0].any()
    np.testing.assert_array_equal(rgb[alpha == 1], rendered.rgb[alpha == 1])
    green, true = (x[rim][:, 1].sum() / x[rim][:, 0].sum() for x in (rgb, truth))
    assert green == pytest.approx(true, abs=0.02)  # no grey of the ground


def test_no_stones_where_the_rock_keeps_them_out():
    rock, rng = trimesh.creation.icosphere(subdivisions=1), np.random.default_rng(0)
    ground = make_ground(Arena(), rock, rng)
    assert make_stones(Arena(spread=0.8), rock, ground, rng) is None
    assert make_stones(Arena(spread=2, stones=9), rock, ground, rng) is not None


def test_the_boulder_is_the_default():
    assert load_scene_file("boulder").model_copy(update={"description": ""}) == SceneFile()


def test_the_sensor_of_a_dataset_is_its_scenes(tmp_path):
    assert sensor_of(tmp_path) == Sensor()
    write_json(tmp_path / "config.json", {"scene": {"sensor": {"noise": 2.5, "drift": 0.0}}})
    assert sensor_of(tmp_path) == Sensor(noise=2.5, drift=0.0)
    write_json(tmp_path / "config.json", {"scene": {"sensor": {"noise": -1}}})
    fails(r"scene\.sensor is damaged", sensor_of, tmp_path)
