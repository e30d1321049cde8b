"""Value, gradient and curvature of the objective, and losses, against float64 references."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from refusals import fails
from scipy.ndimage import correlate1d
from splat import reference
from splat.scenes import cameras_around

from mgs import TrainSettings, fit_gaussians
from mgs.colour import linear_from_pixels, srgb_from_linear
from mgs.fit import objective as module
from mgs.fit.losses import LOSSES, similarity
from mgs.fit.objective import as_target, objective
from mgs.gaussians import Gaussians, learned
from mgs.memory import padded
from mgs.metrics import _similarity
from mgs.splat import MEANS, as_drjit, render
from studies.frame.timing import surface_camera, surface_gaussians

N = 60
LAM = {"colour": 0.02, "scale": 0.05, "rotation": 0.1, "opacity": 0.01, "mean": 30.0}


KINDS = ("frozen", 0.0, True), ("free", 0.0, True), ("frozen", 0.3, False), ("free", 2.0, True)
"""Means, weight of alpha, whether colours are linear."""


@pytest.fixture(scope="module", params=KINDS)
def case(request):
    """Objective, model, and from the reference: Jacobian [M,P], residual [M], weights [M], lam [P]
    and offset from the start [P], parameters in the order of `learned`."""
    means, alpha_weight, linear = request.param
    start = surface_gaussians(N)
    start.log_scales += 0.9
    rng = np.random.default_rng(5)
    parts = start.log_scales, start.quats, start.logit_opacities, start.sh
    moved = ((a + 0.1 * rng.standard_normal(a.shape)).astype(np.float32) for a in parts)
    model = Gaussians(start.means, *moved, linear=linear)
    offsets = 0.02 * rng.standard_normal((N, MEANS[means]))
    if means == "free":
        model.means = (start.means + offsets).astype(np.float32)
    cameras = cameras_around(start, (0.3, 2.0), 24, 20)
    channels = 4 if alpha_weight else 3
    truths = [rng.uniform(0, 1, (20, 24, channels)).astype(np.float32) for _ in cameras]
    weights = [(rng.uniform(size=(20, 24, 1)) > 0.2).astype(np.float32) for _ in cameras]
    pairs = zip(truths, weights, strict=True)
    targets = [np.dstack([model.linear_rgb(t[..., :3]), w, t[..., 3:]]) for t, w in pairs]
    how = {"means": means, "alpha_weight": alpha_weight}
    goal = objective(model, cameras, targets, start, LAM, **how)
    columns = np.split(np.arange(11 + MEANS[means]), (3, 6, 10, 11))
    rows = []
    for camera in cameras:
        J = reference.jacobian(model, camera, **how)
        rows.append(np.concatenate([J[..., c].reshape(20 * 24 * channels, -1) for c in columns], 1))
    images = [reference.render(model, camera) for camera in cameras]
    images = [np.dstack([i["rgb"], i["alpha"]])[..., :channels] for i in images]
    scale = np.sqrt([1.0, 1.0, 1.0, alpha_weight])[:channels]
    residual = ((np.stack(images) - truths) * scale).ravel()
    weight = np.broadcast_to(weights, np.shape(truths)).ravel()
    changes = [(getattr(model, name) - getattr(start, name)).ravel() for name in learned()]
    changes.append(offsets.ravel())
    lam = np.repeat(list(LAM.values()), [change.size for change in changes])
    away = np.concatenate(changes).astype(np.float64)
    return goal, as_drjit(model), np.concatenate(rows), residual, weight, lam, away


def flat(vector):
    return np.concatenate([np.asarray(v).ravel() for v in vector])


def test_value_gradient_and_diagonals_are_those_of_the_reference(case):
    goal, model, J, residual, weight, lam, away = case
    phi = 0.5 * ((weight * residual) ** 2).sum() + 0.5 * (lam * away**2).sum()
    assert goal.phi(model) == pytest.approx(phi, rel=1e-5)
    gradient = J.T @ (weight * residual) + lam * away
    assert np.allclose(flat(goal.gradient(model)), gradient, atol=1e-4 * np.abs(gradient).max())
    whole = (J**2).sum(0) + lam
    each = (J.reshape(2, -1, J.shape[1]) ** 2).sum(1)  # two images
    diagonals = (goal.diagonal, whole), (goal.largest_diagonal, each.max(0) + lam / 2)
    for found, expected in diagonals:
        close = {"rtol": 1e-3, "atol": 1e-5 * expected.max()}
        assert np.allclose(flat(found(model)), expected, **close)


def test_images_of_different_sizes_count_by_their_pixels():
    model = surface_gaussians(50)
    cameras = [surface_camera(model, *size) for size in ((24, 20), (48, 40))]
    targets = [np.full((20, 24, 3), 0.9, np.float32), np.zeros((40, 48, 3), np.float32)]
    whole, *alone = (
        objective(model, cameras[some], targets[some]).phi(as_drjit(model))
        for some in (slice(2), slice(1), slice(1, 2))
    )
    assert whole == pytest.approx(sum(alone), rel=1e-6)


UNSEEN = np.zeros((20, 24, 4), np.float32)
"""A target of weight 0, so that the prior alone acts."""


def test_a_start_in_the_memory_of_the_model_is_kept_apart():
    """Otherwise a recorded step takes both for one array, and later fits have a wrong start."""
    model = surface_gaussians(50)
    images = model, [surface_camera(model, 24, 20)], [UNSEEN]
    settings = TrainSettings(optimiser="adam", passes=1, rates={"colour": 0.01})
    fit_gaussians(*images, settings, start=model, lam={"colour": 1.0})
    other = replace(model, sh=model.sh - 0.2)
    moved = fit_gaussians(*images, settings, start=other, lam={"colour": 1.0}).gaussians
    assert np.allclose(moved.sh - model.sh, -0.01, rtol=0.02)


def test_a_lam_for_each_degree_of_the_colours():
    start = surface_gaussians(50).with_degree(2)
    camera, size = surface_camera(start, 24, 20), start.sh.size
    change = np.linspace(-0.5, 0.5, size, dtype=np.float32).reshape(start.sh.shape)
    model = replace(start, sh=start.sh + change)
    lam = np.repeat([1.0, 4.0, 9.0], [1, 3, 5])[None, :, None]
    goal = objective(start, [camera], [UNSEEN], lam={"colour": lam})
    away = model.sh - start.sh
    assert goal.phi(as_drjit(model)) == pytest.approx(0.5 * (lam * away**2).sum(), rel=1e-5)
    assert np.allclose(np.asarray(goal.gradient(as_drjit(model))[0]), lam * away, rtol=1e-5)
    blind = replace(start, logit_opacities=np.full(50, -40, np.float32))
    diagonal = np.asarray(goal.diagonal(as_drjit(blind))[0])
    assert np.allclose(diagonal, np.broadcast_to(lam, away.shape))
    settings = TrainSettings(passes=360, rates={"colour": 0.2})  # nine coefficients: 1/9 as far
    found = fit_gaussians(model, [camera], [UNSEEN], settings, start=start, lam={"colour": lam})
    assert found.losses[0] == pytest.approx((lam * away**2).sum() / UNSEEN[..., :3].size, rel=1e-5)
    assert found.losses[1] == pytest.approx(found.losses[0], rel=1e-5)
    assert found.loss < 0.05 * found.losses[0]


def test_a_weight_for_alpha_needs_alpha():
    start = surface_gaussians(50)
    camera = surface_camera(start, 24, 20)
    goal = objective(start, [camera], [UNSEEN], alpha_weight=0.1)
    fails(r"target: has 4 channels, .* it needs 5, alpha as the", goal.phi, as_drjit(start))
    with_alpha = objective(start, [camera], [np.dstack([UNSEEN, UNSEEN[..., 0]])])
    assert with_alpha.photos[0].size == (24, 20, 3), "without a weight alpha is not read"


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
        rows = correlate1d(image, window, 0, mode="constant")
        return correlate1d(rows, window, 1, mode="constant")

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


def as_floats(image):
    return mi.Float(padded(image.astype(np.float32)).ravel())


@pytest.mark.parametrize("linear", [True, False])
def test_values_and_gradients_are_those_of_the_reference(images, linear):
    drawn, pixels, weights = images
    x, size = as_floats(drawn), (WIDTH, HEIGHT, drawn.shape[2])
    dr.enable_grad(x)
    values = LOSSES["l1-dssim"](x, as_floats(pixels), as_floats(weights), size, linear)
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
    ours = np.array(similarity(as_floats(b), as_floats(a), (WIDTH, HEIGHT, 3))).reshape(a.shape)
    assert np.allclose(ours[5:-5, 5:-5], theirs[5:-5, 5:-5], atol=1e-5)


def test_a_fit_has_the_loss_of_its_settings():
    model, black = surface_gaussians(50), UNSEEN.copy()
    camera, black[..., 3] = surface_camera(model, 24, 20), 1
    drawn = np.asarray(render(model, camera).rgb, np.float64)
    found = fit_gaussians(model, [camera], [black], TrainSettings(passes=1))
    expected = slow_loss(drawn, 0 * drawn, np.ones_like(drawn)).mean()
    assert found.losses == pytest.approx([expected] * 2, rel=1e-4)


@pytest.mark.parametrize(("linear", "alpha_weight"), [(True, 0.3), (False, 0.3), (False, 0.0)])
def test_images_of_eight_bits_take_a_quarter_of_the_memory_for_the_same_fit(
    monkeypatch, linear, alpha_weight
):
    model = replace(surface_gaussians(50), linear=linear)
    cameras, rng = cameras_around(model, (0.3, 2.0), 24, 20), np.random.default_rng(0)
    channels = 5 if alpha_weight else 4
    pixels = [rng.integers(0, 256, (20, 24, channels), np.uint8) for _ in cameras]
    shares = [image[..., 3:] / np.float32(255) for image in pixels]
    alphas = [share[..., 1:] if alpha_weight else np.float32(1) for share in shares]
    targets = [
        np.dstack([linear_from_pixels(image[..., :3]) * alpha, share])
        for image, alpha, share in zip(pixels, alphas, shares, strict=True)
    ]
    settings = TrainSettings(passes=2, alpha_weight=alpha_weight)
    coded = fit_gaussians(model, cameras, targets, settings).gaussians
    held = as_target(targets[0], linear, alpha_weight).nbytes
    assert held == pixels[0].size
    nearly = targets[0].copy()
    nearly[3, 4, 0] += 1e-5 + nearly[3, 4, 0] * 1e-5
    assert as_target(nearly, linear, alpha_weight).nbytes == 4 * held
    monkeypatch.setattr(module, "_levels", lambda linear: np.full((257, 256), -1, np.float32))
    plain = fit_gaussians(model, cameras, targets, settings).gaussians
    for name in ("sh", "log_scales", "quats", "logit_opacities"):
        assert np.array_equal(getattr(coded, name), getattr(plain, name)), name
