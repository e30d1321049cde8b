"""Extreme input: finite and right results. Bad input: an error that names it."""

import re
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from refusals import fails

import mgs.splat
from mgs import Camera
from mgs.gaussians import ARRAYS, SH_MAX, Gaussians
from mgs.splat import ESTIMATORS, ListCache, fisher, jvp, render
from mgs.splat.constants import NEAR
from mgs.splat.recording import frozen

from . import reference, scenes
from .scenes import SIZE, changed, gradients_of, make_camera, make_gaussians, place, with_gradients
from .test_render import errors

BACKGROUND = (0.2, 0.5, 0.7)
CAMERA = make_camera()
N = 16


def scene(seed=0, **values) -> Gaussians:
    return changed(make_gaussians(N, seed, log_scales=(-4.0, -1.5)), **values)


def with_first(name: str, value, seed=0) -> Gaussians:
    """A random scene whose first four Gaussians have one parameter replaced."""
    values = getattr(scene(seed), name).copy()
    values[:4] = value
    return scene(seed, **{name: values})


PIXELS = [(5, 5), (20, 13), (30, 20), (44, 2)]


def behind_camera() -> Gaussians:
    return with_first("means", place(CAMERA, PIXELS, [-1e-3, -0.5, -2, -100]))


def around_near_plane() -> Gaussians:
    """Small enough that EWA means something there."""
    depths = [NEAR * 1.001, NEAR * 0.999, NEAR * 1.1, 0]
    g = with_first("means", place(CAMERA, PIXELS, depths))
    g.log_scales[:4] = -8
    return g


def thin(ratio: float) -> Gaussians:
    g = scene(2)
    g.log_scales[:] = np.log(0.4) + np.array([0, -np.log(ratio), -np.log(ratio)], np.float32)
    return g


CASES = {
    "behind the camera": behind_camera,
    "near plane": around_near_plane,
    "all behind": lambda: scene(means=scene().means + 100 * CAMERA.position.astype(np.float32)),
    "none in the image": lambda: scene(means=scene().means + 3 * CAMERA.world_to_camera[0, :3]),
    "on the camera": lambda: with_first("means", CAMERA.position),
    "far away": lambda: with_first("means", place(CAMERA, [(22, 13)] * 4, [1e3, 1e4, 1e5, 1e6])),
    "a light year aside": lambda: with_first("means", 1e16),
    "scales of e^-30": lambda: scene(log_scales=np.full((N, 3), -30.0)),
    "scales of e^30": lambda: with_first("log_scales", 30, seed=2),
    "scales of e^30 and e^-30": lambda: with_first("log_scales", (30, -30, -30)),
    "scales of 3e38": lambda: with_first("log_scales", 3e38, seed=2),
    "1:1000": lambda: thin(1e3),
    "1:1000000": lambda: thin(1e6),
    "opaque": lambda: scene(logit_opacities=np.full(N, 20.0)),
    "transparent": lambda: scene(logit_opacities=np.full(N, -20.0)),
    "opacity of 1 and 0": lambda: scene(logit_opacities=np.where(np.arange(N) % 2, 200.0, -200.0)),
    "zero quaternions": lambda: with_first("quats", 0, seed=1),
    "quaternions of norm 1e-30": lambda: scene(1, quats=scene(1).quats * 1e-30),
    "quaternions of norm 1e-9": lambda: scene(quats=scene().quats * 1e-9),
    "quaternions of norm 1e30": lambda: scene(quats=scene().quats * 1e30),
    "black": lambda: scene(sh=np.full((N, 1, 3), -100.0)),
    "one": lambda: make_gaussians(1, 3, spread=0.1, log_scales=(-2, -1), logits=(1, 2)),
    "all at one place": lambda: scene(means=np.zeros((N, 3))),
}


def gradients(gaussians, camera) -> dict[str, np.ndarray]:
    model = with_gradients(gaussians)
    image = render(model, camera, BACKGROUND)
    outputs = (image.rgb, image.alpha, image.depth * image.alpha)
    dr.backward(sum(dr.sum(output, axis=None) for output in outputs))
    return gradients_of(model)


