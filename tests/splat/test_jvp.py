"""Tangents of images against the reference, the adjoint, and Dr.Jit's own AD."""

from dataclasses import replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mgs.errors import InputError
from mgs.gaussians import ARRAYS, LEARNED
from mgs.splat import ListCache, as_drjit, jvp, reference, render

from .scenes import (
    calm,
    changed,
    compare,
    double,
    make_camera,
    make_gaussians,
    thread_count,
    with_gradients,
)
from .test_gradients import gradients, image_weights

BACKGROUND = (0.3, 0.6, 0.1)
OUTPUTS = ("rgb", "alpha", "depth")
TOLERANCE = 1e-5


def random_tangents(gaussians, seed=0, names=ARRAYS) -> dict[str, np.ndarray]:
    rng = np.random.default_rng([seed, 7])
    shapes = {name: getattr(gaussians, name).shape for name in names}
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def images(image) -> dict[str, np.ndarray]:
    return {name: np.asarray(getattr(image, name)) for name in OUTPUTS}


def difference(gaussians, tangents, camera, step=1e-6) -> dict[str, np.ndarray]:
    """Derivative of the reference's images along the tangents, by a central difference."""
    ends = []
    for sign in (+1, -1):
        moved = double(gaussians)
        for name, tangent in tangents.items():
            setattr(moved, name, getattr(moved, name) + sign * step * tangent.astype(np.float64))
        ends.append(reference.render(moved, camera, BACKGROUND))
    return {name: (ends[0][name] - ends[1][name]) / (2 * step) for name in OUTPUTS}


@cache
def case(degree: int):
    """(gaussians, camera, Jacobian of the reference)."""
    camera, style = make_camera(), {"log_scales": (-4.0, -1.0)}
    gaussians = calm(lambda seed: make_gaussians(10, seed, degree, **style), camera, 30 + degree)
    return gaussians, camera, reference.jacobian(gaussians, camera, BACKGROUND)


@pytest.mark.parametrize("names", [LEARNED, *((name,) for name in LEARNED)])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_change_as_the_jacobian_says(degree, names):
    gaussians, camera, J = case(degree)
    tangents = random_tangents(gaussians, degree, names)
    zero = {name: np.zeros(getattr(gaussians, name).shape) for name in LEARNED}
    v = np.concatenate([(zero | tangents)[name].reshape(len(gaussians), -1) for name in LEARNED], 1)
    expected = np.tensordot(J, v, axes=([2, 3], [0, 1])).reshape(camera.height, camera.width, 3)
    found = images(jvp(gaussians, tangents, camera, BACKGROUND))
    assert compare(found["rgb"], expected)[0] < TOLERANCE


def assert_as_differences(gaussians, tangents, camera) -> None:
    found = images(jvp(gaussians, tangents, camera, BACKGROUND))
    expected = difference(gaussians, tangents, camera)
    for output in OUTPUTS:
        assert found[output].shape == expected[output].shape
        assert compare(found[output], expected[output])[0] < TOLERANCE, output


def assert_one_jacobian(gaussians, tangents, camera, u) -> None:
    """<u, J v> = <J^T u, v> for images u and tangents v."""
    Jv = images(jvp(gaussians, tangents, camera, BACKGROUND))
    JTu = gradients(gaussians, camera, u, tuple(tangents))
    forward = sum(float((Jv[name] * u[name]).sum(dtype=np.float64)) for name in OUTPUTS)
    reverse = sum(float((JTu[name] * tangents[name]).sum(dtype=np.float64)) for name in tangents)
    squares = [sum((image[n].astype(float) ** 2).sum() for n in OUTPUTS) for image in (Jv, u)]
    assert abs(forward - reverse) <= 1e-6 * np.sqrt(squares[0] * squares[1])


@pytest.mark.parametrize("names", [ARRAYS, *((name,) for name in ARRAYS[:4])])
@pytest.mark.parametrize("degree", [0, 2])
def test_all_images_change_as_differences_say(degree, names):
    gaussians, camera, _ = case(degree)
    assert_as_differences(gaussians, random_tangents(gaussians, 10 + degree, names), camera)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**31),
    degree=st.integers(0, 3),
    scale=st.floats(-5, -0.5),
    stretch=st.floats(0.1, 4),
    logit=st.floats(-2, 10),
    names=st.sets(st.sampled_from(ARRAYS), min_size=1),
    filtered=st.booleans(),
)
def test_tangents_and_gradients_are_of_one_jacobian(
    seed, degree, scale, stretch, logit, names, filtered
):
    """Forward and reverse mode are two different kernels."""
    camera = make_camera()
    gaussians = make_gaussians(12, seed, degree, (scale - stretch, scale), (logit - 4, logit))
    gaussians = replace(gaussians, antialiased=filtered)
    tangents = random_tangents(gaussians, seed, sorted(names))
    assert_one_jacobian(gaussians, tangents, camera, image_weights(camera, seed))


def test_forward_mode_of_drjit_through_render():
    """`dr.forward` from a number t that moves parameters and background."""
    gaussians, camera, _ = case(1)
    tangents = random_tangents(gaussians)
    t = mi.Float(0)
    dr.enable_grad(t)
    model = as_drjit(gaussians)
    for name in ARRAYS:
        setattr(model, name, getattr(model, name) + t * mi.TensorXf(tangents[name]))
    change = np.array([0.5, -1, 2], np.float32)
    image = render(model, camera, mi.Color3f(*BACKGROUND) + t * mi.Color3f(*change.tolist()))
    dr.forward(t)
    found, expected = images(dr.grad(image)), images(jvp(gaussians, tangents, camera, BACKGROUND))
    expected["rgb"] = expected["rgb"] + (1 - np.asarray(dr.detach(image.alpha)))[..., None] * change
    for output in OUTPUTS:
        np.testing.assert_allclose(found[output], expected[output], rtol=1e-5, atol=1e-5)
        assert np.abs(found[output]).max() > 1


