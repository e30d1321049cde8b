"""Images against the float64 reference: errors, flipped pixels, thresholds."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mgs.colour import SH_C0
from mgs.gaussians import Gaussians
from mgs.splat import fisher, render
from mgs.splat.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

from . import reference
from .scenes import SIZE, changed, make_camera, make_gaussians, margins, place

TOLERANCE = 2e-5
"""Absolute, of rgb and alpha; of depth weighted by alpha, in units of the largest depth."""

NEAR = 3e-5
"""Relative error of alpha in float32: pixels nearer to a decision than this may flip."""

STYLES = {
    "mixed": {},
    "fine": {"log_scales": (-7.0, -2.5)},
    "broad": {"log_scales": (-3.0, 0.0), "logits": (-1.0, 8.0)},
    "opaque": {"log_scales": (-5.0, -1.0), "logits": (0.0, 12.0)},
    "faint": {"logits": (-7.0, -2.0)},
}


def errors(gaussians, camera, background) -> tuple[np.ndarray, np.ndarray]:
    """Per pixel: the largest error in units of the tolerance, and whether no decision is near."""
    image = render(gaussians, camera, background)
    truth = reference.render(gaussians, camera, background)
    rgb, alpha, depth = (np.asarray(a, np.float64) for a in (image.rgb, image.alpha, image.depth))
    assert rgb.shape == (camera.height, camera.width, 3)
    assert alpha.shape == depth.shape == (camera.height, camera.width)
    farthest = max(1.0, truth["depth"].max())
    worst = np.maximum(np.abs(rgb - truth["rgb"]).max(-1), np.abs(alpha - truth["alpha"]))
    worst = np.maximum(worst, np.abs(depth - truth["depth"]) * truth["alpha"] / farthest)
    assert ((depth == 0) == (alpha == 0)).all()
    return worst / TOLERANCE, margins(gaussians, camera) > NEAR


def test_errors_and_flipped_pixels():
    results, eyes = [], ((2.0, 0.4, 1.1), (-1.2, 1.5, 0.3), (0.1, -0.2, 2.5))
    for number, style in enumerate(STYLES.values()):
        for degree in range(4):
            for seed in range(3):
                gaussians = make_gaussians(60, 100 * number + seed, degree, **style)
                results.append(errors(gaussians, make_camera(eye=eyes[seed]), (0.1, 0.5, 0.9)))
    error, decided = (np.stack(values) for values in zip(*results, strict=True))
    print(f"worst error {error[decided].max() * TOLERANCE:.1e}")
    assert decided.mean() > 0.99
    assert error[decided].max() <= 1
    assert (error > 1).mean() < 1e-4


@settings(derandomize=True, deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 2**31),
    n=st.sampled_from([1, 16]),
    size=st.sampled_from([SIZE, (8, 4), (9, 5), (1, 1)]),
    degree=st.integers(0, 3),
    scale=st.floats(-8, 1),
    stretch=st.floats(0, 5),
    logit=st.floats(-6, 20),
    background=st.tuples(*[st.floats(0, 1)] * 3),
    eye=st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.1, 2)),
    focal=st.floats(10, 100),
    filtered=st.booleans(),
)
def test_matches_oracle_for_any_scene(
    seed, n, size, degree, scale, stretch, logit, background, eye, focal, filtered
):
    style = (scale - stretch, scale), (logit - 3, logit)
    gaussians = make_gaussians(n, seed, degree, *style, colour=1.0, antialiased=filtered)
    camera = make_camera(size, focal, eye, target=(0.05, 0.02, 0.01))
    error, decided = errors(gaussians, camera, background)
    assert np.isfinite(error).all()
    assert error[decided].max(initial=0) <= 1


@pytest.mark.parametrize("centre", [(320.0, 4.0), (-300.0, -200.0), (600.0, 240.0)])
def test_error_at_the_edge_of_a_large_image(centre):
    """Splats of a pixel's size, far from the corner or the principal point."""
    camera = make_camera((640, 6), focal=600.0, centre=centre)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        means = place(camera, rng.uniform((500, 0), (640, 6), (60, 2)), rng.uniform(1, 3, 60))
        gaussians = changed(make_gaussians(60, seed, log_scales=(-9.0, -5.0)), means=means)
        error, decided = errors(gaussians, camera, (0.1, 0.5, 0.9))
        assert decided.mean() > 0.99
        assert error[decided].max() <= 1


