"""Tangents of images (forward-mode derivatives) against the oracle, against the adjoint, and
through Dr.Jit's own AD."""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mgs.errors import InputError
from mgs.gaussians import LEARNED
from mgs.splat import ListCache, as_drjit, jvp, reference, render

from .scenes import PARAMETERS, calm, changed, compare, double, make_camera, make_gaussians
from .test_gradients import gradients, image_weights
from .test_robustness import CASES

BACKGROUND = (0.3, 0.6, 0.1)
OUTPUTS = ("rgb", "alpha", "depth")
TOLERANCE = 1e-5


def random_tangents(gaussians, seed=0, names=PARAMETERS) -> dict[str, np.ndarray]:
    """Independent normal numbers for each number of the parameters."""
    rng = np.random.default_rng([seed, 7])
    return {
        name: rng.normal(size=getattr(gaussians, name).shape).astype(np.float32) for name in names
    }


def images(image) -> dict[str, np.ndarray]:
    return {name: np.asarray(getattr(image, name)) for name in OUTPUTS}


def difference(gaussians, tangents, camera, step=1e-6) -> dict[str, np.ndarray]:
    """The derivative of the oracle's images along the tangents, by a central difference in
    float64."""
    ends = []
    for sign in (+1, -1):
        moved = double(gaussians)
        for name, tangent in tangents.items():
            setattr(moved, name, getattr(moved, name) + sign * step * tangent.astype(np.float64))
        ends.append(reference.render(moved, camera, BACKGROUND))
    return {name: (ends[0][name] - ends[1][name]) / (2 * step) for name in OUTPUTS}


@cache
def case(degree: int):
    """(gaussians, camera, the oracle's Jacobian): computed once for all tests of a degree."""
    camera = make_camera()
    gaussians = calm(
        lambda seed: make_gaussians(10, seed, degree, log_scales=(-4.0, -1.0)), camera, 30 + degree
    )
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
    error, sine, bias = compare(found["rgb"], expected)
    print(
        f"degree {degree} {'+'.join(names):40} relative L2 {error:.1e}  1 - cosine {sine:.1e}  bias {bias:+.1e}"
    )
    assert error < TOLERANCE


@pytest.mark.parametrize("names", [PARAMETERS, *((name,) for name in PARAMETERS[:4])])
@pytest.mark.parametrize("degree", [0, 2])
def test_all_images_change_as_differences_say(degree, names):
    """Means too, and alpha and depth."""
    gaussians, camera, _ = case(degree)
    tangents = random_tangents(gaussians, 10 + degree, names)
    found, expected = (
        images(jvp(gaussians, tangents, camera, BACKGROUND)),
        difference(gaussians, tangents, camera),
    )
    for output in OUTPUTS:
        error, _, _ = compare(found[output], expected[output])
        print(f"degree {degree} {'+'.join(names):50} {output:5} relative L2 {error:.1e}")
        assert error < TOLERANCE, output


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**31),
    degree=st.integers(0, 3),
    scale=st.floats(-5, -0.5),
    stretch=st.floats(0.1, 4),
    logit=st.floats(-2, 10),
    names=st.sets(st.sampled_from(PARAMETERS), min_size=1),
)
def test_tangents_and_gradients_are_of_one_jacobian(seed, degree, scale, stretch, logit, names):
    """<u, J v> = <J^T u, v> for random images u and tangents v: forward and reverse mode, two
    different kernels."""
    camera = make_camera()
    gaussians = make_gaussians(12, seed, degree, (scale - stretch, scale), (logit - 4, logit))
    tangents, u = random_tangents(gaussians, seed, sorted(names)), image_weights(camera, seed)
    Jv = images(jvp(gaussians, tangents, camera, BACKGROUND))
    JTu = gradients(gaussians, camera, u, tuple(tangents))
    forward = sum(float((Jv[name] * u[name]).sum(dtype=np.float64)) for name in OUTPUTS)
    reverse = sum(float((JTu[name] * tangents[name]).sum(dtype=np.float64)) for name in tangents)
    size = np.sqrt(sum((Jv[name].astype(np.float64) ** 2).sum() for name in OUTPUTS))
    size *= np.sqrt(sum((u[name] ** 2).sum() for name in OUTPUTS))
    print(
        f"{abs(forward - reverse) / size:.1e} of |u| |J v|, {abs(forward - reverse) / abs(forward):.1e} of <u, J v>"
    )
    assert abs(forward - reverse) <= 1e-6 * size


