"""Stress tests on small ellipsoids, and predicted errors against the oracle."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st
from program import study
from splat.scenes import calm, make_camera, make_gaussians

from mgs.data.dataset import Dataset, load_dataset
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.images import write_png
from mgs.prior.build import prior_from_mesh, save_prior
from mgs.prior.settings import PriorSettings
from mgs.run.folder import Run
from mgs.run.settings import NbvSettings
from mgs.splat import reference
from studies import calibration, faults, predicted_error, stress
from studies.calibration import (
    ause,
    ause_of_constant,
    fit_calibration,
    judged,
    sparsification,
)
from studies.frame.claim import Claim
from studies.frame.output import Panel
from studies.frame.sweep import Cell
from studies.stress import Experiment, open_lab

FOLDERS = {"dataset": "dataset", "prior": "prior"}


def test_detectors_are_judged_by_false_and_missed_alarms():
    def rows(sign):
        clean = {"run": "a", "size": 6, "fault": "none", "failed": False, "sign exposure": 0.01}
        failed = {"run": "a", "size": 1, "fault": "exposure", "failed": True, "sign exposure": sign}
        return [clean, failed, failed | {"failed": False}]

    assert (stress.caught(rows(9.0)), stress.caught(rows(0.0))) == ([1.0], [0.0])
    assert stress.false_alarms(rows(9.0)) == [0.0]
    noisy = [row | {"sign exposure": 9.0} for row in rows(9.0)]
    assert stress.false_alarms(noisy + noisy) == [1.0], "a clean run of two experiments counts once"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Folder with the dataset and the prior of a small rock."""
    folder = tmp_path_factory.mktemp("study")
    synthetic.write_dataset(folder / "dataset", synthetic.orbit_cameras(10, 48, 36))
    cameras = synthetic.orbit_cameras(3, 48, 36, altitude=2.0)
    synthetic.write_dataset(folder / "dataset/test", cameras)
    mesh = folder / "dataset/rock.glb"
    save_prior(folder / "prior", prior_from_mesh(mesh, PriorSettings(gaussians=300)))
    return folder


@pytest.fixture
def lab(root):
    return open_lab(root / "dataset", root / "prior")


@pytest.mark.parametrize("name", faults.IMAGE_FAULTS)
def test_a_fault_of_images_is_a_pure_function_that_grows_with_its_size(root, name):
    frame = faults.captured(load_dataset(root / "dataset").frames[0])
    function, sizes, _ = faults.IMAGE_FAULTS[name]

    def arrays(of):
        return [of.pixels, of.rgba, of.z, of.rock, of.camera.world_to_camera]

    before, changes = [array.copy() for array in arrays(frame)], []
    for size in sizes:
        spoiled, again = (arrays(function(frame, size, np.random.default_rng(3))) for _ in range(2))
        pairs = list(zip(spoiled, before, strict=True))
        assert all(map(np.array_equal, spoiled, again))
        assert all(a.shape == b.shape and np.isfinite(a).all() for a, b in pairs)
        changes.append(sum(np.abs(a.astype(float) - b).sum() for a, b in pairs))
    assert 0 < changes[0] < changes[1] < changes[2]
    assert all(map(np.array_equal, arrays(frame), before))


@pytest.mark.parametrize("name", faults.PRIOR_FAULTS)
def test_a_fault_of_the_prior_leaves_the_prior_as_it_was(lab, name):
    function, sizes, _ = faults.PRIOR_FAULTS[name]
    prior = lab.prior
    before, moved = prior.points.copy(), []
    for size in sizes:
        spoiled = function(prior, size, np.random.default_rng(1))
        assert len(spoiled.points) == len(spoiled.normals) >= spoiled.backed
        lost = len(prior.points) - len(spoiled.points)
        moved.append(lost or float(np.linalg.norm(spoiled.points - prior.points, axis=1).mean()))
    assert 0 < moved[0] < moved[1] < moved[2]
    assert np.array_equal(prior.points, before)


def test_even_views_turn(lab):
    assert lab.even(5) == [0, 2, 4, 6, 8]
    assert sorted(lab.even(5, 0.5)) == [1, 3, 5, 7, 9]


def test_fits_are_measured(root):
    rows = stress.free_means(root, root, "rock", **FOLDERS, turns_=1, counts=[4])["rows"]
    by = {row["means"]: row for row in rows}
    assert by["frozen"]["drift"] == 0 < by["free"]["drift"]
    assert by["frozen"]["tau"] == by["frozen, no prior"]["tau"] == pytest.approx(1)


def test_faults_are_measured_against_the_clean_run(root, monkeypatch):
    monkeypatch.setattr(stress, "PRIOR_FAULTS", {"shifted prior": (faults.shifted, (0.4,), "")})
    monkeypatch.setattr(stress, "IMAGE_FAULTS", {"image noise": (faults.image_noise, (0.3,), "")})
    how = {"scene": "rock", **FOLDERS, "repeats": 1}
    rows = stress.faults(root, root, **how, kinds="prior", others=[FOLDERS])
    clean, shifted, same = rows["rows"]
    assert (clean["fault"], clean["lost"], clean["failed"]) == ("none", 0, False)
    assert shifted["lost"] > stress.FAILURE
    assert shifted["failed"]
    assert same["lost"] == 0, "the prior of the same rock"
    rows = stress.faults(root, root, **how, kinds="images", others=[])
    kinds = [row["fault"] for row in rows["rows"]]
    few, free = ["few passes"] * 3, ["none", "free means"] * 2
    assert kinds == ["none", "image noise", *few, *free, *["one bad pose"] * 2]


CALLS = []


def toy(root, out, scene, lift):
    """Task with one row per run."""
    CALLS.append(scene)
    rows = [{"run": f"{scene}, {k}", "kind": "a", "x": lift + k / 10} for k in (0, 1)]
    return {"rows": rows}


def test_a_run_writes_its_files_continues_and_keeps_earlier_experiments(tmp_path, capsys):
    def experiment(name, lift):
        task = "test_stress:toy"
        cells = [Cell(f"{name}/{s}", task, {"scene": s, "lift": lift}) for s in "ab"]
        claim = Claim("It is so.", lambda rows: [r["x"] for r in rows], "dB", "above", 1.0)
        panels = (Panel("kind", "x", "kind", "x"),)
        return Experiment("Is it so?", lambda size: cells, (claim,), panels)

    table = {"one": experiment("one", 2.0), "two": experiment("two", 0.0)}
    size = replace(stress.SIZES["quick"], experiments=table)
    CALLS.clear()

    def verdicts(*arguments):
        study("stress", tmp_path / "out", *arguments, sizes={"quick": size})
        found = json.loads((tmp_path / "out/verdicts.json").read_text())["experiments"]
        return [(one["name"], one["claims"][0]["verdict"]) for one in found]

    assert verdicts("--only", "one") == [("one", "holds")]
    assert verdicts("--only", "two") == [("one", "holds"), ("two", "fails")]
    assert "| It is so. | **holds** | 2.05 (" in capsys.readouterr().out
    assert verdicts() == [("one", "holds"), ("two", "fails")]
    assert CALLS == ["a", "b", "a", "b"]
    with open(tmp_path / "out/stability.csv") as file:
        assert len(list(csv.DictReader(file))) == 8
    assert "| It is so. | **holds** | 2.05 (" in (tmp_path / "out/stability.md").read_text()
    assert (tmp_path / "out/one.png").is_file()


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
