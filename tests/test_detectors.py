"""Warnings: each appears for its own fault, none on a good run; all are recorded and reported."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import synthetic
import tiny
from scipy.ndimage import binary_dilation, gaussian_filter
from scipy.spatial.transform import Rotation

from mgs import as_drjit, run_nbv
from mgs.colour import srgb_from_linear
from mgs.data.dataset import load_dataset, target_of, write_transforms
from mgs.data.frames import RIM
from mgs.evaluation import evaluate_model, render_view
from mgs.images import write_png
from mgs.metrics import MOST_BLUR, blur
from mgs.run import detectors
from mgs.run.checks import predicted_psnr
from mgs.run.detectors import DETECTORS, ViewIndicators, alarms, step_indicators, view_indicators
from mgs.run.ending import why_ended

FITS = detectors.Before(outline=0.001, offset=0.01)
GOOD = ViewIndicators(FITS, 0.05, 0.02, 1e-3, ratios=(-0.08, 0.0, 0.08), pixels=2000)
DIM = replace(GOOD, ratios=(-0.21, -0.13, -0.05))
NOWHERE = np.zeros((0, 3))
FALLING = (1.0, 0.5, 0.3, 0.25, 0.249, 0.248)


def indicators(
    views=(GOOD,) * 4, losses=FALLING, coverage=0.95, gains=(0.5, 0.4), drift=0.0, last=True
):
    angles = 2 * np.pi * np.arange(len(views)) / len(views)
    ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    return step_indicators(list(views), ring, list(losses), coverage, list(gains), drift, last)


def one_bad(**changes) -> tuple[ViewIndicators, ...]:
    """Three good views, and one with these indicators before the fit."""
    return GOOD, GOOD, GOOD, replace(GOOD, before=replace(FITS, **changes))


BAD = {
    "unconverged": ({"losses": (1.0, 0.8, 0.6, 0.4, 0.3)}, "still fell by 29.3 % a pass"),
    "worse": ({"losses": (1.0, 1.3, 1.2, 1.2, 1.2)}, "at least 20 % above"),
    "blur": ({"views": (replace(GOOD, blur=1.6),) * 4}, "blurred by 1.6 pixels"),
    "prior": ({"views": one_bad(outline=0.6)[3:] * 4}, "60.0 % of the covered pixels"),
    "residual": ({"views": (replace(GOOD, unexplained=0.9),) * 4}, "90 % of the images' variance"),
    "exposure": ({"views": (GOOD, GOOD, GOOD, DIM)}, "by 50 % of"),
    "pose": ({"views": one_bad(offset=0.3)}, "10.0 times farther apart"),
    "outlier": ({"views": (GOOD, GOOD, GOOD, replace(GOOD, srgb_error=0.1))}, "10.0 times"),
    "means": ({"drift": 5.0}, "5.0 standard deviations"),
    "coverage": ({"coverage": 0.2}, "only 20 %"),
    "saturated": ({"gains": (0.5, 0.3, 0.01)}, "gained 2 %"),
}


TEXTURE = np.random.default_rng(0).random((96, 128, 3))


@pytest.mark.parametrize("sigma", [1.5, 2.5, 4.0])
def test_the_blur_of_steps_is_that_of_the_gaussian(sigma):
    steps = gaussian_filter(np.repeat(TEXTURE[:, :8], 16, axis=1), (0, sigma, 0))
    assert blur(steps, np.ones(steps.shape[:2], bool)) == pytest.approx(sigma, rel=0.08)


def test_the_blur_is_that_of_the_worst_direction_and_of_what_counts():
    sharp = TEXTURE[:12, :16].repeat(8, axis=0).repeat(8, axis=1)
    moved = np.mean([np.roll(sharp, (k, k), axis=(0, 1)) for k in range(6)], axis=0)
    whole = np.ones(sharp.shape[:2], bool)
    assert blur(sharp, whole) < 0.5 < MOST_BLUR < blur(moved, whole)
    assert blur(moved[:, ::-1], whole) == pytest.approx(blur(moved, whole))
    left = np.arange(128) < 64
    both = np.where(left[:, None], sharp, moved)
    assert blur(both, whole & left) == blur(sharp[:, :64], whole[:, :64])


def test_the_blur_does_not_depend_on_strips(monkeypatch):
    smooth, counted = gaussian_filter(TEXTURE, (1, 2, 0)), TEXTURE[..., 0] < 0.9
    whole = blur(smooth, counted)
    monkeypatch.setattr("mgs.metrics.STRIP", 7)
    assert blur(smooth, counted) == pytest.approx(whole, rel=1e-12)


def test_the_blur_is_finite_where_there_is_little_to_see():
    whole = np.ones(TEXTURE.shape[:2], bool)
    assert blur(0 * TEXTURE, whole) == blur(TEXTURE, ~whole) == 0
    assert blur(TEXTURE[:2, :2], whole[:2, :2]) == 0 < blur(TEXTURE[:2], whole[:2])
    ramp = np.broadcast_to(np.linspace(0, 1, 128)[:, None], TEXTURE.shape)
    assert 100 < blur(ramp, whole) < np.inf


def test_a_plain_ball_in_front_of_something_is_not_blurred():
    v, u = np.mgrid[-48:48, -64:64] + 0.5
    lit = np.sqrt(np.maximum(1 - (u**2 + v**2) / 30**2, 0))[..., None]
    mask = u**2 + v**2 < 30**2
    image = np.where(mask[..., None], 0.2 + 0.6 * lit, 0.1 + 0.1 * TEXTURE)
    assert blur(image, mask) > MOST_BLUR > blur(image, binary_dilation(mask, iterations=RIM))


@pytest.mark.parametrize("name", DETECTORS)
def test_each_fault_has_one_warning_with_its_number(name):
    changes, words = BAD[name]
    (said,) = alarms(indicators(**changes))
    assert words in said


def test_a_warning_comes_once_and_again_after_it_was_over():
    bad, good = indicators(coverage=0.2), indicators()
    assert set(good) == set(DETECTORS)
    assert alarms(good) == []
    assert len(alarms(bad, good)) == 1
    assert alarms(bad, bad) == []
    assert alarms(good, bad) == []


def test_signs_that_a_step_cannot_have_are_left_out():
    assert set(step_indicators([], NOWHERE, [1.0], 1.0, [], 0.0)) == {"means"}
    # A warm fit may end lower than it was in between, and not lower than at its start.
    assert step_indicators([], NOWHERE, [1.0, 1.2, 1.1, 1.0], 1.0, [], 0.0)["unconverged"] == 0
    unknown = step_indicators([], NOWHERE, [1.0, float("nan"), 1.0, 1.0], 1.0, [], 0.0)
    assert {"unconverged", "worse"}.isdisjoint(unknown)


def test_few_views_need_not_cover_all_nor_fit_well_while_more_are_to_come():
    for views, last, warnings in ((3, True, 1), (4, True, 2), (7, False, 0), (8, False, 2)):
        bad = (replace(GOOD, unexplained=0.9),) * views
        assert len(alarms(indicators(bad, coverage=0.7, last=last))) == warnings


def test_the_outline_is_the_share_of_pixels_that_disagree_by_more_than_the_margin():
    mask, columns = np.zeros((8, 20), bool), np.arange(20)
    mask[:, 5:15] = True
    shifted = (columns >= 8) & (columns < 18)  # 3 pixels to the right
    alpha = np.where(shifted, 0.9, 0.2) * np.ones((8, 1))
    for margin, share in {1: 4 / 13, 2: 2 / 13, 3: 0}.items():
        assert detectors.before_fit(mask, alpha, margin).outline == pytest.approx(share)
    assert detectors.before_fit(mask, alpha, 1).offset == pytest.approx(3 / np.sqrt(80))
    assert detectors.before_fit(mask, 0 * alpha, 1).offset == 1


def test_views_that_are_hard_to_fit_are_no_outliers_beside_others_of_their_side():
    """A highlight seen by four of twelve views on a ring, and one wrong image among the others."""
    errors = np.array([9.0] * 4 + [1.0] * 8)
    views = [replace(GOOD, srgb_error=1e-4 * error) for error in errors**2]
    assert indicators(views)["outlier"] == 1
    views[8] = replace(GOOD, srgb_error=1e-4 * 4.0**2)
    assert indicators(views)["outlier"] == pytest.approx(4)


FAR = replace(GOOD, unexplained=0.5, srgb_error=9e-3, ratios=(-0.18, -0.1, -0.02), pixels=200)


def test_views_of_few_pixels_may_fit_worse_and_one_wrong_view_among_them_is_found():
    views, alike = [GOOD] * 8 + [FAR] * 4, indicators([GOOD] * 12)
    mixed = indicators(views)
    for name in ("outlier", "exposure"):
        assert mixed[name] == pytest.approx(alike[name], abs=1e-9)
    assert mixed["residual"] == pytest.approx(0.05)
    for k in (0, 8):
        ratios = tuple(ratio + 0.26 for ratio in views[k].ratios)
        wrong = replace(views[k], srgb_error=9 * views[k].srgb_error, ratios=ratios)
        found = indicators([*views[:k], wrong, *views[k + 1 :]])
        assert found["outlier"] == pytest.approx(3)
        assert found["exposure"] == pytest.approx(1)


def test_a_prior_need_not_be_better_than_a_pixel_of_the_farthest_views():
    apart = replace(GOOD, before=replace(FITS, offset=0.06))
    assert indicators([apart, GOOD, GOOD, FAR])["pose"] == pytest.approx(2), "one far view"
    assert indicators([apart, GOOD, FAR, FAR])["pose"] == pytest.approx(0.06 * 200**0.5)


def test_an_exposure_shifts_all_pixels_and_a_highlight_some():
    rng = np.random.default_rng(0)
    model = rng.uniform(0.1, 0.5, (30, 40, 1)) * np.ones(3)
    whole = np.ones((30, 40), bool)

    def exposure(factor):
        """Indicator of five views with noise of 10 %, the last one times a factor."""
        images = [model * np.exp(0.1 * rng.normal(size=(30, 40, 1))) for _ in range(5)]
        images[-1] = images[-1] * factor
        views = [view_indicators(i.reshape(-1, 3), whole, model, FITS) for i in images]
        return indicators(views)["exposure"]

    limit, highlight = DETECTORS["exposure"].limit, np.ones((30, 40, 1))
    assert exposure(1.0) < limit / 2
    assert exposure(1.1) > limit
    assert exposure(1 / 1.1) > limit
    highlight[:, :18] = 1.5
    assert exposure(highlight) < limit


def test_the_margin_is_a_pixel_and_the_size_of_a_gaussian():
    camera, model = tiny.orbit()[0], tiny.initial([])

    def margin(size, means=model.means):
        log_scales = np.full_like(model.log_scales, np.log(size))
        return detectors.outline_margin(replace(model, log_scales=log_scales, means=means), camera)

    depth = np.median(camera.project(model.means)[1])
    assert margin(1e-6) == 2
    assert margin(0.3) == 1 + int(np.ceil(0.3 * camera.K[0, 0] / depth)) > 2
    behind = camera.position - 5 * camera.camera_to_world[:3, 2] + 0 * model.means
    assert margin(0.3, behind) == 1
    square = margin(0.3)
    for across in (True, False):
        (camera,) = synthetic.halved(tiny.orbit()[:1], across)
        assert margin(0.3) == square  # of the side with more pixels


def test_a_perfect_render_explains_all_and_a_single_colour_nothing():
    truth = np.random.default_rng(0).uniform(0.2, 0.8, (6, 8, 3)).astype(np.float32)
    colours, mask = truth.reshape(-1, 3), np.ones((6, 8), bool)
    flat = view_indicators(colours, mask, np.broadcast_to(truth.mean((0, 1)), truth.shape), FITS)
    assert flat.unexplained == pytest.approx(1, abs=1e-6)
    assert flat.error == pytest.approx(truth.std(axis=(0, 1)).mean(), rel=0.05)
    unlike = srgb_from_linear(truth) - srgb_from_linear(truth.mean((0, 1)))
    assert flat.srgb_error == pytest.approx(np.mean(unlike**2), rel=1e-5)
    perfect = ViewIndicators(FITS, 0.0, 0.0, pixels=48)
    assert view_indicators(colours, mask, truth, FITS) == perfect
    assert view_indicators(colours[:0], ~mask, truth, FITS) == ViewIndicators(FITS, 0.0, 0.0)


def test_drift_is_in_standard_deviations_of_the_prior():
    start = np.zeros((5, 3))
    assert detectors.means_drift(start + np.array([0.2, 0, 0]), start, 0.1) == pytest.approx(2)


@pytest.fixture(scope="module")
def rock(tmp_path_factory):
    root = tmp_path_factory.mktemp("rock") / "dataset"
    return synthetic.write_rock(root, synthetic.orbit_cameras(10, 64, 48), 600).root


def warnings(state) -> list[str]:
    return [warning for line in state.steps for warning in line.get("warnings", [])]


def test_a_good_run_has_no_warning_and_the_residual_of_new_images(rock, tmp_path):
    # A policy that does not plan, so that both begin alike; on few pixels fits settle late.
    given = {"policy": "d-optimal", "seeds": 5, "warm_passes": 8}
    runs = [run_nbv(rock, tmp_path / str(n), budget=n, **given) for n in (1, 2)]
    before, after = (run.state for run in runs)
    assert [line.get("warnings") for line in after.steps] == [None] * 3
    assert all("prior" in line["indicators"] for line in after.steps)
    assert "saturated" in after.steps[-1]["indicators"]
    assert ["residual" in line for line in after.steps] == [False, True, True]
    frame = load_dataset(rock).frames[after.taken[-1]]
    target = target_of(frame)
    known = frame.mask() & (target[..., 3] > 0)
    wrong = render_view(before.gaussians, frame.camera)[0] - target[..., :3]
    expected = np.sqrt(np.mean(wrong[known] ** 2))
    assert after.steps[-1]["residual"] == pytest.approx(expected, rel=1e-4)


def test_a_run_predicts_the_quality_of_views_not_taken_and_stops_by_it(rock, tmp_path):
    given = {"seeds": 2, "budget": 5}
    whole = run_nbv(rock, tmp_path / "whole", **given).state
    told = [line["prediction"].get("psnr") for line in whole.steps]
    assert told[0] is None
    frames = load_dataset(rock).frames
    left = [frame for k, frame in enumerate(frames) if k not in whole.taken]
    found = evaluate_model(as_drjit(whole.gaussians), left, ())["all"]["psnr_mask"]
    assert told[-1] == pytest.approx(found, abs=2)
    limit = sorted(told[1:])[2]
    views = next(k for k in range(1, 6) if told[k] >= limit)
    early = run_nbv(rock, tmp_path / "early", **given, stop_psnr=limit).state
    assert early.taken == whole.taken[: 2 + views]
    ended = {"reason": "psnr", "views": views, "psnr": told[views], "limit": limit}
    assert early.steps[-1]["ended"] == ended
    words = f"predicted to be {told[views]:.1f} dB after {views} chosen view"
    assert words in why_ended(ended)


def test_the_excess_of_the_last_views_is_scaled_by_the_gains():
    first = {"fitted": 0.9, "left": 9.0}
    entry = {"new": 1.9, "gain": 5.0, "fitted": 0.9, "left": 3.0}
    errors = [0.9 + 1.0 / 5.0 * left for left in (3.0, 2.0)]
    assert predicted_psnr([first]) is None
    assert predicted_psnr([first, entry]) == pytest.approx(-10 * np.log10(errors[0]))
    last = entry | {"left": 2.0}
    # Only the last three views count, and no excess is negative.
    found = predicted_psnr([first, entry | {"new": 99}, entry, entry, last])
    assert found == pytest.approx(-10 * np.log10(errors[1]))
    assert predicted_psnr([first, entry | {"new": 0.1}]) == pytest.approx(-10 * np.log10(0.9))
    assert predicted_psnr([first, {"new": 1.9, "gain": 5.0, "fitted": 0.9}]) is None


def test_a_side_that_no_seed_saw_is_no_drift_of_the_exposure(rock, tmp_path):
    given = {"policy": "farthest", "budget": 3, "seeds": 1, "train": {"passes": 15}}
    state = run_nbv(rock, tmp_path / "run", **given).state
    assert not any("exposure" in warning for warning in warnings(state))
    assert "saturated" not in state.steps[-1]["indicators"], "a policy that ignores gains"


def wrong_pose(frames):
    camera = frames[2].camera
    pose = camera.world_to_camera.copy()
    pose[:3] = Rotation.from_euler("y", 3, degrees=True).as_matrix() @ pose[:3]
    frames[2] = replace(frames[2], camera=replace(camera, world_to_camera=pose))


def drifting_exposure(frames):
    for k, frame in enumerate(frames):
        write_png(frame.image_path, frame.rgb() * np.float32(0.6 * 1.05**k))


def wide_masks(frames):
    for frame in frames:
        write_png(frame.mask_path, binary_dilation(frame.mask(), iterations=6))


SPOILED = {
    wrong_pose: "prior and mask are",
    drifting_exposure: "exposure drifts",
    wide_masks: "the prior's outline and the masks disagree",
}


@pytest.mark.parametrize("spoil", SPOILED)
def test_a_spoiled_dataset_has_the_warning_for_its_fault(rock, tmp_path, spoil):
    root, run, words = tmp_path / "dataset", tmp_path / "run", SPOILED[spoil]
    shutil.copytree(rock, root)
    frames = list(load_dataset(root).frames)
    spoil(frames)
    write_transforms(root, frames)
    given = {"prior": rock / "prior", "budget": 1, "seeds": 9, "train": {"passes": 15}}
    said = warnings(run_nbv(root, run, **given).state)
    assert any(words in warning for warning in said), said
    others = set(SPOILED.values()) - {words}
    assert not any(word in warning for warning in said for word in others), said
