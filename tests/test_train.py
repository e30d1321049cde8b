"""Fitting appearance: it finds what images say, leaves alone what they do not, and repeats itself
bit for bit."""

import math

import numpy as np
import pytest

from mgs.bench.core import surface_camera, surface_gaussians
from mgs.camera import Camera, look_at
from mgs.errors import InputError
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.fit.stopping import LOSS_FLOOR, StopReason, stop_reason
from mgs.gaussians import LEARNED, Gaussians
from mgs.splat import ListCache, fisher, render


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    gaussians = surface_gaussians(600)
    gaussians.logit_opacities[:] = 6.0  # opaque: the far side is hidden
    gaussians.log_scales += 0.7
    return gaussians


@pytest.fixture(scope="module")
def cameras(truth) -> list[Camera]:
    first = surface_camera(truth, 40, 32)
    distance = np.linalg.norm(first.position)
    eyes = [distance * np.array([np.cos(a), np.sin(a), 0.4]) for a in (0.0, 2.1, 4.2)]
    return [Camera(first.K, 40, 32, look_at(eye, [0, 0, 0.4])) for eye in eyes]


@pytest.fixture(scope="module")
def targets(truth, cameras) -> list[np.ndarray]:
    return [np.asarray(render(truth, camera).rgb) for camera in cameras]


def grey(truth: Gaussians) -> Gaussians:
    return Gaussians(
        truth.means, truth.log_scales, truth.quats, truth.logit_opacities, np.zeros_like(truth.sh)
    )


def mean_square(gaussians, cameras, targets) -> float:
    return float(
        np.mean(
            [
                (np.asarray(render(gaussians, c).rgb) - t) ** 2
                for c, t in zip(cameras, targets, strict=True)
            ]
        )
    )


def test_fit_lowers_the_loss_a_hundredfold_and_reports_it(truth, cameras, targets):
    start = grey(truth)
    found = fit(
        start,
        cameras,
        targets,
        TrainSettings(passes=60, tolerance=0.0, rates=(0.05, 0.01, 0.01, 0.02)),
    )
    assert found.stop_reason == "pass-limit"
    assert (found.passes, found.iterations) == (60, 180)
    assert mean_square(found.gaussians, cameras, targets) < 0.01 * mean_square(
        start, cameras, targets
    )
    assert found.loss == pytest.approx(mean_square(found.gaussians, cameras, targets), rel=0.1)
    assert np.array_equal(found.gaussians.means, truth.means)


def test_alpha_as_a_channel_makes_alpha_right(truth, cameras, targets):
    """A black model in front of black: what it covers cannot be told from colours, and can from
    alpha."""
    black = Gaussians(
        truth.means,
        truth.log_scales,
        truth.quats,
        truth.logit_opacities,
        np.full_like(truth.sh, -2.0),
    )
    start = Gaussians(
        black.means, black.log_scales, black.quats, np.zeros_like(black.logit_opacities), black.sh
    )
    alphas = [np.asarray(render(black, camera).alpha) for camera in cameras]
    with_alpha = [np.dstack([np.zeros((*a.shape, 3)), np.ones_like(a), a]) for a in alphas]

    def error(weight):
        settings = TrainSettings(passes=20, tolerance=0.0, alpha_weight=weight)
        found = fit(start, cameras, with_alpha, settings).gaussians
        drawn = [np.asarray(render(found, camera).alpha) for camera in cameras]
        return float(np.mean([np.abs(d - a).mean() for d, a in zip(drawn, alphas, strict=True)]))

    assert error(1.0) < 0.3 * error(0.0)


def test_one_step_is_adam_on_the_gradient_of_the_summed_squared_error(truth, cameras, targets):
    """The first Adam step moves each parameter by its rate times g / (|g| + epsilon): against
    finite differences."""
    from mgs.fit.optimisers import ADAM_EPSILON

    start = grey(truth)
    found = fit(
        start,
        cameras[:1],
        targets[:1],
        TrainSettings(optimiser="adam", passes=1, rates=(0.02, 0, 0, 0)),
    )
    step = (found.gaussians.sh - start.sh)[:, 0, :]

    def half_sum(sh):
        moved = Gaussians(start.means, start.log_scales, start.quats, start.logit_opacities, sh)
        return 0.5 * float(
            ((np.asarray(render(moved, cameras[0]).rgb, np.float64) - targets[0]) ** 2).sum()
        )

    for i in np.argsort(-np.abs(step[:, 0]))[:3]:
        up, down = start.sh.copy(), start.sh.copy()
        up[i, 0, 0] += 0.05
        down[i, 0, 0] -= 0.05
        g = (half_sum(up) - half_sum(down)) / 0.1
        assert step[i, 0] == pytest.approx(-0.02 * g / (abs(g) + ADAM_EPSILON), rel=1e-2)


