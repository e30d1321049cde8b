"""`mgs reproduce` on ellipsoids of 200 Gaussians: cells, tables, and bad input."""

import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import synthetic
from program import command, exit_code
from refusals import occupied, refused

from mgs.data.dataset import TEST_FOLDER, load_dataset
from mgs.errors import InputError
from mgs.files import write_json
from mgs.fit.settings import COLOURS_ALONE
from mgs.run.folder import read_checkpoint
from mgs.run.nbv import run_nbv
from mgs.study import case, free_fit, reproduce
from mgs.study import reproduce_results as results
from mgs.study.case import Case, Scene, Size
from mgs.study.reproduce import FREE_FIT, ReproduceSize, Rock, Run, RunSize
from mgs.study.reproduce_results import Work
from mgs.study.sweep import cell_folder, run_cells

ONE = RunSize(Size(48, 36, 8, 3, spp=1), 200, 2)
TINY = ReproduceSize(ONE, ONE, curve_rocks=2, seed_rocks=1, pool_rocks=1)


def silent(name, done, total):
    pass


def ellipsoids(root, out, scene, seed, size, changes=None, mesh=None):
    """In place of the task that renders: another rock for each seed, at once."""
    folder, images = out / "dataset", (size["width"], size["height"])
    if not folder.exists():
        rocks = [(synthetic.CENTRE, synthetic.AXES * (1 + 0.1 * seed))]
        synthetic.write_dataset(folder, synthetic.orbit_cameras(size["frames"], *images), rocks)
        tests = synthetic.orbit_cameras(size["tests"], *images)
        synthetic.write_dataset(folder / TEST_FOLDER, tests, rocks)
    return {"frames": size["frames"]}


@pytest.fixture
def quick(monkeypatch):
    """The preset `quick` is tiny, nothing is rendered, and few policies are compared."""
    monkeypatch.setitem(reproduce.SIZES, "quick", TINY)
    monkeypatch.setattr(case, "make_dataset", ellipsoids)
    for name, value in {
        "POLICIES": ("farthest", "uniform"),
        "PAIRS": (("farthest", "uniform"),),
        "TABLE_POLICIES": ("d-optimal", "random"),
        "SLOW_POLICIES": (),
        "DRAWS": 2,
        "FEWER_IMAGES": 1,
    }.items():
        monkeypatch.setattr(reproduce, name, value)


def done(capsys, *arguments):
    command("reproduce", *arguments)
    return capsys.readouterr().out


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_curves_are_made_once_and_hold_what_the_runs_found(quick, tmp_path, capsys):
    out = tmp_path / "out"
    said = done(capsys, out, "--only", "curves")
    assert "0/8 curves dataset/boulder-1" in said
    folder = out / "results"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    names = ("curves.csv", "curves.json", "curves.md", "curves.png", "curves_by_rock.csv")
    assert set(before) == {*names, "statistics.json"}
    rows, each = rows_of(folder / "curves.csv"), rows_of(folder / "curves_by_rock.csv")
    assert [(row["policy"], row["images"]) for row in rows[:3]] == [("farthest", n) for n in "456"]
    line = "mgs reproduce --scale quick --only curves --rocks 2"
    assert {row["command"] for row in rows} == {line}
    (mean,), last = (
        [float(r["test_psnr"]) for r in of if (r["policy"], r["images"]) == ("uniform", "6")]
        for of in (rows, each)
    )
    assert len(last) == 2
    assert mean == pytest.approx(np.mean(last))
    statistics = json.loads((folder / "statistics.json").read_text())
    assert all(pair["p"] in (0.5, 1.0) for pair in statistics["test_psnr"]["pairs"])
    again = done(capsys, out, "--only", "curves")
    assert "/8" not in again, "a cell was done twice"
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_policy_of_ones_own_is_compared_over_rocks(quick, tmp_path, capsys):
    out, mine = tmp_path / "out", tmp_path / "mine.py"
    mine.write_text("def first(candidates):\n    return -1.0 * (candidates[:, 0] > -9)\n")
    one = (out, "--only", "curves", "--rocks", 1)
    done(capsys, *one)
    said = done(capsys, *one, "--policy", f"{mine}:first")
    assert "4/5 curves run/boulder-1" in said, "the other policies are not run again"
    rows = rows_of(out / "results/curves.csv")
    assert {row["policy"] for row in rows} == {"farthest", "uniform", "mine.py:first"}
    line = "mgs reproduce --scale quick --only curves --rocks 1 --policy mine.py:first"
    assert {row["command"] for row in rows} == {line}
    pairs = json.loads((out / "results/statistics.json").read_text())["test_psnr"]["pairs"]
    own = [("mine.py:first", "uniform"), ("mine.py:first", "farthest")]
    assert [(pair["policy"], pair["other"]) for pair in pairs] == [("farthest", "uniform"), *own]
    mine.write_text("def first(candidates):\n    return candidates[:, 0]\n")
    more = done(capsys, *one, "--policy", f"{mine}:first", "--policy", "coverage")
    assert "4/6 curves run/boulder-1" in more, "another file is another policy"
    rows = rows_of(out / "results/curves.csv")
    assert {row["policy"] for row in rows} == {"farthest", "uniform", "mine.py:first", "coverage"}


