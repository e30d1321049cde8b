"""Predicted errors: their terms against the oracle, and the measures of calibration on errors whose
truth is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splat.scenes import calm, make_camera, make_gaussians

from mgs.data.dataset import Dataset
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.images import write_png
from mgs.run.folder import Run
from mgs.run.settings import NbvSettings
from mgs.splat import reference
from studies import calibration, predicted_error
from studies.calibration import (
    ause,
    ause_of_constant,
    fit_calibration,
    judged,
    sparsification,
)

N = 20_000


def known(seed=0, n=N):
    """Errors of normal distributions whose standard deviations spread over a decade."""
    rng = np.random.default_rng(seed)
    sigma = 0.1 * 10 ** rng.uniform(-0.5, 0.5, n)
    return sigma * rng.standard_normal(n), sigma


def test_parameter_variance_is_that_of_the_oracles_jacobian():
    camera = make_camera((20, 14))
    gaussians = calm(lambda seed: make_gaussians(6, seed, 1, log_scales=(-2.5, -1.0)), camera, 3)
    J = reference.jacobian(gaussians, camera)
    variance = np.random.default_rng(1).uniform(0.01, 0.1, J.shape[-2:])
    expected = (np.square(J) * variance).sum(axis=(2, 3))
    rng, draws = np.random.default_rng(2), 500
    found = predicted_error.parameter_variance(gaussians, camera, variance, rng, draws)
    expected = expected.reshape(found.shape)
    seen = expected > 1e-3 * expected.max()
    ratio = found[seen] / expected[seen]
    assert abs(ratio.mean() - 1) < 0.03
    assert np.abs(ratio - 1).max() < 6 * np.sqrt(2 / draws)


def test_residual_variance_is_the_weighted_mean_over_pixels(tmp_path):
    camera = make_camera((20, 14))
    gaussians = calm(lambda seed: make_gaussians(5, seed, log_scales=(-2.5, -1.5)), camera, 5)
    truth = np.random.default_rng(0).random((14, 20, 3)).astype(np.float32)
    write_png(tmp_path / "truth.png", truth)
    frame = Frame("truth", camera, 0.0, tmp_path / "truth.png", None, None)
    found = predicted_error.residual_variance(gaussians, [frame, frame])
    # Weights of a Gaussian: the oracle's image in which it alone is white.
    white = [predicted_error._coloured(gaussians, one) for one in np.eye(5)]
    weights = np.stack([reference.render(one, camera)["rgb"][..., 0] for one in white])
    rendered = reference.render(gaussians, camera)["rgb"]
    error = np.square(rendered - frame.target()[0][..., :3]).mean(-1)
    expected = (weights * error).sum((1, 2)) / weights.sum((1, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def judge(errors, sigma):
    return judged(errors, sigma, calibration.NORMAL, np.random.default_rng(1))


def test_a_true_sigma_is_found_to_be_true():
    found = judge(*known())
    for level in calibration.LEVELS:
        assert np.abs(np.array(found["held"][str(level)]) - level).max() < 0.02
    area = found["ause"]
    assert abs(area["ause"] - area["perfect"]) < 0.02
    assert area["ause"] < 0.5 * area["constant"]
    assert np.abs(np.array(found["pit"]) * calibration.BINS - 1).max() < 0.15
    assert found["spearman"] > 0.4


def test_a_sigma_half_as_large_and_one_that_knows_nothing_are_found_out():
    errors, sigma = known()
    assert judge(errors, sigma / 2)["held"]["0.9"][0] < 0.7
    shuffled = judge(errors, np.random.default_rng(2).permutation(sigma))
    area = shuffled["ause"]
    assert abs(area["ause"] - area["constant"]) < 0.05
    assert area["perfect"] < 0.5 * area["constant"]  # errors drawn from it follow it
    assert abs(shuffled["spearman"]) < 0.05
    assert judge(errors, np.full(N, 0.1))["spearman"] == 0


def test_calibration_finds_the_weights_of_the_terms():
    rng = np.random.default_rng(0)
    a, b, idle = rng.uniform(0.1, 2, (3, N))
    errors = np.sqrt(0.5 * a + 3 * b + 0.2) * rng.standard_normal(N)
    found = fit_calibration({"a": a, "b": b, "idle": idle}, errors)
    assert found.weights["a"] == pytest.approx(0.5, abs=0.15)
    assert found.weights["b"] == pytest.approx(3, rel=0.1)
    assert found.weights["idle"] < 0.15
    assert found.widths[0.9] == pytest.approx(calibration.NORMAL[0.9], rel=0.03)
    inside = np.abs(errors) <= found.widths[0.9] * found.sigma({"a": a, "b": b, "idle": idle})
    assert inside.mean() == pytest.approx(0.9, abs=1e-3)


@settings(max_examples=8)
@given(st.floats(1e-8, 1e8), st.floats(1e-8, 1e8))
def test_calibration_does_not_depend_on_units(unit, scale):
    rng = np.random.default_rng(0)
    term = rng.uniform(0.1, 2, 500)
    errors = np.sqrt(term) * rng.standard_normal(500)
    plain = fit_calibration({"t": term}, errors).sigma({"t": term})
    scaled = fit_calibration({"t": scale * term}, unit * errors).sigma({"t": scale * term})
    np.testing.assert_allclose(scaled, unit * plain, rtol=1e-3)


def test_exact_fits_do_not_break_the_calibration():
    found = fit_calibration({"t": np.zeros(10)}, np.zeros(10))
    assert np.isfinite(found.sigma({"t": np.zeros(10)})).all()


@given(st.integers(0, 10_000), st.integers(2, 300))
def test_sparsification(seed, n):
    rng = np.random.default_rng(seed)
    errors, sigma = rng.random(n), rng.random(n)
    best = sparsification(errors, errors)
    assert best[0] == pytest.approx(1)
    assert (np.diff(best) <= 1e-12).all()
    assert (sparsification(errors, sigma) >= best - 1e-9).all()
    assert ause(errors, errors) == 0
    assert ause(errors, -errors) >= ause_of_constant(errors) - 1e-9
    assert ause(np.zeros(n), sigma) == 0


@pytest.mark.parametrize(
    ("trained", "changes", "said"),
    [
        (5, {}, "has 5 images; calibration leaves out a third of them, and needs 6 or more"),
        (7, {"train": {"means": "free"}}, "learns means"),
        (7, {"exposure": True}, "estimates exposure"),
        (8, {}, "was trained on all views there are"),
    ],
)
def test_runs_that_cannot_be_calibrated(trained, changes, said, tmp_path):
    frames = tuple(Frame(name, make_camera(), 0.0, None, None, None) for name in "abcdefgh")
    given_settings = NbvSettings(dataset="d", prior="p", **changes)
    run = Run(tmp_path, given_settings, Dataset(tmp_path, frames))
    run.steps = [{"seeds": list(range(trained))}]
    with pytest.raises(InputError, match=said):
        predicted_error._views(run)
