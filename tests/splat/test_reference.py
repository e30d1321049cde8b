"""The oracle itself: camera convention, projection, derivatives against central differences, all in float64."""

import numpy as np
import pytest

from mgs.colour import SH_C0
from mgs.gaussians import Gaussians
from mgs.rotation import rotmat_from_quat
from mgs.splat import reference
from mgs.splat.constants import EPS2D

from .scenes import calm, double, make_camera, make_gaussians, place

BACKGROUND = (0.2, 0.7, 0.4)


def single(mean, **values) -> Gaussians:
    """One round, nearly opaque white Gaussian."""
    one = Gaussians(
        np.asarray(mean, np.float64)[None],
        np.full((1, 3), -3.0),
        np.array([[1.0, 0, 0, 0]]),
        np.array([3.0]),
        np.full((1, 1, 3), 0.5 / SH_C0),
    )
    return Gaussians(**{**vars(one), **values})


@pytest.mark.parametrize(("pixel", "depth"), [((11.5, 8.5), 1.5), ((33.0, 20.25), 2.5), ((22.5, 13.5), 4.0)])
def test_gaussian_lands_on_the_pixel_of_the_camera(pixel, depth):
    camera = make_camera()
    mean = place(camera, [pixel], [depth])[0]
    np.testing.assert_allclose(camera.project([mean])[0][0], pixel, atol=1e-9)
    image = reference.render(single(mean), camera)
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    weight = image["alpha"] / image["alpha"].sum()
    assert abs((weight * u).sum() - pixel[0]) < 0.05
    assert abs((weight * v).sum() - pixel[1]) < 0.05
    np.testing.assert_allclose(image["depth"][image["alpha"] > 0], depth, rtol=1e-12)
    np.testing.assert_allclose(image["rgb"][..., 0], image["alpha"], atol=1e-12)


def test_covariance_is_that_of_the_camera_seen_by_differences():
    """T Sigma T^T with T the derivative of `Camera.project`, by central differences: independent of the EWA formula."""
    camera, g = make_camera(), double(make_gaussians(20, 1, spread=0.3))
    projected = reference.project(g, camera)
    A = rotmat_from_quat(g.quats) * np.exp(g.log_scales)[:, None, :]
    for j in range(len(g)):
        steps = 1e-6 * np.eye(3)
        T = (camera.project(g.means[j] + steps)[0] - camera.project(g.means[j] - steps)[0]).T / 2e-6
        cov = T @ A[j] @ A[j].T @ T.T + EPS2D * np.eye(2)
        np.testing.assert_allclose(projected.cov2d[j], cov, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(projected.means2d[j], camera.project(g.means[j : j + 1])[0][0], atol=1e-9)


def test_nearer_gaussian_hides_the_farther():
    camera = make_camera()
    means = place(camera, [(20.5, 12.5)] * 2, [3.0, 1.5])
    g = Gaussians(
        means,
        np.full((2, 3), -2.0),
        np.tile([1.0, 0, 0, 0], (2, 1)),
        np.array([9.0, 9.0]),
        np.array([[[1.0, -9, -9]], [[-9.0, 1, -9]]]),
    )
    centre = reference.render(g, camera)["rgb"][12, 20]
    assert centre[1] > 0.7
    assert centre[0] < 1e-3


def test_background_shows_where_alpha_is_not():
    camera, g = make_camera(), make_gaussians(10, 3)
    black, over = reference.render(g, camera), reference.render(g, camera, BACKGROUND)
    np.testing.assert_allclose(over["rgb"] - black["rgb"], (1 - black["alpha"])[..., None] * BACKGROUND, atol=1e-12)


def central(gaussians: Gaussians, camera, j: int, name: str, index, step=1e-6) -> np.ndarray:
    """d rgb / d one number of Gaussian j, [H*W,3]."""
    ends = []
    for sign in (+1, -1):
        moved = double(gaussians)
        getattr(moved, name)[(j, *index)] += sign * step
        ends.append(reference.render(moved, camera, BACKGROUND)["rgb"].reshape(-1, 3))
    return (ends[0] - ends[1]) / (2 * step)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_jacobian_against_central_differences(degree):
    """Every column of every Gaussian, background included; colours clamped at 0 and alphas clamped at ALPHA_MAX among them."""

    def make(seed):
        g = make_gaussians(6, seed, degree, log_scales=(-3.5, -1.0))
        g.means[5], g.log_scales[5], g.logit_opacities[5] = 0, 0.5, 20
        return g

    camera = make_camera((21, 14), focal=24)
    g = calm(make, camera, 7)
    projected = reference.project(g, camera)
    assert (projected.colours == 0).any()
    assert reference.composite(projected, camera)[3].any(), "no alpha above ALPHA_MAX, though one opacity is 1"
    J = reference.jacobian(g, camera, BACKGROUND)
    K = (degree + 1) ** 2
    columns = [("sh", (k, c)) for k in range(K) for c in range(3)]
    columns += [("log_scales", (i,)) for i in range(3)] + [("quats", (i,)) for i in range(4)] + [("logit_opacities", ())]
    assert J.shape == (21 * 14, 3, 6, len(columns))
    for j in range(len(g)):
        for column, (name, index) in enumerate(columns):
            expected = central(g, camera, j, name, index)
            error = np.abs(J[:, :, j, column] - expected).max()
            assert error < 2e-8 * max(1.0, np.abs(expected).max() / 1e-2), (name, index, j, error)


def test_fisher_is_the_jacobian_squared():
    camera, g = make_camera((21, 14), focal=24), make_gaussians(4, 2, 1)
    J = reference.jacobian(g, camera, BACKGROUND).reshape(-1, 4, 20)
    block = reference.fisher_block(g, camera, BACKGROUND)
    for j in range(4):
        np.testing.assert_allclose(block[j], J[:, j].T @ J[:, j], atol=1e-12)
        np.testing.assert_allclose(reference.fisher(g, camera, BACKGROUND)[j], np.diag(block[j]), atol=1e-12)


def test_spherical_harmonics_are_orthonormal():
    """Integrals over the sphere by Gauss-Legendre x uniform azimuth, exact for these degrees."""
    z, wz = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * 2 * np.pi / 16
    s = np.sqrt(1 - z * z)
    directions = np.stack([np.outer(s, np.cos(phi)), np.outer(s, np.sin(phi)), np.outer(z, np.ones(16))], -1).reshape(-1, 3)
    Y = reference.sh_basis(directions, 3)
    weights = np.repeat(wz, 16) * 2 * np.pi / 16
    np.testing.assert_allclose(Y.T @ (weights[:, None] * Y), np.eye(16), atol=1e-12)