def test_one_step_is_natural_on_the_gradient_of_the_objective(truth, cameras, targets):
    """The first step goes against a tenth of the gradient over four times the information, at most
    by the rate."""
    start = grey(truth)
    lam = {"colour": 0.05, "scale": 0.5, "rotation": 0.5, "opacity": 0.1}
    found = fit(
        start, cameras[:1], targets[:1], TrainSettings(passes=1, rates=(0.01, 0, 0, 0)), lam=lam
    )
    step = (found.gaussians.sh - start.sh)[:, 0, :]
    information = fisher(start, cameras[0])[:, :3] + 0.05

    def half_sum(sh):
        moved = Gaussians(start.means, start.log_scales, start.quats, start.logit_opacities, sh)
        return 0.5 * float(
            ((np.asarray(render(moved, cameras[0]).rgb, np.float64) - targets[0]) ** 2).sum()
        )

    inside = np.argsort(np.abs(np.abs(step[:, 0]) - 0.005))[
        :3
    ]  # steps of about half the rate, so not cut
    longest = np.argsort(-np.abs(step[:, 0]))[:2]
    for i in (*inside, *longest):
        up, down = start.sh.copy(), start.sh.copy()
        up[i, 0, 0] += 0.05
        down[i, 0, 0] -= 0.05
        g = (half_sum(up) - half_sum(down)) / 0.1
        expected = np.clip(-0.1 * g / (4 * information[i, 0]), -0.01, 0.01)
        assert step[i, 0] == pytest.approx(expected, rel=1e-2)
    assert np.abs(step).max() == pytest.approx(0.01, rel=1e-4)


def test_what_no_image_shows_stays_where_the_prior_put_it(truth, cameras, targets):
    start = grey(truth)
    found = fit(start, cameras[:1], targets[:1], TrainSettings(passes=1))
    hidden = fisher(start, cameras[0])[:, 0] == 0
    assert hidden.sum() > 20
    for name in LEARNED:
        assert np.array_equal(getattr(found.gaussians, name)[hidden], getattr(start, name)[hidden])
        assert not np.array_equal(
            getattr(found.gaussians, name)[~hidden], getattr(start, name)[~hidden]
        )


def test_fit_repeats_bitwise_and_owes_nothing_to_a_used_cache(truth, cameras, targets):
    settings, cache = TrainSettings(passes=5), ListCache()
    first = fit(grey(truth), cameras, targets, settings, cache=cache)
    again = fit(grey(truth), cameras, targets, settings, cache=cache)
    assert first.loss == again.loss
    assert all(
        np.array_equal(getattr(first.gaussians, n), getattr(again.gaussians, n)) for n in LEARNED
    )
    other = fit(grey(truth), cameras, targets, TrainSettings(passes=5, seed=1))
    assert not np.array_equal(first.gaussians.sh, other.gaussians.sh)


def test_stops_when_passes_no_longer_help(truth, cameras, targets):
    found = fit(grey(truth), cameras, targets, TrainSettings(passes=50, rates=(1e-4,) * 4))
    assert found.stop_reason == "settled"
    assert found.passes < 50


def faster(factor: float, **values) -> TrainSettings:
    """Learning rates that many times too high."""
    return TrainSettings(
        rates={kind: factor * rate for kind, rate in TrainSettings().rates.items()}, **values
    )


def test_a_fit_whose_loss_rises_has_diverged(truth, cameras, targets):
    found = fit(grey(truth), cameras, targets, faster(1000))
    assert found.stop_reason == StopReason.DIVERGED
    assert found.losses[0] == pytest.approx(mean_square(grey(truth), cameras, targets), rel=1e-5)
    assert min(found.losses[-5:]) > 1.5 * found.losses[0]
    assert found.passes == len(found.losses) - 1 < 40
    assert found.loss == min(found.losses[1:])


@pytest.mark.parametrize("views", [1, 3])
def test_a_fit_that_leaves_the_numbers_returns_what_it_was_given(truth, cameras, targets, views):
    start = grey(truth)
    found = fit(start, cameras[:views], targets[:views], faster(1e40, optimiser="adam"))
    assert (found.stop_reason, found.passes) == (StopReason.DIVERGED, 1)
    assert np.isnan(found.losses[1])
    assert found.loss == found.losses[0]
    for name in LEARNED:
        assert np.array_equal(getattr(found.gaussians, name), getattr(start, name))


