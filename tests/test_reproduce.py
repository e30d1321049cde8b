"""Table I, set-ups and flights on ellipsoids of 200 Gaussians: cells, tables, and bad input."""

import csv
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import synthetic
from program import study
from refusals import occupied, refused

from mgs.data.dataset import TEST_FOLDER
from mgs.files import write_json
from mgs.learning import fit_views
from mgs.progress import no_progress
from mgs.run.folder import read_checkpoint
from mgs.run.policies import Poses
from mgs.survey import flight
from mgs.survey.flight import SurveySettings, fly
from studies import case, certificate, flights, free_fit, results, setups, table1
from studies.case import Case, Rock, Size
from studies.oracle import foretold
from studies.setups import SetupSize
from studies.sweep import cell_folder, run_cells
from studies.table1 import ReproduceSize, Run, RunSize

OWN = f"{Path(__file__).parent.parent / 'studies/policies.py'}:angle"
ONE = RunSize(Size(48, 36, 8, 3, spp=1), 200, 2)
FEW = SetupSize(48, 36, 3, 1, 6, fewer=4, gaussians=200)
TINY = ReproduceSize(ONE, FEW, FEW, setup_rocks=2, oracle_rocks=1)


def ellipsoids(root, out, scene, seed, size, changes=None, mesh=None):
    """In place of the task that renders: another rock for each seed, at once."""
    folder, images = out / "dataset", (size["width"], size["height"])
    if not folder.exists():
        rocks = [(synthetic.CENTRE, synthetic.AXES * (1 + 0.1 * (seed % 5)))]
        synthetic.write_dataset(folder, synthetic.orbit_cameras(size["frames"], *images), rocks)
        tests = synthetic.orbit_cameras(size["tests"], *images)
        synthetic.write_dataset(folder / TEST_FOLDER, tests, rocks)
    return {"frames": size["frames"]}


@pytest.fixture
def quick(monkeypatch):
    """The preset `quick` is tiny, nothing is rendered, and few policies are compared."""
    monkeypatch.setitem(table1.SIZES, "quick", TINY)
    monkeypatch.setattr(case, "make_dataset", ellipsoids)
    for name in set(setups.SETUPS) - {"ring", "one seed"}:
        monkeypatch.delitem(setups.SETUPS, name)
    for module, values in {
        setups: {"JUDGE_PASSES": 2, "DRAWS": 2},
        table1: {
            "POLICIES": ("directional-d", "random"),
            "TABLE_POLICIES": ("d-optimal", "random"),
            "SLOW_POLICIES": (),
            "DRAWS": 2,
            "FEWER_IMAGES": 1,
        },
    }.items():
        for name, value in values.items():
            monkeypatch.setattr(module, name, value)


def done(capsys, *arguments):
    study(*arguments)
    return capsys.readouterr().out


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_setups_are_made_once_and_compare_a_policy_of_ones_own(
    quick, tmp_path, capsys, monkeypatch
):
    out, line = tmp_path / "out", "python -m studies.setups OUT --scale quick --rocks 2"
    with monkeypatch.context() as patched:
        patched.setattr(setups, "learn", None)  # these policies need no model to choose
        assert "dataset/boulder-11" in done(capsys, "setups", out, "--rocks", 2)
    folder = out / "results"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert set(before) == {"setups.csv", "setups.json", "setups.md", "setups.png", "leads.csv"}
    rows = rows_of(folder / "setups.csv")
    assert {row["command"] for row in rows} == {line}
    assert len(rows) == 2 * 2 * 2
    orbits = {path.name for path in out.glob("cells/dataset/boulder-11/*")}
    assert orbits == {"circle-1", "hemisphere-1"}
    assert [float(row["test_gain"]) for row in rows if row["policy"] == "random"] == [0] * 4
    cells = [json.loads(path.read_text()) for path in out.glob("cells/setup/**/result.json")]
    assert len(cells) >= 8
    assert {len(set(cell["found"]["taken"])) for cell in cells} == {6}
    again = done(capsys, "setups", out, "--rocks", 2)
    assert "setup/" not in again, "a cell was done twice"
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before

    mine = tmp_path / "mine.py"
    mine.write_text("def first(candidates):\n    return -1.0 * (candidates[:, 0] > -9)\n")
    one = ("setups", out, "--rocks", 1, "--policy", f"{mine}:first")
    said = done(capsys, *one)
    assert "mine.py:first" in said
    assert "directional-d" not in said, "the other policies are not run again"
    rows = rows_of(folder / "setups.csv")
    assert {row["policy"] for row in rows} == {*table1.POLICIES, "mine.py:first"}
    line = "python -m studies.setups OUT --scale quick --rocks 1 --policy mine.py:first"
    assert {row["command"] for row in rows} == {line}
    mine.write_text("def first(candidates):\n    return candidates[:, 0]\n")
    assert "mine.py:first" in done(capsys, *one), "another file is another policy"