def test_enabled_gradients_and_suspended_ones_play_no_part():
    gaussians, camera, _ = case(0)
    tangents = random_tangents(gaussians)
    expected = images(jvp(gaussians, tangents, camera, BACKGROUND))
    model = with_gradients(gaussians, ["sh"])
    background = mi.Color3f(*BACKGROUND)
    dr.enable_grad(background)
    dr.set_grad(background, 1)
    with dr.suspend_grad():
        tensors = {name: mi.TensorXf(value) for name, value in tangents.items()}
        found = jvp(model, tensors, camera, background)
    assert not dr.grad_enabled(found)
    assert not np.any(dr.grad(model.sh))
    for output in OUTPUTS:
        np.testing.assert_array_equal(images(found)[output], expected[output])


def test_what_is_not_named_does_not_change():
    gaussians, camera, _ = case(1)
    for tangents in ({}, {"sh": np.zeros_like(gaussians.sh)}):
        for change in images(jvp(gaussians, tangents, camera, BACKGROUND)).values():
            assert not change.any()
    by_colour = images(jvp(gaussians, random_tangents(gaussians, names=["sh"]), camera))
    assert by_colour["rgb"].any()
    assert not by_colour["alpha"].any()
    assert not by_colour["depth"].any()


def test_nothing_changes_where_alpha_is_clamped():
    """Where alpha is at ALPHA_MAX; around it, it does. (Other clamps belong to the projection.)"""
    gaussians, camera, _ = case(0)
    shape = {"means": np.zeros((1, 3)), "log_scales": np.full((1, 3), 0.5)}
    wide = changed(gaussians[:1], logit_opacities=[20.0], **shape)
    alpha = np.asarray(render(wide, camera).alpha)
    change = images(jvp(wide, {"log_scales": np.ones((1, 3))}, camera))["alpha"]
    clamped = alpha >= np.float32(0.999)
    assert clamped.any()
    assert not clamped.all()
    assert not change[clamped].any()
    assert (change[(alpha > 0.01) & ~clamped] > 0).all()


@pytest.mark.parametrize("size", [(1, 1), (9, 5), (150, 70)])
def test_any_image_size(size):
    """Several tiles, too, and images whose last blocks reach beyond the edge."""
    camera = make_camera(size, focal=0.8 * max(size))
    gaussians = calm(lambda seed: make_gaussians(16, seed, log_scales=(-4.0, -1.5)), camera, 3)
    assert_as_differences(gaussians, random_tangents(gaussians), camera)


def test_a_cache_changes_nothing():
    camera, kept = make_camera(), ListCache()
    gaussians = make_gaussians(60, 3, log_scales=(-5.0, -1.5))
    for growth in (0, 0, -0.5, 0.3):
        grown = changed(gaussians, log_scales=gaussians.log_scales + np.float32(growth))
        tangents = random_tangents(grown)
        found, expected = (
            images(jvp(grown, tangents, camera, BACKGROUND, lists)) for lists in (kept, None)
        )
        for output in OUTPUTS:
            np.testing.assert_array_equal(found[output], expected[output])
    assert kept.builds == 3


@pytest.mark.parametrize("scale", [1, 1e-36])
def test_reruns_are_bitwise_equal(scale):
    """Also for changes so small that some threads would flush them to 0."""
    camera = make_camera((200, 150), focal=200.0)
    gaussians = make_gaussians(1500, 11, 1, log_scales=(-6.0, -2.5))
    tangents = {n: np.float32(scale) * value for n, value in random_tangents(gaussians).items()}
    runs = []
    for threads in (1, 2, 2):
        with thread_count(threads):
            found = images(jvp(gaussians, tangents, camera, BACKGROUND))
        runs.append({name: value.tobytes() for name, value in found.items()})
    assert runs[0] == runs[1] == runs[2]


@pytest.mark.parametrize("degree", [0, 3])
def test_no_gaussians_change_nothing(degree):
    gaussians, camera = make_gaussians(0, 0, degree), make_camera()
    change = images(jvp(gaussians, random_tangents(gaussians), camera, BACKGROUND))
    assert change["rgb"].shape == (camera.height, camera.width, 3)
    assert not any(values.any() for values in change.values())


@pytest.mark.parametrize(
    ("tangents", "message"),
    [
        ({"scales": np.zeros((10, 3))}, "'scales' is no parameter; choose from means, log_scales"),
        ({"quats": np.zeros((10, 3))}, r"quats has shape \(10, 3\), expected \(10, 4\), that of"),
        ({"sh": dr.zeros(mi.TensorXf, (10, 3))}, r"shape \(10, 3\), expected \(10, 1, 3\), that"),
        ({"means": "north"}, "means must be numbers of the parameter's shape"),
        ({"means": np.full((10, 3), np.nan)}, "means is NaN or infinite, first at Gaussian 0; rem"),
        ({"means": np.full((10, 3), 1e39)}, "means is NaN or infinite, first at Gaussian 0; rem"),
    ],
)
def test_bad_tangents_are_one_line(tangents, message):
    gaussians, camera, _ = case(0)
    with pytest.raises(InputError, match=message) as error:
        jvp(gaussians, tangents, camera)
    assert "\n" not in str(error.value)


def test_bad_gaussians_are_those_of_render():
    gaussians, camera, _ = case(0)
    quats = np.where(np.arange(10)[:, None] == 5, np.nan, gaussians.quats)
    broken = changed(gaussians, quats=quats)
    with pytest.raises(InputError, match="quats is NaN or infinite, first at Gaussian 5"):
        jvp(broken, random_tangents(gaussians), camera)
