"""Fisher information against a brute-force Jacobian per pixel and channel, in float64; the other
estimators against theirs."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mgs.errors import InputError
from mgs.splat import ESTIMATORS, ListCache, fisher, groups, reference, render
from mgs.splat.information import hutchinson
from mgs.splat.rendering import as_drjit

from .scenes import calm, double, make_camera, make_gaussians

BACKGROUND = (0.3, 0.6, 0.1)
TOLERANCE = 1e-3
FLOOR = 1e-6
"""Entries below this share of the largest are compared as absolute numbers."""


def assert_close(found, expected, what=""):
    """Relative error TOLERANCE on entries above FLOOR of the largest; FLOOR * TOLERANCE * 10 of the
    largest on the others."""
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


def make(seed, degree=0, n=16, **style):
    """A random scene with a wide splat whose alpha is clamped in the middle and one whose colours
    are clamped at 0."""
    g = make_gaussians(n, seed, degree, **{"log_scales": (-4.0, -1.0), **style})
    g.means[0], g.log_scales[0], g.logit_opacities[0] = 0, (-0.5, -0.8, -0.3), 20
    g.sh[1] = 0
    g.sh[1, 0] = (-4, 2, -4)
    return g


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_exact_and_block_against_brute_force(degree):
    camera = make_camera()
    g = calm(lambda seed: make(seed, degree), camera, 20 + degree)
    projected = reference.project(g, camera)
    assert reference.composite(projected, camera)[3].any(), "no clamped alpha"
    assert (projected.colours[1] == 0).any(), "no clamped colour"
    expected = reference.fisher_block(g, camera, BACKGROUND)
    block = fisher(g, camera, "block", BACKGROUND)
    exact = fisher(g, camera, "exact", BACKGROUND)
    assert_close(block, expected, f"degree {degree} block")
    assert_close(exact, diagonal(expected), f"degree {degree} exact")
    np.testing.assert_array_equal(block, block.transpose(0, 2, 1))


def test_recorded_kernels_know_numbers_of_gaussians_from_other_numbers():
    """Scenes of 8, 10, 7, 22, 32 and 4 Gaussians in turn. The kernels contain these numbers for
    other reasons (sums, pixels), and a recording once took one for the other."""
    camera = make_camera()
    for n in (8, 10, 7, 22, 32, 4):
        g = calm(lambda seed, n=n: make_gaussians(n, seed, log_scales=(-4.0, -1.0)), camera, n)
        expected = reference.fisher_block(g, camera, BACKGROUND)
        assert_close(fisher(g, camera, "exact", BACKGROUND), diagonal(expected), f"{n} exact")
        assert_close(fisher(g, camera, "block", BACKGROUND), expected, f"{n} block")
        J = reference.jacobian(g, camera, BACKGROUND)
        for free in (False, True):
            watched = as_drjit(g)
            dr.enable_grad(watched.sh, *([watched.means] if free else []))
            dr.backward(dr.sum(render(watched, camera, BACKGROUND).rgb, axis=None))
            np.testing.assert_allclose(
                dr.grad(watched.sh).numpy()[:, 0], J.sum((0, 1))[:, :3], rtol=1e-4, atol=1e-4
            )


@pytest.mark.parametrize("degree", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_blocks_of_one_gaussian(degree):
    """With one Gaussian all addresses are constants, which is hardest on the compiler: it takes 20
    s for degree 3."""
    camera = make_camera()
    g = calm(
        lambda seed: make_gaussians(
            1, seed, degree, spread=0.1, log_scales=(-2, -1), logits=(1, 2)
        ),
        camera,
        3,
    )
    assert_close(
        fisher(g, camera, "block", BACKGROUND),
        reference.fisher_block(g, camera, BACKGROUND),
        f"one, degree {degree}",
    )


def test_images_of_several_tiles():
    """Memory and lanes are ordered by tiles of 128x64 pixels; this image has four, and borders
    between them must not matter."""
    camera = make_camera((150, 70), focal=150.0)
    g = calm(lambda seed: make_gaussians(30, seed, log_scales=(-4.0, -1.0)), camera, 3)
    expected = reference.fisher_block(g, camera, BACKGROUND)
    assert_close(fisher(g, camera, "block", BACKGROUND), expected, "block")
    assert_close(fisher(g, camera, "exact", BACKGROUND), diagonal(expected), "exact")
    weights = np.random.default_rng(0).normal(size=(70, 150, 3)).astype(np.float32)
    watched = as_drjit(g)
    dr.enable_grad(watched.log_scales)
    image = render(watched, camera, BACKGROUND)
    dr.backward(dr.sum(image.rgb * mi.TensorXf(weights), axis=None))
    np.testing.assert_allclose(image.rgb, reference.render(g, camera, BACKGROUND)["rgb"], atol=2e-5)
    scales = np.tensordot(
        weights.reshape(-1, 3), reference.jacobian(g, camera, BACKGROUND), axes=([0, 1], [0, 1])
    )[:, 3:6]
    found = np.asarray(dr.grad(watched.log_scales))
    assert np.linalg.norm(found - scales) < 1e-4 * np.linalg.norm(scales)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**31),
    scale=st.floats(-5, -0.5),
    stretch=st.floats(0.1, 6),
    logit=st.floats(-2, 20),
    background=st.tuples(*[st.floats(0, 1)] * 3),
)
def test_exact_and_block_for_any_scene(seed, scale, stretch, logit, background):
    camera = make_camera()
    style = {"log_scales": (scale - stretch, scale), "logits": (logit - 4, logit)}
    g = calm(lambda s: make(s, **style), camera, seed)
    expected = reference.fisher_block(g, camera, background)
    assert_close(fisher(g, camera, "block", background), expected, "block")
    assert_close(fisher(g, camera, "exact", background), diagonal(expected), "exact")


def test_blocks_are_positive_semidefinite():
    block = fisher(make_gaussians(60, 4), make_camera(), "block").astype(np.float64)
    values = np.linalg.eigvalsh(block)
    assert (values[:, 0] > -1e-5 * values[:, -1]).all()


def test_clamped_scale_carries_no_information():
    """A log-scale beyond LOG_SCALE_RANGE has derivative zero, and its neighbours have not."""
    camera, g = make_camera(), make_gaussians(16, 5)
    g.means[2], g.log_scales[2] = 0, (-30, -2, 30)
    exact, block = fisher(g, camera)[2], fisher(g, camera, "block")[2]
    assert (exact[[3, 5]] == 0).all()
    assert (exact[[0, 4, 10]] > 0).all()
    assert (block[[3, 5]] == 0).all()


def test_unseen_gaussian_carries_no_information():
    camera, g = make_camera(), make_gaussians(16, 5)
    g.means[3] = camera.position - 2 * camera.world_to_camera[2, :3]
    g.means[4] = camera.position + np.array([3, 3, 3])
    assert (fisher(g, camera)[[3, 4]] == 0).all()
    assert (fisher(g, camera, "block")[[3, 4]] == 0).all()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_groups_tile_the_columns(degree):
    parts = list(groups(degree).values())
    assert [p.start for p in parts] == [0, *(p.stop for p in parts[:-1])]
    assert parts[-1].stop == 3 * (degree + 1) ** 2 + 8
    assert fisher(make_gaussians(16, 1, degree), make_camera()).shape == (16, parts[-1].stop)


def test_hutchinson_converges_as_one_over_sqrt_k():
    """The squared error of the mean of k probes is 2 (H^2 - sum J^4) / k, exactly; averaged over
    parameters, to sampling error.

    Probes are nested (the first k of 256), as the estimator draws them, so this also fixes its
    seeds.
    """
    camera = make_camera((21, 14), focal=24)
    g = calm(
        lambda seed: make_gaussians(16, seed, log_scales=(-3.5, -1.0), logits=(-2, 3)), camera, 3
    )
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
    """Errors of 16 neighbouring views average out in their sum: it is off by a quarter of what one
    view is off by."""
    g = make_gaussians(16, 3, log_scales=(-3.5, -1.0), logits=(-2, 3))
    cameras = [make_camera((21, 14), focal=24, eye=(2.0, 0.4 + 1e-3 * i, 1.1)) for i in range(16)]
    exact = [fisher(g, camera) for camera in cameras]
    estimate = [fisher(g, camera, "hutchinson", probes=1) for camera in cameras]
    each = np.mean(
        [np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(estimate, exact, strict=True)]
    )
    together = np.linalg.norm(np.sum(estimate, 0) - np.sum(exact, 0)) / np.linalg.norm(
        np.sum(exact, 0)
    )
    print(f"one view {each:.2f}, sum of 16 {together:.2f}")
    assert together < 0.5 * each
    again = fisher(g, cameras[3], "hutchinson", probes=1)
    np.testing.assert_array_equal(again, estimate[3])


def test_hutchinson_is_the_same_with_and_without_a_cache():
    camera, g = make_camera(), make_gaussians(16, 6)
    np.testing.assert_array_equal(
        fisher(g, camera, "hutchinson"), fisher(g, camera, "hutchinson", cache=ListCache())
    )


def test_probes_of_hutchinson_are_an_option():
    """More probes come nearer; the other estimators have no options."""
    camera, g = make_camera(), make_gaussians(16, 6)
    exact = fisher(g, camera)
    few, many = (
        np.linalg.norm(fisher(g, camera, "hutchinson", probes=k) - exact) for k in (2, 128)
    )
    assert many < 0.5 * few
    for probes in (0, -1, 1.5):
        with pytest.raises(InputError, match="probes"):
            fisher(g, camera, "hutchinson", probes=probes)
    with pytest.raises(TypeError, match="probes"):
        fisher(g, camera, "exact", probes=2)


def test_gradient_estimators_work_where_gradients_are_suspended():
    camera, g = make_camera(), make_gaussians(16, 6)
    with dr.suspend_grad():
        found = fisher(g, camera, "loss-gradient")
    np.testing.assert_array_equal(found, fisher(g, camera, "loss-gradient"))


def test_loss_gradient_is_the_square_of_its_loss_by_central_differences():
    """L = mean (rgb - 0.5)^2 of the oracle, differentiated numerically and squared."""
    camera = make_camera()
    g = calm(
        lambda seed: make_gaussians(8, seed, log_scales=(-3.0, -1.0), logits=(-1, 4)), camera, 8
    )

    def loss(gaussians):
        return ((reference.render(gaussians, camera, BACKGROUND)["rgb"] - 0.5) ** 2).mean()

    columns = [("sh", (0, c)) for c in range(3)]
    columns += (
        [("log_scales", (i,)) for i in range(3)]
        + [("quats", (i,)) for i in range(4)]
        + [("logit_opacities", ())]
    )
    expected = np.zeros((8, 11))
    for j in range(8):
        for column, (name, index) in enumerate(columns):
            ends = []
            for sign in (+1, -1):
                moved = double(g)
                getattr(moved, name)[(j, *index)] += sign * 1e-5
                ends.append(loss(moved))
            expected[j, column] = ((ends[0] - ends[1]) / 2e-5) ** 2
    found = fisher(g, camera, "loss-gradient", BACKGROUND)
    assert np.linalg.norm(np.sqrt(found) - np.sqrt(expected)) < 1e-4 * np.linalg.norm(
        np.sqrt(expected)
    )
    assert np.linalg.norm(found - expected) < 2e-4 * np.linalg.norm(expected)


def test_loss_gradient_is_not_the_fisher_information():
    """Gradients of pixels cancel before they are squared, so the two differ by far more than a
    factor."""
    camera, g = make_camera(), make_gaussians(16, 9)
    exact, scalar = fisher(g, camera), fisher(g, camera, "loss-gradient")
    seen = exact > 1e-6 * exact.max()
    ratio = np.log(scalar[seen] / exact[seen] + 1e-30)
    assert ratio.std() > 1


def test_every_estimator_is_named_and_unknown_ones_are_an_error():
    assert set(ESTIMATORS) == {"exact", "block", "hutchinson", "loss-gradient"}
    with pytest.raises(InputError, match=r"estimator 'magic': unknown; choose one of .*exact"):
        fisher(make_gaussians(1, 1), make_camera(), "magic")