def test_no_set_of_a_study_is_above_its_bound(quick, tmp_path, capsys, monkeypatch):
    small = {"COUNTS": (2,), "BATCH": 2, "BATCHES": 2, "SIZE": 2, "DRAWS": 3}
    small |= {"SHARES": (0.8,), "GAUSSIANS": 400, "TRAINING": certificate.TRAINING[:1]}
    for name, value in small.items():
        monkeypatch.setattr(certificate, name, value)
    out = tmp_path / "out"
    done(capsys, "certificate", out, "--rocks", 2)
    folder = out / "results"
    rows = rows_of(folder / "certificate.csv")
    assert [row["policy"] for row in rows] == [*certificate.POLICIES] * 2
    for row in rows:
        kinds = ("plan", "greedy", "farthest", "random", "random_best", "best")
        shares = {key: float(row[key]) for key in kinds}
        assert max(shares.values()) <= 1 + 1e-9
        assert shares["best"] >= shares["plan"] >= shares["random"] > 0
    curve = rows_of(folder / "certificate-curve.csv")
    for row in curve:
        assert 0 < float(row["percent"]) <= 100.1
    at = {(row["rock"], row["views"], row["kind"]): float(row["percent"]) for row in curve}
    bounds = {key: value for key, value in at.items() if key[2] == "bound"}
    assert all(value <= bounds[(*key[:2], "bound")] for key, value in at.items())
    assert (folder / "certificate.png").is_file()


def test_flights_keep_their_length_and_are_compared_with_even_spacing(
    quick, tmp_path, capsys, monkeypatch
):
    def fit_one_pass(scene, frames, views):
        train = scene.settings.train.model_copy(update={"passes": 1})
        return fit_views(scene, frames, views, train=train)

    monkeypatch.setattr(flights, "fit_views", fit_one_pass)
    out = tmp_path / "out"
    done(capsys, "flights", out, "--rocks", 1)
    rows = rows_of(out / "results/flights.csv")
    kinds = len(flights.FLIERS) * len(flights.LENGTHS)
    even = [row for row in rows if row["policy"] == flights.EVEN]
    assert len(rows) - len(even) == kinds * len(flights.POOLS)
    assert len(even) == 6 * len(flights.POOLS), "9 candidates"
    cell = next((out / "cells/flights").glob("*/dome-*/result.json"))
    found = json.loads(cell.read_text())["found"]
    for row in found["flights"]:
        assert row["metres"] <= (row["length"] or 1) * found["whole"] * 1.000001
        assert len(set(row["taken"])) == row["images"]
    assert "| dome | 20% | planned tour |" in (out / "results/flights.md").read_text()