def assert_right(gaussians, camera, quats: bool = True) -> None:
    """Image and Fisher information as the reference has them; gradients, tangents, and information
    of means finite. quats=False: without the columns of quaternions."""
    with np.errstate(all="ignore"):
        error, _ = errors(gaussians, camera, BACKGROUND)
        expected = reference.fisher_block(gaussians, camera, BACKGROUND)
    assert error.max() <= 1
    for name, gradient in gradients(gaussians, camera).items():
        assert np.isfinite(gradient).all(), f"gradient of {name}"
    tangents = {name: np.ones_like(getattr(gaussians, name)) for name in ARRAYS}
    for name, change in vars(jvp(gaussians, tangents, camera, BACKGROUND)).items():
        assert np.isfinite(np.asarray(change)).all(), f"tangent of {name}"
    for estimator in ("exact", "block"):
        found = fisher(gaussians, camera, estimator, means="free", alpha_weight=1.0)
        assert np.isfinite(found).all()
    found, blocks = (fisher(gaussians, camera, e, BACKGROUND) for e in ("exact", "block"))
    assert np.isfinite(blocks).all()
    assert (found >= 0).all()
    diagonal = np.einsum("nii->ni", expected)
    part = np.arange(11) if quats else np.array([0, 1, 2, 3, 4, 5, 10])
    square = np.ix_(np.arange(len(found)), part, part)
    for values, truths in ((found[:, part], diagonal[:, part]), (blocks[square], expected[square])):
        big = np.abs(truths) >= 1e-6 * np.abs(truths).max()  # if nothing is seen, all are 0
        np.testing.assert_allclose(values[big], truths[big], rtol=1e-3)


BEYOND_DIFFERENCES = {"scales of e^30 and e^-30", "quaternions of norm 1e-9"}
"""Where the step of central differences exceeds the quaternion, or turns a needle away."""


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize("name", CASES)
def test_extreme_gaussians(name, antialiased):
    g = replace(CASES[name](), antialiased=antialiased)
    assert_right(g, CAMERA, quats=name not in BEYOND_DIFFERENCES)


@pytest.mark.parametrize("seed", range(3))
def test_needles_across_a_large_image(seed):
    """A metre long, a tenth of a millimetre thick: xi is a small difference of large numbers."""
    g = make_gaussians(6, seed, spread=0.3, logits=(0, 4))
    g.log_scales[:] = np.log([1, 1e-4, 1e-4])
    assert_right(g, make_camera((640, 120), focal=600))


@pytest.mark.parametrize("size", [(1, 1), (1, 30), (30, 1), (8, 4), (33, 17)])
def test_any_image_size(size):
    assert_right(scene(2), make_camera(size, focal=0.8 * max(size)))


def test_image_sizes_may_be_numpys_integers():
    camera, (width, height) = make_camera(), SIZE
    counted = Camera(camera.K, np.int64(width), np.uint16(height), camera.world_to_camera)
    np.testing.assert_array_equal(render(scene(2), counted).rgb, render(scene(2), camera).rgb)


@pytest.mark.parametrize("degree", [0, 3])
def test_no_gaussians_is_the_background(degree):
    g = make_gaussians(0, 0, degree)
    image = render(g, CAMERA, BACKGROUND, ListCache())
    expected = np.broadcast_to(BACKGROUND, (SIZE[1], SIZE[0], 3))
    np.testing.assert_allclose(np.asarray(image.rgb), expected, atol=1e-7)
    assert not np.any(np.asarray(image.alpha))
    assert not np.any(np.asarray(image.depth))
    change = jvp(g, {"means": g.means}, CAMERA, BACKGROUND)
    assert change.rgb.shape == image.rgb.shape
    assert not any(np.asarray(values).any() for values in vars(change).values())
    columns = 3 * (degree + 1) ** 2 + 8
    for estimator in ESTIMATORS:
        shape = (0, columns, columns) if estimator == "block" else (0, columns)
        assert fisher(g, CAMERA, estimator).shape == shape


@pytest.mark.parametrize("n", [0, 60])
def test_gradient_of_the_background_is_what_shines_through(n):
    background = mi.Color3f(*BACKGROUND)
    dr.enable_grad(background)
    image = render(make_gaussians(n, 3), CAMERA, background)
    dr.backward(dr.sum(image.rgb, axis=None))
    through = float(np.sum(1 - np.asarray(dr.detach(image.alpha))))
    np.testing.assert_allclose(np.asarray(dr.grad(background)).ravel(), [through] * 3, rtol=1e-5)


