"""Gradients and tangents of images against the float64 reference, judged as vectors by the relative
L2 error, and against one another. Scenes have no pixel near a threshold, where no derivative
exists.
"""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import fails

from mgs import splat
from mgs.gaussians import ARRAYS, LEARNED
from mgs.splat import as_drjit, fisher, fisher_derivatives, groups, jvp, moved, render

from . import reference, scenes
from .scenes import calm, make_camera, make_clamped, make_gaussians, relative_error, with_gradients

BACKGROUND = (0.3, 0.6, 0.1)
OUTPUTS = ("rgb", "alpha", "depth")
GRADIENT, TANGENT = 1e-4, 1e-5
"""Tolerances."""


@cache
def case(degree: int):
    """(gaussians, camera). Of even degrees not antialiased, so that alphas are clamped."""
    camera, antialiased = make_camera(), degree % 2 == 1
    gaussians = calm(lambda seed: make_clamped(seed, degree, 10, antialiased), camera, 30 + degree)
    clamped = reference.composite(reference.project(gaussians, camera), camera)[3]
    assert clamped.any() or antialiased
    return gaussians, camera


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
    return scenes.gradients_of(model, wanted)


def random_tangents(gaussians, seed=0, names=ARRAYS) -> dict[str, np.ndarray]:
    rng = np.random.default_rng([seed, 7])
    shapes = {name: getattr(gaussians, name).shape for name in names}
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def images(image) -> dict[str, np.ndarray]:
    return {name: np.asarray(getattr(image, name)) for name in OUTPUTS}


LOSSES = {
    "a part of alpha": lambda image: image.alpha[10:20, 5:30],
    "rgba": lambda image: dr.square(dr.concat([image.rgb, image.alpha[..., None]], axis=2)),
    "columns of depth": lambda image: dr.square(dr.sum(image.depth, axis=0)),
}


@pytest.mark.parametrize("loss", LOSSES)
def test_gradient_of_any_loss(loss):
    gaussians, camera = case(1)
    model = with_gradients(gaussians, ["log_scales"])
    image = render(model, camera, BACKGROUND)
    leaf = splat.Image(*(dr.copy(dr.detach(getattr(image, name))) for name in OUTPUTS))
    dr.enable_grad(leaf)
    dr.backward(dr.sum(LOSSES[loss](leaf), axis=None))
    dr.backward(dr.sum(LOSSES[loss](image), axis=None))
    weights = {name: np.asarray(dr.grad(getattr(leaf, name))) for name in OUTPUTS}
    expected = gradients(gaussians, camera, weights, ("log_scales",))["log_scales"]
    assert relative_error(scenes.gradients_of(model, ["log_scales"])["log_scales"], expected) < 1e-5


def test_gradient_stops_where_a_scale_is_clamped():
    gaussians, camera = case(1)
    scales = gaussians.log_scales.copy()
    scales[2, 1], scales[4, 0] = -30, 30
    found = gradients(scenes.changed(gaussians, log_scales=scales), camera, image_weights(camera))
    assert found["log_scales"][2, 1] == found["log_scales"][4, 0] == 0
    assert all(np.isfinite(g).all() for g in found.values())


SCENE = {
    "seed": st.integers(0, 2**31),
    "degree": st.integers(0, 3),
    "scale": st.floats(-5, -0.5),
    "stretch": st.floats(0.1, 4),
    "logit": st.floats(-2, 10),
    "antialiased": st.booleans(),
}


@settings(derandomize=True, deadline=None, max_examples=10)
@given(**SCENE, focal=st.floats(20, 80))
def test_tangents_for_any_scene(seed, degree, scale, stretch, logit, focal, antialiased):
    camera, style = make_camera(focal=focal), {"antialiased": antialiased}
    style |= {"log_scales": (scale - stretch, scale), "logits": (logit - 4, logit)}
    gaussians = calm(lambda s: make_gaussians(10, s, degree, **style), camera, seed)
    J = reference.jacobian(gaussians, camera, BACKGROUND, "free", 1.0)
    K = 3 * (degree + 1) ** 2
    parts = np.split(J, (K, K + 3, K + 7, K + 8), axis=3)
    for name, part in zip((*LEARNED, "means"), parts, strict=True):
        tangent = random_tangents(gaussians, seed, [name])
        change = jvp(gaussians, tangent, camera, BACKGROUND)
        found = np.dstack([change.rgb, change.alpha]).reshape(-1, 4)
        expected = np.tensordot(part, tangent[name].reshape(10, -1), 2)
        error = np.linalg.norm(found - expected)
        assert error < GRADIENT * np.linalg.norm(expected) + 1e-12, name


def assert_as_differences(gaussians, tangents, camera) -> None:
    found = images(jvp(gaussians, tangents, camera, BACKGROUND))
    expected = scenes.difference(gaussians, tangents, camera, BACKGROUND)
    for output in OUTPUTS:
        assert found[output].shape == expected[output].shape
        assert relative_error(found[output], expected[output]) < TANGENT, output


@pytest.mark.parametrize("names", [ARRAYS, *((name,) for name in ARRAYS[:4])])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_all_images_change_as_differences_say(degree, names):
    gaussians, camera = case(degree)
    assert_as_differences(gaussians, random_tangents(gaussians, 10 + degree, names), camera)