def test_metres_are_compared_at_the_same_psnr():
    about = {"rock": "boulder-11", "scene": "boulder", "pool": "dome"}
    cell = SimpleNamespace(name="flights/boulder-11/dome-128x96", about=about)
    even = [(10, 20), (20, 24), (30, 23.5), (40, 28)]
    flown = [{"policy": flights.EVEN, "length": None, "metres": m, "psnr": p} for m, p in even]
    flown += [{"policy": "mine", "length": 0.5, "metres": 15, "psnr": 26}]
    flown += [{"policy": "mine", "length": 0.2, "metres": 12, "psnr": 19}]
    *_, found, low = flights.rows_of({cell.name: {"flights": flown}}, [cell])
    assert (found["ratio"], found["gain"]) == (pytest.approx(15 / 35), pytest.approx(4))
    assert (low["ratio"], low["gain"]) == (None, pytest.approx(-1.8))


@pytest.mark.slow
def test_a_survey_without_errors_changes_nothing(quick, tmp_path, capsys, monkeypatch):
    exact, surveyed = SurveySettings(sensor=0, exact_poses=True), []

    def without_errors(dataset, settings):
        surveyed.append(dataset.root)
        return fly(dataset, exact)

    monkeypatch.setattr(flight, "fly", without_errors)
    out = tmp_path / "out"
    done(capsys, "setups", out, "--rocks", 1)
    done(capsys, "survey", out, "--rocks", 1)
    assert len(surveyed) == 1
    assert (out / "results/survey-leads.csv").is_file()
    rows, without = (rows_of(out / f"results/{name}.csv") for name in ("survey", "setups"))
    ring = {row["policy"]: float(row["test"]) for row in without if row["setup"] == "ring"}
    assert {row["policy"]: float(row["test"]) for row in rows} == pytest.approx(ring)


@pytest.mark.slow
def test_rocks_of_ones_own_take_the_place_of_the_others(quick, tmp_path, capsys, monkeypatch):
    rendered = []

    def seen(root, out, scene, seed, size, changes, mesh):
        rendered.append((scene, Path(mesh).name))
        return ellipsoids(root, out, scene, seed, size)

    monkeypatch.setattr(case, "make_dataset", seen)
    monkeypatch.setattr(table1, "POLICIES", ("uniform", "random"))
    out, meshes = tmp_path / "out", [tmp_path / "one.ply", tmp_path / "two.glb"]
    for mesh in meshes:
        mesh.write_text(mesh.name)
    given = [part for mesh in meshes for part in ("--mesh", mesh)]
    said = done(capsys, "setups", out, *given)
    assert set(rendered) == {("boulder", "one.ply"), ("boulder", "two.glb")}
    assert "dataset/one-" in said
    assert {row["scene"] for row in rows_of(out / "results/setups.csv")} == {"one", "two"}
    line = "python -m studies.setups OUT --scale quick --rocks 2 --mesh one.ply --mesh two.glb"
    assert {row["command"] for row in rows_of(out / "results/setups.csv")} == {line}
    twice = ["--mesh", meshes[0], "--mesh", tmp_path / "out/../one.ply"]
    for options, line in (
        (["--rocks", 3, *given], "--rocks 3: setups can have 1 to 2"),
        ([part for _ in range(21) for part in ("--mesh", meshes[0])], "--mesh: 21 files"),
        (twice, "one.ply: there is one of this name already"),
    ):
        assert line in refused(capsys, [out, *options], out, "setups")
    meshes[0].write_text("another rock")
    again = done(capsys, "setups", out, *given)
    assert "dataset/one-" in again, "another file is another rock"
    assert "/two-" not in again