def test_gradient_of_extreme_scenes_is_right_too():
    g = thin(1e3)
    g.logit_opacities[::2] = 20
    weights = np.random.default_rng(0).normal(size=(SIZE[1], SIZE[0], 3))
    weights[scenes.margins(g, CAMERA) <= 1e-4] = 0
    model = with_gradients(g, ARRAYS[1:])
    rgb = render(model, CAMERA, BACKGROUND).rgb
    dr.backward(dr.sum(rgb * mi.TensorXf(weights.astype(np.float32)), axis=None))
    J = reference.jacobian(g, CAMERA, BACKGROUND)
    expected = np.tensordot(weights.reshape(-1, 3), J, axes=([0, 1], [0, 1]))
    found, parts = gradients_of(model, ARRAYS[1:]), np.split(expected, (3, 6, 10), axis=1)
    for name, part in zip(("sh", *ARRAYS[1:4]), parts, strict=True):
        assert scenes.relative_error(found[name], part) < 1e-4, name


@pytest.mark.parametrize("name", ARRAYS)
def test_not_a_number_names_the_parameter_and_the_first_gaussian(name):
    g = scene()
    getattr(g, name)[5], getattr(g, name)[9] = -np.inf, np.nan
    cache = ListCache()
    render(scene(), CAMERA, cache=cache)
    first = f"{name} is NaN or infinite, first at Gaussian"
    for call, options in ((render, {}), (render, {"cache": cache}), (fisher, {})):
        fails(f"{first} 5", call, g, CAMERA, **options)
    hidden = behind_camera()
    getattr(hidden, name)[0] = np.nan
    fails(f"{first} 0", render, hidden, CAMERA)


def test_opacities_of_extreme_logits():
    logits = np.array([-3e38, -1000, -80, 0, 2, 1000], np.float32)
    g = changed(make_gaussians(len(logits), 0), logit_opacities=logits)
    expected = [0, 0, np.exp(-80.0), 0.5, 1 / (1 + np.exp(-2.0)), 1]
    np.testing.assert_allclose(g.opacities, expected, rtol=1e-6)
    assert g.opacities.dtype == np.float32
    projected = reference.project(g, CAMERA)
    np.testing.assert_allclose(projected.opacities, expected * projected.compensations, rtol=1e-6)


def test_colours_beyond_measure_are_an_error():
    g = scene()
    g.sh[5, 0, 1] = -1.01 * SH_MAX
    for call in (render, fisher):
        fails("sh is beyond 1,000,000, first at Gaussian 5; repair", call, g, CAMERA)
    fails("up to 1,000,000", fisher, scene(), CAMERA, background=(0, -1.01 * SH_MAX, 0))


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_the_largest_colours_have_finite_information_and_gradients(estimator):
    g = make_gaussians(N, 0, 3, log_scales=(-2.0, 0.0))
    g.sh[:] = SH_MAX * np.sign(g.sh)
    assert np.isfinite(fisher(g, CAMERA, estimator, (SH_MAX, 0, 0))).all()
    assert fisher(g, CAMERA, estimator).max() > SH_MAX
    assert all(np.isfinite(gradient).all() for gradient in gradients(g, CAMERA).values())


SHAPES = [("means", (N, 2)), ("quats", (N - 1, 4)), ("sh", (N, 3)), ("sh", (N, 5, 3))]


@pytest.mark.parametrize(("name", "shape"), [*SHAPES, ("means", (0, 3))])
def test_shapes_that_do_not_fit_are_an_error(name, shape):
    """With no means, those of the next array do not fit."""
    for call in (render, fisher):
        named = f"{name if shape[0] else 'log_scales'} has shape"
        fails(named, call, changed(scene(), **{name: np.zeros(shape)}), CAMERA)


def test_no_variant_is_named_in_the_code():
    folders = [Path(mgs.splat.__file__).parent, Path(mgs.splat.__file__).parents[2] / "plugins"]
    files = [path for folder in folders for path in folder.rglob("*.py")]
    assert len(files) >= 6
    variants = r"llvm_|cuda_|scalar_rgb|metal_|drjit\.(llvm|cuda)|set_variant"
    for path in files:
        found = re.search(variants, path.read_text())
        assert found is None, f"{path} names {found.group()}"


def test_an_interruption_within_drjit_stays_one():
    """Dr.Jit reports it as a RuntimeError where it arrives in Python that Dr.Jit calls."""

    class Interrupting:
        DRJIT_STRUCT: ClassVar = {"x": mi.Float}

        @property
        def x(self):
            raise KeyboardInterrupt

    double = frozen(lambda x: ())(lambda x: x)
    with pytest.raises(KeyboardInterrupt):
        double(Interrupting())
