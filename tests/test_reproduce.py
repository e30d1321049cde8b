"""`mgs reproduce` on ellipsoids of 200 Gaussians: cells, what they say together, and bad input."""

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
from refusals import occupied, refused

from mgs.cli.app import main
from mgs.data.dataset import TEST_FOLDER, load_dataset
from mgs.errors import InputError
from mgs.files import write_json
from mgs.fit.settings import COLOURS_ALONE
from mgs.run.folder import read_checkpoint
from mgs.run.nbv import run_nbv
from mgs.study import free_fit, material, reproduce, tasks
from mgs.study.reproduce import FREE_FIT, Preset, Rock, Run, Size
from mgs.study.reproduce_figures import curves_figure, pools_figure, seeds_figure
from mgs.study.reproduce_results import (
    curve_rows,
    curve_statistics,
    largest_gap,
    pool_rows,
    seed_rows,
    write_pools,
)
from mgs.study.reproduce_tables import pools_markdown, seeds_markdown, statistics_markdown
from mgs.study.sweep import cell_folder, run_cells

SIZE = Size(48, 36, 8, 1, 3, 200, 2)
TINY = Preset(SIZE, SIZE, curve_rocks=2, seed_rocks=1, pool_rocks=1)


def silent(name, done, total):
    pass


def ellipsoids(root, out, scene, seed, orbit, test_views, preset):
    """In place of the task that renders: another rock for each seed, as quickly as can be."""
    folder = out / "dataset"
    if not folder.exists():
        rocks = [(synthetic.CENTRE, synthetic.AXES * (1 + 0.1 * seed))]
        cameras = synthetic.orbit_cameras(preset["frames"], preset["width"], preset["height"])
        tests = synthetic.orbit_cameras(test_views, preset["width"], preset["height"])
        synthetic.write_dataset(folder, cameras, rocks)
        synthetic.write_dataset(folder / TEST_FOLDER, tests, rocks)
    return {"frames": preset["frames"]}


@pytest.fixture
def quick(monkeypatch):
    """The preset `quick` is tiny, and nothing is rendered; few policies are compared."""
    monkeypatch.setitem(reproduce.PRESETS, "quick", TINY)
    monkeypatch.setattr(tasks, "make_dataset", ellipsoids)
    monkeypatch.setattr(reproduce, "POLICIES", ("farthest", "uniform"))
    monkeypatch.setattr(reproduce, "PAIRS", (("farthest", "uniform"),))
    monkeypatch.setattr(reproduce, "TABLE_POLICIES", ("d-optimal", "random"))
    monkeypatch.setattr(reproduce, "SLOW_POLICIES", ())
    monkeypatch.setattr(reproduce, "DRAWS", 2)


