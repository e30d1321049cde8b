"""Detectors: each fires on what it is for, none on a good run, and what they say is kept, printed
and reported."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import synthetic
import tiny
from rich.console import Console

from mgs.cli.nbv import resume_and_print
from mgs.data.dataset import load_dataset, target_of, write_transforms
from mgs.fit.settings import TrainSettings
from mgs.images import write_png
from mgs.prior.build import build_prior, save_prior
from mgs.prior.settings import PriorSettings
from mgs.report.page_facts import measured, read_shown
from mgs.report.runs import read_run
from mgs.run import folder as run_folder
from mgs.run import recording
from mgs.run.detectors import (
    DETECTORS,
    Before,
    ViewSigns,
    alarms,
    before_fit,
    means_drift,
    outline_margin,
    residual,
    step_signs,
    view_signs,
)
from mgs.run.nbv import run_nbv
from mgs.splat import render

FITS = Before(outline=0.001, offset=0.01, exposure=0.01)
GOOD = ViewSigns(FITS, unexplained=0.05, error=0.02)
FALLING = (1.0, 0.5, 0.3, 0.25, 0.249, 0.248)


def signs(views=(GOOD,) * 4, losses=FALLING, coverage=0.95, gains=(0.5, 0.4), drift=0.0):
    return step_signs(list(views), list(losses), coverage, list(gains), drift)


def test_a_good_step_says_nothing():
    assert set(signs()) == set(DETECTORS)
    assert alarms(signs()) == []


BAD = {
    "unconverged": ({"losses": (1.0, 0.8, 0.6, 0.4, 0.3)}, "still fell by 29.3 % a pass"),
    "worse": ({"losses": (1.0, 1.3, 1.2, 1.2, 1.2)}, "at least 20 % above"),
    "prior": ({"views": (replace(GOOD, before=replace(FITS, outline=0.6)),) * 4}, "60.0 % of the covered pixels"),
    "residual": ({"views": (replace(GOOD, unexplained=0.9),) * 4}, "90 % of the images' variance"),
    "exposure": ({"views": (GOOD, GOOD, GOOD, replace(GOOD, before=replace(FITS, exposure=0.01 + np.log(2))))}, "2.00 times"),
    "pose": ({"views": (GOOD, GOOD, GOOD, replace(GOOD, before=replace(FITS, offset=0.2)))}, "20.0 % of the rock's size"),
    "outlier": ({"views": (GOOD, GOOD, GOOD, replace(GOOD, error=0.2))}, "10.0 times"),
    "means": ({"drift": 4.0}, "4.0 standard deviations"),
    "coverage": ({"coverage": 0.2}, "only 20 %"),
    "saturated": ({"gains": (0.5, 0.3, 0.01)}, "gained 2 %"),
}  # fmt: skip


@pytest.mark.parametrize("name", DETECTORS)
def test_each_detector_fires_on_its_own_fault_alone_and_says_the_number(name):
    changes, words = BAD[name]
    said = alarms(signs(**changes))
    assert len(said) == 1
    assert words in said[0]


def test_a_warning_comes_once_and_again_after_it_was_over():
    bad, good = signs(coverage=0.2), signs()
    assert len(alarms(bad, good)) == 1
    assert alarms(bad, bad) == []
    assert alarms(good, bad) == []


def test_signs_that_a_step_cannot_tell_are_left_out():
    assert set(step_signs([], [1.0], 1.0, [], 0.0)) == {"means"}
    back = step_signs(
        [], [1.0, 1.2, 1.1, 1.0], 1.0, [], 0.0
    )  # of a warm fit: lower than before, but not than at its start
    assert back["unconverged"] == 0
    assert {"unconverged", "worse"}.isdisjoint(
        step_signs([], [1.0, float("nan"), 1.0, 1.0], 1.0, [], 0.0)
    )


@pytest.mark.parametrize("views", [1, 2, 3, 4])
def test_coverage_is_expected_of_four_views_and_more(views):
    assert bool(alarms(signs(views=(GOOD,) * views, coverage=0.7))) == (views == 4)


def seen(mask, alpha, margin, rendered=0.5, truth=0.5):
    target = np.ones((*mask.shape, 4), np.float32) * [truth, truth, truth, 1]
    return before_fit(target, mask, np.broadcast_to(rendered, (*mask.shape, 3)), alpha, margin)


def test_the_outline_is_the_share_of_pixels_that_disagree_by_more_than_the_margin():
    mask = np.zeros((8, 20), bool)
    mask[:, 5:15] = True
    alpha = np.where((np.arange(20) >= 8) & (np.arange(20) < 18), 0.9, 0.2) * np.ones(
        (8, 1)
    )  # 3 pixels to the right
    assert seen(mask, alpha, 1).outline == pytest.approx(4 / 13)
    assert seen(mask, alpha, 2).outline == pytest.approx(2 / 13)
    assert seen(mask, alpha, 3).outline == 0
    assert seen(mask, alpha, 1).offset == pytest.approx(3 / np.sqrt(80))
    assert seen(mask, 0 * alpha, 1).offset == 1


def test_the_exposure_is_the_factor_that_the_prior_lacks():
    whole = np.ones((4, 5))
    assert seen(whole > 0, whole, 1, rendered=0.25, truth=0.5).exposure == pytest.approx(
        np.log(0.501 / 0.251)
    )
    half_grey = np.where(np.arange(5) < 2, 0.9, 0.5)[None, :, None] * np.ones((4, 1, 3))
    assert seen(whole > 0, whole, 1, rendered=half_grey).exposure == 0
    assert seen(whole > 0, 0 * whole, 1).exposure == 0


def test_the_margin_is_a_pixel_and_the_size_of_a_gaussian(rock):
    frame = load_dataset(rock).frames[0]
    model = tiny.initial([])
    small, large = (
        replace(model, log_scales=model.log_scales * 0 + np.log(size)) for size in (1e-6, 0.1)
    )
    depth = np.median(frame.camera.project(model.means)[1])
    assert outline_margin(small, frame.camera) == 2
    assert outline_margin(large, frame.camera) == 1 + int(
        np.ceil(0.1 * frame.camera.K[0, 0] / depth)
    )
    behind = replace(
        model,
        means=(frame.camera.position - 5 * (frame.camera.camera_to_world[:3, 2]) + 0 * model.means),
    )
    assert outline_margin(behind, frame.camera) == 1


def test_a_perfect_render_explains_all_and_a_single_colour_nothing():
    truth = np.random.default_rng(0).uniform(0.2, 0.8, (6, 8, 3)).astype(np.float32)
    target, mask = np.dstack([truth, np.ones((6, 8), np.float32)]), np.ones((6, 8), bool)
    flat = view_signs(target, mask, np.broadcast_to(truth.mean((0, 1)), truth.shape), FITS)
    assert flat.unexplained == pytest.approx(1, abs=1e-6)
    assert flat.error == pytest.approx(truth.std(axis=(0, 1)).mean(), rel=0.05)
    assert view_signs(target, mask, truth, FITS) == ViewSigns(FITS, 0.0, 0.0)
    assert view_signs(target, ~mask, truth, FITS) == ViewSigns(FITS, 0.0, 0.0)


def test_drift_is_in_standard_deviations_of_a_gaussian():
    start, log_scales = np.zeros((5, 3)), np.log(np.full((5, 3), 0.1))
    assert means_drift(start, start, log_scales) == 0
    assert means_drift(start + np.array([0.2, 0, 0]), start, log_scales) == pytest.approx(2)


@pytest.fixture(scope="module")
def rock(tmp_path_factory):
    """A dataset of an ellipsoid on which a fit can be good, and its prior."""
    folder = tmp_path_factory.mktemp("rock")
    dataset = synthetic.write_dataset(folder / "dataset", synthetic.orbit_cameras(10, 64, 48))
    save_prior(folder / "dataset/prior", build_prior(dataset, PriorSettings(gaussians=600))[0])
    return folder / "dataset"


def test_a_good_run_raises_no_alarm(rock, tmp_path):
    state = run_nbv(rock, tmp_path / "run", budget=2, seeds=5)
    assert [line.get("warnings") for line in state.steps] == [None] * 3
    assert all("prior" in line["signs"] for line in state.steps)


def test_a_side_that_no_seed_saw_is_no_drift_of_the_exposure(rock, tmp_path):
    """Gaussians that no seed saw are grey, and the rock is not."""
    state = run_nbv(rock, tmp_path / "run", policy="farthest", budget=3, seeds=1)
    said = [warning for line in state.steps for warning in line.get("warnings", [])]
    assert not any("exposure" in warning for warning in said), said


def test_a_run_that_is_stopped_too_early_says_so_in_the_console_in_its_steps_and_on_the_page(
    rock, tmp_path
):
    from mgs.run.nbv import start_run

    start_run(rock, tmp_path / "run", budget=1, seeds=5, train=TrainSettings(passes=3).model_dump())
    console = Console(record=True, width=300)
    resume_and_print(tmp_path / "run", console)
    state = run_folder.read_checkpoint(tmp_path / "run")
    (said,) = [warning for warning in state.steps[0]["warnings"] if "still fell" in warning]
    assert f"step 0: {said}" in console.export_text()
    shown = read_shown("d-optimal", read_run(tmp_path / "run"), load_dataset(rock))
    assert f"step 0: {said}" in shown.notes
    assert not any("signs" in key for key in measured(state.steps[0]))


def test_a_prior_in_the_wrong_place_is_said_before_anything_else_is_known(rock, tmp_path):
    from mgs.prior.build import load_prior

    prior = load_prior(rock / "prior")
    save_prior(tmp_path / "prior", replace(prior, points=prior.points + np.array([0.4, 0, 0])))
    state = run_nbv(rock, tmp_path / "run", prior=tmp_path / "prior", budget=0, seeds=5)
    assert any(
        "the prior's outline and the masks disagree" in warning
        for warning in state.steps[0]["warnings"]
    )


def test_a_loop_without_renders_has_no_signs(dataset, tmp_path):
    loaded = load_dataset(dataset)
    settings = tiny.start(tmp_path / "run", loaded)
    state = recording.run(tmp_path / "run", settings, loaded, tiny.operations(), tiny.silent)
    assert not any("signs" in line or "warnings" in line for line in state.steps)


def wrong_pose(frames):
    """One camera is turned by 3 degrees."""
    from scipy.spatial.transform import Rotation

    pose = frames[2].camera.world_to_camera.copy()
    pose[:3] = Rotation.from_euler("y", 3, degrees=True).as_matrix() @ pose[:3]
    return [
        replace(f, camera=replace(f.camera, world_to_camera=pose)) if k == 2 else f
        for k, f in enumerate(frames)
    ]


def drifting_exposure(frames):
    """Each image is 5 % brighter than the one before."""
    for k, frame in enumerate(frames):
        write_png(frame.image_path, frame.rgb() * np.float32(0.6 * 1.05**k))
    return frames


def one_wrong_mask(frames):
    """A quarter of one mask is missing."""
    mask = frames[4].mask()
    columns = np.flatnonzero(mask.any(axis=0))
    mask[:, columns[: len(columns) // 3]] = False
    write_png(frames[4].mask_path, mask)
    return frames


def wide_masks(frames):
    """All masks reach far beyond the rock."""
    from scipy.ndimage import binary_dilation

    for frame in frames:
        write_png(frame.mask_path, binary_dilation(frame.mask(), iterations=6))
    return frames


SPOILED = {
    "pose": (wrong_pose, "prior and mask are"),
    "exposure": (drifting_exposure, "exposure drifts"),
    "mask": (one_wrong_mask, "prior and mask are"),
    "masks": (wide_masks, "the prior's outline and the masks disagree"),
}


@pytest.mark.parametrize("fault", SPOILED)
def test_a_spoiled_capture_raises_the_alarm_that_is_meant_for_it(rock, tmp_path, fault):
    spoil, words = SPOILED[fault]
    root = tmp_path / "dataset"
    shutil.copytree(rock, root)
    write_transforms(root, spoil(list(load_dataset(root).frames)))
    state = run_nbv(
        root, tmp_path / "run", prior=rock / "prior", policy="uniform", budget=5, seeds=5
    )
    said = [warning for line in state.steps for warning in line.get("warnings", [])]
    assert any(words in warning for warning in said), said
    others = {word for name, (_, word) in SPOILED.items() if name != fault} - {words}
    assert not any(word in warning for warning in said for word in others), said


def test_new_images_are_held_against_the_model_before_them(rock, tmp_path):
    before, after = (
        run_nbv(rock, tmp_path / f"{budget}", budget=budget, seeds=4) for budget in (1, 2)
    )
    assert ["residual" in line for line in after.steps] == [False, True, True]
    frame = load_dataset(rock).frames[after.taken[-1]]
    target = target_of(frame)
    known = frame.mask() & (target[..., 3] > 0)
    wrong = np.asarray(render(before.gaussians, frame.camera).rgb) - target[..., :3]
    assert after.steps[-1]["residual"] == pytest.approx(
        np.sqrt(np.mean(wrong[known] ** 2)), rel=1e-4
    )


def test_an_image_of_which_no_colour_is_known_has_no_residual():
    target, mask = np.full((2, 3, 4), 0.5), np.ones((2, 3), bool)
    assert residual([(np.zeros((2, 3, 3)), target, mask)]) == 0.5
    target[..., 3] = 0
    assert residual([(np.zeros((2, 3, 3)), target, mask)]) is None