def test_the_model_of_the_lowest_loss_is_kept(truth, cameras, targets):
    long = fit(grey(truth), cameras, targets, faster(50, passes=8, decay=1.0))
    best = int(np.argmin(long.losses[1:])) + 1
    assert best < long.passes
    assert long.loss == long.losses[best] < long.losses[-1]
    short = fit(grey(truth), cameras, targets, faster(50, passes=best, decay=1.0))
    assert short.losses == long.losses[: best + 1]
    assert all(
        np.array_equal(getattr(short.gaussians, n), getattr(long.gaussians, n)) for n in LEARNED
    )


LONG = [2 * 0.9**k for k in range(6)]
"""From twice the start to 1.18 times."""


@pytest.mark.parametrize(
    ("losses", "limit", "expected"),
    [
        ([1, 0.5, 0.4, 0.3], 40, None),
        ([1, 0.5, 0.499, 0.498], 40, StopReason.SETTLED),
        ([1, 0.5, 0.499, 0.498], 3, StopReason.SETTLED),
        (
            [1, 0.5, 0.499, 0.4993],
            40,
            StopReason.SETTLED,
        ),  # a rise within the tolerance is no fall, and no divergence
        ([1, 0.5, 0.499], 40, None),  # twice in a row
        ([1, 0.5, 0.499], 2, StopReason.PASS_LIMIT),
        ([1, 0.5, 0.49, 0.4895], 40, None),
        ([1, 0.5, 0.6, 0.7], 40, None),
        ([1, 0.5, 0.504, 0.508], 40, None),  # small rises that add up
        ([1, 0.5, 0.6, 0.598, 0.597], 40, None),  # flat, but well above what it had
        ([1, 1.2, 1.2, 1.2, 1.2, 1.2], 40, None),  # flat above the start
        (
            [1, 1.2, 1.2, 1.2, 1.2, 1.2],
            5,
            StopReason.PASS_LIMIT,
        ),  # worse than the start, which is not yet divergence
        (
            [1, 1.03, 1.2, 1.28, 1.05, 1.05],
            5,
            StopReason.PASS_LIMIT,
        ),  # as a short fit with a new view may end
        (
            [2.06, 2.40, 2.31, 2.25, 2.18, 2.08],
            5,
            StopReason.PASS_LIMIT,
        ),  # risen by one new view, and on its way back
        ([1, 1.2, 1.1, 1.05, 1.02, 1.005], 5, StopReason.PASS_LIMIT),
        ([1, 1.04], 1, StopReason.PASS_LIMIT),  # as the first pass of a healthy fit
        ([1, 3, 1.4, 3, 3, 3, 3], 40, None),
        ([1, 3, 3, 3, 3], 40, None),
        ([1, 3, 3, 3, 3, 3], 40, StopReason.DIVERGED),  # flat as a black image is
        ([1, 3, 3], 2, StopReason.DIVERGED),
        ([1, *LONG], 40, None),
        ([1, 0.1, 3, 4, 5, 6, 7], 40, StopReason.DIVERGED),
        ([1, 0.5, math.nan], 40, StopReason.DIVERGED),
        ([1, math.inf], 40, StopReason.DIVERGED),
        ([0, *[LOSS_FLOOR] * 3], 40, StopReason.SETTLED),  # started from the solution
    ],
)
def test_why_a_fit_stops(losses, limit, expected):
    assert stop_reason(losses, 0.01, limit) is expected


def test_without_tolerance_nothing_converges():
    assert stop_reason([1, 0.5, 0.5, 0.5], 0.0, 40) is None


def test_what_is_refused_for_another_reason_than_its_numbers_is_no_divergence(
    truth, cameras, targets, monkeypatch
):
    monkeypatch.setattr("mgs.splat.blocks.MAX_PAIRS", 4)
    with pytest.raises(InputError, match="pairs"):
        fit(grey(truth), cameras, targets, TrainSettings(passes=1))


