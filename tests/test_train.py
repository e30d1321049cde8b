"""Fits: loss, single steps, stopping and bitwise repetition."""

import math
from dataclasses import replace

import numpy as np
import pytest
from refusals import fails
from splat.scenes import cameras_around

from mgs import Camera, InputError, ListCache, ModelSettings, TrainSettings, fisher, render
from mgs.fit.fitting import COLOUR_MIN, fit_gaussians
from mgs.fit.optimisers import ADAM_EPSILON
from mgs.fit.stopping import LOSS_FLOOR, StopReason, stop_reason
from mgs.gaussians import LEARNED, Gaussians
from studies.frame.timing import surface_gaussians


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    gaussians = surface_gaussians(600)
    gaussians.logit_opacities[:] = 6.0  # opaque: the far side is hidden
    gaussians.log_scales += 0.7
    return gaussians


@pytest.fixture(scope="module")
def cameras(truth) -> list[Camera]:
    return cameras_around(truth, (0.0, 2.1, 4.2))


@pytest.fixture(scope="module")
def targets(truth, cameras) -> list[np.ndarray]:
    return [np.asarray(render(truth, camera).rgb) for camera in cameras]


def grey(truth: Gaussians) -> Gaussians:
    return replace(truth, sh=np.zeros_like(truth.sh))


def mean_square(gaussians, cameras, targets) -> float:
    pairs = zip(cameras, targets, strict=True)
    return float(np.mean([(np.asarray(render(gaussians, c).rgb) - t) ** 2 for c, t in pairs]))


def rates_of(colour: float, scale=0.0, rotation=0.0, opacity=0.0) -> dict[str, float]:
    return {"colour": colour, "scale": scale, "rotation": rotation, "opacity": opacity}


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in LEARNED)


def derivative(start: Gaussians, camera: Camera, target: np.ndarray, i: int) -> float:
    """Derivative of half the squared error by the first colour coefficient of a Gaussian."""
    values = []
    for step in (0.05, -0.05):
        sh = start.sh.copy()
        sh[i, 0, 0] += step
        rgb = np.asarray(render(replace(start, sh=sh), camera).rgb, np.float64)
        values.append(0.5 * ((rgb - target) ** 2).sum())
    return float(values[0] - values[1]) / 0.1


def test_fit_lowers_the_loss_a_hundredfold_and_reports_it(truth, cameras, targets):
    start, rates = grey(truth), rates_of(0.05, 0.01, 0.01, 0.02)
    settings = TrainSettings(passes=60, tolerance=0.0, rates=rates, loss="squared")
    found = fit_gaussians(start, cameras, targets, settings)
    assert found.stop_reason == "pass-limit"
    assert (found.passes, found.iterations) == (60, 180)
    after = mean_square(found.gaussians, cameras, targets)
    assert after < 0.01 * mean_square(start, cameras, targets)
    assert found.loss == pytest.approx(after, rel=0.1)
    assert np.array_equal(found.gaussians.means, truth.means)


def test_alpha_as_a_channel_makes_alpha_right(truth, cameras):
    """A black model in front of black: alpha alone shows what it covers."""
    black = replace(truth, sh=np.full_like(truth.sh, -2.0))
    start = replace(black, logit_opacities=np.zeros_like(black.logit_opacities))
    alphas = [np.asarray(render(black, camera).alpha) for camera in cameras]
    with_alpha = [np.dstack([np.zeros((*a.shape, 3)), np.ones_like(a), a]) for a in alphas]

    def error(weight):
        settings = TrainSettings(passes=20, tolerance=0.0, alpha_weight=weight)
        found = fit_gaussians(start, cameras, with_alpha, settings).gaussians
        drawn = [np.asarray(render(found, camera).alpha) for camera in cameras]
        return float(np.mean([np.abs(d - a).mean() for d, a in zip(drawn, alphas, strict=True)]))

    assert error(1.0) < 0.3 * error(0.0)


def test_one_step_is_adam_on_the_gradient_of_the_summed_squared_error(truth, cameras, targets):
    """The first step is minus the rate times g / (|g| + epsilon)."""
    start = grey(truth)
    settings = TrainSettings(optimiser="adam", passes=1, rates=rates_of(0.02), loss="squared")
    found = fit_gaussians(start, cameras[:1], targets[:1], settings)
    step = (found.gaussians.sh - start.sh)[:, 0, 0]
    for i in np.argsort(-np.abs(step))[:3]:
        g = derivative(start, cameras[0], targets[0], i)
        assert step[i] == pytest.approx(-0.02 * g / (abs(g) + ADAM_EPSILON), rel=1e-2)