@settings(derandomize=True, deadline=None, max_examples=30)
@given(
    **SCENE,
    names=st.sets(st.sampled_from(ARRAYS), min_size=1),
    outputs=st.sampled_from([OUTPUTS, ("rgb",), ("rgb", "alpha"), ("depth",)]),
)
def test_tangents_and_gradients_are_of_one_jacobian(
    seed, degree, scale, stretch, logit, names, antialiased, outputs
):
    """<u, J v> = <J^T u, v>: forward and reverse mode are two different kernels."""
    camera, style = make_camera(), {"log_scales": (scale - stretch, scale)}
    gaussians = make_clamped(seed, degree, 12, antialiased, **style, logits=(logit - 4, logit))
    tangents = random_tangents(gaussians, seed, sorted(names))
    weights = image_weights(camera, seed)
    u = {name: weights[name] for name in outputs}
    Jv = images(jvp(gaussians, tangents, camera, BACKGROUND))
    JTu = gradients(gaussians, camera, u, tuple(tangents))
    forward = sum(float((Jv[name] * u[name]).sum(dtype=np.float64)) for name in u)
    reverse = sum(float((JTu[name] * tangents[name]).sum(dtype=np.float64)) for name in tangents)
    squares = [sum((image[n].astype(float) ** 2).sum() for n in u) for image in (Jv, u)]
    assert abs(forward - reverse) <= 3e-6 * np.sqrt(squares[0] * squares[1])


def test_forward_mode_of_drjit_through_render():
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


@pytest.mark.parametrize("seed", [4, 5])
def test_the_depth_of_faint_splats(seed):
    """Expected depth is a quotient by alpha, here a few 1/255."""
    camera, gaussians = make_camera(), make_gaussians(5, seed, logits=(-3, -1))
    assert scenes.margins(gaussians, camera).min() > 1e-3
    assert_as_differences(gaussians, random_tangents(gaussians, seed), camera)


@pytest.mark.parametrize("size", [(1, 1), (9, 5), (150, 70)])
def test_any_image_size(size):
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
    fails(message, jvp, gaussians, tangents, camera)


@pytest.mark.parametrize(
    "start", [np.zeros(7), np.array([0.02, -0.01, 0.03, 0.05, -0.02, 0.01, 0.1])]
)
@pytest.mark.parametrize("degree", [0, 3])
def test_images_are_differentiated_by_the_pose_and_the_focal_length(degree, start):
    camera = make_camera()
    weights = image_weights(camera)

    def at(numbers):
        return moved(camera, dr.concat([mi.Float64(x) for x in numbers[:6]]), numbers[6])

    make = lambda seed: make_clamped(seed, degree, 10, degree == 3)  # noqa: E731
    gaussians = calm(make, at(start), 30, least=3e-4)

    for i, unit in enumerate(2e-7 * np.eye(7)):
        ends = [reference.render(gaussians, at(start + step), BACKGROUND) for step in (unit, -unit)]
        expected = {name: (ends[0][name] - ends[1][name]) / 4e-7 for name in OUTPUTS}
        for mode in ("forward", "backward"):
            change, numbers = mi.Float(0), [mi.Float64(x) for x in start]
            dr.enable_grad(change)
            numbers[i] += change
            image = render(gaussians, at(numbers), BACKGROUND)
            if mode == "forward":
                dr.forward(change)
                for name in OUTPUTS:
                    found = dr.grad(getattr(image, name))
                    assert relative_error(found, expected[name]) < TANGENT, (i, name)
            else:
                drawn = (getattr(image, n) * mi.TensorXf(np.float32(weights[n])) for n in OUTPUTS)
                dr.backward(sum(dr.sum(one, axis=None) for one in drawn))
                total = sum((expected[name] * weights[name]).sum() for name in OUTPUTS)
                size = sum(np.abs(expected[name] * weights[name]).sum() for name in OUTPUTS)
                assert abs(float(dr.grad(change)[0]) - total) < 1e-5 * size


@pytest.mark.parametrize("degree", [0, 3])
def test_information_is_differentiated_by_the_pose_and_the_focal_length(degree):
    """Against differences of the reference; half the scenes are antialiased, and half clamped."""
    camera, step = make_camera(), 4e-7
    make = lambda seed: make_clamped(seed, degree, 8, degree == 3)  # noqa: E731
    gaussians = calm(make, camera, 40, least=3e-4)
    found = fisher_derivatives(gaussians, camera, BACKGROUND)
    expected = []
    for x in step * np.eye(7):
        there = [moved(camera, mi.Float64(y[:6].tolist()), y[6]) for y in (x, -x)]
        up, down = (reference.fisher(gaussians, one, BACKGROUND) for one in there)
        expected.append((up - down) / (2 * step))
    for numbers in (slice(0, 3), slice(3, 6), slice(6, 7)):
        for name, columns in groups(degree).items():
            parts = (np.stack(all_)[numbers, :, columns] for all_ in (found, expected))
            assert relative_error(*parts) < 2 * GRADIENT, (numbers, name)
    window = camera.cropped(7, 3, 20, 11), camera.cropped(27, 3, 18, 11)
    parts = [fisher_derivatives(gaussians, one, BACKGROUND) for one in window]
    whole = fisher_derivatives(gaussians, camera.cropped(7, 3, 38, 11), BACKGROUND)
    assert relative_error(sum(parts), whole) < TANGENT


def test_where_a_camera_has_no_derivative_a_line_says_so():
    gaussians, camera = case(0)
    motion = mi.Float64([0.0] * 6)
    dr.enable_grad(motion)
    fails("use mgs", fisher, gaussians, moved(camera, motion))
    still = moved(camera, dr.detach(motion))
    assert np.array_equal(fisher(gaussians, still), fisher(gaussians, camera))
    fails("origin", moved(camera, motion).seen_from, (1, 0, 0))
    frozen = dr.freeze(lambda x: render(gaussians, camera).rgb * x)
    with pytest.raises(RuntimeError) as error:
        frozen(mi.Float(1))
    assert "outside of `dr.freeze`" in str(error.value.__cause__)
