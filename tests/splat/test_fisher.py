"""Fisher information, also of means and alpha, against a float64 Jacobian per pixel and channel;
as an operator, against the dense matrix."""

from dataclasses import replace
from itertools import product

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import fails
from scipy.linalg import block_diag

from mgs.gaussians import LEARNED
from mgs.splat import MEANS, Information, fisher, groups, information, jvp, render, vjp

from . import reference, scenes
from .scenes import (
    calm,
    changed,
    make_camera,
    make_clamped,
    make_gaussians,
    relative_error,
    with_gradients,
)

BACKGROUND = (0.3, 0.6, 0.1)
TOLERANCE = 1e-3
FLOOR = 1e-6
"""Entries below this share of the largest are compared absolutely."""
CORRELATION = {True: 2e-5, False: 1e-5}
"""Tolerance of blocks, by `antialiased`, as a share of sqrt(H_ii H_jj): columns have own units."""


def assert_close(found, expected, what=""):
    """Relative error TOLERANCE above FLOOR; 10 FLOOR TOLERANCE of the largest entry below."""
    assert found.dtype == np.float32
    assert found.shape == expected.shape
    size, error = np.abs(expected), np.abs(found - expected)
    big = size > FLOOR * size.max()
    relative = (error[big] / size[big]).max(initial=0)
    print(f"{what} worst relative error {relative:.1e} of {big.sum()} entries")
    assert relative < TOLERANCE, what
    assert error[~big].max(initial=0) <= 10 * TOLERANCE * FLOOR * size.max(), what


def diagonal(blocks) -> np.ndarray:
    return np.einsum("nii->ni", blocks)


def scale_of(blocks) -> np.ndarray:
    """sqrt(H_ii H_jj) of every entry."""
    return np.sqrt(diagonal(blocks)[:, :, None] * diagonal(blocks)[:, None, :])


def assert_right(g, camera, background=BACKGROUND, means="frozen", alpha_weight=0.0) -> None:
    """Both exact estimators against brute force."""
    options = {"means": means, "alpha_weight": alpha_weight}
    expected = reference.fisher_block(g, camera, background, **options)
    exact = fisher(g, camera, "exact", background, **options)
    block = fisher(g, camera, "block", background, **options)
    colours = exact[:, groups(g.sh_degree)["colour"]]
    np.testing.assert_array_equal(information.fisher_of_colours(g, camera), colours)
    what = f"degree {g.sh_degree}, means {means}, alpha {alpha_weight}"
    for name, columns in groups(g.sh_degree, means).items():
        for found in (exact, diagonal(block)):
            assert_close(found[:, columns], diagonal(expected)[:, columns], f"{what}, {name}")
    if means == "frozen":
        assert_close(block, expected, f"{what}, blocks")
    size = scale_of(expected)
    seen = size > FLOOR * size.max()
    error = (np.abs(block - expected)[seen] / size[seen]).max()
    print(f"{what}, blocks, worst error over sqrt(H_ii H_jj) {error:.1e}")
    assert error < CORRELATION[g.antialiased]
    np.testing.assert_array_equal(block, block.transpose(0, 2, 1))


FROZEN = product([0, 1, 2, 3], ["frozen"], [True, False])
MOVING = product([0, 1, 3], ["free"], [True])


@pytest.mark.parametrize(("degree", "means", "antialiased"), [*FROZEN, *MOVING])
def test_exact_and_block_against_brute_force(degree, means, antialiased):
    camera = make_camera()
    g = calm(lambda seed: make_clamped(seed, degree, antialiased=antialiased), camera, 20 + degree)
    projected = reference.project(g, camera)
    clamped = reference.composite(projected, camera)[3].any()
    assert clamped or antialiased, "no clamped alpha"
    assert (projected.colours[1] == 0).any(), "no clamped colour"
    for weight in (0.0, 0.3, 4.0):
        assert_right(g, camera, means=means, alpha_weight=weight)


def test_recorded_kernels_know_numbers_of_gaussians_from_other_numbers():
    """The kernels contain these numbers for other reasons (sums, pixels), too."""
    camera = make_camera()
    for n in (8, 10, 7, 22, 32, 4):
        g = calm(lambda seed, n=n: make_gaussians(n, seed, log_scales=(-4.0, -1.0)), camera, n)
        assert_right(g, camera)
        expected = reference.jacobian(g, camera, BACKGROUND).sum((0, 1))[:, :3]
        for names in (["sh"], ["sh", "means"]):
            model = scenes.with_gradients(g, names)
            dr.backward(dr.sum(render(model, camera, BACKGROUND).rgb, axis=None))
            found = scenes.gradients_of(model, ["sh"])["sh"][:, 0]
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("means", MEANS)
def test_images_of_several_tiles(means):
    camera = make_camera((150, 70), focal=165.0, eye=(0.2, -2.0, 1.0))
    g = calm(lambda seed: make_gaussians(60, seed, log_scales=(-5, -2)), camera, 3)
    assert_right(g, camera, means=means, alpha_weight=0.1)