def test_what_no_image_shows_stays_where_the_prior_put_it(truth, cameras, targets):
    start = grey(truth)
    found = fit_gaussians(start, cameras[:1], targets[:1], TrainSettings(passes=1))
    hidden = fisher(start, cameras[0])[:, 0] == 0
    assert hidden.sum() > 20
    for name in LEARNED:
        after, before = getattr(found.gaussians, name), getattr(start, name)
        assert np.array_equal(after[hidden], before[hidden])
        assert not np.array_equal(after[~hidden], before[~hidden])


@pytest.mark.parametrize("degree", range(3))
def test_colours_learn_one_more_sh_degree_after_some_steps(truth, cameras, targets, degree):
    """As in 3DGS; here after each pass."""
    start = grey(truth).with_degree(2)
    train = TrainSettings(passes=degree + 1, tolerance=0, sh_steps=len(cameras), loss="squared")
    found = fit_gaussians(start, cameras, targets, train).gaussians
    learned = (found.sh != start.sh).any(axis=(0, 2))
    assert np.array_equal(learned, np.arange(9) < (degree + 1) ** 2)


def test_the_coefficients_of_a_colour_do_not_overshoot_together(truth, cameras, targets):
    """From the truth, images with noise leave nothing to learn: the loss rises by the steps."""
    rng = np.random.default_rng(0)
    noisy = [t + rng.normal(0, 0.05, t.shape).astype(np.float32) * (t > 0) for t in targets]
    start = truth.with_degree(3)
    losses = fit_gaussians(start, cameras, noisy, TrainSettings(passes=2)).losses
    assert max(losses) < 1.2 * losses[0]  # 1.32 where every coefficient steps as if alone


def test_fit_repeats_bitwise_and_owes_nothing_to_a_used_cache(truth, cameras, targets):
    settings, cache = TrainSettings(passes=5), ListCache()
    first = fit_gaussians(grey(truth), cameras, targets, settings, cache=cache)
    again = fit_gaussians(grey(truth), cameras, targets, settings, cache=cache)
    assert first.loss == again.loss
    assert same(first.gaussians, again.gaussians)
    other = fit_gaussians(grey(truth), cameras, targets, TrainSettings(passes=5, seed=1))
    assert not np.array_equal(first.gaussians.sh, other.gaussians.sh)


def faster(factor: float, **values) -> TrainSettings:
    """Settings with multiplied learning rates."""
    rates = {kind: factor * rate for kind, rate in TrainSettings().rates.items()}
    return TrainSettings(rates=rates, **values)


@pytest.mark.parametrize(("first", "later"), [(10, 3), (2, 2)])
def test_fits_after_the_first_take_fewer_passes_at_lower_rates(first, later):
    rates = rates_of(0.02) | {"mean": 0.01}
    settings = ModelSettings(warm_passes=3, warm_rate=0.5, train={"passes": first, "rates": rates})
    assert settings.train_at(0) == settings.train
    assert settings.train_at(1).passes == settings.train_at(9).passes == later
    assert settings.train_at(1).rates == {kind: rate / 2 for kind, rate in rates.items()}


def test_a_fit_whose_loss_rises_has_diverged(truth, cameras, targets):
    found = fit_gaussians(grey(truth), cameras, targets, faster(1000, loss="squared"))
    assert found.stop_reason == StopReason.DIVERGED
    assert found.losses[0] == pytest.approx(mean_square(grey(truth), cameras, targets), rel=1e-5)
    assert min(found.losses[-5:]) > 1.5 * found.losses[0]
    assert found.passes == len(found.losses) - 1 < 40
    assert found.loss == min(found.losses[1:])


@pytest.mark.parametrize("views", [1, 3])
def test_a_fit_that_leaves_the_numbers_returns_what_it_was_given(truth, cameras, targets, views):
    start = grey(truth)
    rates = {kind: 1e40 * rate for kind, rate in TrainSettings().rates.items()}
    beyond = TrainSettings(optimiser="adam").model_copy(update={"rates": rates})  # unchecked
    found = fit_gaussians(start, cameras[:views], targets[:views], beyond)
    assert (found.stop_reason, found.passes) == (StopReason.DIVERGED, 1)
    assert np.isnan(found.losses[1])
    assert found.loss == found.losses[0]
    assert same(found.gaussians, start)


