"""The Mitsuba integrator `mgs_splat`: the same image and derivatives as the API, through every
perspective sensor."""

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mgs.splat.plugins  # noqa: F401  registers mgs_splat
from mgs.camera import Camera, look_at
from mgs.colour import linear_from_srgb
from mgs.errors import InputError
from mgs.gaussians import Gaussians
from mgs.splat import as_drjit, camera_from_sensor, jvp, reference, render
from mgs.splat_ply import read_ply, write_ply

WIDTH, HEIGHT, FOV = 70, 46, 38.0
EYE, TARGET = (0.3, -2.0, 0.9), (0.05, 0.0, 0.0)
NAMES = [field.name for field in fields(Gaussians)]
LOOK_AT = look_at(EYE, TARGET)


def gaussians(n: int = 60, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    parts = (
        rng.normal(0, 0.3, (n, 3)),
        rng.normal(-2.6, 0.4, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(0, 2, n),
        0.5 * rng.normal(size=(n, 4, 3)),
    )
    return Gaussians(*(part.astype(np.float32) for part in parts))


@pytest.fixture(scope="module")
def ply(tmp_path_factory):
    path = tmp_path_factory.mktemp("plugin") / "x.ply"
    write_ply(path, gaussians())
    return path


def sensor_dict(film: dict | None = None, **options) -> dict:
    film = {
        "type": "hdrfilm",
        "width": WIDTH,
        "height": HEIGHT,
        "pixel_format": "rgb",
        "rfilter": {"type": "box"},
    } | (film or {})
    to_world = mi.ScalarTransform4f().look_at(origin=EYE, target=TARGET, up=[0, 0, 1])
    return {"type": "perspective", "fov": FOV, "to_world": to_world, "film": film} | options


def load(ply, sensor: dict | None = None, **options):
    integrator = {"type": "mgs_splat", "filename": str(ply)} | options
    return mi.load_dict(
        {"type": "scene", "integrator": integrator, "sensor": sensor or sensor_dict()}
    )


def camera(
    axis: str = "x",
    ppo=(0.0, 0.0),
    crop=(0, 0, WIDTH, HEIGHT),
    width: int = WIDTH,
    height: int = HEIGHT,
) -> Camera:
    """The equivalent camera, from the definitions of Mitsuba's documentation, in float64."""
    extent = {
        "x": width,
        "y": height,
        "smaller": min(width, height),
        "larger": max(width, height),
        "diagonal": np.hypot(width, height),
    }[axis]
    focal = 0.5 * extent / np.tan(np.radians(FOV / 2))
    left, top, columns, rows = crop
    K = [
        [focal, 0, (0.5 - ppo[0]) * width - left],
        [0, focal, (0.5 - ppo[1]) * height - top],
        [0, 0, 1],
    ]
    return Camera(np.array(K), columns, rows, LOOK_AT)


AXES = ["x", "y", "smaller", "larger", "diagonal"]
CROP = (11, 5, 41, 30)
CROPPED = dict(
    zip(("crop_offset_x", "crop_offset_y", "crop_width", "crop_height"), CROP, strict=True)
)
PPO = {"principal_point_offset_x": 0.13, "principal_point_offset_y": -0.07}
TALL = {"width": 40, "height": 64}
SENSORS = [
    *(({"fov_axis": axis}, {}, {"axis": axis}) for axis in AXES),
    *(({"fov_axis": axis}, TALL, {"axis": axis, "crop": (0, 0, 40, 64)} | TALL) for axis in AXES),
    (PPO, {}, {"ppo": (0.13, -0.07)}),
    ({}, CROPPED, {"crop": CROP}),
    (
        PPO | {"fov_axis": "diagonal"},
        CROPPED,
        {"ppo": (0.13, -0.07), "axis": "diagonal", "crop": CROP},
    ),
    ({}, {"rfilter": {"type": "gaussian"}}, {}),
]


@pytest.mark.parametrize(("options", "film", "expected"), SENSORS)
def test_same_image_as_the_api(ply, options, film, expected):
    """Every fov axis on wide and tall films, principal point, crop window; a film's filter changes
    nothing.

    Bitwise the same through the sensor's camera. Mitsuba keeps a sensor in float32, so the camera
    defined in float64 differs by 1e-7 of the focal length, and the image by little more than its
    own rounding.
    """
    scene = load(ply, sensor_dict(film, **options))
    image = np.asarray(mi.render(scene))
    np.testing.assert_array_equal(
        image, np.asarray(render(read_ply(ply), camera_from_sensor(scene.sensors()[0])).rgb)
    )
    truth = np.asarray(render(read_ply(ply), camera(**expected)).rgb)
    assert truth.max() > 0.3
    np.testing.assert_allclose(image, truth, atol=4e-6)


@pytest.mark.parametrize(("options", "film", "expected"), SENSORS)
def test_camera_has_the_rays_of_the_sensor(options, film, expected):
    """Mitsuba's own rays through the pixel centres are those of the camera."""
    sensor = mi.load_dict(sensor_dict(film, **options))
    found = camera_from_sensor(sensor)
    np.testing.assert_allclose(found.K, camera(**expected).K, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(found.world_to_camera, LOOK_AT, atol=1e-6)
    v, u = np.mgrid[: found.height, : found.width] + 0.5
    position = np.stack([u.ravel() / found.width, v.ravel() / found.height]).astype(np.float32)
    rays, _ = sensor.sample_ray(0, 0, mi.Point2f(position), mi.Point2f(0))
    directions = (found.unproject(np.ones((found.height, found.width))) - found.position).reshape(
        -1, 3
    )
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(np.asarray(rays.d).T, directions, atol=2e-6)


def test_alpha_depth_and_background(ply):
    """An rgba film gets alpha, `depth` an AOV after it, `background` shows through."""
    background = (0.1, 0.2, 0.3)
    scene = load(
        ply, sensor_dict({"pixel_format": "rgba"}), depth=True, background=list(background)
    )
    image = np.asarray(mi.render(scene))
    truth = render(read_ply(ply), camera(), background)
    assert image.shape == (HEIGHT, WIDTH, 5)
    np.testing.assert_allclose(image[..., :3], np.asarray(truth.rgb), atol=1e-6)
    np.testing.assert_allclose(image[..., 3], np.asarray(truth.alpha), atol=1e-6)
    np.testing.assert_allclose(image[..., 4], np.asarray(truth.depth), rtol=1e-4)
    assert scene.integrator().aov_names() == ["depth.z"]


def test_colours_in_display_space(ply):
    """A PLY of another tool is blended in sRGB; the image is linear all the same, and gradients
    flow through the conversion."""
    scene = load(ply, colour_space="srgb")
    params = mi.traverse(scene)
    dr.enable_grad(params["integrator.sh"])
    image = mi.render(scene, params)
    blended = np.asarray(render(read_ply(ply), camera()).rgb)
    np.testing.assert_allclose(
        np.asarray(image),
        np.where(blended > 1, np.asarray(image), linear_from_srgb(blended)),
        atol=4e-6,
    )
    dr.backward(dr.sum(image, axis=None))

    model = as_drjit(read_ply(ply))
    dr.enable_grad(model.sh)
    rgb = render(model, camera()).rgb.array
    dr.backward(
        dr.sum(dr.select(rgb <= 0.04045, rgb / 12.92, dr.power((rgb + 0.055) / 1.055, 2.4)))
    )
    truth = np.asarray(dr.grad(model.sh))
    assert np.linalg.norm(
        np.asarray(dr.grad(params["integrator.sh"])) - truth
    ) <= 1e-5 * np.linalg.norm(truth)
    assert load(ply).integrator().colour_space == "linear"


def test_traverse_lists_the_parameters(ply):
    params = mi.traverse(load(ply))
    model = gaussians()
    for name in NAMES:
        key = f"integrator.{name}"
        assert not params.flags(key) & mi.ParamFlags.NonDifferentiable
        np.testing.assert_array_equal(np.asarray(params[key]), getattr(model, name))


def test_a_changed_parameter_changes_the_image(ply):
    """Also another number of Gaussians: the block lists of the first image must not serve the
    second."""
    scene = load(ply)
    params = mi.traverse(scene)
    first = np.asarray(mi.render(scene, params)).copy()
    other = gaussians(n=90, seed=1)
    for name in NAMES:
        params[f"integrator.{name}"] = mi.TensorXf(getattr(other, name))
    params.update()
    second = np.asarray(mi.render(scene, params))
    assert np.abs(first - second).max() > 0.1
    np.testing.assert_allclose(second, np.asarray(render(other, camera()).rgb), atol=1e-6)


@pytest.mark.parametrize(
    ("pixel_format", "depth", "film"),
    [("rgb", False, {}), ("rgba", False, {}), ("rgba", True, CROPPED)],
)
def test_gradients_are_those_of_the_api(ply, pixel_format, depth, film):
    """Of every parameter, means included, through colour, and through alpha and depth where the
    film has them."""
    scene = load(ply, sensor_dict({"pixel_format": pixel_format} | film), depth=depth)
    params = mi.traverse(scene)
    for name in NAMES:
        dr.enable_grad(params[f"integrator.{name}"])
    image = mi.render(scene, params)
    weights = mi.TensorXf(np.random.default_rng(0).normal(size=image.shape).astype(np.float32))
    dr.backward(dr.sum(image * weights, axis=None))

    model = as_drjit(read_ply(ply))
    for name in NAMES:
        dr.enable_grad(getattr(model, name))
    drawn = render(model, camera(crop=CROP) if film else camera())
    loss = dr.sum(drawn.rgb * weights[..., :3], axis=None)
    if pixel_format == "rgba":
        loss += dr.sum(drawn.alpha * weights[..., 3], axis=None)
    if depth:
        loss += dr.sum(drawn.depth * weights[..., 4], axis=None)
    dr.backward(loss)
    for name in NAMES:
        truth = np.asarray(dr.grad(getattr(model, name)))
        found = np.asarray(dr.grad(params[f"integrator.{name}"]))
        assert np.abs(truth).max() > 0
        assert np.linalg.norm(found - truth) <= 1e-5 * np.linalg.norm(truth), name


def test_frozen_parameters_get_no_gradient(ply):
    scene = load(ply)
    params = mi.traverse(scene)
    dr.enable_grad(params["integrator.sh"])
    dr.backward(dr.sum(mi.render(scene, params), axis=None))
    assert np.abs(np.asarray(dr.grad(params["integrator.sh"]))).max() > 0
    assert not dr.grad_enabled(params["integrator.means"])


def test_adam_lowers_a_loss(ply):
    """`mi.ad.Adam` on the scene's parameters: half of the squared error is gone after 15 steps."""
    scene = load(ply)
    params = mi.traverse(scene)
    target = mi.render(scene)
    learned = [
        "integrator.sh",
        "integrator.log_scales",
        "integrator.logit_opacities",
        "integrator.means",
        "integrator.quats",
    ]
    rng = np.random.default_rng(2)
    for key in learned:
        params[key] = mi.TensorXf(
            np.asarray(params[key]) + 0.05 * rng.normal(size=params[key].shape).astype(np.float32)
        )
    params.update()
    optimiser = mi.ad.Adam(lr=0.01, params={key: params[key] for key in learned})
    losses = []
    for _ in range(15):
        params.update(optimiser)
        loss = dr.mean(dr.square(mi.render(scene, params) - target), axis=None)
        dr.backward(loss)
        optimiser.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < 0.5 * losses[0]


def test_samples_and_seeds_change_nothing(ply):
    scene = load(ply)
    images = [
        np.asarray(mi.render(scene, spp=spp, seed=seed)).tobytes()
        for spp, seed in ((1, 0), (1, 7), (16, 0))
    ]
    assert len(set(images)) == 1


def test_files_lie_beside_the_scene(ply, tmp_path):
    """A scene file in XML names its PLY relative to itself."""
    write_ply(tmp_path / "beside.ply", gaussians())
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><sensor type="perspective"/><integrator type="mgs_splat">'
        '<string name="filename" value="beside.ply"/><rgb name="background" value="0.2 0.4 0.6"/></integrator></scene>'
    )
    integrator = mi.load_file(str(tmp_path / "scene.xml")).integrator()
    assert str(integrator) == "MgsSplat[60 Gaussians, SH degree 1]"
    np.testing.assert_allclose(integrator.background, (0.2, 0.4, 0.6), rtol=1e-6)


BAD_FILES = [
    ({}, "mgs_splat: `filename` is missing or no string; name a 3DGS PLY"),
    ({"filename": 5}, "mgs_splat: `filename` is missing or no string; name a 3DGS PLY"),
    ({"filename": "PLY", "depth": "false"}, "mgs_splat: depth 'false' must be a boolean"),
    (
        {"filename": "PLY", "background": "white"},
        "background white: must be one or three numbers, linear RGB, up to 1,000,000",
    ),
    (
        {"filename": "PLY", "background": [0.0, float("nan"), 0.0]},
        "must be one or three numbers, linear RGB, up to 1,000,000",
    ),
    ({"filename": "nowhere.ply"}, "nowhere.ply: no such file; give a 3DGS PLY"),
    ({"filename": __file__}, "export it again"),
    (
        {"filename": "PLY", "colour_space": "Lab"},
        "mgs_splat: colour_space 'Lab' is unknown; choose linear or srgb",
    ),
]


@pytest.mark.parametrize(("options", "message"), BAD_FILES)
def test_bad_files(ply, options, message):
    """Mitsuba makes a RuntimeError of what a plugin raises; our one line is its last."""
    if options.get("filename") == "PLY":
        options = options | {"filename": str(ply)}
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "mgs_splat"} | options)
    last = str(error.value).splitlines()[-1]
    assert "InputError" in last
    assert last.endswith(message)