@pytest.mark.parametrize("eye", [(2.0, 0.4, 1.1), (-1.5, 1.0, 0.3), (0.1, 0.2, 2.5)])
@pytest.mark.parametrize("degree", [0, 2])
def test_means_have_one_jacobian_too(degree, eye):
    """<u, J v> = <J^T u, v> where the means alone change, from several cameras."""
    camera, gaussians = make_camera(eye=eye), make_gaussians(30, 5, degree, log_scales=(-4.0, -1.5))
    v, u = random_tangents(gaussians, degree, ["means"]), image_weights(camera, degree)
    Jv, JTu = (
        images(jvp(gaussians, v, camera, BACKGROUND)),
        gradients(gaussians, camera, u, ("means",)),
    )
    forward = sum(float((Jv[name] * u[name]).sum(dtype=np.float64)) for name in OUTPUTS)
    reverse = float((JTu["means"] * v["means"]).sum(dtype=np.float64))
    sizes = [
        np.sqrt(sum((image[name].astype(np.float64) ** 2).sum() for name in OUTPUTS))
        for image in (Jv, u)
    ]
    assert sizes[0] > 1
    assert abs(forward - reverse) <= 1e-6 * sizes[0] * sizes[1]


def test_forward_mode_of_drjit_through_render():
    """`dr.forward` from a number t that moves parameters and background gives `jvp`, and what the
    background adds to it."""
    gaussians, camera, _ = case(1)
    tangents = random_tangents(gaussians)
    t = mi.Float(0)
    dr.enable_grad(t)
    model = as_drjit(gaussians)
    for name in PARAMETERS:
        setattr(model, name, getattr(model, name) + t * mi.TensorXf(tangents[name]))
    change = np.array([0.5, -1, 2], np.float32)
    image = render(model, camera, mi.Color3f(*BACKGROUND) + t * mi.Color3f(*change.tolist()))
    dr.forward(t)
    found, expected = images(dr.grad(image)), images(jvp(gaussians, tangents, camera, BACKGROUND))
    expected["rgb"] = expected["rgb"] + (1 - np.asarray(dr.detach(image.alpha)))[..., None] * change
    for output in OUTPUTS:
        np.testing.assert_allclose(
            found[output], expected[output], rtol=1e-5, atol=1e-5, err_msg=output
        )
        assert np.abs(found[output]).max() > 1


def test_a_loss_has_the_derivative_of_its_gradient():
    """Forward mode goes on through whatever is computed from the image: a loss by t is its gradient
    times the tangents."""
    gaussians, camera, _ = case(0)
    tangents = random_tangents(gaussians, 1, LEARNED)
    model = as_drjit(gaussians)
    for name in LEARNED:
        setattr(model, name, dr.copy(getattr(model, name)))
        dr.enable_grad(getattr(model, name))

    def loss():
        image = render(model, camera, BACKGROUND)
        return dr.mean(dr.square(image.rgb), axis=None) + dr.mean(
            image.alpha * image.depth, axis=None
        )

    dr.backward(loss())
    expected = sum(
        float((np.asarray(dr.grad(getattr(model, name))) * tangents[name]).sum())
        for name in LEARNED
    )
    for name in LEARNED:
        dr.set_grad(getattr(model, name), mi.TensorXf(tangents[name]))
    found = float(dr.forward_to(loss()).array[0])
    assert found == pytest.approx(expected, rel=1e-4)


def test_enabled_gradients_and_suspended_ones_play_no_part():
    gaussians, camera, _ = case(0)
    tangents = random_tangents(gaussians)
    expected = images(jvp(gaussians, tangents, camera, BACKGROUND))
    watched = as_drjit(gaussians)
    dr.enable_grad(watched.sh)
    background = mi.Color3f(*BACKGROUND)
    dr.enable_grad(background)
    dr.set_grad(background, 1)
    with dr.suspend_grad():
        found = jvp(
            watched,
            {name: mi.TensorXf(value) for name, value in tangents.items()},
            camera,
            background,
        )
    assert not dr.grad_enabled(found)
    assert not np.any(dr.grad(watched.sh))
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


def test_nothing_changes_where_something_is_clamped():
    """A colour at 0, a log-scale outside its range, an alpha at ALPHA_MAX: no tangent, and
    neighbours keep theirs."""
    gaussians, camera, _ = case(0)
    dark = changed(gaussians, sh=np.where(np.arange(10)[:, None, None] == 3, -10, gaussians.sh))
    tangent = np.zeros_like(gaussians.sh)
    tangent[3] = 1
    assert not images(jvp(dark, {"sh": tangent}, camera))["rgb"].any()
    assert images(jvp(gaussians, {"sh": tangent}, camera))["rgb"].any()

    thin = changed(
        gaussians,
        log_scales=np.where(np.arange(10)[:, None] == 2, (-30, -2, -2), gaussians.log_scales),
    )
    tangent = np.zeros_like(gaussians.log_scales)
    tangent[2, 0] = 1
    assert not images(jvp(thin, {"log_scales": tangent}, camera))["rgb"].any()
    tangent[2, 1] = 1
    assert images(jvp(thin, {"log_scales": tangent}, camera))["rgb"].any()

    wide = changed(
        gaussians[:1],
        means=np.zeros((1, 3)),
        log_scales=np.full((1, 3), 0.5),
        logit_opacities=[20.0],
    )
    alpha = np.asarray(render(wide, camera).alpha)
    change = images(jvp(wide, {"log_scales": np.ones((1, 3))}, camera))["alpha"]
    clamped = alpha >= np.float32(0.999)
    assert clamped.any()
    assert not clamped.all()
    assert not change[clamped].any()
    assert (change[(alpha > 0.01) & ~clamped] > 0).all()