def test_rocks_of_ones_own_take_the_place_of_the_others(quick, tmp_path, capsys, monkeypatch):
    rendered = []

    def seen(root, out, scene, seed, size, changes, mesh):
        rendered.append((scene, Path(mesh).name))
        return ellipsoids(root, out, scene, seed, size)

    monkeypatch.setattr(case, "make_dataset", seen)
    out, meshes = tmp_path / "out", [tmp_path / "one.ply", tmp_path / "two.glb"]
    for mesh in meshes:
        mesh.write_text(mesh.name)
    given = [part for mesh in meshes for part in ("--mesh", mesh)]
    said = done(capsys, out, "--only", "curves", *given)
    assert rendered == [("boulder", "one.ply"), ("boulder", "two.glb")]
    assert "0/8 curves dataset/one-" in said
    assert {row["scene"] for row in rows_of(out / "results/curves_by_rock.csv")} == {"one", "two"}
    line = "mgs reproduce --scale quick --only curves --rocks 2 --mesh one.ply --mesh two.glb"
    assert {row["command"] for row in rows_of(out / "results/curves.csv")} == {line}
    twice = ["--mesh", meshes[0], "--mesh", tmp_path / "out/../one.ply"]
    for options, line in (
        (["--rocks", 3, *given], "--rocks 3: curves can have 1 to 2"),
        ([part for _ in range(21) for part in ("--mesh", meshes[0])], "--mesh: 21 files"),
        (twice, "one.ply: there is one of this name already"),
    ):
        assert line in refused(capsys, ["reproduce", out, *options], out)
    meshes[0].write_text("another rock")
    again = done(capsys, out, "--only", "curves", *given)
    assert "dataset/one-" in again, "another file is another rock"
    assert "/two-" not in again


def test_a_case_is_the_scene_with_some_keys_changed(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        "mgs.synth.rendering.synthesise", lambda out, scene, *_, **__: made.append(scene)
    )
    monkeypatch.setattr(case, "load_dataset", lambda folder: ())
    changes = {"rock": {"specular": 0.0}, "orbit": {"kind": "hemisphere", "distances": [1, 2]}}
    for scene in (Scene("strata", 3), Scene("strata", 3, changes)):
        (cell, prior) = Case(scene, ONE.images, {"density": 0.125}).cells()
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


def test_a_timed_run_has_a_process_of_its_own(quick, tmp_path):
    run = Run(Rock("boulder", 1), ONE, "farthest", budget=4, timed=True)
    *before, cell = run.cells()
    found = run_cells(tmp_path, [*before, cell], silent)[cell.name]
    assert cell.alone
    assert found["images"] == found["all"]["count"] == 8
    assert found["held_out"]["psnr"] is None
    assert found["test"]["count"] == 3
    steps = read_checkpoint(cell_folder(tmp_path, cell.name) / "run").steps
    assert found["seconds"] == pytest.approx(sum(sum(step["seconds"].values()) for step in steps))
    choices = [step["seconds"]["score"] for step in steps[1:]]
    assert found["choice_seconds"] == pytest.approx(sum(choices) / 4)
    assert 100 < found["peak_megabytes"] < 4000
    wrong = Run(Rock("boulder", 1), ONE, "nonsense", budget=1, timed=True)
    with pytest.raises(InputError, match=r"^policy nonsense: unknown"):
        run_cells(tmp_path, wrong.cells(), silent)