def done(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main(["reproduce", *(str(argument) for argument in arguments)])
    said = capsys.readouterr()
    assert stop.value.code == 0, said.err
    return said.out


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_curves_are_made_once_and_hold_what_the_runs_found(quick, tmp_path, capsys):
    out = tmp_path / "out"
    said = done(capsys, out, "--only", "curves")
    assert "curves 0/8 dataset/boulder-1" in said
    results = out / "results"
    before = {path.name: path.read_bytes() for path in results.iterdir()}
    assert set(before) == {
        "curves.csv",
        "curves.json",
        "curves.md",
        "curves.png",
        "curves_by_rock.csv",
        "statistics.json",
    }
    rows = rows_of(results / "curves.csv")
    assert [(row["policy"], row["images"]) for row in rows[:3]] == [
        ("farthest", "4"),
        ("farthest", "5"),
        ("farthest", "6"),
    ]
    assert {row["command"] for row in rows} == {
        "mgs reproduce --preset quick --only curves --rocks 2"
    }
    each = rows_of(results / "curves_by_rock.csv")
    last = [
        float(row["test_psnr"])
        for row in each
        if row["policy"] == "uniform" and row["images"] == "6"
    ]
    mean = next(
        float(row["test_psnr"])
        for row in rows
        if row["policy"] == "uniform" and row["images"] == "6"
    )
    assert len(last) == 2
    assert mean == pytest.approx(np.mean(last))
    statistics = json.loads((results / "statistics.json").read_text())
    assert all(pair["p"] in (0.5, 1.0) for pair in statistics["test_psnr"]["pairs"]), (
        "what two rocks can say"
    )
    again = done(capsys, out, "--only", "curves")
    assert "/8" not in again, "a cell was done twice"
    assert {path.name: path.read_bytes() for path in results.iterdir()} == before


def test_a_policy_of_ones_own_is_compared_over_rocks(quick, tmp_path, capsys):
    out, mine = tmp_path / "out", tmp_path / "mine.py"
    mine.write_text(
        "def first(candidates):\n    return -1.0 * len(candidates) * (candidates[:, 0] > -9)\n"
    )
    done(capsys, out, "--only", "curves", "--rocks", 1)
    said = done(capsys, out, "--only", "curves", "--rocks", 1, "--policy", f"{mine}:first")
    assert "curves 4/5 run/boulder-1" in said, "the other policies are not run again"
    rows = rows_of(out / "results/curves.csv")
    assert {row["policy"] for row in rows} == {"farthest", "uniform", "mine.py:first"}
    assert {row["command"] for row in rows} == {
        "mgs reproduce --preset quick --only curves --rocks 1 --policy mine.py:first"
    }
    pairs = json.loads((out / "results/statistics.json").read_text())["test_psnr"]["pairs"]
    own = [("mine.py:first", "uniform"), ("mine.py:first", "farthest")]
    assert [(pair["policy"], pair["other"]) for pair in pairs] == [("farthest", "uniform"), *own]
    mine.write_text("def first(candidates):\n    return candidates[:, 0]\n")
    again = done(capsys, out, "--only", "curves", "--rocks", 1, "--policy", f"{mine}:first")
    assert "curves 4/5 run/boulder-1" in again, "another file is another policy"
    more = done(
        capsys,
        out,
        "--only",
        "curves",
        "--rocks",
        1,
        "--policy",
        f"{mine}:first",
        "--policy",
        "coverage",
    )
    assert "curves 5/6 run/boulder-1" in more, "two more"
    assert {row["policy"] for row in rows_of(out / "results/curves.csv")} == {
        "farthest",
        "uniform",
        "mine.py:first",
        "coverage",
    }


def test_rocks_of_ones_own_take_the_place_of_the_others(quick, tmp_path, capsys, monkeypatch):
    rendered = []

    def seen(root, out, scene, seed, orbit, test_views, preset, mesh):
        rendered.append((scene, Path(mesh).name))
        return ellipsoids(root, out, scene, seed, orbit, test_views, preset)

    monkeypatch.setattr(tasks, "make_dataset", seen)
    out, meshes = tmp_path / "out", [tmp_path / "one.ply", tmp_path / "two.glb"]
    for mesh in meshes:
        mesh.write_text(mesh.name)
    given = [part for mesh in meshes for part in ("--mesh", mesh)]
    said = done(capsys, out, "--only", "curves", *given)
    assert rendered == [("boulder", "one.ply"), ("boulder", "two.glb")]
    assert "curves 0/8 dataset/one-" in said
    assert {row["scene"] for row in rows_of(out / "results/curves_by_rock.csv")} == {"one", "two"}
    command = "mgs reproduce --preset quick --only curves --rocks 2 --mesh one.ply --mesh two.glb"
    assert {row["command"] for row in rows_of(out / "results/curves.csv")} == {command}
    assert "--rocks 3: curves can have 1 to 2" in refused(
        capsys, ["reproduce", out, "--rocks", 3, *given], out
    )
    many = [part for _ in range(21) for part in ("--mesh", meshes[0])]
    assert "--mesh: 21 files" in refused(capsys, ["reproduce", out, *many], out)
    assert "--rocks 2: curves can have 1 to 1" in refused(
        capsys, ["reproduce", out, "--rocks", 2, *given[:2]], out
    )
    twice = ["reproduce", out, "--mesh", meshes[0], "--mesh", tmp_path / "out/../one.ply"]
    assert "one.ply: there is one of this name already" in refused(capsys, twice, out)
    meshes[0].write_text("another rock")
    again = done(capsys, out, "--only", "curves", *given)
    assert "dataset/one-" in again, "another file is another rock"
    assert "/two-" not in again


def test_a_prior_is_built_once_and_whole(tmp_path, monkeypatch):
    """Killed while it was being saved, and asked for again."""
    dataset, folder = tmp_path / "dataset", tmp_path / "cell/prior"
    synthetic.write_dataset(dataset, synthetic.orbit_cameras(8, 48, 36))

    def struck(out, prior):
        (out / "mesh.ply").write_text("half of a mesh")
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(material, "save_prior", struck)
        with pytest.raises(KeyboardInterrupt):
            material.made_prior(folder, dataset, gaussians=200)
    assert not folder.exists()
    prior = material.made_prior(folder, dataset, gaussians=200)
    monkeypatch.setattr(material, "build_prior", None)
    assert np.array_equal(material.made_prior(folder, dataset, gaussians=200).points, prior.points)
    assert material.made_dataset(dataset, "boulder", None).frames == load_dataset(dataset).frames, (
        "it is there"
    )


def test_a_timed_run_has_a_process_of_its_own(quick, tmp_path):
    run = Run(Rock("boulder", 1), SIZE, "farthest", budget=4, timed=True)
    *before, cell = run.cells()
    found = run_cells(tmp_path, [*before, cell], silent)[cell.name]
    assert cell.alone
    assert found["images"] == found["all"]["count"] == 8
    assert found["held_out"]["psnr"] is None
    assert found["test"]["count"] == 3
    steps = read_checkpoint(cell_folder(tmp_path, cell.name) / "run").steps
    assert found["seconds"] == pytest.approx(sum(sum(step["seconds"].values()) for step in steps))
    assert found["choice_seconds"] == pytest.approx(
        sum(step["seconds"]["score"] for step in steps[1:]) / 4
    )
    assert 100 < found["peak_megabytes"] < 4000


def test_a_free_fit_is_measured_on_all_views(quick, tmp_path, monkeypatch):
    monkeypatch.setattr(
        free_fit, "in_own_process", lambda task, out, *arguments: task(*arguments)
    )  # it would not see PASSES
    monkeypatch.setattr(free_fit, "PASSES", 3)
    *before, cell = Run(
        Rock("boulder", 1), SIZE, FREE_FIT, seeds=SIZE.frames, budget=0, timed=True
    ).cells()
    found = run_cells(tmp_path, [*before, cell], silent)[cell.name]
    assert cell.alone
    assert found["images"] == found["all"]["count"] == SIZE.frames
    assert found["test"]["count"] == SIZE.test_views
    assert found["held_out"]["psnr"] is None
    assert found["choice_seconds"] is None
    assert found["all"]["psnr"] > 15
    assert found["seconds"] > 0


def test_what_a_timed_run_raises_comes_through(quick, tmp_path):
    run = Run(Rock("boulder", 1), SIZE, "nonsense", budget=1, timed=True)
    with pytest.raises(InputError, match="--policy nonsense: unknown"):
        run_cells(tmp_path, run.cells(), silent)


def linger(path):
    """A task that takes long, and says which process it is in."""
    path.write_text(str(os.getpid()))
    time.sleep(60)


LINGERING = """
import sys
from pathlib import Path
from test_reproduce import linger
from mgs.study.tasks import in_own_process
if __name__ == "__main__":
    in_own_process(linger, Path("cell"), Path(sys.argv[1]))
"""


def test_a_study_that_is_killed_leaves_no_process_behind(tmp_path):
    program, said = tmp_path / "program.py", tmp_path / "pid"
    program.write_text(LINGERING)
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])
    }
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
    """Until something has come to be, for half a minute at most."""
    until = time.monotonic() + 30
    while not come():
        assert time.monotonic() < until, "in vain"
        time.sleep(0.1)