def stack(camera, opacities) -> Gaussians:
    """Round white Gaussians one behind the other, all centred on the middle of pixel (20, 12)."""
    n, opacities = len(opacities), np.asarray(opacities, np.float64)
    means = place(camera, [(20.5, 12.5)] * n, 1.5 + 0.1 * np.arange(n))
    logits, white = np.log(opacities / (1 - opacities)), np.full((n, 1, 3), 0.5 / SH_C0)
    parts = means, np.full((n, 3), -2.0), np.eye(4)[[0] * n], logits, white
    return Gaussians(*(part.astype(np.float32) for part in parts), antialiased=False)


@pytest.mark.parametrize("above", [False, True])
def test_threshold_and_bound_of_alpha(above):
    camera = make_camera()
    gaussians = stack(camera, [ALPHA_MIN * (1.001 if above else 0.999)])
    alpha = np.asarray(render(gaussians, camera).alpha)
    assert alpha[12, 20] == pytest.approx(ALPHA_MIN * 1.001 if above else 0, rel=1e-4)
    np.testing.assert_allclose(alpha, reference.render(gaussians, camera)["alpha"], atol=TOLERANCE)
    alpha = np.asarray(render(changed(stack(camera, [0.5]), logit_opacities=[20]), camera).alpha)
    assert alpha[12, 20] == pytest.approx(ALPHA_MAX, abs=1e-6)


@pytest.mark.parametrize("above", [False, True])
def test_threshold_of_transmittance(above):
    """A fourth splat would leave TRANSMITTANCE_MIN (1 +- 1e-3)."""
    camera = make_camera()
    last = 1 - TRANSMITTANCE_MIN * (1.001 if above else 0.999) / 0.1**3
    gaussians = stack(camera, [0.9, 0.9, 0.9, last])
    alpha = float(np.asarray(render(gaussians, camera).alpha)[12, 20])
    assert alpha == pytest.approx(1 - 1.001 * TRANSMITTANCE_MIN if above else 1 - 0.1**3, abs=1e-6)
    assert alpha == pytest.approx(reference.render(gaussians, camera)["alpha"][12, 20], abs=1e-6)


def test_tiles_are_the_whole_bit_for_bit():
    """Tiles of no whole blocks, of Gaussians so large that the Jacobian's clamp matters. The
    reference draws those of a world whose coordinates count from another place."""
    camera, g = make_camera((50, 37)), make_gaussians(60, 3, 1, log_scales=(-3.0, 0.5), spread=1.5)
    whole, truth = render(g, camera, 0.3), reference.render(g, camera, (0.3, 0.3, 0.3))
    plain, information = 0, np.zeros_like(fisher(g, camera))
    far = replace(g, origin=(1.0, 2.0, -3.0))
    for top in range(0, 37, 11):
        for left in range(0, 50, 13):
            width, height = min(13, 50 - left), min(11, 37 - top)
            tile = camera.cropped(left, top, width, height)
            window = slice(top, top + height), slice(left, left + width)
            drawn = render(g, tile, 0.3)
            for name in ("rgb", "alpha", "depth"):
                expected = np.asarray(getattr(whole, name))[window]
                np.testing.assert_array_equal(np.asarray(getattr(drawn, name)), expected)
                moved = tile.seen_from(np.negative(far.origin))
                found = reference.render(far, moved, (0.3, 0.3, 0.3))[name]
                np.testing.assert_allclose(found, truth[name][window], rtol=0, atol=1e-12)
            information += fisher(g, tile)
            half = tile.cropped(0, 0, width, height // 2)
            rows = np.asarray(drawn.rgb)[: height // 2]
            np.testing.assert_array_equal(np.asarray(render(g, half, 0.3).rgb), rows)
            alone = np.asarray(render(g, replace(tile, film=None, corner=(0, 0)), 0.3).rgb)
            plain += (np.abs(alone - np.asarray(drawn.rgb)) > 1e-3).any(-1).sum()
    np.testing.assert_allclose(information, fisher(g, camera), rtol=1e-4, atol=1e-6)
    assert plain > 0.2 * 50 * 37, "a camera that does not know its film draws otherwise"