def test_a_free_fit_is_measured_on_all_views(quick, tmp_path, monkeypatch):
    monkeypatch.setattr(free_fit, "in_new_process", lambda task, out, *how: task(*how))
    monkeypatch.setattr(free_fit, "PASSES", 3)
    run = Run(Rock("boulder", 1), ONE, FREE_FIT, seeds=8, budget=0, timed=True)
    *before, cell = run.cells()
    found = run_cells(tmp_path, [*before, cell], silent)[cell.name]
    assert cell.alone
    assert found["images"] == found["all"]["count"] == 8
    assert found["test"]["count"] == 3
    assert found["held_out"]["psnr"] is None
    assert found["choice_seconds"] is None
    assert found["all"]["psnr"] > 15


def linger(path):
    """A task that takes long, and writes which process it is in."""
    path.write_text(str(os.getpid()))
    time.sleep(60)


LINGERING = """
import sys
from pathlib import Path
from test_reproduce import linger
from mgs.study.case import in_new_process
if __name__ == "__main__":
    in_new_process(linger, Path("cell"), Path(sys.argv[1]))
"""


def test_a_study_that_is_killed_leaves_no_process_behind(tmp_path):
    program, said = tmp_path / "study.py", tmp_path / "pid"
    program.write_text(LINGERING)
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = os.environ | {"PYTHONPATH": paths}
    study = subprocess.Popen([sys.executable, str(program), str(said)], env=environment)
    try:
        wait_for(lambda: said.is_file() and said.read_text())
    finally:
        study.kill()
        study.wait()
    wait_for(lambda: has_ended(said.read_text()))


