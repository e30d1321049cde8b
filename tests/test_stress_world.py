"""The experiments of `mgs stress` on light, material and sensor: a second sun, a specular rock, a
noisy survey."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic

from mgs.data.dataset import load_dataset, write_transforms
from mgs.images import write_png
from mgs.policy.poses import seed_views
from mgs.prior.build import build_prior, save_prior
from mgs.prior.settings import PriorSettings
from mgs.run.nbv import run_nbv
from mgs.study.stress import lab as labs
from mgs.study.stress import registry, specular, sun, survey
from mgs.study.stress.faults import captured
from mgs.study.stress.lab import PRESETS, greedy, open_lab
from mgs.study.stress.picture import draw_experiment
from mgs.study.stress.verdict import judged
from mgs.study.sweep import cell_folder

FRAMES = 10


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A study's folder with a small rock as the cell of its dataset leaves it, and its variants:
    the same again, `later` half as bright and metered so."""
    folder = tmp_path_factory.mktemp("study")
    out = cell_folder(folder, "dataset/rock")
    dataset = synthetic.write_dataset(out / "dataset", synthetic.orbit_cameras(FRAMES, 64, 48))
    tests = synthetic.write_dataset(
        out / "dataset/test", synthetic.orbit_cameras(3, 64, 48, altitude=2.0)
    )
    write_transforms(out / "dataset/test", tests.frames)
    save_prior(out / "prior", build_prior(dataset, PriorSettings(gaussians=300))[0])
    record = {"exposure": 2.0, "scene": {"sky": {"sun_azimuth": 35.0}}}
    (out / "dataset/config.json").write_text(json.dumps(record))
    for variant in ("later", "diffuse", "specular"):
        shutil.copytree(out, f"{out}-{variant}")
    for frame in load_dataset(Path(f"{out}-later/dataset")).frames:
        write_png(frame.image_path, frame.rgb() / 2)
    Path(f"{out}-later/dataset/config.json").write_text(json.dumps(record | {"exposure": 1.0}))
    return folder


@pytest.mark.parametrize("policy", ["d-optimal", "directional-i", "uniform"])
def test_greedy_chooses_as_the_loop_does(root, tmp_path, policy):
    lab, cell = open_lab(root, "rock"), cell_folder(root, "dataset/rock")
    positions = np.array([camera.position for camera in lab.cameras])
    seeds = seed_views(positions, lab.prior.points.mean(0), 3)
    state = run_nbv(
        cell / "dataset",
        tmp_path / "run",
        prior=cell / "prior",
        policy=policy,
        seeds=3,
        budget=3,
        train={"tolerance": 0.0},
    )
    assert greedy(lab, seeds, range(FRAMES), 3, policy) == state.taken


def test_greedy_refuses_what_needs_a_fit(root):
    with pytest.raises(NotImplementedError, match="no information"):
        greedy(open_lab(root, "rock"), [0], range(FRAMES), 1, "i-optimal")


def test_a_variant_is_the_scene_with_some_keys_changed(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        labs, "made_dataset", lambda out, scene, images, seed, tests: made.append((scene, images))
    )
    monkeypatch.setattr(labs, "made_prior", lambda *_, **settings: None)
    quick = PRESETS["quick"]
    cell = labs.variant_cell(quick, "strata", 3, "matt", {"rock": {"specular": 0.0}}, frames=5)
    assert cell.name == "dataset/strata-3-matt"
    labs.make_scene(tmp_path, tmp_path, **cell.arguments)
    labs.make_scene(tmp_path, tmp_path, **labs.scene_cell(quick, "strata", 3).arguments)
    (changed, few), (usual, images) = made
    assert (few.frames, images.frames) == (5, quick.images.frames)
    assert (changed.rock.specular, usual.rock.specular) == (0.0, 0.3)
    assert changed.model_copy(update={"rock": usual.rock}) == usual
    assert changed.rock.model_copy(update={"specular": 0.3}) == usual.rock


