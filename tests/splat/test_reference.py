"""The oracle itself: camera convention, projection, derivatives against central differences, all in
float64."""

import numpy as np
import pytest

from mgs.colour import SH_C0
from mgs.gaussians import Gaussians
from mgs.rotation import rotmat_from_quat
from mgs.splat import reference
from mgs.splat.constants import EPS2D, FRUSTUM_MARGIN

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


@pytest.mark.parametrize(
    ("pixel", "depth"), [((11.5, 8.5), 1.5), ((33.0, 20.25), 2.5), ((22.5, 13.5), 4.0)]
)
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
    """T Sigma T^T with T the derivative of `Camera.project`, by central differences: independent of
    the EWA formula."""
    camera, g = make_camera(), double(make_gaussians(20, 1, spread=0.3))
    projected = reference.project(g, camera)
    A = rotmat_from_quat(g.quats) * np.exp(g.log_scales)[:, None, :]
    for j in range(len(g)):
        steps = 1e-6 * np.eye(3)
        T = (camera.project(g.means[j] + steps)[0] - camera.project(g.means[j] - steps)[0]).T / 2e-6
        cov = T @ A[j] @ A[j].T @ T.T + EPS2D * np.eye(2)
        np.testing.assert_allclose(projected.cov2d[j], cov, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(
            projected.means2d[j], camera.project(g.means[j : j + 1])[0][0], atol=1e-9
        )


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
    np.testing.assert_allclose(
        over["rgb"] - black["rgb"], (1 - black["alpha"])[..., None] * BACKGROUND, atol=1e-12
    )


def central(
    gaussians: Gaussians, camera, j: int, name: str, index, direction=1.0, step=1e-6
) -> np.ndarray:
    """d (r, g, b, alpha) / d one number of Gaussian j, or several that change together along a
    direction: [H*W,4]."""
    ends = []
    for sign in (+1, -1):
        moved = double(gaussians)
        getattr(moved, name)[(j, *index)] += sign * step * direction
        image = reference.render(moved, camera, BACKGROUND)
        ends.append(np.concatenate([image["rgb"], image["alpha"][..., None]], 2).reshape(-1, 4))
    return (ends[0] - ends[1]) / (2 * step)


def opaque_in_the_middle(seed: int, degree: int = 0) -> Gaussians:
    """Six Gaussians, one of them wide with an opacity of 1."""
    g = make_gaussians(6, seed, degree, log_scales=(-3.5, -1.0))
    g.means[5], g.log_scales[5], g.logit_opacities[5] = 0, 0.5, 20
    return g


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_jacobian_against_central_differences(degree):
    """Every column of every Gaussian, background included; colours clamped at 0 and alphas clamped
    at ALPHA_MAX among them."""
    camera = make_camera((21, 14), focal=24)
    g = calm(lambda seed: opaque_in_the_middle(seed, degree), camera, 7)
    projected = reference.project(g, camera)
    assert (projected.colours == 0).any()
    assert reference.composite(projected, camera)[3].any(), (
        "no alpha above ALPHA_MAX, though one opacity is 1"
    )
    J = reference.jacobian(g, camera, BACKGROUND)
    K = (degree + 1) ** 2
    columns = [("sh", (k, c)) for k in range(K) for c in range(3)]
    columns += (
        [("log_scales", (i,)) for i in range(3)]
        + [("quats", (i,)) for i in range(4)]
        + [("logit_opacities", ())]
    )
    assert J.shape == (21 * 14, 3, 6, len(columns))
    for j in range(len(g)):
        for column, (name, index) in enumerate(columns):
            expected = central(g, camera, j, name, index)[:, :3]
            error = np.abs(J[:, :, j, column] - expected).max()
            assert error < 2e-8 * max(1.0, np.abs(expected).max() / 1e-2), (name, index, j, error)


@pytest.mark.parametrize("centre", [None, (25.5, 3.0)])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_columns_of_means_and_rows_of_alpha_against_central_differences(degree, centre):
    """All that the image does as means move: centre, footprint, colour. The second camera looks
    past most of them, at some from beyond its margin, where the projection's Jacobian no longer
    follows the mean."""
    camera, weight = make_camera((21, 14), focal=24, centre=centre), 0.3
    g = calm(lambda seed: opaque_in_the_middle(seed, degree), camera, 11)
    if centre:
        drawn = reference.composite(reference.project(g, camera), camera)
        beyond = camera.project(g.means[drawn[0][drawn[1].any(0)]])[0][:, 0] > 21 * (
            1 + FRUSTUM_MARGIN / 2
        )
        assert beyond.any()
    normals = np.random.default_rng(degree).normal(size=(6, 3))
    frozen, free, normal = (
        reference.jacobian(g, camera, BACKGROUND, means=means, normals=normals, alpha_weight=weight)
        for means in ("frozen", "free", "normal")
    )
    P = 3 * (degree + 1) ** 2 + 8
    assert [J.shape[1:] for J in (frozen, free, normal)] == [
        (4, 6, P),
        (4, 6, P + 3),
        (4, 6, P + 1),
    ]
    np.testing.assert_array_equal(free[..., :P], frozen)
    np.testing.assert_array_equal(normal[..., :P], frozen)
    np.testing.assert_array_equal(frozen[:, :3], reference.jacobian(g, camera, BACKGROUND))
    assert np.abs(free[..., P:]).max() > 0.1
    for j in range(6):
        unit = normals[j] / np.linalg.norm(normals[j])
        columns = [(free, P + i, "means", (i,), 1.0) for i in range(3)] + [
            (normal, P, "means", (), unit)
        ]
        columns += [(frozen, P - 8 + i, "log_scales", (i,), 1.0) for i in range(3)]
        columns += [(frozen, P - 1, "logit_opacities", (), 1.0), (frozen, 0, "sh", (0, 0), 1.0)]
        for J, column, name, index, direction in columns:
            expected = central(g, camera, j, name, index, direction) * (1, 1, 1, np.sqrt(weight))
            error = np.abs(J[:, :, j, column] - expected).max()
            assert error < 2e-8 * max(1.0, np.abs(expected).max() / 1e-2), (name, index, j, error)


def test_fisher_is_the_jacobian_squared():
    camera, g = make_camera((21, 14), focal=24), make_gaussians(4, 2, 1)
    J = reference.jacobian(g, camera, BACKGROUND).reshape(-1, 4, 20)
    block = reference.fisher_block(g, camera, BACKGROUND)
    for j in range(4):
        np.testing.assert_allclose(block[j], J[:, j].T @ J[:, j], atol=1e-12)
        np.testing.assert_allclose(
            reference.fisher(g, camera, BACKGROUND)[j], np.diag(block[j]), atol=1e-12
        )


def test_spherical_harmonics_are_orthonormal():
    """Integrals over the sphere by Gauss-Legendre x uniform azimuth, exact for these degrees."""
    z, wz = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * 2 * np.pi / 16
    s = np.sqrt(1 - z * z)
    directions = np.stack(
        [np.outer(s, np.cos(phi)), np.outer(s, np.sin(phi)), np.outer(z, np.ones(16))], -1
    ).reshape(-1, 3)
    Y = reference.sh_basis(directions, 3)
    weights = np.repeat(wz, 16) * 2 * np.pi / 16
    np.testing.assert_allclose(Y.T @ (weights[:, None] * Y), np.eye(16), atol=1e-12)
