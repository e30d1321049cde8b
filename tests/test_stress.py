"""Stress tests on small ellipsoids."""

import json
from dataclasses import replace

import numpy as np
import pytest
import synthetic
from program import study

from mgs.data.dataset import load_dataset
from studies import faults, stress
from studies.frame.claim import Claim
from studies.frame.output import Panel, read_rows
from studies.frame.sweep import Cell
from studies.stress import Experiment, open_lab

FOLDERS = {"dataset": "dataset", "prior": "dataset/prior"}


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
    synthetic.write_rock(folder / "dataset", synthetic.orbit_cameras(10, 48, 36), 300)
    cameras = synthetic.orbit_cameras(3, 48, 36, altitude=2.0)
    synthetic.write_dataset(folder / "dataset/test", cameras)
    return folder


@pytest.fixture
def lab(root):
    return open_lab(root / "dataset", root / "dataset/prior")


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
    assert len(read_rows(tmp_path / "out/stability.csv")) == 8
    assert "| It is so. | **holds** | 2.05 (" in (tmp_path / "out/stability.md").read_text()
    assert (tmp_path / "out/one.png").is_file()
