"""Mitsuba integrator `mgs_splat`: image and derivatives of the API, through perspective sensors."""

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from program import python
from splat.scenes import gradients_of, relative_error, with_gradients
from test_render_command import gaussians as any_gaussians

import mgs.splat.plugins  # noqa: F401  registers mgs_splat
from mgs import Camera, InputError, read_ply, write_ply
from mgs.colour import linear_from_srgb
from mgs.gaussians import ARRAYS, Gaussians
from mgs.splat import camera_from_sensor, jvp, moved, render

WIDTH, HEIGHT, FOV = 70, 46, 38.0
EYE, TARGET = (0.3, -2.0, 0.9), (0.05, 0.0, 0.0)


def gaussians(n: int = 60) -> Gaussians:
    return any_gaussians(1, n)


@pytest.fixture(scope="module")
def ply(tmp_path_factory):
    path = tmp_path_factory.mktemp("plugin") / "x.ply"
    write_ply(path, gaussians())
    return path


def sensor_dict(film: dict | None = None, **options) -> dict:
    whole = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgb"}
    film = whole | {"rfilter": {"type": "box"}} | (film or {})
    to_world = mi.ScalarTransform4f().look_at(origin=EYE, target=TARGET, up=[0, 0, 1])
    return {"type": "perspective", "fov": FOV, "to_world": to_world, "film": film} | options


def load(ply, sensor: dict | None = None, **options):
    integrator = {"type": "mgs_splat", "filename": str(ply)} | options
    scene = {"type": "scene", "integrator": integrator, "sensor": sensor or sensor_dict()}
    return mi.load_dict(scene)


def camera(scene) -> Camera:
    return camera_from_sensor(scene.sensors()[0])


CROP = {"crop_offset_x": 11, "crop_offset_y": 5, "crop_width": 41, "crop_height": 30}
PPO = {"principal_point_offset_x": 0.13, "principal_point_offset_y": -0.07}
TALL = {"width": 40, "height": 64}
SENSORS = [
    *(({"fov_axis": axis}, {}) for axis in ("x", "y", "smaller", "larger", "diagonal")),
    *(({"fov_axis": axis}, TALL) for axis in ("smaller", "larger")),
    (PPO, {}),
    ({}, CROP),
    (PPO | {"fov_axis": "diagonal"}, CROP),
    ({}, {"rfilter": {"type": "gaussian"}}),
]
"""Options of a sensor and of its film."""


def assert_near(found, truth) -> None:
    """Check that found differs from truth by at most 1e-5 of its norm."""
    found, truth = np.asarray(found), np.asarray(truth)
    assert np.linalg.norm(truth) > 0
    assert np.linalg.norm(found - truth) <= 1e-5 * np.linalg.norm(truth)


@pytest.mark.parametrize(("options", "film"), SENSORS)
def test_camera_and_image_are_those_of_the_sensor(ply, options, film):
    """Rays through the centres of pixels are the sensor's own, which are float32."""
    scene = load(ply, sensor_dict(film, **options))
    found = camera(scene)
    v, u = np.mgrid[: found.height, : found.width] + 0.5
    position = np.stack([u.ravel() / found.width, v.ravel() / found.height]).astype(np.float32)
    rays, _ = scene.sensors()[0].sample_ray(0, 0, mi.Point2f(position), mi.Point2f(0))
    directions = found.unproject(np.ones((found.height, found.width))).reshape(-1, 3) - EYE
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(np.asarray(rays.d).T, directions, atol=2e-6)
    np.testing.assert_allclose(found.position, EYE, atol=1e-6)
    truth = np.asarray(render(read_ply(ply), found).rgb)
    image = np.asarray(mi.render(scene))
    np.testing.assert_array_equal(image, truth)
    assert truth.max() > 0.3
    if "crop_width" in film:
        sensor = sensor_dict({k: v for k, v in film.items() if k not in CROP}, **options)
        (left, top), (height, width) = found.corner, truth.shape[:2]
        whole = np.asarray(mi.render(load(ply, sensor)))
        np.testing.assert_array_equal(image, whole[top : top + height, left : left + width])


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize("space", ["linear", "srgb"])
def test_properties(ply, space, antialiased):
    background, own = (0.1, 0.2, 0.3), load(ply).integrator()
    assert (own.colour_space, own.aov_names()) == ("linear", [])
    assert own.gaussians.antialiased == read_ply(ply).antialiased
    options = {"background": list(background), "colour_space": space, "antialiased": antialiased}
    scene = load(ply, sensor_dict({"pixel_format": "rgba"}), depth=True, **options)
    image = np.asarray(mi.render(scene))
    truth = render(replace(read_ply(ply), antialiased=antialiased), camera(scene), background)
    rgb, beyond = np.asarray(truth.rgb), np.asarray(truth.rgb) > 1
    expected = rgb if space == "linear" else np.where(beyond, image[..., :3], linear_from_srgb(rgb))
    assert image.shape == (HEIGHT, WIDTH, 5)
    np.testing.assert_allclose(image[..., :3], expected, atol=4e-6)
    np.testing.assert_allclose(image[..., 3], np.asarray(truth.alpha), atol=1e-6)
    np.testing.assert_allclose(image[..., 4], np.asarray(truth.depth), rtol=1e-4)
    assert scene.integrator().aov_names() == ["depth.z"]


