"""Fisher information against a float64 Jacobian per pixel and channel."""

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mgs.errors import InputError
from mgs.splat import ListCache, fisher, reference, render
from mgs.splat.information import hutchinson
from mgs.splat.rendering import as_drjit

from .scenes import (
    calm,
    gradients_of,
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


def assert_right(g, camera, background=BACKGROUND, what=""):
    """Both exact estimators against brute force."""
    expected = reference.fisher_block(g, camera, background)
    block = fisher(g, camera, "block", background)
    assert_close(block, expected, f"{what} block")
    assert_close(fisher(g, camera, "exact", background), diagonal(expected), f"{what} exact")
    np.testing.assert_array_equal(block, block.transpose(0, 2, 1))


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_exact_and_block_against_brute_force(degree, antialiased):
    camera = make_camera()
    g = calm(lambda seed: make_clamped(seed, degree, antialiased=antialiased), camera, 20 + degree)
    projected = reference.project(g, camera)
    clamped = reference.composite(projected, camera)[3].any()
    assert clamped or antialiased, "no clamped alpha"
    assert (projected.colours[1] == 0).any(), "no clamped colour"
    assert_right(g, camera, what=f"degree {degree}")


def test_recorded_kernels_know_numbers_of_gaussians_from_other_numbers():
    """The kernels contain these numbers for other reasons (sums, pixels), too."""
    camera = make_camera()
    for n in (8, 10, 7, 22, 32, 4):
        g = calm(lambda seed, n=n: make_gaussians(n, seed, log_scales=(-4.0, -1.0)), camera, n)
        assert_right(g, camera, what=f"{n} Gaussians")
        expected = reference.jacobian(g, camera, BACKGROUND).sum((0, 1))[:, :3]
        for names in (["sh"], ["sh", "means"]):
            model = with_gradients(g, names)
            dr.backward(dr.sum(render(model, camera, BACKGROUND).rgb, axis=None))
            found = gradients_of(model, ["sh"])["sh"][:, 0]
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**31),
    scale=st.floats(-5, -0.5),
    stretch=st.floats(0.1, 6),
    logit=st.floats(-2, 20),
    background=st.tuples(*[st.floats(0, 1)] * 3),
    antialiased=st.booleans(),
)
def test_exact_and_block_for_any_scene(seed, scale, stretch, logit, background, antialiased):
    camera, style = make_camera(), {"antialiased": antialiased}
    style |= {"log_scales": (scale - stretch, scale), "logits": (logit - 4, logit)}
    g = calm(lambda s: make_clamped(s, **style), camera, seed)
    assert_right(g, camera, background)


def test_clamped_scale_carries_no_information():
    """A log-scale beyond LOG_SCALE_RANGE has derivative zero, and its neighbours have not."""
    camera, g = make_camera(), make_gaussians(16, 5)
    g.means[2], g.log_scales[2] = 0, (-30, -2, 30)
    exact, block = fisher(g, camera)[2], fisher(g, camera, "block")[2]
    assert (exact[[3, 5]] == 0).all()
    assert (exact[[0, 4, 10]] > 0).all()
    assert (block[[3, 5]] == 0).all()


def test_hutchinson_converges_as_one_over_sqrt_k():
    """The expected squared error of the mean of k probes is 2 (H^2 - sum J^4) / k."""
    camera, style = make_camera((21, 14), focal=24), {"log_scales": (-3.5, -1.0), "logits": (-2, 3)}
    g = calm(lambda seed: make_gaussians(16, seed, **style), camera, 3)
    J2 = reference.jacobian(g, camera, BACKGROUND).reshape(-1, 16, 11) ** 2
    H = J2.sum(0)
    variance = 2 * (H**2 - (J2**2).sum(0))
    seen = (H / H.max()) > 1e-9
    ks = (4, 16, 64, 256)
    cache, errors = ListCache(), []
    for k in ks:
        estimate = hutchinson(as_drjit(g), camera, BACKGROUND, cache, probes=k, seed=1)
        errors.append(np.sqrt(((estimate - H)[seen] ** 2 / variance[seen]).mean()))
    slope = np.polyfit(np.log(ks), np.log(errors), 1)[0]
    print("k", ks, "rms error / sigma", [f"{e:.3f}" for e in errors], f"slope {slope:.3f}")
    assert abs(slope + 0.5) < 0.08
    assert np.all(np.abs(np.sqrt(ks) * errors - 1) < 0.35)


def test_probes_of_hutchinson_are_independent_from_view_to_view():
    """Errors of 16 neighbouring views average out in their sum."""
    g = make_gaussians(16, 3, log_scales=(-3.5, -1.0), logits=(-2, 3))
    cameras = [make_camera((21, 14), focal=24, eye=(2.0, 0.4 + 1e-3 * i, 1.1)) for i in range(16)]
    exact = [fisher(g, camera) for camera in cameras]
    estimate = [fisher(g, camera, "hutchinson", probes=1) for camera in cameras]

    def error(a, b):
        return np.linalg.norm(a - b) / np.linalg.norm(b)

    each = np.mean([error(a, b) for a, b in zip(estimate, exact, strict=True)])
    assert error(np.sum(estimate, 0), np.sum(exact, 0)) < 0.5 * each
    again = fisher(g, cameras[3], "hutchinson", probes=1)
    np.testing.assert_array_equal(again, estimate[3])


@pytest.mark.parametrize("probes", [0, 1.5])
def test_probes_of_hutchinson_are_a_whole_number(probes):
    with pytest.raises(InputError, match="probes"):
        fisher(make_gaussians(16, 6), make_camera(), "hutchinson", probes=probes)


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


def test_an_unknown_estimator_is_one_line():
    with pytest.raises(InputError, match=r"estimator 'magic': unknown; choose one of .*exact"):
        fisher(make_gaussians(1, 1), make_camera(), "magic")
