"""Cost of removing a Gaussian, against rendering without it; pruning by this cost."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import fails

from mgs.fit.pruning import NEIGHBOURS, fewest, prune, removal_cost
from mgs.splat import render

from . import reference
from .scenes import calm, make_camera, make_gaussians

BACKGROUND = (0.3, 0.6, 0.1)


def brute_force(gaussians, camera):
    """Squared change of the float64 image as each Gaussian is left out in turn."""
    whole = reference.render(gaussians, camera, BACKGROUND)["rgb"]
    left = [gaussians[np.arange(len(gaussians)) != j] for j in range(len(gaussians))]
    images = [reference.render(others, camera, BACKGROUND)["rgb"] for others in left]
    return np.array([((image - whole) ** 2).sum() for image in images])


def never_finished(seed):
    """A scene in which no pixel is finished, so that no removal makes splats appear."""
    g = make_gaussians(6, seed, log_scales=(-4.0, -1.0), logits=(-3, 1), antialiased=False)
    g.logit_opacities[1:] = np.minimum(g.logit_opacities[1:], -0.5)
    g.logit_opacities[0] = 8.0  # clamped at ALPHA_MAX, where derivatives are 0
    return g


@settings(derandomize=True, deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31))
def test_the_cost_is_the_change_of_the_image(seed):
    camera = make_camera((26, 18), focal=30.0)
    g = calm(never_finished, camera, seed)
    expected = reference.removal_cost(g, camera, BACKGROUND)
    np.testing.assert_allclose(expected, brute_force(g, camera), rtol=1e-9, atol=1e-12)
    found = removal_cost(g, [camera], BACKGROUND)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-6 * expected.max())


def test_any_scene_and_several_cameras_against_the_oracle():
    cameras = [make_camera(), make_camera(eye=(-0.5, 2.1, 0.9))]
    g = make_gaussians(60, 5, degree=1, log_scales=(-4.0, -1.0))
    expected = sum(reference.removal_cost(g, camera, BACKGROUND) for camera in cameras)
    found = removal_cost(g, cameras, BACKGROUND)
    assert np.abs(found - expected).max() < 2e-3 * expected.max()
    assert removal_cost(g[:0], cameras).shape == (0,)


def wall(side=9, spacing=0.12):
    """Splats on a surface, and others of similar colours behind it."""
    y, z = (spacing * (grid.ravel() - side / 2) for grid in np.mgrid[:side, :side])
    n = side * side
    g = make_gaussians(2 * n, 1, logits=(2.0, 2.2))
    g.means[:] = np.concatenate([np.stack([np.full(n, x), y, z], 1) for x in (0.3, 0.3 - spacing)])
    g.log_scales[:] = np.log(spacing * np.array([0.1, 0.65, 0.65]))
    g.quats[:] = (1, 0, 0, 0)
    g.sh[:] = 0.3 * np.sin(2 * g.means + [0, 1, 2])[:, None]
    return g


def test_what_is_pruned_changes_images_by_about_what_was_predicted():
    cameras = [make_camera(), make_camera(eye=(2.0, -0.8, 0.5))]
    g = wall()
    found = prune(g, cameras, 0.01)
    assert NEIGHBOURS < len(found.kept) < len(g)
    assert found.actual <= found.noise == 0.01
    covered = 3 * sum(float(np.asarray(render(g, camera).alpha).sum()) for camera in cameras)
    change = 0.0
    for camera in cameras:
        pruned, whole = (np.asarray(render(h, camera).rgb, float) for h in (g[found.kept], g))
        change += ((pruned - whole) ** 2).sum()
    assert found.actual == pytest.approx(np.sqrt(change / covered), rel=1e-4)
    assert 0.5 < (found.actual / found.predicted) ** 2 < 2
    more = prune(g, cameras, 0.03)
    assert len(more.kept) < len(found.kept)


def test_gaussians_that_no_camera_sees_go_first_and_reruns_are_equal():
    camera = make_camera()
    g = wall()
    g.means[::4] = 2 * camera.position - g.means[::4]  # behind the camera
    first, again = (prune(g, [camera], 1e-6) for _ in range(2))
    removed = np.delete(np.arange(len(g)), first.kept)
    assert len(removed) > 10
    assert (removed % 4 == 0).all()
    assert first.actual == 0
    np.testing.assert_array_equal(first.kept, again.kept)
    assert prune(g[:0], [camera], 0.01).kept.shape == (0,)


def test_a_noise_that_is_not_positive_and_a_negative_count_are_one_line():
    fails("noise", prune, wall(), [make_camera()], float("nan"))
    fails("count -1 must be at least 0", fewest, wall(), [make_camera()], -1)