def test_a_changed_parameter_changes_the_image(ply):
    """Also with another number of Gaussians: block lists must not be reused."""
    scene = load(ply)
    params = mi.traverse(scene)
    first = np.asarray(mi.render(scene, params)).copy()
    other = gaussians(n=90)
    for name in ARRAYS:
        params[f"integrator.{name}"] = mi.TensorXf(getattr(other, name))
    params.update()
    second = np.asarray(mi.render(scene, params))
    assert np.abs(first - second).max() > 0.1
    np.testing.assert_allclose(second, np.asarray(render(other, camera(scene)).rgb), atol=1e-6)


def test_gradients_are_those_of_the_api(ply):
    scene = load(ply, sensor_dict({"pixel_format": "rgba"} | CROP), depth=True)
    params = mi.traverse(scene)
    for name in ARRAYS:
        dr.enable_grad(params[f"integrator.{name}"])
    image = mi.render(scene, params)
    weights = mi.TensorXf(np.random.default_rng(0).normal(size=image.shape).astype(np.float32))
    dr.backward(dr.sum(image * weights, axis=None))

    model = with_gradients(read_ply(ply))
    drawn = render(model, camera(scene))
    outputs = [drawn.rgb, drawn.alpha[..., None], drawn.depth[..., None]]
    dr.backward(dr.sum(dr.concat(outputs, axis=2) * weights, axis=None))
    for name, expected in gradients_of(model).items():
        assert_near(dr.grad(params[f"integrator.{name}"]), expected)


def test_samples_and_seeds_change_nothing(ply):
    scene = load(ply)
    cases = ((1, 0), (1, 7), (16, 0))
    images = {np.asarray(mi.render(scene, spp=spp, seed=seed)).tobytes() for spp, seed in cases}
    assert len(images) == 1


def test_files_lie_beside_the_scene(ply, tmp_path):
    write_ply(tmp_path / "beside.ply", gaussians())
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><sensor type="perspective"/><integrator type="mgs_splat">'
        '<string name="filename" value="beside.ply"/>'
        '<rgb name="background" value="0.2 0.4 0.6"/></integrator></scene>'
    )
    integrator = mi.load_file(str(tmp_path / "scene.xml")).integrator()
    assert str(integrator) == "MgsSplat[60 Gaussians, SH degree 1]"
    np.testing.assert_allclose(integrator.background, (0.2, 0.4, 0.6), rtol=1e-6)


PLY = {"filename": "PLY"}
BAD_FILES = [
    ({}, "mgs_splat: `filename` is missing or no string; name a 3DGS PLY"),
    ({"filename": "nowhere.ply"}, "nowhere.ply: no such file"),
    (PLY | {"depth": "false"}, "mgs_splat: depth 'false' must be a boolean"),
    (PLY | {"background": "white"}, "must be one or three numbers, linear RGB, up to 1,000,000"),
    (PLY | {"colour_space": "Lab"}, "colour_space 'Lab' is unknown; choose linear or srgb"),
]


@pytest.mark.parametrize(("options", "message"), BAD_FILES)
def test_bad_files(ply, options, message):
    """Mitsuba wraps the exceptions of a plug-in in a RuntimeError; our line is its last."""
    if options.get("filename") == "PLY":
        options = options | {"filename": str(ply)}
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "mgs_splat"} | options)
    last = str(error.value).splitlines()[-1]
    assert "InputError" in last
    assert message in last


MIRRORED = mi.ScalarTransform4f().scale([-1, 1, 1])


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        ({"type": "orthographic"}, "sensor: OrthographicCamera has no pinhole; splatting needs"),
        ({"type": "thinlens", "aperture_radius": 0.1}, "ThinLensCamera has no pinhole"),
        ({"type": "perspective", "to_world": MIRRORED}, "to_world mirrors the image"),
    ],
)
def test_bad_sensors(ply, sensor, message):
    with pytest.raises(RuntimeError) as error:
        mi.render(load(ply), sensor=mi.load_dict(sensor))
    assert isinstance(error.value.__cause__, InputError)
    assert message in str(error.value.__cause__)


def test_a_parameter_that_is_not_finite_is_named(ply):
    scene = load(ply)
    params = mi.traverse(scene)
    opacities = gaussians().logit_opacities
    opacities[7] = np.nan
    params["integrator.logit_opacities"] = mi.TensorXf(opacities)
    params.update()
    with pytest.raises(RuntimeError) as error:
        mi.render(scene)
    assert "logit_opacities is NaN or infinite, first at Gaussian 7" in str(error.value.__cause__)


