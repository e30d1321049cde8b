"""The reference itself: camera convention, projection, derivatives against central differences."""

import numpy as np
import pytest

from mgs.colour import SH_C0, sh_basis
from mgs.gaussians import Gaussians
from mgs.rotation import rotmat_from_quat
from mgs.splat.constants import EPS2D, FRUSTUM_MARGIN

from . import reference
from .scenes import calm, difference, double, make_camera, make_clamped, make_gaussians, place

BACKGROUND = (0.2, 0.7, 0.4)


@pytest.mark.parametrize(
    ("pixel", "depth"), [((11.5, 8.5), 1.5), ((33.0, 20.25), 2.5), ((22.5, 13.5), 4.0)]
)
def test_gaussian_lands_on_the_pixel_of_the_camera(pixel, depth):
    camera = make_camera()
    mean = place(camera, [pixel], [depth])[0]
    np.testing.assert_allclose(camera.project([mean])[0][0], pixel, atol=1e-9)
    white = np.full((1, 1, 3), 0.5 / SH_C0)
    g = Gaussians(mean[None], np.full((1, 3), -3.0), np.eye(1, 4), np.array([3.0]), white)
    image = reference.render(g, camera)
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    weight = image["alpha"] / image["alpha"].sum()
    assert abs((weight * u).sum() - pixel[0]) < 0.05
    assert abs((weight * v).sum() - pixel[1]) < 0.05
    np.testing.assert_allclose(image["depth"][image["alpha"] > 0], depth, rtol=1e-12)
    np.testing.assert_allclose(image["rgb"][..., 0], image["alpha"], atol=1e-12)


def test_covariance_is_that_of_the_camera_seen_by_differences():
    """T Sigma T^T with T the derivative of `Camera.project`, independent of the EWA formula."""
    camera, g = make_camera(), double(make_gaussians(20, 1, spread=0.3))
    projected = reference.project(g, camera)
    A = rotmat_from_quat(g.quats) * np.exp(g.log_scales)[:, None, :]
    for j in range(len(g)):
        steps = 1e-6 * np.eye(3)
        T = (camera.project(g.means[j] + steps)[0] - camera.project(g.means[j] - steps)[0]).T / 2e-6
        cov = T @ A[j] @ A[j].T @ T.T + EPS2D * np.eye(2)
        np.testing.assert_allclose(projected.cov2d[j], cov, rtol=1e-6, atol=1e-6)
        pixel = camera.project(g.means[j : j + 1])[0][0]
        np.testing.assert_allclose(projected.means2d[j], pixel, atol=1e-9)


def test_nearer_gaussian_hides_the_farther():
    camera = make_camera()
    means = place(camera, [(20.5, 12.5)] * 2, [3.0, 1.5])
    sh = np.array([[[1.0, -9, -9]], [[-9.0, 1, -9]]])
    g = Gaussians(means, np.full((2, 3), -1.0), np.eye(4)[[0, 0]], np.array([9.0, 9.0]), sh)
    centre = reference.render(g, camera)["rgb"][12, 20]
    assert centre[1] > 0.7
    assert centre[0] < 1e-3


def parameter_columns(degree: int) -> list[tuple[str, tuple[int, ...]]]:
    """(parameter, index) of each column of the Fisher information."""
    columns = [("sh", (k, c)) for k in range((degree + 1) ** 2) for c in range(3)]
    columns += [("log_scales", (i,)) for i in range(3)] + [("quats", (i,)) for i in range(4)]
    return [*columns, ("logit_opacities", ())]


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize("centre", [None, (25.5, 3.0)])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_jacobian_against_central_differences(degree, centre, antialiased):
    """Also of colours clamped at 0 and alphas clamped at ALPHA_MAX.

    The second camera sees some means beyond its margin, where the projection's Jacobian no longer
    follows the mean.
    """
    camera, weight = make_camera((21, 14), focal=24, centre=centre), 0.3

    def make(seed: int) -> Gaussians:
        g = make_clamped(seed, degree, 6, antialiased)
        g.log_scales[0] = 0.5  # pixels are large
        return g

    g = calm(make, camera, 11)
    projected = reference.project(g, camera)
    order, alpha, _, clamped = reference.composite(projected, camera)
    assert centre or antialiased or clamped.any()
    assert centre or (projected.colours == 0).any()
    if centre:
        pixels, _ = camera.project(g.means[order[alpha.any(0)]])
        assert (pixels[:, 0] > 21 * (1 + FRUSTUM_MARGIN / 2)).any()
    options = [{"means": means, "alpha_weight": weight} for means in ("frozen", "free")]
    frozen, free = (reference.jacobian(g, camera, BACKGROUND, **how) for how in options)
    P = 3 * (degree + 1) ** 2 + 8
    assert frozen.shape[1:] == (4, 6, P)
    assert free.shape[-1] == P + 3
    np.testing.assert_array_equal(free[..., :P], frozen)
    np.testing.assert_array_equal(frozen[:, :3], reference.jacobian(g, camera, BACKGROUND))
    assert np.abs(free[..., P:]).max() > 0.1
    for j in range(6):
        columns = [(free, P + i, "means", (i,)) for i in range(3)]
        learned = enumerate(parameter_columns(degree))
        columns += [(frozen, i, name, index) for i, (name, index) in learned]
        for J, column, name, index in columns:
            tangent = np.zeros(getattr(g, name).shape)
            tangent[(j, *index)] = 1.0
            change = difference(g, {name: tangent}, camera, BACKGROUND)
            expected = np.dstack([change["rgb"], np.sqrt(weight) * change["alpha"]]).reshape(-1, 4)
            error = np.abs(J[:, :, j, column] - expected).max()
            assert error < 2e-8 * max(1.0, np.abs(expected).max() / 1e-2), (name, index, j)


def test_fisher_is_the_jacobian_squared():
    camera, g = make_camera((21, 14), focal=24), make_gaussians(4, 2, 1)
    J = reference.jacobian(g, camera, BACKGROUND).reshape(-1, 4, 20)
    block = reference.fisher_block(g, camera, BACKGROUND)
    diagonal = reference.fisher(g, camera, BACKGROUND)
    for j in range(4):
        np.testing.assert_allclose(block[j], J[:, j].T @ J[:, j], atol=1e-12)
        np.testing.assert_allclose(diagonal[j], np.diag(block[j]), atol=1e-12)


def test_spherical_harmonics_are_orthonormal():
    """Integrals over the sphere by Gauss-Legendre x uniform azimuth, exact for these degrees."""
    z, wz = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * 2 * np.pi / 16
    s = np.sqrt(1 - z * z)
    xyz = np.outer(s, np.cos(phi)), np.outer(s, np.sin(phi)), np.outer(z, np.ones(16))
    Y = sh_basis(np.stack(xyz, -1).reshape(-1, 3), 3)
    weights = np.repeat(wz, 16) * 2 * np.pi / 16
    np.testing.assert_allclose(Y.T @ (weights[:, None] * Y), np.eye(16), atol=1e-12)