def test_the_second_half_of_the_flight_has_the_second_sun_at_the_first_exposure(root):
    lab = open_lab(root, "rock")
    both = sun.two_suns(lab, root, "rock", "rock-later")
    assert both.frames[: FRAMES // 2] == lab.frames[: FRAMES // 2]
    for before, after in zip(lab.frames[FRAMES // 2 :], both.frames[FRAMES // 2 :], strict=True):
        np.testing.assert_allclose(
            after.rgb(), before.rgb(), atol=0.02
        )  # half as bright, at twice the exposure
        np.testing.assert_allclose(
            after.target()[0][..., :3], before.target()[0][..., :3], atol=0.02
        )
        assert after.camera == before.camera


def test_gains_take_out_an_exposure_that_differs(root):
    lab = open_lab(root, "rock")
    taken = lab.even(5)
    darker = [
        sun.scaled(captured(f), np.full(3, 0.5)) if i == taken[2] else f
        for i, f in enumerate(lab.frames)
    ]
    mended = sun.with_gains(lab.changed(frames=tuple(darker)), taken)
    one, other = (
        mended.frames[i].rgb()[mended.frames[i].mask()].mean() for i in (taken[2], taken[0])
    )
    same, same_other = (
        lab.frames[i].rgb()[lab.frames[i].mask()].mean() for i in (taken[2], taken[0])
    )
    assert one / other == pytest.approx(same / same_other, rel=0.1)
    left = next(i for i in range(FRAMES) if i not in taken)
    assert mended.frames[left] is darker[left]


def test_views_of_the_first_half_alone():
    for turn in (0, 0.5):
        views = sun.first_half(24, 8, turn)
        assert len(set(views)) == 8
        assert set(views) <= set(range(12))


def test_a_sun_that_moved_is_measured_and_judged(root, monkeypatch, tmp_path):
    monkeypatch.setattr(sun, "VIEWS", 4)
    rows = sun.sun(root, root, "rock", "rock-later", 1)["rows"]
    json.dumps(rows, allow_nan=False)
    assert all(judged(claim, rows)["runs"] == 1 for claim in sun.SUN.claims)
    of_itself = next(row for row in rows if row.get("ranking") == sun.ONE)
    assert of_itself["tau"] == pytest.approx(1)
    draw_experiment(tmp_path / "sun.png", sun.SUN, rows)
    signs = sun.of_limits(rows)
    assert {row["under"] for row in signs} == {sun.ONE, sun.TWO}


def test_higher_degrees_start_as_the_same_picture(root):
    lab = open_lab(root, "rock")
    start = lab.start(lab.even(4))
    assert lab.quality(start.with_degree(3)) == pytest.approx(lab.quality(start), abs=1e-3)


def test_errors_are_told_by_the_angle_between_sun_and_camera(root):
    lab = open_lab(root, "rock")
    model = lab.fit(lab.even(4)).gaussians
    rows = specular.errors_by_angle(lab, model, range(FRAMES), 0.0)
    angles = [row["angle"] for row in rows]
    assert angles[0] == pytest.approx(
        0, abs=3
    )  # the rock's middle is a little off the axis of the orbit
    assert angles[FRAMES // 2] == pytest.approx(180, abs=3)
    assert {row["angle of sun"] % specular.BIN for row in rows} == {0}
    dark = replace(model, sh=model.sh - 10)
    for row, frame in zip(
        specular.errors_by_angle(lab, dark, range(FRAMES), 0.0), lab.frames, strict=True
    ):
        known = frame.mask() & (frame.target()[1] > 0)  # not the rim
        assert row["rms"] == pytest.approx(
            np.sqrt((frame.rgb()[known] ** 2).mean()), rel=0.05
        )  # black against it


def test_a_specular_rock_is_measured_and_judged(root, monkeypatch, tmp_path):
    monkeypatch.setattr(specular, "FEW", 4)
    monkeypatch.setattr(specular, "DEGREES", (0, 1))
    monkeypatch.setattr(specular, "VIEWS", 4)
    monkeypatch.setattr(specular, "SEEDS", 3)
    rows = specular.specular(root, root, "rock", 1)["rows"]
    json.dumps(rows, allow_nan=False)
    fits = {(row["material"], row["views"], row["degree"]) for row in rows if "views" in row}
    assert fits == {(specular.SHINY, v, d) for v in (4, FRAMES) for d in specular.DEGREES} | {
        ("diffuse", 4, 0)
    }
    draw_experiment(tmp_path / "specular.png", specular.SPECULAR, rows)
    assert specular.towards_the_sun(rows) == [
        pytest.approx(0)
    ]  # both materials are the same images here
    shone = [
        row | {"rms": row["rms"] + (row["material"] == "specular") * row["angle"]}
        if "rms" in row
        else row
        for row in rows
    ]
    assert specular.towards_the_sun(shone)[0] > 60


def test_the_best_degree_is_that_of_each_run():
    rows = [
        {"run": run, "material": "specular", "views": 12, "degree": degree, "psnr": psnr}
        for run, values in (("a", (20, 21, 23, 22)), ("b", (20, 19, 18, 17)))
        for degree, psnr in enumerate(values)
    ]
    assert specular.best_of_degrees(12)(rows) == [3, -1]


def test_the_order_of_policies_is_compared_with_that_of_exact_data():
    def rows(noisy):
        of = {survey.EXACT: (1, 2, 3, 4), survey.USUAL: noisy}
        return [
            {"run": "a", "level": level, "policy": policy, "psnr": psnr}
            for level, values in of.items()
            for policy, psnr in zip(labs.POLICIES, values, strict=True)
        ]

    assert survey.order(survey.USUAL)(rows((5, 6, 7, 8))) == [pytest.approx(1)]
    assert survey.order(survey.USUAL)(rows((8, 7, 6, 5))) == [pytest.approx(-1)]


def test_a_survey_has_measured_depth_and_estimated_poses_and_is_flown_once(
    root, tmp_path, monkeypatch
):
    monkeypatch.setitem(survey.LEVELS, survey.USUAL, (0.1, 1))  # images so small bear no more noise
    lab = open_lab(root, "rock")
    exact, none = survey.surveyed(lab, root, tmp_path, survey.EXACT, 300)
    noisy, errors = survey.surveyed(lab, root, tmp_path, survey.USUAL, 300)
    assert none == {"depth error": 0, "pose error": 0}
    assert errors["depth error"] > 0.5
    assert errors["pose error"] > 0.1
    assert exact is lab
    assert not np.array_equal(noisy.frames[1].depth(), lab.frames[1].depth())
    assert not np.allclose(noisy.cameras[3].world_to_camera, lab.cameras[3].world_to_camera)
    monkeypatch.setattr(survey, "fly", lambda *_: pytest.fail("flown again"))
    again, _ = survey.surveyed(lab, root, tmp_path, survey.USUAL, 300)
    assert np.array_equal(again.prior.points, noisy.prior.points)


def test_surveys_of_every_level_are_measured_and_judged(root, tmp_path, monkeypatch):
    """Made-up qualities: each level costs 3 dB more than the one before, whichever policy chose the
    views."""
    place = list(survey.LEVELS)
    asked = []

    def flown(lab, root, out, level, gaussians):
        return level, {"depth error": 1.0, "pose error": 2.0}

    def qualities(level, seeds, count, policies):
        asked.append((level, tuple(policies), tuple(seeds), count))
        return [
            {"policy": policy, "psnr": 40 - 3.0 * place.index(level) - k / 8}
            for k, policy in enumerate(policies)
        ]

    monkeypatch.setattr(survey, "surveyed", flown)
    monkeypatch.setattr(survey, "by_policy", qualities)
    rows = survey.survey(root, tmp_path, "rock", 2, 300)["rows"]
    assert {level: policies for level, policies, *_ in asked} == {
        level: labs.POLICIES if level in survey.COMPARED else ("uniform",)
        for level in survey.LEVELS
    }
    assert len({seeds for *_, seeds, _ in asked}) == 2
    verdicts = [judged(claim, rows)["verdict"] for claim in survey.SURVEY.claims]
    assert verdicts == ["fails", "holds", "holds", "holds", "holds", "holds", "holds", "holds"]
    draw_experiment(tmp_path / "survey.png", survey.SURVEY, rows)


def test_datasets_of_all_experiments_have_names_of_their_own():
    for preset in PRESETS.values():
        cells = registry.datasets(preset)
        assert len({cell.name for cell in cells}) == len(cells)
