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
from mgs.gaussians import ARRAYS
from mgs.splat import as_drjit, jvp, reference, render

from .scenes import (
    calm,
    double,
    make_camera,
    make_clamped,
    make_gaussians,
    relative_error,
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
    """(gaussians, camera). With an even degree also alphas clamped at ALPHA_MAX."""
    camera, antialiased = make_camera(), degree % 2 == 1
    gaussians = calm(lambda seed: make_clamped(seed, degree, 10, antialiased), camera, 30 + degree)
    clamped = reference.composite(reference.project(gaussians, camera), camera)[3]
    assert clamped.any() or antialiased
    return gaussians, camera


def assert_as_differences(gaussians, tangents, camera) -> None:
    found = images(jvp(gaussians, tangents, camera, BACKGROUND))
    expected = difference(gaussians, tangents, camera)
    for output in OUTPUTS:
        assert found[output].shape == expected[output].shape
        assert relative_error(found[output], expected[output]) < TOLERANCE, output


@pytest.mark.parametrize("names", [ARRAYS, *((name,) for name in ARRAYS[:4])])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_all_images_change_as_differences_say(degree, names):
    gaussians, camera = case(degree)
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
    """<u, J v> = <J^T u, v> for images u and tangents v: forward and reverse mode are two different
    kernels."""
    camera = make_camera()
    gaussians = make_gaussians(12, seed, degree, (scale - stretch, scale), (logit - 4, logit))
    gaussians = replace(gaussians, antialiased=filtered)
    tangents = random_tangents(gaussians, seed, sorted(names))
    u = image_weights(camera, seed)
    Jv = images(jvp(gaussians, tangents, camera, BACKGROUND))
    JTu = gradients(gaussians, camera, u, tuple(tangents))
    forward = sum(float((Jv[name] * u[name]).sum(dtype=np.float64)) for name in OUTPUTS)
    reverse = sum(float((JTu[name] * tangents[name]).sum(dtype=np.float64)) for name in tangents)
    squares = [sum((image[n].astype(float) ** 2).sum() for n in OUTPUTS) for image in (Jv, u)]
    assert abs(forward - reverse) <= 1e-6 * np.sqrt(squares[0] * squares[1])


def test_forward_mode_of_drjit_through_render():
    """`dr.forward` from a number t that moves parameters and background."""
    gaussians, camera = case(1)
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
    gaussians, camera = case(0)
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
    gaussians, camera = case(1)
    for tangents in ({}, {"sh": np.zeros_like(gaussians.sh)}):
        for change in images(jvp(gaussians, tangents, camera, BACKGROUND)).values():
            assert not change.any()
    by_colour = images(jvp(gaussians, random_tangents(gaussians, names=["sh"]), camera))
    assert by_colour["rgb"].any()
    assert not by_colour["alpha"].any()
    assert not by_colour["depth"].any()


@pytest.mark.parametrize("size", [(1, 1), (9, 5), (150, 70)])
def test_any_image_size(size):
    """Several tiles, too, and images whose last blocks reach beyond the edge."""
    camera = make_camera(size, focal=0.8 * max(size))
    gaussians = calm(lambda seed: make_gaussians(16, seed, log_scales=(-4.0, -1.5)), camera, 3)
    assert_as_differences(gaussians, random_tangents(gaussians), camera)


@pytest.mark.parametrize(
    ("tangents", "message"),
    [
        ({"scales": np.zeros((10, 3))}, "'scales' is no parameter; choose from means, log_scales"),
        ({"quats": np.zeros((10, 3))}, r"quats has shape \(10, 3\), expected \(10, 4\), that of"),
        ({"means": "north"}, "means must be numbers of the parameter's shape"),
        ({"means": np.full((10, 3), 1e39)}, "means is NaN or infinite, first at Gaussian 0; rem"),
    ],
)
def test_bad_tangents_are_one_line(tangents, message):
    gaussians, camera = case(0)
    with pytest.raises(InputError, match=message) as error:
        jvp(gaussians, tangents, camera)
    assert "\n" not in str(error.value)