def timed(root, out, dataset, prior, settings):
    """In place of the task that times a policy: numbers that tell which settings it was given."""
    value = 20 + settings["seed"] / 1000 + settings["budget"] / 10
    metrics = {"count": 3, "psnr": value, "ssim": 0.9, "psnr_mask": 22.0, "ssim_mask": 0.8}
    numbers = {
        "images": settings["seeds"] + settings["budget"],
        "test": metrics,
        "all": metrics,
        "held_out": metrics,
    }
    return numbers | {"choice_seconds": 0.5, "seconds": 12.3, "peak_megabytes": 512.6}


def test_table_1_has_equal_counts_and_the_papers_rows(quick, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tasks, "time_policy", timed)
    monkeypatch.setattr(free_fit, "time_free_fit", timed)
    monkeypatch.setattr(reproduce, "FEWER_IMAGES", 1)
    out = tmp_path / "out"
    done(capsys, out, "--only", "table1")
    rows = {row["row"]: row for row in rows_of(out / "results/table1.csv")}
    policies = [
        "d-optimal",
        "random, draw 1",
        "random, draw 2",
        "coverage, fewer images",
        "all views",
        "all views, as 3DGS",
    ]
    assert list(rows) == policies
    assert [row["images"] for row in rows.values()] == ["6", "6", "6", "5", "8", "8"]
    text = (out / "results/table1.md").read_text()
    assert "| the paper's D-Optimal NBV, on its rock | 54 | – | – | – | 25.97 | 0.9654 |" in text
    assert (
        "| d-optimal | 6 | 20.20 | 0.9000 | 22.00 | 20.20 | 0.9000 | 20.20 | 0.50 | 12 | 513 |"
        in text
    )
    assert (
        "| random, mean of 2 | 6 | 20.70 | 0.9000 | 22.00 | 20.70 | 0.9000 | 20.70 | 0.50 | 12 | 513 |"
        in text
    )
    assert rows["random, draw 2"]["command"].startswith("mgs nbv cells/dataset/boulder-0/")
    assert rows["random, draw 2"]["command"].endswith(
        "--policy random --seeds 4 --budget 2 --seed 1000"
    )
    assert "`mgs reproduce --preset quick --only table1`" in text
    assert "Not done yet" not in text