@pytest.mark.parametrize("space", ["linear", "srgb"])
def test_forward_mode_is_that_of_the_api(ply, space):
    film, background = {"pixel_format": "rgba"}, (0.2, 0.1, 0.3)
    options = {"depth": True, "colour_space": space, "background": list(background)}
    scene = load(ply, sensor_dict(film), **options)
    params, model, rng = mi.traverse(scene), gaussians(), np.random.default_rng(4)
    assert not np.any(scene.integrator().render_forward(scene, params)), "nothing changes yet"
    tangents = {n: rng.normal(size=getattr(model, n).shape).astype(np.float32) for n in ARRAYS}
    t = mi.Float(0)
    dr.enable_grad(t)
    for name, tangent in tangents.items():
        params[f"integrator.{name}"] = params[f"integrator.{name}"] + t * mi.TensorXf(tangent)
    params.update()
    image = mi.render(scene, params)
    dr.forward(t)
    found = np.asarray(dr.grad(image))
    assert found.shape == (HEIGHT, WIDTH, 5)

    expected = jvp(model, tangents, camera(scene), background)
    rgb = np.asarray(expected.rgb)
    if space == "srgb":
        blended = np.asarray(render(model, camera(scene), background).rgb)
        slope = 2.4 / 1.055 * ((blended + 0.055) / 1.055) ** 1.4
        rgb = rgb * np.where(blended <= 0.04045, 1 / 12.92, slope)
    assert_near(found[..., :3], rgb)
    assert_near(found[..., 3], expected.alpha)
    assert_near(found[..., 4], expected.depth)


@pytest.mark.parametrize("film", [{}, CROP])
def test_the_sensor_is_differentiated(ply, film):
    """Move by to_world and x_fov, as `moved`: Mitsuba's cameras have x to the left and y up."""
    scene = load(ply, sensor_dict(film, **PPO))
    own = camera(scene)
    whole, window = own.film or own, (*own.corner, own.width, own.height)
    degrees = 2 * np.degrees(np.arctan(np.tan(np.radians(FOV / 2)) * np.exp(-1e-6)))
    per_log_focal = float((degrees - FOV) / 1e-6)
    for i in range(7):
        params, t = mi.traverse(scene), mi.Float(0)
        dr.enable_grad(t)
        x = [mi.Float64(0)] * 7
        x[i] = mi.Float64(t)
        motion = [mi.Float(part) for part in x]
        before, fov = params["sensor.to_world"], params["sensor.x_fov"]
        axis, rate = np.eye(3)[i % 3] * (-1, -1, 1), 180 / np.pi
        change = mi.Transform4f().rotate(axis, rate * motion[i]) if i < 3 else mi.Transform4f()
        if 3 <= i < 6:
            change = mi.Transform4f().translate(mi.Vector3f(*(float(a) * motion[i] for a in axis)))
        params["sensor.to_world"] = before @ change
        if i == 6:
            params["sensor.x_fov"] = fov + per_log_focal * motion[6]
        params.update()
        image = mi.render(scene, params)
        dr.forward(t)
        found = np.asarray(dr.grad(image))
        params["sensor.to_world"], params["sensor.x_fov"] = before, fov
        params.update()

        s = mi.Float(0)
        dr.enable_grad(s)
        x = [mi.Float64(0)] * 7
        x[i] = mi.Float64(s)
        there = moved(whole, dr.concat(x[:6]), x[6])
        drawn = render(read_ply(ply), there.cropped(*window)).rgb
        dr.forward(s)
        assert relative_error(found, dr.grad(drawn)) < 3e-4, i


@pytest.mark.parametrize("around", [{"type": "aov", "aovs": "z:depth"}, {"type": "moment"}])
def test_another_integrator_cannot_nest_it(ply, around):
    nested = around | {"image": {"type": "mgs_splat", "filename": str(ply)}}
    scene = mi.load_dict({"type": "scene", "integrator": nested, "sensor": sensor_dict()})
    with pytest.raises(RuntimeError) as error:
        mi.render(scene, spp=1)
    assert isinstance(error.value.__cause__, InputError)


def test_registered_at_import(ply, tmp_path):
    """Before a variant is set, and for each variant, from any folder."""
    lines = [
        "import mitsuba as mi, mgs.splat.plugins",
        "mi.set_variant('scalar_rgb')",
        "try: mi.load_dict({'type': 'mgs_splat'})",
        "except RuntimeError as error: print('no scalar_rgb' in str(error))",
        f"mi.set_variant({mi.variant()!r})",
        f"print(mi.load_dict({{'type': 'mgs_splat', 'filename': {str(ply)!r}}}))",
    ]
    done = python("\n".join(lines), cwd=tmp_path)
    splats = "MgsSplat[60 Gaussians, SH degree 1]"
    assert done.stdout.split("\n")[:2] == ["True", splats], done.stderr


def test_the_documented_example(tmp_path, monkeypatch):
    page = (Path(__file__).parent.parent / "docs/mitsuba.md").read_text()
    program = page.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    write_ply("splats.ply", gaussians())
    variables: dict = {}
    exec(program, variables)
    first = np.mean(np.asarray(variables["target"]) ** 2)  # the target is half the image
    assert variables["loss"].array[0] < 0.3 * first