def test_the_loss_is_the_objective_over_the_number_of_pixel_values(truth, cameras, targets):
    lam, start = {"colour": 0.3, "scale": 2.0, "rotation": 5.0, "opacity": 0.1}, grey(truth)
    begun = Gaussians(
        truth.means,
        truth.log_scales + 0.1,
        truth.quats + 0.05,
        truth.logit_opacities - 0.3,
        np.full_like(truth.sh, 0.2),
    )
    found = fit(begun, cameras, targets, TrainSettings(passes=1), start=start, lam=lam)
    weights = dict(zip(LEARNED, lam.values(), strict=True))
    prior = sum(
        weights[name] * ((getattr(begun, name) - getattr(start, name)) ** 2).sum()
        for name in LEARNED
    )
    expected = mean_square(begun, cameras, targets) + prior / sum(target.size for target in targets)
    assert found.losses[0] == pytest.approx(expected, rel=1e-4)
    # The loss of a pass of one image is measured before its step: that of the model given.
    single = fit(begun, cameras[:1], targets[:1], TrainSettings(passes=1), start=start, lam=lam)
    assert single.losses[1] == pytest.approx(single.losses[0], rel=1e-4)


def test_what_no_image_sees_goes_back_to_its_start(truth, cameras):
    """Where the gradient is the prior's alone, the most probable parameters are those of the
    start."""
    black = [np.zeros((32, 40, 4), np.float32) for _ in cameras]  # of weight 0
    begun = Gaussians(
        truth.means,
        truth.log_scales + 0.05,
        truth.quats,
        truth.logit_opacities + 0.1,
        truth.sh + 0.1,
    )
    lam = dict.fromkeys(("colour", "scale", "rotation", "opacity"), 100.0)
    settings = TrainSettings(passes=100, tolerance=0.0, decay=1e-3)
    found = fit(begun, cameras, black, settings, start=truth, lam=lam)
    for name in LEARNED:
        assert np.allclose(getattr(found.gaussians, name), getattr(truth, name), atol=2e-3), name
    assert found.loss < 1e-3 * found.losses[0]


def test_the_gradient_of_the_prior_is_that_of_the_objective(truth, cameras, targets):
    """One Adam step moves against the sum of both gradients: the image's is found without prior,
    the prior's by hand."""
    from mgs.fit.optimisers import ADAM_EPSILON

    rates, start = TrainSettings(optimiser="adam", passes=1, rates=(1e-3, 0, 0, 0)), grey(truth)
    begun = Gaussians(
        truth.means,
        truth.log_scales,
        truth.quats,
        truth.logit_opacities,
        np.full_like(truth.sh, 0.3),
    )

    def gradient(found):
        move = (begun.sh.astype(np.float64) - found.gaussians.sh) / 1e-3
        return move * ADAM_EPSILON / (1 - np.abs(move))

    image = gradient(fit(begun, cameras[:1], targets[:1], rates))
    both = gradient(fit(begun, cameras[:1], targets[:1], rates, start=start, lam={"colour": 0.002}))
    small = np.abs(image) < 0.02  # elsewhere the step says only the sign
    assert small.sum() > 100
    assert np.allclose((both - image)[small], 0.002 * 0.3, rtol=0.05, atol=2e-5)


def test_colours_stay_above_zero_and_none_is_dead(truth, cameras, targets):
    """Colours that are driven below black stop at the bound, and come back when the images ask for
    it."""
    from mgs.fit.fitting import COLOUR_MIN

    start = grey(truth)
    black = [np.zeros_like(target) for target in targets]
    fast = TrainSettings(passes=40, tolerance=0.0, rates=(0.2, 0, 0, 0))
    dark = fit(start, cameras, black, fast).gaussians
    seen = sum(fisher(start, camera)[:, 0] for camera in cameras) > 1
    rgb = 0.5 + 0.28209479 * dark.sh[:, 0]
    assert rgb.min() == pytest.approx(COLOUR_MIN, rel=0.01)
    assert np.allclose(rgb[seen], COLOUR_MIN, rtol=0.01)
    bright = fit(dark, cameras, targets, fast).gaussians
    assert mean_square(bright, cameras, targets) < 0.05 * mean_square(dark, cameras, targets)
    assert (0.5 + 0.28209479 * bright.sh[seen, 0]).min() >= 0.99 * COLOUR_MIN


def test_a_start_of_another_shape_is_refused(truth, cameras, targets):
    richer = Gaussians(
        truth.means,
        truth.log_scales,
        truth.quats,
        truth.logit_opacities,
        np.zeros((len(truth), 4, 3)),
    )
    with pytest.raises(InputError, match="start: has colours of shape"):
        fit(truth, cameras, targets, TrainSettings(passes=1), start=richer)