@settings(derandomize=True, deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 2**31),
    degree=st.integers(0, 1),
    scale=st.floats(-5, -0.5),
    stretch=st.floats(0.1, 6),
    logit=st.floats(-2, 20),
    background=st.tuples(*[st.floats(0, 1)] * 3),
    eye=st.tuples(st.floats(0, 6.28), st.floats(-2, 2)),
    means=st.sampled_from(list(MEANS)),
    weight=st.sampled_from([0, 1e-3, 1, 100]),
    antialiased=st.booleans(),
)
def test_exact_and_block_for_any_scene(
    seed, degree, scale, stretch, logit, background, eye, means, weight, antialiased
):
    azimuth, height = eye
    camera = make_camera(eye=(2 * np.cos(azimuth), 2 * np.sin(azimuth), height))
    style = {"log_scales": (scale - stretch, scale), "logits": (logit - 4, logit)}
    g = calm(lambda s: make_clamped(s, degree, antialiased=antialiased, **style), camera, seed)
    assert_right(g, camera, background, means, weight)


def test_clamped_scale_carries_no_information():
    """A log-scale beyond LOG_SCALE_RANGE has derivative zero, and its neighbours have not."""
    camera, g = make_camera(), make_gaussians(16, 5)
    g.means[2], g.log_scales[2] = 0, (-30, -2, 30)
    exact, block = fisher(g, camera)[2], fisher(g, camera, "block")[2]
    assert (exact[[3, 5]] == 0).all()
    assert (exact[[0, 4, 10]] > 0).all()
    assert (block[[3, 5]] == 0).all()


def test_gradient_estimators_work_where_gradients_are_suspended():
    camera, g = make_camera(), make_gaussians(16, 6)
    with dr.suspend_grad():
        found = fisher(g, camera, "loss-gradient")
    np.testing.assert_array_equal(found, fisher(g, camera, "loss-gradient"))


def test_loss_gradient_is_the_square_of_its_loss():
    """L = mean (rgb - 0.5)^2, by the Jacobian of the reference."""
    camera, style = make_camera(), {"log_scales": (-3.0, -1.0), "logits": (-1, 4)}
    g = calm(lambda seed: make_gaussians(8, seed, **style), camera, 8)
    residual = reference.render(g, camera, BACKGROUND)["rgb"].reshape(-1, 3) - 0.5
    J = reference.jacobian(g, camera, BACKGROUND)
    true_slope = np.tensordot(2 / residual.size * residual, J, axes=([0, 1], [0, 1]))
    found = fisher(g, camera, "loss-gradient", BACKGROUND)
    assert relative_error(np.sqrt(found), np.abs(true_slope)) < 1e-4
    assert relative_error(found, true_slope**2) < 2e-4


@pytest.mark.parametrize("means", MEANS)
@pytest.mark.parametrize("degree", [0, 3])
def test_groups_tile_the_columns_and_means_come_last(degree, means):
    parts = groups(degree, means)
    sizes = {name: part.stop - part.start for name, part in parts.items()}
    expected = {"colour": 3 * (degree + 1) ** 2, "scale": 3, "rotation": 4, "opacity": 1}
    assert sizes == expected | ({"mean": MEANS[means]} if means != "frozen" else {})
    starts, stops = ([getattr(p, end) for p in parts.values()] for end in ("start", "stop"))
    assert starts == [0, *stops[:-1]]
    none = make_gaussians(0, 1, degree)
    empty = fisher(none, make_camera(), "block", means=means)
    assert empty.shape == (0, stops[-1], stops[-1])


def test_unseen_means_and_clamped_alphas_carry_no_information():
    camera, g = make_camera(), make_gaussians(16, 5, 1)
    g.means[3] = camera.position - 2 * camera.world_to_camera[2, :3]
    g.means[4] = camera.position
    options = {"means": "free", "alpha_weight": 2.0}
    exact, block = (fisher(g, camera, e, **options) for e in ("exact", "block"))
    assert (exact[[3, 4]] == 0).all()
    assert (block[[3, 4]] == 0).all()
    assert (exact[5, -3:] > 0).all()
    shape = {"means": np.zeros((1, 3)), "log_scales": np.full((1, 3), 6.0)}
    wide = changed(g[:1], logit_opacities=[20.0], sh=0 * g.sh[:1], **shape)
    assert (fisher(wide, camera, **options)[:, 12:] == 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"estimator": "magic"}, r"estimator 'magic': unknown; choose one of .*exact"),
        ({"means": "fixed"}, "means 'fixed': unknown; choose one of frozen, free"),
        ({"alpha_weight": -0.1}, r"fisher: alpha_weight -0\.1 must be from 0 to 1e[+]12"),
        ({"weights": np.ones((3, 4))}, r"weights of shape \(3, 4\) must be numbers from 0"),
        ({"weights": -np.ones(3)}, r"weights of shape \(3,\) must be numbers from 0"),
        ({"chosen": [7]}, "chosen names no Gaussians of 5"),
        ({"estimator": "loss-gradient", "means": "free"}, "'loss-gradient' has no means"),
    ],
)
def test_unusable_options_are_one_line(options, message):
    fails(message, fisher, make_gaussians(5, 0), make_camera(), **options)


