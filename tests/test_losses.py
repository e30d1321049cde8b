"""Losses of a fit: L1 + D-SSIM against NumPy, finite differences and scikit-image."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import correlate1d

from mgs.colour import srgb_from_linear
from mgs.fit.fitting import fit_gaussians
from mgs.fit.losses import LOSSES, similarity
from mgs.fit.settings import TrainSettings
from mgs.memory import padded
from mgs.metrics import _similarity
from mgs.splat import render
from studies.bench import surface_camera, surface_gaussians

HEIGHT, WIDTH = 14, 17


def srgb(c):
    """sRGB in float64, with the curve going on above 1."""
    curve = 1.055 * np.maximum(c, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(c <= 0.0031308, 12.92 * c, curve)


def slow_loss(drawn, pixels, weights, linear=True):
    """`l1_dssim` in float64."""
    encoded = srgb if linear else np.array
    offsets = np.arange(-5, 6)
    window = np.exp(-0.5 * (offsets / 1.5) ** 2)
    window /= window.sum()

    def blur(image):
        return correlate1d(
            correlate1d(image, window, 0, mode="constant"), window, 1, mode="constant"
        )

    y = np.dstack([encoded(pixels[..., :3]), pixels[..., 3:]])
    x = y + (np.dstack([encoded(drawn[..., :3]), drawn[..., 3:]]) - y) * weights
    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = 1e-4, 9e-4
    ssim = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    return 0.8 * np.abs(x - y) + 0.2 * (1 - ssim)


@pytest.fixture(scope="module", params=[3, 4])
def images(request):
    """A render, an image and weights, [H,W,C]; some pixels are dark, unknown, or above 1."""
    rng, shape = np.random.default_rng(0), (HEIGHT, WIDTH, request.param)
    pixels = rng.random(shape) ** 3
    drawn = np.clip(pixels + 0.1 * rng.normal(size=shape), 1e-4, None)
    weights = np.ones(shape)
    weights[3:5, 2:9] = 0
    weights[..., 3:] *= 0.3
    return drawn, pixels, weights


def flat(image):
    return mi.Float(padded(image.astype(np.float32)).ravel())


@pytest.mark.parametrize("linear", [True, False])
def test_values_and_gradients_are_those_of_the_reference(images, linear):
    drawn, pixels, weights = images
    x, size = flat(drawn), (WIDTH, HEIGHT, drawn.shape[2])
    dr.enable_grad(x)
    values = LOSSES["l1-dssim"](x, flat(pixels), flat(weights), size, linear)
    dr.backward(dr.sum(values))
    assert np.allclose(np.array(values), slow_loss(*images, linear).ravel(), atol=2e-5)
    found, rng = np.array(dr.grad(x)).reshape(drawn.shape), np.random.default_rng(1)
    for at in rng.permutation(list(np.ndindex(drawn.shape)))[:60]:
        step = np.zeros_like(drawn)
        step[tuple(at)] = 1e-6
        up, down = (slow_loss(drawn + s * step, pixels, weights, linear).sum() for s in (1, -1))
        assert found[tuple(at)] == pytest.approx((up - down) / 2e-6, rel=2e-3, abs=2e-3)


def test_similarity_is_that_of_scikit_image_inside_the_border(images):
    drawn, pixels, _ = images
    a, b = srgb_from_linear(pixels[..., :3]), srgb_from_linear(drawn[..., :3])
    _, theirs = _similarity(a, b)
    ours = np.array(similarity(flat(b), flat(a), (WIDTH, HEIGHT, 3))).reshape(a.shape)
    assert np.allclose(ours[5:-5, 5:-5], theirs[5:-5, 5:-5], atol=1e-5)


def test_a_fit_lowers_l1_and_dssim():
    model = surface_gaussians(300)
    model.log_scales += 0.7
    camera = surface_camera(model, 40, 32)
    rgb = np.asarray(render(model, camera).rgb)
    target = np.dstack([rgb, np.ones(rgb.shape[:2])]).astype(np.float32)
    model.sh[:] = 0
    found = fit_gaussians(
        model, [camera], [target], TrainSettings(loss="l1-dssim", passes=8, tolerance=0)
    )
    grey = np.asarray(render(model, camera).rgb, np.float64)
    assert found.losses[0] == pytest.approx(
        slow_loss(grey, rgb, np.ones_like(rgb)).mean(), rel=1e-4
    )
    assert found.losses[1] == pytest.approx(found.losses[0], rel=1e-5)
    assert found.loss < 0.9 * found.losses[0]
