"""Products with the Jacobian, and the information as an operator, against the dense matrix."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from refusals import fails
from scipy.linalg import block_diag

from mgs.gaussians import LEARNED
from mgs.splat import Information, jvp, reference, render, vjp

from .scenes import calm, make_camera, make_gaussians, with_gradients

CAMERAS = [make_camera((24, 16), 26.0), make_camera((24, 16), 26.0, (0.3, -2.0, 1.0))]
BACKGROUND = (0.3, 0.6, 0.1)
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
    for given, W in ((None, 1), (weights, weights.ravel()[:, None])):
        info = Information(gaussians, CAMERAS, BACKGROUND, weights=given)
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


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda g: vjp(g, np.ones((2, 2, 3)), CAMERAS[0]), "cotangent: has shape"),
        (lambda g: vjp(g, 0, CAMERAS[0], by=["colour"]), "'colour' is no parameter"),
        (lambda g: render(g, []), "one or more cameras of one image size"),
        (lambda g: Information(g, CAMERAS, weights=[1]), "weights must be 2 arrays"),
        (lambda g: Information(g, CAMERAS).log_det(LAM, probes=1), "give at least 2"),
        (lambda g: Information(g, CAMERAS).solve(np.ones((6, 11)), 0 * LAM), "must be positive"),
    ],
)
def test_what_cannot_be_is_one_line(gaussians, call, message):
    fails(message, call, replace(gaussians))