def test_too_many_sums_are_refused(monkeypatch):
    camera, g = make_camera(), make_gaussians(16, 5)
    monkeypatch.setattr(information, "MAX_SUMS", 1024 * 24 + 1)
    fisher(g, camera, "block")
    fails("view: 1,024 pairs .*fewer than 682", fisher, g, camera, "block", means="free")


@pytest.mark.parametrize(("degree", "means"), [(0, "frozen"), (1, "free")])
def test_weights_and_chosen_gaussians_against_brute_force(degree, means):
    camera = make_camera()
    g = calm(lambda seed: make_clamped(seed, degree), camera, 30 + degree)
    J = reference.jacobian(g, camera, BACKGROUND, means, 0.3)
    weights = np.random.default_rng(0).uniform(0, 2, (camera.height, camera.width, 4))
    weights[:, :9] = 0
    for some, full in (
        (weights, weights),
        (weights[..., 0], weights[..., :1] * [1, 1, 1, 0] + [0, 0, 0, 1]),
        ([1, 0, 0], np.ones_like(weights) * [1, 0, 0, 1]),
    ):
        rows = (J * np.sqrt(full).reshape(-1, 4)[:, :, None, None]).reshape(-1, *J.shape[2:])
        expected = np.matmul(rows.transpose(1, 2, 0), rows.transpose(1, 0, 2))
        options = {"means": means, "alpha_weight": 0.3, "weights": some}
        block = fisher(g, camera, "block", BACKGROUND, **options)
        size = scale_of(expected)
        assert np.abs(block - expected)[size > 0].max() <= 1e-5 * size.max()
        exact = fisher(g, camera, "exact", BACKGROUND, **options)
        K = 3 * (degree + 1) ** 2
        assert_close(exact[:, :K], diagonal(expected)[:, :K])
        # Alone, Gaussian 5 would be hidden by nothing.
        for name, whole in (("exact", exact), ("block", block)):
            found = fisher(g, camera, name, BACKGROUND, chosen=[5, 2], **options)
            np.testing.assert_allclose(found, whole[[5, 2]], rtol=1e-5, atol=1e-5 * whole.max())


def test_several_cameras_are_each_alone():
    g, cameras = make_gaussians(16, 5), [make_camera(), make_camera(eye=(0.3, -2, 1))]
    for name in ("exact", "block"):
        alone = [fisher(g, camera, name, chosen=[3]) for camera in cameras]
        np.testing.assert_array_equal(fisher(g, cameras, name, chosen=[3]), alone)
    fails("weights must be 2 arrays", fisher, g, cameras, weights=[1])


CAMERAS = [make_camera((24, 16), 26.0), make_camera((24, 16), 26.0, (0.3, -2.0, 1.0))]
LAM = np.r_[np.full(8, 1e-2), np.full(3, 3e-2)]


@pytest.fixture(scope="module")
def gaussians():
    return calm(lambda seed: make_gaussians(6, seed, log_scales=(-3.0, -1.0)), CAMERAS[0], 3)


@pytest.fixture(scope="module")
def dense(gaussians):
    """Jacobian of both images [2 H W 3, N P]."""
    each = [reference.jacobian(gaussians, camera, BACKGROUND) for camera in CAMERAS]
    return np.concatenate([J.reshape(-1, J.shape[2] * J.shape[3]) for J in each])


def rows(parts) -> np.ndarray:
    return np.concatenate([np.float64(part).reshape(len(part), -1) for part in parts], 1)


def test_products_and_solutions_are_those_of_the_matrix(gaussians, dense):
    rng = np.random.default_rng(0)
    v, weights = rng.normal(size=(6, 11)), rng.uniform(0, 2, (2, 16, 24, 3))
    for of, W in ((None, 1), (weights, weights.ravel()[:, None])):
        info = Information(gaussians, CAMERAS, BACKGROUND, weights=of)
        H = dense.T @ (W * dense)
        expected = H @ v.ravel()
        error = np.linalg.norm(info.product(v).ravel() - expected)
        assert error < 1e-5 * np.linalg.norm(expected)