def test_table_1_can_choose_several_views_between_fits(quick, tmp_path, capsys, monkeypatch):
    asked = []

    def told(root, out, dataset, prior, settings):
        asked.append(settings)
        return timed(root, out, dataset, prior, settings)

    monkeypatch.setattr(tasks, "time_policy", told)
    monkeypatch.setattr(free_fit, "time_free_fit", told)
    out = tmp_path / "out"
    done(capsys, out, "--only", "table1", "--batch", 2)
    rows = {row["row"]: row for row in rows_of(out / "results/table1.csv")}
    assert rows["d-optimal"]["command"].endswith(
        "--policy d-optimal --batch 2 --seeds 4 --budget 2 --seed 0"
    )
    assert [settings.get("batch") for settings in asked] == [
        *[2] * (len(asked) - 1),
        None,
    ]  # the last is no run
    assert (
        "`mgs reproduce --preset quick --only table1 --batch 2`"
        in (out / "results/table1.md").read_text()
    )
    done(capsys, out, "--only", "table1")  # other runs, but for the fit to all views
    assert len(asked) == 2 * len(rows) - 1


def test_table_1_is_there_for_the_rows_that_are_done(quick, tmp_path, capsys, monkeypatch):
    def killed(root, out, dataset, prior, settings):
        if settings["policy"] == "random" and settings["seed"]:
            raise KeyboardInterrupt
        return timed(root, out, dataset, prior, settings)

    monkeypatch.setattr(tasks, "time_policy", killed)
    monkeypatch.setattr(reproduce, "FEWER_IMAGES", 1)
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as stop:
        main(["reproduce", str(out), "--only", "table1"])
    assert stop.value.code == 130
    assert "run the same command again to continue" in capsys.readouterr().err
    text = (out / "results/table1.md").read_text()
    assert [row["row"] for row in rows_of(out / "results/table1.csv")] == [
        "d-optimal",
        "random, draw 1",
    ]
    assert "| random, mean of 1 | 6 |" in text
    assert (
        "Not done yet: random, draw 2; coverage, fewer images; all views; all views, as 3DGS.\n"
        in text
    )