@pytest.mark.parametrize(
    ("sensor", "name"),
    [
        ({"type": "orthographic"}, "OrthographicCamera"),
        ({"type": "thinlens", "aperture_radius": 0.1}, "ThinLensCamera"),
    ],
)
def test_bad_sensors(ply, sensor, name):
    with pytest.raises(RuntimeError) as error:
        mi.render(load(ply), sensor=mi.load_dict(sensor))
    assert isinstance(error.value.__cause__, InputError)
    assert (
        str(error.value.__cause__)
        == f"sensor: {name} has no pinhole; splatting needs a `perspective` sensor"
    )


def test_a_mirrored_sensor(ply):
    to_world = sensor_dict()["to_world"] @ mi.ScalarTransform4f().scale([-1, 1, 1])
    with pytest.raises(RuntimeError) as error:
        mi.render(load(ply, sensor_dict(to_world=to_world)))
    assert "to_world mirrors the image" in str(error.value.__cause__)


def test_not_finite(ply):
    """A NaN that an optimiser made is named."""
    scene = load(ply)
    params = mi.traverse(scene)
    opacities = gaussians().logit_opacities
    opacities[7] = np.nan
    params["integrator.logit_opacities"] = mi.TensorXf(opacities)
    params.update()
    with pytest.raises(RuntimeError) as error:
        mi.render(scene)
    assert "logit_opacities is NaN or infinite, first at Gaussian 7" in str(error.value.__cause__)


