"""Density control of a fit: formula of a split, relocation, bitwise repetition."""

from dataclasses import replace

import numpy as np
import pytest

from mgs.bench import surface_camera, surface_gaussians
from mgs.errors import InputError
from mgs.fit.density import MOST_COPIES, Statistics, relocate, split, statistics
from mgs.fit.fitting import fit
from mgs.fit.objective import objective
from mgs.fit.settings import RATES, TrainSettings
from mgs.splat import as_drjit, reference, render


@pytest.mark.parametrize("opacity", [0.01, 0.5, 0.99])
@pytest.mark.parametrize("copies", [1, 2, 7, MOST_COPIES])
def test_copies_keep_opacity_at_the_centre_and_along_a_line(opacity, copies):
    """Reference: the opacity of the copies together, integrated numerically in float64."""
    (new,), (factor,) = split(np.array([opacity]), np.array([copies]))
    x = np.linspace(-30, 30, 60_001)
    together = 1 - (1 - new * np.exp(-0.5 * (x / factor) ** 2)) ** copies
    assert together.max() == pytest.approx(opacity, rel=1e-9)
    assert together.sum() == pytest.approx(opacity * np.exp(-0.5 * x**2).sum(), rel=1e-6)


@pytest.fixture(scope="module")
def scene():
    """A speckled surface, a camera, its image with weights of 1, and the same surface in grey."""
    truth = surface_gaussians(300)
    truth.log_scales += 0.7
    camera = surface_camera(truth, 40, 32)
    rgb = np.asarray(render(truth, camera).rgb)
    return truth, camera, np.dstack([rgb, np.ones(rgb.shape[:2])]).astype(np.float32)


def test_statistics_are_those_of_the_reference(scene):
    truth, camera, target = scene
    grey = replace(truth, sh=np.zeros_like(truth.sh))
    found = statistics(objective(grey, [camera], [target]), as_drjit(grey))
    projected = reference.project(grey, camera)
    order, alpha, T, _ = reference.composite(projected, camera)
    weights = np.zeros((len(alpha), len(grey)))
    weights[:, order] = alpha * T
    squares = (weights @ projected.colours - target[..., :3].reshape(-1, 3)) ** 2
    assert np.allclose(found.weight, weights.sum(0), rtol=1e-3, atol=1e-3)
    assert np.allclose(found.error, weights.T @ squares.mean(1), rtol=1e-3, atol=1e-4)


def test_the_dead_and_least_seen_move_to_the_error():
    model, n = surface_gaussians(200), 200
    model.logit_opacities[:5] = -9.0
    weight, error = np.arange(1.0, n + 1), np.zeros(n)
    error[150] = 1.0
    new, kept = relocate(model, Statistics(weight, error), np.random.default_rng(0))
    moved = np.flatnonzero(kept < 0)
    assert set(moved) == {*range(10), 150}  # five dead ones are among the ten least seen
    assert np.allclose(new.opacities[moved], 1 - (1 - model.opacities[150]) ** (1 / 11), rtol=1e-5)
    assert np.abs(new.means[moved] - model.means[150]).max() < 5 * np.exp(new.log_scales[150].max())
    others = kept >= 0
    assert new[others] == model[others]
    still, kept = relocate(model, Statistics(weight, 0 * error), np.random.default_rng(0))
    assert still == model
    assert (kept >= 0).all()


def test_a_fit_with_relocation_repeats_bitwise_and_needs_free_means(scene):
    truth, camera, target = scene
    start = replace(truth, sh=np.zeros_like(truth.sh))
    rates = RATES | {"mean": 0.01}
    settings = TrainSettings(means="free", density="relocate", passes=12, rates=rates)
    one, two = (fit(start, [camera], [target], settings) for _ in range(2))
    assert one.gaussians == two.gaussians
    assert one.losses == two.losses
    assert one.loss < one.losses[0]
    with pytest.raises(InputError, match="free means"):
        fit(start, [camera], [target], TrainSettings(density="relocate"))
    with pytest.raises(InputError, match="fixed, relocate"):
        fit(start, [camera], [target], TrainSettings(density="dreams"))