def fake(run, value, steps=3):
    """What a run might have found: a curve that ends in a value."""
    images = [run.seeds + k for k in range(steps)]
    values = [value - 0.5 * (steps - 1 - k) for k in range(steps)]
    measured = {
        "coverage": [0.9] * steps,
        "test_psnr": values,
        "test_psnr_mask": [v - 3 for v in values],
    }
    return {"images": images, "taken": [0, run.size.frames // 2]} | measured


def test_differences_are_paired_by_rock():
    runs = reproduce.curve_runs(TINY, 3)
    ahead = {"d-optimal": 0.0, "uniform": 0.3, "directional-i": 0.5}
    found = {
        run.name: fake(run, 25 + 10 * run.rock.index + ahead.get(run.policy, 0.1)) for run in runs
    }
    row = next(
        row
        for row in curve_rows(found, runs)
        if row["policy"] == "d-optimal" and row["images"] == 6
    )
    assert row["test_psnr"] == pytest.approx(35)
    assert [row[f"test_psnr_over_uniform{end}"] for end in ("", "_low", "_high")] == pytest.approx(
        [-0.3] * 3
    )
    pairs = curve_statistics(found, runs)["test_psnr"]["pairs"]
    assert [(p["policy"], p["other"]) for p in pairs] == list(reproduce.PAIRS)
    assert [p["difference"] for p in pairs] == pytest.approx([-0.3, -0.1, 0.2, 0.4, 0, -0.1, 0])
    assert [p["ahead"] for p in pairs] == [0, 0, 3, 3, 0, 0, 0]
    assert [p["p"] for p in pairs] == pytest.approx([*[0.25] * 4, 1, 0.25, 1])
    assert [p["p_holm"] for p in pairs] == pytest.approx([1.0] * 7)
    reach = curve_statistics(found, runs)["test_psnr"]["reach"]  # curves rise by 0.5 dB an image
    assert [reach[policy]["images"] for policy in ("uniform", "directional-i")] == pytest.approx(
        [5.6, 5.2]
    )
    assert reach["d-optimal"]["images"] is None
    assert [reach[policy]["rocks"] for policy in ("d-optimal", "uniform", "random")] == [0, 3, 3]
    text = statistics_markdown(curve_statistics(found, runs))
    assert "| d-optimal | 34.50 | 31.50 | – | – |" in text
    assert "| uniform | 34.80 | 31.80 | 5.6 | 5.6 |" in text
    assert (
        "| d-optimal − uniform | full frame | -0.30 [-0.30, -0.30] | 0 of 3 | 0.25 | 1 | -0.30, 0 of 1 |"
        in text
    )


def test_what_holds_on_scenes_that_chose_no_setting_is_told():
    """Of five rocks, one a scene, policies were developed on the first two."""
    runs = reproduce.curve_runs(TINY, 5)
    ahead = {0: 5.0, 1: 5.0, 2: 0.1, 3: 0.2, 4: -0.6}
    found = {
        run.name: fake(run, 25 + (ahead[run.rock.index] if run.policy == "directional-i" else 0.0))
        for run in runs
    }
    pairs = curve_statistics(found, runs)["test_psnr"]["pairs"]
    pair = next(
        pair for pair in pairs if (pair["policy"], pair["other"]) == ("directional-i", "uniform")
    )
    assert (pair["rocks"], pair["ahead"], pair["difference"]) == (5, 4, pytest.approx(9.7 / 5))
    there = pair["elsewhere"]
    assert (there["rocks"], there["ahead"], there["difference"]) == (3, 2, pytest.approx(-0.1))


def test_of_one_rock_nothing_is_claimed():
    runs = reproduce.curve_runs(TINY, 1)
    found = {run.name: fake(run, 25) for run in runs}
    for pair in curve_statistics(found, runs)["test_psnr"]["pairs"]:
        assert [pair[key] for key in ("difference_low", "difference_high", "p", "p_holm")] == [
            None
        ] * 4
    assert (
        "| d-optimal − uniform | full frame | +0.00 | 0 of 1 | – | – | – |"
        in statistics_markdown(curve_statistics(found, runs))
    )


def test_shares_are_of_what_the_oracle_gains_over_random():
    runs, oracle = reproduce.pool_runs(TINY, 2), reproduce.oracle_runs(TINY, 2)
    value = {"oracle": 27.0, "random": 25.0, "d-optimal": 25.5}
    found = {
        run.name: fake(
            run, value.get(run.policy, 26.0) + run.rock.index + run.draw - (run.policy == "random")
        )
        for run in runs + oracle
    }
    rows = {(row["pool"], row["policy"]): row for row in pool_rows(found, runs, oracle)}
    for pool in reproduce.POOLS:
        shares = {
            policy: rows[pool, policy]["test_psnr_share"]
            for policy in ("oracle", "random", "d-optimal", "farthest")
        }
        assert shares == pytest.approx(
            {"oracle": 1, "random": 0, "d-optimal": 0.25, "farthest": 0.5}
        )
        assert rows[pool, "random"]["rocks"] == 2
    half, pools = "+0.50 [+0.50, +0.50]", len(reproduce.POOLS)
    text = pools_markdown(list(rows.values()))
    assert f"| test views (dB) | {' | '.join(reproduce.POOLS)} |" in text
    assert f"| d-optimal |{' 26.00 |' * pools}\n" in text
    assert (
        text.count(f"| d-optimal |{f' {half} |' * pools}\n") == 3
    )  # full frame, rock, and over the whole curve
    assert f"| directional-i |{' – |' * pools}\n" in text
    assert f"| d-optimal |{' 25% |' * pools}\n" in text
    assert "test_psnr_led" not in rows["ring", "directional-i"]
    without = pool_rows(found, runs, [])
    assert {row["test_psnr_share"] for row in without} == {None}


def test_the_largest_gap_of_a_ring():
    assert largest_gap([0, 27, 23, 19], 32) == pytest.approx(19 * 360 / 32)
    assert largest_gap([5], 8) == 360
    assert largest_gap([6, 0, 2, 4], 8) == 90


def test_numbers_of_seeds_are_compared_at_equal_images(tmp_path):
    runs = reproduce.seed_runs(TINY, 2)
    assert {run.seeds + run.settings()["budget"] for run in runs} == {6}
    found = {run.name: fake(run, 25 + run.seeds / 10) for run in runs}
    rows = seed_rows(found, runs)
    assert [row["test_psnr_over_four"] for row in rows[:6]] == pytest.approx(
        [-0.3, -0.2, -0.1, 0, 0.2, 0.4]
    )
    assert (
        "| d-optimal | 1 | 90.0 | 180 (180) | 25.10 | -0.30 [-0.30, -0.30] | -0.30 [-0.30, -0.30] |"
        in seeds_markdown(rows)
    )
    seeds_figure(tmp_path / "seeds.png", rows)
    assert (tmp_path / "seeds.png").stat().st_size > 10_000


def test_the_pool_of_mixed_distances_has_near_and_far_views(tmp_path):
    run = Run(Rock("boulder", 1), SIZE, "uniform", pool="mixed distances")
    dataset, _, cell = run.cells()
    assert dataset.name == "dataset/boulder-1/hemisphere-1-2-3-8x48x36"
    assert cell.arguments["dataset"] == dataset.name
    assert run_cells(tmp_path, [dataset], silent)[dataset.name] == {"frames": 8}
    loaded = load_dataset(tasks.dataset_of(tmp_path, dataset.name))
    middle = loaded.test_views().frames[0].camera.position
    reach = [np.linalg.norm(frame.camera.position) for frame in loaded.frames]
    assert [round(r / np.linalg.norm(middle)) for r in reach] == [1, 2, 3, 1, 2, 3, 1, 2]


def test_the_pool_of_an_arc_is_half_dense_and_half_sparse(tmp_path):
    ellipsoids(
        tmp_path,
        cell_folder(tmp_path, "ring"),
        "boulder",
        1,
        "circle",
        2,
        {"frames": 12, "width": 48, "height": 36},
    )
    out = cell_folder(tmp_path, "arc")
    out.mkdir(parents=True)
    assert tasks.make_arc(tmp_path, out, "ring", 3) == {"frames": 8}
    ring, arc = load_dataset(tasks.dataset_of(tmp_path, "ring")), load_dataset(out / "dataset")
    assert [frame.name for frame in arc.frames] == [
        ring.frames[i].name for i in (0, 1, 2, 3, 4, 5, 6, 9)
    ]
    assert np.array_equal(arc.frames[7].target()[0], ring.frames[9].target()[0])
    assert len(arc.test_views()) == 2
    assert tasks.make_arc(tmp_path, out, "ring", 3) == {"frames": 8}


def test_pools_and_the_oracle_that_sees_the_truth(quick, tmp_path, monkeypatch):
    monkeypatch.setattr(reproduce, "POLICIES", ("uniform", "random"))
    monkeypatch.setattr(reproduce, "DRAWS", 1)
    monkeypatch.setattr(reproduce, "POOLS", {"five nearest": {"orbit": "circle", "nearest": 5}})
    cells = reproduce.cells_of("oracle", TINY, 1)
    found = run_cells(tmp_path, cells, silent)
    oracle = reproduce.oracle_runs(TINY, 1)[0]
    numbers = found[oracle.name]
    others = [found[run.name] for run in reproduce.pool_runs(TINY, 1)]
    assert all(numbers["test_psnr"][1] >= other["test_psnr"][1] for other in others), (
        "the first choice is the best there is"
    )
    state = read_checkpoint(cell_folder(tmp_path, oracle.name) / "run")
    assert state.steps[1]["score"] == state.steps[1]["test_psnr"], (
        "what it foresaw is what the loop then fits"
    )
    written = write_pools(
        tmp_path,
        tmp_path / "results",
        {name: found[name] for name in found if name != oracle.name},
        TINY,
        1,
        "c",
    )
    rows = {row["policy"]: row for row in rows_of(written[0])}
    assert list(rows) == ["uniform", "random", "oracle"]
    assert all(path.is_file() for path in written)


def test_a_run_that_was_killed_goes_on(quick, tmp_path):
    run = Run(Rock("boulder", 1), SIZE, "d-optimal")
    *before, cell = run.cells()
    run_cells(tmp_path, before, silent)
    folder = cell_folder(tmp_path, cell.name)
    folder.mkdir(parents=True)
    (folder / ".run.1.part").mkdir()
    where = cell_folder(tmp_path, cell.arguments["prior"]) / "prior"
    first = {**run.settings(), "budget": 2, "evaluate_every": 1, "train": COLOURS_ALONE}

    def stop(state):
        if len(state.steps) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_nbv(
            tasks.dataset_of(tmp_path, cell.arguments["dataset"]),
            folder / "run",
            prior=where,
            on_step=stop,
            **first,
        )
    whole = run_cells(tmp_path, [*before, cell], silent)[cell.name]
    assert whole == run_cells(tmp_path / "other", [*before, cell], silent)[cell.name]


def test_figures_of_curves_and_pools(tmp_path):
    runs = reproduce.curve_runs(TINY, 3)
    rng = np.random.default_rng(0)
    found = {run.name: fake(run, 25 + rng.normal()) for run in runs}
    curves_figure(tmp_path / "curves.png", curve_rows(found, runs))
    pools = reproduce.pool_runs(TINY, 3)
    found = {run.name: fake(run, 25 + rng.normal()) for run in pools}
    pools_figure(tmp_path / "pools.png", pool_rows(found, pools, []))
    assert all((tmp_path / f"{name}.png").stat().st_size > 10_000 for name in ("curves", "pools"))


def test_every_run_of_every_result_has_its_own_cell():
    for preset in reproduce.PRESETS.values():
        for name, result in reproduce.RESULTS.items():
            runs = result.runs(preset, result.rocks(preset))
            assert len({run.name for run in runs}) == len(runs), name
            cells = reproduce.cells_of(name, preset, result.rocks(preset))
            names = {cell.name for cell in cells}
            assert all(need in names for cell in cells for need in cell.needs)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--preset", "huge"], "--preset 'huge': unknown; choose one of quick, paper"),
        (
            ["--only", "table2"],
            "--only 'table2': unknown; choose some of table1,figures,curves,seeds,pools,oracle",
        ),
        (["--only", ","], "--only '': unknown"),
        (["--rocks", "0"], "should be greater than or equal to 1"),
        (["--rocks", "21"], "--rocks 21: curves can have 1 to 20"),
        (["--rocks", "11", "--only", "pools"], "--rocks 11: pools can have 1 to 10"),
        (["--workers", "2", "--scheduler", "tcp://x:1"], "give one of them"),
        (["--workers", "0"], "should be greater than or equal to 1"),
        (["--policy", "best"], "--policy best: unknown; choose one of"),
        (["--policy", "uniform"], "--policy uniform: is compared anyway"),
        (
            ["--policy", "angle", "--policy", "angle"],
            "--policy angle: there is one of this name already",
        ),
        (
            ["--policy", "block-d", "--only", "table1"],
            "--policy block-d: is for curves and pools, and --only leaves both out",
        ),
        (["--policy", "none.py:f"], "none.py"),
        (["--mesh", "none.glb"], "none.glb: cannot be read (No such file or directory)"),
        (
            ["--mesh", "none.glb", "--only", "table1"],
            "--mesh none.glb: is for results over many rocks, and --only leaves them out",
        ),
        (["--batch", "0"], "should be greater than or equal to 1"),
        (
            ["--batch", "5", "--only", "curves"],
            "--batch 5: is for table1 and figures, and --only leaves both out",
        ),
    ],
)
def test_bad_options_are_one_clear_line(capsys, tmp_path, arguments, line):
    assert line in refused(capsys, ["reproduce", tmp_path / "out", *arguments], tmp_path)


def test_a_folder_of_another_preset_or_of_something_else_is_refused(capsys, tmp_path):
    occupied(tmp_path / "full")
    assert "not empty" in refused(capsys, ["reproduce", tmp_path / "full"], tmp_path)
    (tmp_path / "paper").mkdir()
    write_json(tmp_path / "paper/study.json", {"preset": "paper"})
    assert "was begun with --preset paper" in refused(
        capsys, ["reproduce", tmp_path / "paper"], tmp_path
    )