def test_the_model_of_the_lowest_loss_is_kept(truth, cameras, targets):
    long = fit_gaussians(grey(truth), cameras, targets, faster(50, passes=8, decay=1.0))
    best = int(np.argmin(long.losses[1:])) + 1
    assert best < long.passes
    assert long.loss == long.losses[best] < long.losses[-1]
    short = fit_gaussians(grey(truth), cameras, targets, faster(50, passes=best, decay=1.0))
    assert short.losses == long.losses[: best + 1]
    assert same(short.gaussians, long.gaussians)


@pytest.mark.parametrize(
    ("losses", "limit", "expected"),
    [
        ([1, 0.5, 0.4, 0.3], 40, None),
        ([1, 0.5, 0.499, 0.498], 40, StopReason.SETTLED),
        ([1, 0.5, 0.499, 0.498], 3, StopReason.SETTLED),
        ([1, 0.5, 0.499, 0.4993], 40, StopReason.SETTLED),  # a rise within the tolerance
        ([1, 0.5, 0.499], 40, None),  # needs two passes in a row
        ([1, 0.5, 0.499], 2, StopReason.PASS_LIMIT),
        ([1, 0.5, 0.49, 0.4895], 40, None),
        ([1, 0.5, 0.504, 0.508], 40, None),  # small rises add up
        ([1, 0.5, 0.6, 0.598, 0.597], 40, None),  # flat, but above the lowest
        ([1, 1.03, 1.2, 1.28, 1.05, 1.05], 5, StopReason.PASS_LIMIT),  # a short fit, a new view
        ([1, 3, 1.4, 3, 3, 3, 3], 40, None),
        ([1, 3, 3, 3, 3], 40, None),
        ([1, 3, 3, 3, 3, 3], 40, StopReason.DIVERGED),
        ([1, 3, 3], 2, StopReason.DIVERGED),
        ([1, 0.1, 3, 4, 5, 6, 7], 40, StopReason.DIVERGED),
        ([1, 0.5, math.nan], 40, StopReason.DIVERGED),
        ([0, *[LOSS_FLOOR] * 3], 40, StopReason.SETTLED),  # starts at the solution
    ],
)
def test_why_a_fit_stops(losses, limit, expected):
    assert stop_reason(losses, 0.01, limit) is expected
    assert stop_reason([1, 0.5, 0.5, 0.5], 0.0, 40) is None, "without tolerance nothing settles"


def test_what_is_refused_for_another_reason_than_its_numbers_is_no_divergence(
    truth, cameras, targets, monkeypatch
):
    monkeypatch.setattr("mgs.splat.blocks.MAX_PAIRS", 4)
    fails("pairs", fit_gaussians, grey(truth), cameras, targets, TrainSettings(passes=1))


def test_colours_stay_above_zero_and_none_is_dead(truth, cameras, targets):
    """Colours that are driven to black stop at the bound, and can still become brighter."""
    start = grey(truth)
    black = [np.zeros_like(target) for target in targets]
    fast = TrainSettings(passes=40, tolerance=0.0, rates=rates_of(0.2))
    dark = fit_gaussians(start, cameras, black, fast).gaussians
    seen = sum(fisher(start, camera)[:, 0] for camera in cameras) > 1
    rgb = 0.5 + 0.28209479 * dark.sh[:, 0]
    assert rgb.min() == pytest.approx(COLOUR_MIN, rel=0.01)
    assert np.allclose(rgb[seen], COLOUR_MIN, rtol=0.01)
    bright = fit_gaussians(dark, cameras, targets, fast).gaussians
    assert mean_square(bright, cameras, targets) < 0.05 * mean_square(dark, cameras, targets)
    assert (0.5 + 0.28209479 * bright.sh[seen, 0]).min() >= 0.99 * COLOUR_MIN


def test_a_start_of_another_shape_is_refused(truth, cameras, targets):
    richer = replace(truth, sh=np.zeros((len(truth), 4, 3)))
    with pytest.raises(InputError, match="start: has colours of shape"):
        fit_gaussians(truth, cameras, targets, TrainSettings(passes=1), start=richer)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"optimiser": "dreams"}, "natural, adam"),
        ({"loss": "dreams"}, "squared, l1-dssim"),
        ({"density": "dreams"}, "fixed, adaptive"),
        ({"density": "adaptive"}, "free means"),
        ({"means": "free"}, "no rate of mean"),
    ],
)
def test_unusable_settings_are_refused(truth, values, words):
    fails(words, fit_gaussians, truth, [], [], TrainSettings(**values))
