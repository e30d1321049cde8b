"""Gradients of images against the float64 reference, judged as vectors by the relative L2 error.
Scenes have no pixel near a threshold, where no gradient exists.
"""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mgs.gaussians import ARRAYS
from mgs.splat import Image, reference, render
from mgs.splat.rendering import composite_channels, splats_and_lists

from .scenes import (
    calm,
    changed,
    double,
    gradients_of,
    make_camera,
    make_clamped,
    make_gaussians,
    margins,
    relative_error,
    with_gradients,
)

BACKGROUND = (0.3, 0.6, 0.1)
OUTPUTS = ("rgb", "alpha", "depth")
TOLERANCE = 1e-4


def image_weights(camera, seed=0) -> dict[str, np.ndarray]:
    """Random gradients of a loss by each output image."""
    rng, shape = np.random.default_rng([seed, 99]), (camera.height, camera.width)
    sizes = {"rgb": (*shape, 3), "alpha": shape, "depth": shape}
    return {name: rng.normal(0, 1, size) for name, size in sizes.items()}


def gradients(gaussians, camera, weights, wanted=ARRAYS) -> dict[str, np.ndarray]:
    """Gradient of sum(weight * image), summed over the outputs, by `dr.backward`."""
    model = with_gradients(gaussians, wanted)
    image = render(model, camera, BACKGROUND)
    weights = {name: mi.TensorXf(w.astype(np.float32)) for name, w in weights.items()}
    dr.backward(sum(dr.sum(getattr(image, name) * w, axis=None) for name, w in weights.items()))
    return gradients_of(model, wanted)


def dot(image, weights) -> np.ndarray:
    return np.array([(image[name] * weights[name]).sum() for name in OUTPUTS])


def differences(gaussians, camera, weights, wanted, step=1e-6) -> dict[str, np.ndarray]:
    """{parameter: [3 outputs, shape of the parameter]} by central differences."""
    result = {}
    for name in wanted:
        values = getattr(gaussians, name)
        gradient = np.zeros((len(OUTPUTS), *values.shape))
        for index in np.ndindex(values.shape):
            ends = []
            for sign in (+1, -1):
                moved = double(gaussians)
                getattr(moved, name)[index] += sign * step
                ends.append(dot(reference.render(moved, camera, BACKGROUND), weights))
            gradient[(slice(None), *index)] = (ends[0] - ends[1]) / (2 * step)
        result[name] = gradient
    return result


@cache
def case(degree: int):
    """(gaussians, camera, weights, expected gradients per output). Of even degrees not
    antialiased, so that alphas are clamped at ALPHA_MAX."""
    camera, antialiased = make_camera(), degree % 2 == 1
    gaussians = calm(lambda seed: make_clamped(seed, degree, 10, antialiased), camera, 10 + degree)
    weights = image_weights(camera, degree)
    return gaussians, camera, weights, differences(gaussians, camera, weights, ARRAYS)


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradient_of_each_output(degree, output):
    gaussians, camera, weights, expected = case(degree)
    wanted = ARRAYS if output == "rgb" else ARRAYS[:4]  # no colour changes alpha or depth
    found = gradients(gaussians, camera, {output: weights[output]}, wanted)
    for name in wanted:
        truth = expected[name][OUTPUTS.index(output)]
        assert found[name].shape == getattr(gaussians, name).shape
        assert relative_error(found[name], truth) < TOLERANCE / 2, name


@pytest.mark.parametrize("seed", [4, 5])
def test_gradient_of_the_depth_of_faint_splats(seed):
    """Expected depth is a quotient by alpha, here a few 1/255."""
    camera = make_camera()
    gaussians = make_gaussians(5, seed, logits=(-3, -1))
    assert margins(gaussians, camera).min() > 1e-3
    weights = image_weights(camera, seed)
    wanted = ARRAYS[:4]
    found = gradients(gaussians, camera, {"depth": weights["depth"]}, wanted)
    expected = differences(gaussians, camera, weights, wanted)
    for name in wanted:
        assert relative_error(found[name], expected[name][OUTPUTS.index("depth")]) < TOLERANCE, name


LOSSES = {
    "a part of alpha": lambda image: image.alpha[10:20, 5:30],
    "columns of alpha": lambda image: dr.square(dr.sum(image.alpha, axis=0)),
    "alpha times rgb": lambda image: image.alpha[..., None] * image.rgb,
    "rgba": lambda image: dr.square(dr.concat([image.rgb, image.alpha[..., None]], axis=2)),
    "columns of depth": lambda image: dr.square(dr.sum(image.depth, axis=0)),
}