def test_a_case_is_the_scene_with_some_keys_changed(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        "mgs.synth.rendering.synth_orbit", lambda out, scene, *_, **__: made.append(scene)
    )
    monkeypatch.setattr(case, "load_dataset", lambda folder: ())
    changes = {"rock": {"specular": 0.0}, "orbit": {"kind": "hemisphere", "distances": [1, 2]}}
    for changed in ({}, changes):
        rock, settings = Rock("strata", 3), {"density": 0.125}
        (cell, prior) = Case(rock, ONE.images, settings, changes=changed).cells()
        assert cell.name == "dataset/strata-3/8x48x36"
        assert prior.name == "prior/strata-3/8x48x36-0.125"
        case.make_dataset(tmp_path, tmp_path, **json.loads(json.dumps(cell.arguments)))
    usual, changed = made
    assert (changed.rock.specular, changed.orbit.distances) == (0, (1, 2))
    back = {"rock": usual.rock, "orbit": usual.orbit}
    assert changed.model_copy(update=back) == usual


def test_a_prior_is_built_once_and_whole(tmp_path, monkeypatch):
    """Killed while it was being saved, and asked for again."""
    dataset, out = tmp_path / "dataset", tmp_path / "cell"
    synthetic.write_dataset(dataset, synthetic.orbit_cameras(8, 48, 36))

    def struck(folder, prior):
        (folder / "mesh.ply").write_text("half of a mesh")
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(case, "save_prior", struck)
        with pytest.raises(KeyboardInterrupt):
            case.make_prior(tmp_path, out, "dataset", gaussians=200)
    assert not (out / "prior").exists()
    found = case.make_prior(tmp_path, out, "dataset", gaussians=200)
    monkeypatch.setattr(case, "build_prior", None)
    assert case.make_prior(tmp_path, out, "dataset", gaussians=200) == found
    assert found["gaussians"] == 200


def test_a_run_and_3dgs_are_timed_alone_and_measured_on_all_views(quick, tmp_path, monkeypatch):
    for module in (case, free_fit):
        monkeypatch.setattr(module, "in_new_process", lambda task, out, *how: task(*how))
    monkeypatch.setattr(free_fit, "PASSES", 3)
    rock, row = Rock("boulder", 1), "3DGS, random points, twice the steps"
    runs = Run(rock, ONE, "farthest", budget=4), Run(rock, ONE, row, seeds=8, budget=0)
    run, free = (one.cells()[-1] for one in runs)
    results = run_cells(tmp_path, [cell for one in runs for cell in one.cells()], no_progress)
    for cell in (run, free):
        found = results[cell.name]
        assert cell.alone
        assert found["images"] == found["all"]["count"] == 8
        assert found["held_out"]["psnr"] is None
        assert found["test"]["count"] == 3
    found = results[run.name]
    folder = cell_folder(tmp_path, run.name) / "run"
    settings = json.loads((folder / "config.json").read_text())["settings"]
    assert settings["train"]["alpha_weight"] == 0, "studies fit colours alone"
    steps = read_checkpoint(folder).steps
    assert found["seconds"] == pytest.approx(sum(sum(step["seconds"].values()) for step in steps))
    choices = [step["seconds"]["score"] for step in steps[1:]]
    assert found["choice_seconds"] == pytest.approx(sum(choices) / 4)
    found = results[free.name]
    assert found["gaussians"] > 0
    assert found["choice_seconds"] is None
    assert found["all"]["psnr"] > 15


LINGERING = """
import time
from pathlib import Path

def linger():
    print("begun", flush=True)
    time.sleep(100)

if __name__ == "__main__":
    from studies.case import in_new_process

    in_new_process(linger, Path("cell"))
"""
"""A study with a task that takes long."""