def moving(params, tangents, t) -> None:
    """Make parameters of the scene functions of t, a Dr.Jit number with gradients."""
    for name, tangent in tangents.items():
        params[f"integrator.{name}"] = params[f"integrator.{name}"] + t * mi.TensorXf(tangent)
    params.update()


@pytest.mark.parametrize("space", ["linear", "srgb"])
def test_forward_mode_against_differences(ply, space):
    """`dr.forward` through `mi.render` and `render_forward` itself: the oracle's central
    differences in float64, of colour, alpha and depth, in pixels where float32 takes the same
    decisions as float64."""
    scene = load(
        ply,
        sensor_dict({"pixel_format": "rgba"}),
        depth=True,
        colour_space=space,
        background=[0.2, 0.1, 0.3],
    )
    params, model = mi.traverse(scene), gaussians()
    rng = np.random.default_rng(4)
    tangents = {
        name: rng.normal(size=getattr(model, name).shape).astype(np.float32) for name in NAMES
    }
    t = mi.Float(0)
    dr.enable_grad(t)
    moving(params, tangents, t)
    image = mi.render(scene, params)
    dr.forward(t)
    found = np.asarray(dr.grad(image))
    assert found.shape == (HEIGHT, WIDTH, 5)

    sensor_camera, ends = camera_from_sensor(scene.sensors()[0]), []
    for sign in (+1, -1):
        moved = Gaussians(
            *(
                getattr(model, name).astype(np.float64) + sign * 1e-6 * tangents[name]
                for name in NAMES
            )
        )
        drawn = reference.render(moved, sensor_camera, (0.2, 0.1, 0.3))
        rgb = drawn["rgb"]
        if space == "srgb":
            rgb = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        ends.append(np.concatenate([rgb, drawn["alpha"][..., None], drawn["depth"][..., None]], 2))
    expected = (ends[0] - ends[1]) / 2e-6
    decided = reference.margins(model, sensor_camera) > 3e-5
    assert decided.mean() > 0.99
    for channels in (slice(0, 3), slice(3, 4), slice(4, 5)):
        error = np.linalg.norm((found - expected)[decided][:, channels])
        assert error < 1e-5 * np.linalg.norm(expected[decided][:, channels])