@pytest.mark.parametrize("loss", LOSSES)
def test_gradient_of_any_loss(loss):
    """Losses that slice, join and reduce images, against the same loss in two steps."""
    gaussians, camera, _, _ = case(1)
    model = with_gradients(gaussians, ["log_scales"])
    image = render(model, camera, BACKGROUND)
    leaf = Image(*(dr.copy(dr.detach(getattr(image, name))) for name in OUTPUTS))
    dr.enable_grad(leaf)
    dr.backward(dr.sum(LOSSES[loss](leaf), axis=None))
    dr.backward(dr.sum(LOSSES[loss](image), axis=None))
    weights = {name: np.asarray(dr.grad(getattr(leaf, name))) for name in OUTPUTS}
    expected = gradients(gaussians, camera, weights, ("log_scales",))["log_scales"]
    assert relative_error(gradients_of(model, ["log_scales"])["log_scales"], expected) < 1e-5


@pytest.mark.parametrize("means", [False, True])
@pytest.mark.parametrize("channels", [3, 4])
def test_some_channels_alone_have_the_same_image_and_derivatives(means, channels):
    """`composite_channels` against `render` over black."""
    camera, gaussians = make_camera(), make_gaussians(60, 3, 1, log_scales=(-5.0, -1.5))
    weights = image_weights(camera)
    weights = np.dstack([weights["rgb"], weights["alpha"]])[..., :channels].astype(np.float32)
    wanted = ARRAYS if means else ARRAYS[1:]

    def alone(model):
        splats, lists, packed = splats_and_lists(model, camera, None)
        return composite_channels(splats, packed, lists, camera.width, camera.height, channels)

    def together(model):
        image = render(model, camera)
        rgba = mi.Vector4f(*mi.Color3f(dr.unravel(mi.Color3f, image.rgb.array)), image.alpha.array)
        shape = (camera.height, camera.width, 4)
        return image.rgb if channels == 3 else mi.TensorXf(dr.ravel(rgba), shape)

    def derivatives(draw):
        """Image, tangent along the parameters' own values, and gradients by them."""
        model = with_gradients(gaussians, wanted)
        for name in wanted:
            dr.set_grad(getattr(model, name), getattr(gaussians, name))
        rgb = draw(model)
        dr.forward_to(rgb)
        results = [dr.detach(rgb), dr.grad(rgb)]
        model = with_gradients(gaussians, wanted)
        dr.backward(dr.sum(draw(model) * mi.TensorXf(weights), axis=None))
        return [np.asarray(r) for r in (*results, *gradients_of(model, wanted).values())]

    expected, found = derivatives(together), derivatives(alone)
    np.testing.assert_array_equal(found[0][..., :3], expected[0][..., :3])
    assert np.abs(found[0] - expected[0]).max() < 1e-6  # alpha: 1 - T, not the sum of weights
    for name, a, b in zip(("tangent", *wanted), found[1:], expected[1:], strict=True):
        assert relative_error(a, b) < 1e-5, name


def test_gradient_stops_where_a_scale_is_clamped():
    gaussians, camera, weights, _ = case(1)
    scales = gaussians.log_scales.copy()
    scales[2, 1], scales[4, 0] = -30, 30
    found = gradients(changed(gaussians, log_scales=scales), camera, {"rgb": weights["rgb"]})
    assert found["log_scales"][2, 1] == found["log_scales"][4, 0] == 0
    assert all(np.isfinite(g).all() for g in found.values())


@settings(derandomize=True, deadline=None, max_examples=10)
@given(
    seed=st.integers(0, 2**31),
    degree=st.integers(0, 3),
    scale=st.floats(-5, -0.5),
    stretch=st.floats(0.1, 4),
    logit=st.floats(-2, 10),
    focal=st.floats(20, 80),
    antialiased=st.booleans(),
)
def test_gradient_for_any_scene(seed, degree, scale, stretch, logit, focal, antialiased):
    camera, style = make_camera(focal=focal), {"antialiased": antialiased}
    style |= {"log_scales": (scale - stretch, scale), "logits": (logit - 4, logit)}
    gaussians = calm(lambda s: make_gaussians(10, s, degree, **style), camera, seed)
    weights = {"rgb": image_weights(camera, seed)["rgb"]}
    J = reference.jacobian(gaussians, camera, BACKGROUND)
    expected = np.tensordot(weights["rgb"].reshape(-1, 3), J, axes=([0, 1], [0, 1]))
    found = gradients(gaussians, camera, weights, ARRAYS[1:])
    K = 3 * (degree + 1) ** 2
    parts = np.split(expected, (K, K + 3, K + 7), axis=1)
    for name, part in zip(("sh", *ARRAYS[1:4]), parts, strict=True):
        error = np.linalg.norm(found[name].reshape(10, -1) - part)
        assert error < TOLERANCE * np.linalg.norm(part) + 1e-12, name