@pytest.mark.parametrize("name", CASES)
def test_tangents_of_extreme_scenes_are_finite(name):
    gaussians, camera = CASES[name](), make_camera()
    for change in images(jvp(gaussians, random_tangents(gaussians), camera, BACKGROUND)).values():
        assert np.isfinite(change).all()


@pytest.mark.parametrize("size", [(1, 1), (9, 5), (150, 70)])
def test_any_image_size(size):
    """Also of several tiles, and whose last blocks reach beyond its edge."""
    camera = make_camera(size, focal=0.8 * max(size))
    gaussians = calm(lambda seed: make_gaussians(16, seed, log_scales=(-4.0, -1.5)), camera, 3)
    tangents = random_tangents(gaussians)
    found, expected = (
        images(jvp(gaussians, tangents, camera, BACKGROUND)),
        difference(gaussians, tangents, camera),
    )
    for output in OUTPUTS:
        assert found[output].shape == expected[output].shape
        assert compare(found[output], expected[output])[0] < TOLERANCE, output


def test_a_cache_changes_nothing():
    """Kept lists, and those that replace them, give the bits of lists made for the call."""
    camera, gaussians, kept = (
        make_camera(),
        make_gaussians(60, 3, log_scales=(-5.0, -1.5)),
        ListCache(),
    )
    for growth in (0, 0, -0.5, 0.3):
        grown = changed(gaussians, log_scales=gaussians.log_scales + np.float32(growth))
        tangents = random_tangents(grown)
        found, expected = (
            images(jvp(grown, tangents, camera, BACKGROUND, lists)) for lists in (kept, None)
        )
        for output in OUTPUTS:
            np.testing.assert_array_equal(found[output], expected[output])
    assert kept.builds == 3


@pytest.mark.parametrize("scale", [1, 1e-12, 1e-28, 1e-36])
def test_reruns_are_bitwise_equal(scale):
    """With 1 and 2 threads, and for changes so small that some threads would flush them to 0."""
    camera = make_camera((200, 150), focal=200.0)
    gaussians = make_gaussians(1500, 11, 1, log_scales=(-6.0, -2.5))
    tangents = {
        name: np.float32(scale) * value for name, value in random_tangents(gaussians).items()
    }
    runs = []
    for threads in (1, 2, 2):
        before = dr.thread_count()
        dr.set_thread_count(threads)
        runs.append(
            {
                name: value.tobytes()
                for name, value in images(jvp(gaussians, tangents, camera, BACKGROUND)).items()
            }
        )
        dr.set_thread_count(before)
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
        (
            {"scales": np.zeros((10, 3))},
            "tangents: 'scales' is no parameter; choose from means, log_scales, quats, ",
        ),
        (
            {"quats": np.zeros((10, 3))},
            r"tangents: quats has shape \(10, 3\), expected \(10, 4\), that of the parameter",
        ),
        (
            {"sh": dr.zeros(mi.TensorXf, (10, 3))},
            r"tangents: sh has shape \(10, 3\), expected \(10, 1, 3\), that of the parameter",
        ),
        ({"means": "north"}, "tangents: means must be numbers of the parameter's shape"),
        (
            {"means": np.full((10, 3), np.nan)},
            "tangents: means is NaN or infinite, first at Gaussian 0; remove or repair it",
        ),
        (
            {"means": np.full((10, 3), 1e39)},
            "tangents: means is NaN or infinite, first at Gaussian 0; remove or repair it",
        ),
    ],
)
def test_bad_tangents_are_one_line(tangents, message):
    gaussians, camera, _ = case(0)
    with pytest.raises(InputError, match=message) as error:
        jvp(gaussians, tangents, camera)
    assert "\n" not in str(error.value)


def test_bad_gaussians_are_those_of_render():
    gaussians, camera, _ = case(0)
    broken = changed(
        gaussians, quats=np.where(np.arange(10)[:, None] == 5, np.nan, gaussians.quats)
    )
    with pytest.raises(InputError, match="quats is NaN or infinite, first at Gaussian 5"):
        jvp(broken, random_tangents(gaussians), camera)