def test_forward_mode_goes_along_the_gradients_that_are_set(ply):
    """`render_forward` gives `jvp` along them. A parameter without gradients does not change;
    without any the result is 0."""
    scene = load(ply)
    params = mi.traverse(scene)
    assert not np.any(scene.integrator().render_forward(scene, params))
    tangent = np.random.default_rng(5).normal(size=gaussians().sh.shape).astype(np.float32)
    dr.enable_grad(params["integrator.sh"])
    dr.set_grad(params["integrator.sh"], mi.TensorXf(tangent))
    found = np.asarray(scene.integrator().render_forward(scene, params))
    expected = jvp(gaussians(), {"sh": tangent}, camera_from_sensor(scene.sensors()[0]))
    np.testing.assert_array_equal(found, np.asarray(expected.rgb))
    assert found.any()


@pytest.mark.parametrize(
    "program",
    [
        "mi.set_variant(VARIANT); import mgs.splat.plugins",
        "import mgs.splat.plugins; mi.set_variant(VARIANT)",
        "mi.set_variant('scalar_rgb'); import mgs.splat.plugins; mi.set_variant(VARIANT)",
        "mi.set_variant(VARIANT); import mgs.splat.plugins; mi.set_variant('scalar_rgb'); mi.set_variant(VARIANT)",
    ],
)
def test_registered_at_import(ply, program, tmp_path):
    """Before or after the variant is set; from any folder."""
    load_it = f"print(mi.load_dict({{'type': 'mgs_splat', 'filename': {str(ply)!r}}}))"
    lines = f"import mitsuba as mi\nVARIANT = {mi.variant()!r}\n{program}\n{load_it}"
    done = subprocess.run(
        [sys.executable, "-c", lines], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout.strip() == "MgsSplat[60 Gaussians, SH degree 1]", done.stderr


def test_the_documented_example(tmp_path, monkeypatch):
    """The program in docs/mitsuba.md runs, and lowers its loss."""
    page = (Path(__file__).parent.parent / "docs/mitsuba.md").read_text()
    program = page.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    write_ply("splats.ply", gaussians())
    variables: dict = {}
    exec(program, variables)
    first = np.mean(
        np.asarray(variables["target"]) ** 2
    )  # The target is half the image, so this is the loss of the start.
    assert variables["loss"].array[0] < 0.3 * first