def has_ended(process):
    try:
        return "zombie" in Path(f"/proc/{process}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True


def wait_for(come):
    until = time.monotonic() + 30
    while not come():
        assert time.monotonic() < until, "in vain"
        time.sleep(0.1)


def timed(root, out, dataset, prior, settings):
    """In place of the task that times a policy: numbers that depend on its settings."""
    value = 20 + settings["seed"] / 1000 + settings["budget"] / 10
    metrics = {"count": 3, "psnr": value, "ssim": 0.9, "psnr_mask": 22.0, "ssim_mask": 0.8}
    found = {"images": settings["seeds"] + settings["budget"], "choice_seconds": 0.5}
    found |= dict.fromkeys(("test", "all", "held_out"), metrics)
    return found | {"seconds": 12.3, "peak_megabytes": 512.6}


def test_table_1_has_equal_counts_and_the_papers_rows(quick, tmp_path, capsys, monkeypatch):
    asked = []

    def told(root, out, dataset, prior, settings):
        asked.append(settings)
        return timed(root, out, dataset, prior, settings)

    monkeypatch.setattr(case, "time_policy", told)
    monkeypatch.setattr(free_fit, "time_free_fit", told)
    out, table = tmp_path / "out", tmp_path / "out/results/table1.md"
    done(capsys, out, "--only", "table1")
    rows = {row["row"]: row for row in rows_of(out / "results/table1.csv")}
    assert {name: row["images"] for name, row in rows.items()} == {
        "d-optimal": "6",
        "random, draw 1": "6",
        "random, draw 2": "6",
        "coverage, fewer images": "5",
        "all views": "8",
        "all views, as 3DGS": "8",
    }
    text = table.read_text()
    theirs = "| the paper's D-Optimal NBV, on its rock | 54 | – | – | – | 25.97 | 0.9654 |"
    ours = "0.9000 | 22.00 | {0} | 0.9000 | {0} | 0.50 | 12 | 513 |"
    assert theirs in text
    assert "| d-optimal | 6 | 20.20 | " + ours.format("20.20") in text
    assert "| random, mean of 2 | 6 | 20.70 | " + ours.format("20.70") in text
    assert "`mgs reproduce --scale quick --only table1`" in text
    assert "Not done yet" not in text
    line = rows["random, draw 2"]["command"]
    assert line.startswith("mgs nbv cells/dataset/boulder-0/circle-1/8x48x36/dataset --prior ")
    assert line.endswith("--policy random --seed-views 4 --budget 2 --random-seed 1000")
    done(capsys, out, "--only", "table1", "--batch", 2)
    rows = {row["row"]: row for row in rows_of(out / "results/table1.csv")}
    ending = "--policy d-optimal --batch 2 --seed-views 4 --budget 2 --random-seed 0"
    assert rows["d-optimal"]["command"].endswith(ending)
    batches = [settings.get("batch") for settings in asked]
    assert batches == [None] * 6 + [2] * 5  # the fit to all views is no run
    assert "--only table1 --batch 2`" in table.read_text()


def test_table_1_is_there_for_the_rows_that_are_done(quick, tmp_path, capsys, monkeypatch):
    def killed(root, out, dataset, prior, settings):
        if settings["policy"] == "random" and settings["seed"]:
            raise KeyboardInterrupt
        return timed(root, out, dataset, prior, settings)

    monkeypatch.setattr(case, "time_policy", killed)
    out = tmp_path / "out"
    assert exit_code("reproduce", out, "--only", "table1") == 130
    assert "run the same command again to continue" in capsys.readouterr().err
    done_rows = [row["row"] for row in rows_of(out / "results/table1.csv")]
    assert done_rows == ["d-optimal", "random, draw 1"]
    text = (out / "results/table1.md").read_text()
    assert "| random, mean of 1 | 6 |" in text
    left = "random, draw 2; coverage, fewer images; all views; all views, as 3DGS"
    assert f"Not done yet: {left}.\n" in text


def fake(runs, value, steps=3):
    """What runs might have found: curves that rise by 0.5 dB an image and end in value(run)."""
    found = {}
    for run in runs:
        psnr = [value(run) - 0.5 * (steps - 1 - k) for k in range(steps)]
        images, taken = [run.seeds + k for k in range(steps)], [0, run.size.images.frames // 2]
        measured = {"test_psnr": psnr, "test_psnr_mask": [v - 3 for v in psnr]}
        found[run.name] = {"images": images, "taken": taken, "coverage": [0.9] * steps} | measured
    return found


def test_differences_are_paired_by_rock(tmp_path):
    runs = reproduce.curve_runs(TINY, 3)
    ahead = {"d-optimal": 0.0, "uniform": 0.3, "directional-i": 0.5}
    found = fake(runs, lambda run: 25 + 10 * run.rock.index + ahead.get(run.policy, 0.1))
    results.write_curves(Work(tmp_path, found, TINY, 3, "c"))
    rows = json.loads((tmp_path / "results/curves.json").read_text())["rows"]
    row = next(r for r in rows if (r["policy"], r["images"]) == ("d-optimal", 6))
    assert row["test_psnr"] == pytest.approx(35)
    ends = [row[f"test_psnr_over_uniform{end}"] for end in ("", "_low", "_high")]
    assert ends == pytest.approx([-0.3] * 3)
    statistics = results.statistics_of(found, runs)["test_psnr"]
    pairs, reach = statistics["pairs"], statistics["reach"]
    assert [(p["policy"], p["other"]) for p in pairs] == list(reproduce.PAIRS)
    assert [p["effect"] for p in pairs] == pytest.approx([-0.3, -0.1, 0.2, 0.4, 0, -0.1, 0])
    assert [p["ahead"] for p in pairs] == [0, 0, 3, 3, 0, 0, 0]
    assert [p["p"] for p in pairs] == pytest.approx([*[0.25] * 4, 1, 0.25, 1])
    assert [p["p_holm"] for p in pairs] == pytest.approx([1.0] * 7)
    assert [p["verdict"] for p in pairs[:4]] == ["fails", "fails", "holds", "holds"]
    images = [reach[policy]["images"] for policy in ("uniform", "directional-i")]
    assert images == pytest.approx([5.6, 5.2])
    assert reach["d-optimal"] == {"images": None, "rocks": 0}
    text = (tmp_path / "results/curves.md").read_text()
    assert "| d-optimal | 34.50 | 31.50 | – | – |" in text
    assert "| uniform | 34.80 | 31.80 | 5.6 | 5.6 |" in text
    pair = "| d-optimal − uniform | full frame | -0.30 [-0.30, -0.30], 0 of 3 | fails | 0.25 | 1 |"
    assert pair + " -0.30, 0 of 1 |" in text
    assert (tmp_path / "results/curves.png").stat().st_size > 10_000


def test_scenes_that_chose_no_setting_are_judged_alone():
    """Policies were developed on the first two of five rocks, one rock a scene."""
    runs, ahead = reproduce.curve_runs(TINY, 5), (5.0, 5.0, 0.1, 0.2, -0.6)
    found = fake(runs, lambda r: 25 + ahead[r.rock.index] * (r.policy == "directional-i"))
    pairs = results.statistics_of(found, runs)["test_psnr"]["pairs"]
    pair = next(p for p in pairs if (p["policy"], p["other"]) == ("directional-i", "uniform"))
    assert (pair["runs"], pair["ahead"], pair["effect"]) == (5, 4, pytest.approx(9.7 / 5))
    there = pair["elsewhere"]
    assert (there["runs"], there["ahead"], there["effect"]) == (3, 2, pytest.approx(-0.1))


def test_of_one_rock_nothing_is_claimed():
    runs = reproduce.curve_runs(TINY, 1)
    statistics = results.statistics_of(fake(runs, lambda run: 25), runs)
    for pair in statistics["test_psnr"]["pairs"]:
        assert pair["interval"] is pair["p"] is pair["p_holm"] is None
        assert pair["verdict"] == "depends"
    line = "| d-optimal − uniform | full frame | +0.00, 0 of 1 | depends | – | – | – |"
    assert line in results.statistics_text(statistics)


def test_shares_are_of_what_the_oracle_gains_over_random(tmp_path):
    runs, oracle = reproduce.pool_runs(TINY, 2), reproduce.oracle_runs(TINY, 2)
    value = {"oracle": 27.0, "random": 24.0, "d-optimal": 25.5}
    found = fake(runs + oracle, lambda r: value.get(r.policy, 26.0) + r.rock.index + r.draw)
    means, _ = results.pool_rows(found, runs + oracle)
    rows = {(row["pool"], row["policy"]): row for row in means}
    expected = {"oracle": 1, "random": 0, "d-optimal": 0.25, "farthest": 0.5}
    for pool in reproduce.POOLS:
        shares = {policy: rows[pool, policy]["test_psnr_share"] for policy in expected}
        assert shares == pytest.approx(expected)
        assert rows[pool, "random"]["rocks"] == 2
    half, pools = "+0.50 [+0.50, +0.50]", len(reproduce.POOLS)
    text = results.pools_text(means)
    assert f"| test views (dB) | {' | '.join(reproduce.POOLS)} |" in text
    assert f"| d-optimal |{' 26.00 |' * pools}\n" in text
    assert text.count(f"| d-optimal |{f' {half} |' * pools}\n") == 3  # frame, rock, whole curve
    assert f"| directional-i |{' – |' * pools}\n" in text
    assert f"| d-optimal |{' 25% |' * pools}\n" in text
    written = results.write_pools(Work(tmp_path, fake(runs, lambda r: 25.0), TINY, 2, "c"))
    assert {row["test_psnr_share"] for row in rows_of(written[0])} == {""}, "without the oracle"
    assert all(path.is_file() for path in written)


def test_numbers_of_seeds_are_compared_at_equal_images(tmp_path):
    runs = reproduce.seed_runs(TINY, 2)
    assert {run.seeds + run.settings()["budget"] for run in runs} == {6}
    found = fake(runs, lambda run: 25 + run.seeds / 10)
    rows, _ = results.seed_rows(found, runs)
    over = [row["test_psnr_over_four"] for row in rows[:6]]
    assert over == pytest.approx([-0.3, -0.2, -0.1, 0, 0.2, 0.4])
    results.write_seeds(Work(tmp_path, found, TINY, 2, "c"))
    line = "| d-optimal | 1 | 90.0 | 180 (180) | 25.10 | -0.30 [-0.30, -0.30] |"
    assert line in (tmp_path / "results/seeds.md").read_text()
    assert (tmp_path / "results/seeds.png").stat().st_size > 10_000
    assert results.largest_gap([0, 27, 23, 19], 32) == pytest.approx(19 * 360 / 32)
    assert results.largest_gap([5], 8) == 360
    assert results.largest_gap([6, 0, 2, 4], 8) == 90


def test_a_pool_changes_the_orbit_of_the_scene():
    dataset, _, cell = Run(Rock("boulder", 1), ONE, "uniform", pool="mixed distances").cells()
    assert dataset.name == "dataset/boulder-1/hemisphere-1-2-3/8x48x36"
    assert dataset.arguments["changes"]["orbit"] == {"kind": "hemisphere", "distances": [1, 2, 3]}
    assert cell.arguments["dataset"] == f"cells/{dataset.name}/dataset"


def test_the_pool_of_an_arc_is_half_dense_and_half_sparse(quick, tmp_path):
    run = Run(Rock("boulder", 1), ONE, "uniform", pool="biased arc")
    ring, _, arc, cell = run.cells()
    for _ in range(2):
        assert run_cells(tmp_path, [ring, arc], silent)[arc.name] == {"frames": 7}
    whole = load_dataset(tmp_path / arc.arguments["ring"])
    some = load_dataset(tmp_path / cell.arguments["dataset"])
    kept = [whole.frames[i].name for i in (*range(6), 6)]
    assert [frame.name for frame in some.frames] == kept
    assert np.array_equal(some.frames[6].target()[0], whole.frames[6].target()[0])
    assert len(some.test_views()) == 3


def test_pools_and_the_oracle_that_sees_the_truth(quick, tmp_path, monkeypatch):
    monkeypatch.setattr(reproduce, "POLICIES", ("uniform", "random"))
    monkeypatch.setattr(reproduce, "DRAWS", 1)
    monkeypatch.setattr(reproduce, "POOLS", {"five nearest": {"kind": "circle", "nearest": 5}})
    found = run_cells(tmp_path, reproduce.RESULTS["oracle"].cells(TINY, 1), silent)
    oracle = reproduce.oracle_runs(TINY, 1)[0]
    best = found[oracle.name]["test_psnr"][1]
    others = [found[run.name]["test_psnr"][1] for run in reproduce.pool_runs(TINY, 1)]
    assert best >= max(others), "the first choice is the best there is"
    step = read_checkpoint(cell_folder(tmp_path, oracle.name) / "run").steps[1]
    assert step["score"] == step["test_psnr"], "what it foresaw is what the loop then fits"
    without = {name: found[name] for name in found if name != oracle.name}
    written = results.write_pools(Work(tmp_path, without, TINY, 1, "c"))
    assert [row["policy"] for row in rows_of(written[0])] == ["uniform", "random", "oracle"]


def test_a_run_that_was_killed_goes_on(quick, tmp_path):
    run = Run(Rock("boulder", 1), ONE, "d-optimal")
    *before, cell = run.cells()
    run_cells(tmp_path, before, silent)
    folder = cell_folder(tmp_path, cell.name)
    (folder / ".run.1.part").mkdir(parents=True)
    dataset, prior = (tmp_path / cell.arguments[name] for name in ("dataset", "prior"))
    given = {**run.settings(), "budget": 2, "evaluate_every": 1, "train": COLOURS_ALONE}

    def stop(state):
        if len(state.steps) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_nbv(dataset, folder / "run", prior=prior, on_step=stop, **given)
    whole = run_cells(tmp_path, [*before, cell], silent)[cell.name]
    assert whole == run_cells(tmp_path / "other", [*before, cell], silent)[cell.name]


def test_every_run_of_every_result_has_its_own_cell():
    for size in reproduce.SIZES.values():
        for name, result in reproduce.RESULTS.items():
            runs = result.runs(size, result.count(size))
            assert len({run.name for run in runs}) == len(runs), name
            cells = {cell.name: cell for cell in result.cells(size, result.count(size))}
            assert all(need in cells for cell in cells.values() for need in cell.needs)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("--scale huge", "--scale 'huge': unknown; choose one of quick, paper"),
        ("--only table2", "unknown; choose some of table1,figures,curves,seeds,pools,oracle"),
        ("--only ,", "--only '': unknown"),
        ("--rocks 21", "--rocks 21: curves can have 1 to 20"),
        ("--rocks 11 --only pools", "--rocks 11: pools can have 1 to 10"),
        ("--workers 2 --scheduler tcp://x:1", "give one of them"),
        ("--policy best", "--policy best: unknown; choose one of"),
        ("--policy uniform", "--policy uniform: is compared anyway"),
        ("--policy angle --policy angle", "angle: there is one of this name already"),
        ("--policy block-d --only table1", "is for curves and pools, and --only leaves both out"),
        ("--policy none.py:f", "none.py"),
        ("--mesh none.glb", "none.glb: cannot be read (No such file or directory)"),
        ("--mesh none.glb --only table1", "is for results over many rocks, and --only leaves them"),
        ("--batch 0", "should be greater than or equal to 1"),
        ("--batch 5 --only curves", "is for table1 and figures, and --only leaves both out"),
    ],
)
def test_bad_options_are_one_clear_line(capsys, tmp_path, arguments, line):
    given = ["reproduce", tmp_path / "out", *arguments.split(" ")]
    assert line in refused(capsys, given, tmp_path)


def test_a_folder_of_another_preset_or_of_something_else_is_refused(capsys, tmp_path):
    occupied(tmp_path / "full")
    assert "not empty" in refused(capsys, ["reproduce", tmp_path / "full"], tmp_path)
    (tmp_path / "paper").mkdir()
    write_json(tmp_path / "paper/study.json", {"preset": "paper"})
    line = refused(capsys, ["reproduce", tmp_path / "paper"], tmp_path)
    assert "was begun with --scale paper" in line