def test_log_determinant_solutions_and_samples_are_those_of_the_matrix(gaussians, dense):
    info = Information(gaussians, CAMERAS[:1], BACKGROUND)
    J = dense[: len(dense) // 2]
    A = J.T @ J + np.diag(np.tile(LAM, 6))
    true, found = np.linalg.slogdet(A)[1], info.log_det(LAM, probes=4, steps=12)
    assert abs(found.value - true) < 4 * found.error < 6
    # The same probes with the matrix itself, whitened by its blocks.
    L = block_diag(*np.linalg.cholesky(A.reshape(6, 11, 6, 11)[range(6), :, range(6)]))
    values, vectors = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, A).T))
    z = np.random.default_rng(0).choice([-1.0, 1.0], (4, 66))
    traces = ((z @ vectors) ** 2 * (np.log(values) + (1 - values) / 2)).sum(1)
    assert abs(found.value - 2 * np.log(np.diag(L)).sum() - traces.mean()) < 0.02
    v = np.random.default_rng(0).normal(size=(6, 11))
    x = np.linalg.solve(A, v.ravel())
    assert np.linalg.norm(info.solve(v, LAM, 1e-4).ravel() - x) < 1e-3 * np.linalg.norm(x)
    # x^T A x / sigma^2 of a draw x is chi-squared with a degree for each parameter.
    drawn, squares = info.samples(LAM, 4, pixel_noise=0.1, tolerance=1e-2), []
    for one in drawn:
        x = rows(getattr(one, name) - getattr(gaussians, name) for name in LEARNED).ravel()
        squares.append(x @ A @ x / 0.1**2)
    assert abs(np.mean(squares) - len(A)) < 4 * np.sqrt(2 * len(A) / len(drawn))


def test_reverse_products_are_the_gradient_and_the_transpose(gaussians):
    z = np.random.default_rng(1).normal(size=(2, 16, 24, 3))
    found = vjp(gaussians, z, CAMERAS, BACKGROUND)
    model = with_gradients(gaussians)
    dr.backward(dr.sum(render(model, CAMERAS, BACKGROUND).rgb * dr.llvm.ad.TensorXf(z), axis=None))
    for name, value in found.items():
        np.testing.assert_allclose(value, dr.grad(getattr(model, name)), rtol=1e-5, atol=1e-6)
    v = np.random.default_rng(2).normal(size=gaussians.means.shape)
    image = jvp(gaussians, {"means": v}, CAMERAS, BACKGROUND).rgb
    assert np.isclose((np.asarray(image) * z).sum(), (v * found["means"]).sum(), rtol=1e-4)
    alone = [jvp(gaussians, {"means": v}, camera, BACKGROUND).rgb for camera in CAMERAS]
    np.testing.assert_allclose(image, np.stack(alone), rtol=1e-6)


def test_without_views_the_prior_is_left_and_without_gaussians_nothing(gaussians):
    info, b = Information(gaussians, []), np.ones((6, 11))
    np.testing.assert_allclose(info.solve(b, LAM), b / LAM)
    np.testing.assert_allclose(info.solve(b, 2.0), b / 2)
    assert info.log_det(LAM).value == pytest.approx(6 * np.log(LAM).sum())
    assert len(info.samples(LAM, 1)[0]) == 6
    none = make_gaussians(0, 0)
    info = Information(none, CAMERAS)
    assert info.log_det(LAM) == (0, 0)
    assert len(info.samples(LAM, 1)[0]) == 0
    found = vjp(none, np.ones((16, 24, 3)), CAMERAS[0])
    assert {name: value.shape for name, value in found.items()} == {
        name: getattr(none, name).shape for name in found
    }


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda g: vjp(g, np.ones((2, 2, 3)), CAMERAS[0]), "cotangent: has shape"),
        (lambda g: vjp(g, 0, CAMERAS[0], by=["colour"]), "'colour' is no parameter"),
        (lambda g: render(g, []), "one or more cameras of one image size"),
        (lambda g: fisher(g, []), "takes one or more cameras"),
        (lambda g: Information(g, CAMERAS).product(np.ones(66)), "vector must be .*[(]6, 11[)]"),
        (lambda g: Information(g, CAMERAS).solve(np.ones((6, 11)), [1, 2]), "lam must be numbers"),
        (
            lambda g: Information(g, CAMERAS, weights=[np.ones(2)] * 2).product(np.ones((6, 11))),
            "weights of shape",
        ),
        (lambda g: Information(g, CAMERAS, weights=[1]), "weights must be 2 arrays"),
        (lambda g: Information(g, CAMERAS).log_det(LAM, probes=1), "give at least 2"),
        (lambda g: Information(g, CAMERAS).solve(np.ones((6, 11)), 0 * LAM), "must be positive"),
    ],
)
def test_what_cannot_be_is_one_line(gaussians, call, message):
    fails(message, call, replace(gaussians))