def test_a_study_that_is_killed_leaves_no_process_behind(tmp_path):
    (tmp_path / "study.py").write_text(LINGERING)
    study = subprocess.Popen(
        [sys.executable, tmp_path / "study.py"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert study.stdout.readline() == "begun\n"
    study.kill()
    study.communicate(timeout=60)  # returns when the last process that has the pipe has ended


def test_table_1_has_equal_counts_and_the_papers_rows(quick, tmp_path, capsys, monkeypatch):
    """Interrupted, continued, and with batches."""
    asked = []

    def timed(root, out, dataset, prior, settings):
        """In place of the task that times a policy: numbers that depend on its settings."""
        asked.append(settings)
        if len(asked) == 3:
            raise KeyboardInterrupt
        value = 20 + settings["seed"] / 1000 + settings["budget"] / 10
        metrics = {"count": 3, "psnr": value, "ssim": 0.9, "psnr_mask": 22.0, "ssim_mask": 0.8}
        found = {"images": settings["seeds"] + settings["budget"], "choice_seconds": 0.5}
        found |= dict.fromkeys(("test", "all", "held_out"), metrics)
        return found | {"seconds": 12.3, "peak_megabytes": 512.6}

    monkeypatch.setattr(case, "time_policy", timed)
    monkeypatch.setattr(free_fit, "time_3dgs", timed)
    monkeypatch.setattr(results, "_write_figures", lambda work: [])
    out, table = tmp_path / "out", tmp_path / "out/results/table1.md"

    def rows():
        return {row["row"]: row for row in rows_of(out / "results/table1.csv")}

    study("table1", out, exit_code=130)
    assert "run the same command again to continue" in capsys.readouterr().err
    assert list(rows()) == ["d-optimal", "random, draw 1"]
    assert "| random, mean of 1 | 6 |" in table.read_text()
    left = "random, draw 2; coverage, fewer images; all views; 3DGS; 3DGS, random points"
    assert f"Not done yet: {left}.\n" in table.read_text()
    done(capsys, "table1", out)
    assert {name: row["images"] for name, row in rows().items()} == {
        "d-optimal": "6",
        "random, draw 1": "6",
        "random, draw 2": "6",
        "coverage, fewer images": "5",
        "all views": "8",
        "3DGS": "8",
        "3DGS, random points": "8",
    }
    text = table.read_text()
    theirs = "| the paper's D-Optimal NBV, on its rock | 54 | – | – | – | 25.97 | 0.9654 |"
    ours = "0.9000 | 22.00 | {0} | 0.9000 | {0} | 0.50 | 12 | 513 |"
    assert theirs in text
    assert "| d-optimal | 6 | 20.20 | " + ours.format("20.20") in text
    assert "| random, mean of 2 | 6 | 20.70 | " + ours.format("20.70") in text
    assert "`python -m studies.table1 OUT --scale quick`" in text
    assert "Not done yet" not in text
    line = rows()["random, draw 2"]["command"]
    assert line.startswith("mgs nbv cells/dataset/boulder-0/circle-1/8x48x36/dataset --prior ")
    assert line.endswith("--policy random --seeds 4 --budget 2 --seed 1000")
    done(capsys, "table1", out, "--batch", 2)
    ending = "--policy d-optimal --batch 2 --seeds 4 --budget 2 --seed 0"
    assert rows()["d-optimal"]["command"].endswith(ending)
    batches = [settings.get("batch") for settings in asked]
    assert batches == [None] * 8 + [2] * 5  # 3DGS is no run
    assert "studies.table1 OUT --scale quick --batch 2`" in table.read_text()


def made_up(value, scenes):
    """Rows of set-ups in which each policy finds value(policy) + the number of its rock."""
    return [
        {"rock": f"{scene}-{k}", "scene": scene, "setup": "ring", "policy": policy}
        | dict.fromkeys(setups.MEASURES, value[policy] + k)
        | {f"{key}_gain": value[policy] - value["random"] for key in setups.MEASURES}
        for k, scene in enumerate(scenes)
        for policy in value
    ]


def test_leads_are_over_scenes_and_corrected_for_all_tests():
    value = {"directional-d": 26.0, "cover": 25.8, "random": 25.0, "oracle": 26.25}
    rows = made_up(value, ("a", "b", "c", "c"))
    rows[8]["test"] += 0.3  # directional-d on one of two rocks of the third scene
    found = setups.leads_of(rows, "directional-d", "test")
    assert [lead["setup"] for lead in found] == ["ring", "ring", "mean", "mean"]
    leads = {lead["policy"]: lead for lead in found[:2]}
    assert set(leads) == {"cover", "random"}
    assert [leads[p]["scenes"] for p in leads] == [3, 3]
    assert leads["cover"]["lead"] == pytest.approx((0.2 + 0.2 + 0.35) / 3)
    assert [leads[p]["p"] for p in leads] == [0.25, 0.25]
    assert [leads[p]["p_holm"] for p in leads] == [1.0, 1.0]
    text = setups.text_of(rows, list(leads.values()))
    assert "| directional-d | +1.00 |" in text
    assert "| cover | +0.25 [" in text
    assert "| cover | 64% |" in text
    one = setups.leads_of(made_up(value, ("a",)), "directional-d", "test")
    assert {lead["p_holm"] for lead in one} == {lead["lead_low"] for lead in one} == {None}


@pytest.mark.slow
def test_an_oracle_that_sees_the_truth_is_best_in_its_first_choice(quick, tmp_path, monkeypatch):
    monkeypatch.setattr(setups, "JUDGE_PASSES", 10)
    size, rocks = replace(TINY.setups, images=5), TINY.some_rocks(1)
    found = run_cells(tmp_path, setups.cells_of(size, rocks, ("oracle", "random")), no_progress)
    ring = {name: r["test"] for name, r in found.items() if "/ring-" in name and "/oracle-" in name}
    others = [r["test"] for name, r in found.items() if "/ring-" in name and "/random-" in name]
    assert len(others) == setups.DRAWS
    assert next(iter(ring.values())) >= max(others) - 0.1, "its fit is warm, the judge's is not"
    cells = setups.cells_of(size, rocks, ("oracle", "random"))
    predicted = setups.foretold_of(found, cells)
    assert {row["policy"] for row in predicted} == set(setups.SCORED)
    assert all(-1 <= row["spearman"] <= 1 <= 1 + row["regret"] for row in predicted)
    text = setups.text_of(setups.rows_of(found, cells), [], predicted)
    assert "| rank correlation of the score with the gain | ring |" in text


def test_scores_equal_to_the_gains_foretell_them():
    psnr = np.array([20.0, 22.0, 21.0])
    scores = {"right": psnr, "wrong": [3, 1, 2], "same": [1, 1, 1]}

    rules = [
        Poses(name, lambda candidates, *_, values=values: values) for name, values in scores.items()
    ]
    scene = SimpleNamespace(positions=lambda frames: np.zeros((3, 3)), centre=np.zeros(3))
    state = SimpleNamespace(frames=[], taken=[0])
    found = foretold(rules, scene, state, [0, 1, 2], psnr)
    assert found["right"] == {"spearman": 1, "regret": 0}
    assert found["wrong"] == {"spearman": -1, "regret": 2}
    assert found["same"] == {"spearman": 0, "regret": 2}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--rocks", 13], "--rocks 13: setups can have 1 to 12"),
        (["--workers", 2, "--scheduler", "tcp://x:1"], "give one of them"),
        (["--policy", "uniform"], "--policy uniform: is compared anyway"),
        (["--policy", OWN, "--policy", OWN], "angle: there is one of this name already"),
        (["--mesh", "none.glb"], "none.glb: cannot be read (No such file or directory)"),
    ],
)
def test_options_that_cannot_be_are_one_line(capsys, tmp_path, options, words):
    assert words in refused(capsys, [tmp_path / "out", *options], tmp_path, "setups")


def test_a_folder_of_another_scale_or_of_something_else_is_refused(capsys, tmp_path):
    occupied(tmp_path / "full")
    assert "is there already" in refused(capsys, [tmp_path / "full"], tmp_path, "setups")
    (tmp_path / "paper").mkdir()
    write_json(tmp_path / "paper/study.json", {"scale": "paper"})
    line = refused(capsys, [tmp_path / "paper"], tmp_path, "setups")
    assert "was begun with --scale paper" in line
