"""Table I, set-ups, flights and certificates on ellipsoids of 200 Gaussians; and bad input."""

import json
import os
import re
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import synthetic
from program import study
from refusals import fails, occupied, refused

from mgs.files import read_json, write_json
from mgs.fit.settings import ALPHA_WEIGHT
from mgs.run.folder import read_checkpoint
from mgs.survey import flight
from mgs.survey.flight import SurveySettings, fly
from studies import certificate, curves, fits, flights, link, pools, setups, table1
from studies.frame import case
from studies.frame.case import Case, Rock, Size
from studies.frame.output import read_rows
from studies.frame.sweep import cell_folder, run_cells
from studies.setups import SETUPS, SetupSize

OWN = f"{Path(__file__).parent.parent / 'studies/policies.py'}:angle"
IMAGES = Size(48, 36, 8, 3, spp=1)
FEW = SetupSize(
    48, 36, 3, 1, 6, fewer=4, gaussians=200, passes=2, draws=2,
    setups={name: SETUPS[name] for name in ("ring", "one seed")},
    policies=("directional-d", "random"), count=2,
)  # fmt: skip
QUICK = {"sizes": {"quick": FEW}}
TABLE = table1.TableSize(
    IMAGES, 200, 2, policies=("d-optimal", "random"), slow={}, draws=2, fewer=1, passes_3dgs=3
)

pytestmark = pytest.mark.usefixtures("ellipsoids", "coarse_priors")


def done(capsys, *arguments, **changes):
    study(*arguments, **(changes or QUICK))
    return capsys.readouterr().out


def test_setups_are_made_once_and_compare_a_policy_of_ones_own(
    tmp_path, figures, capsys, monkeypatch
):
    out = tmp_path / "out"
    assert setups.sized(FEW, setups.STUDY.parser().parse_args(["OUT"])).images == FEW.images
    some = ("setups", out, "--rocks", 1, "--images", 5)
    with monkeypatch.context() as patched:
        patched.setattr("mgs.learn", None)  # these policies need no model to choose
        assert "dataset/boulder-11" in done(capsys, *some)
    before = {path.name: path.read_bytes() for path in out.glob("setups*")}
    assert set(before) == {f"setups{end}" for end in (".csv", ".json", ".md", ".png", "-leads.csv")}
    rows = read_rows(out / "setups.csv")
    assert {row["command"] for row in rows} == {"python -m studies.setups OUT --rocks 1 --images 5"}
    assert len(rows) == 2 * 2
    orbits = {path.name for path in out.glob("cells/dataset/boulder-11/*")}
    assert orbits == {"circle-1", "hemisphere-1", "spiral-1.25-2"}
    assert [row["test_gain"] for row in rows if row["policy"] == "random"] == [0] * 2
    cells = [json.loads(path.read_text()) for path in out.glob("cells/setup/**/result.json")]
    assert len(cells) >= 4
    assert {len(set(cell["found"]["taken"])) for cell in cells} == {5}
    assert "setup/" not in done(capsys, *some), "a cell was done twice"
    assert {path.name: path.read_bytes() for path in out.glob("setups*")} == before

    mine = tmp_path / "mine.py"
    mine.write_text("def first(candidates):\n    return -1.0 * (candidates[:, 0] > -9)\n")
    one = (*some, "--policy", f"{mine}:first")
    told = done(capsys, *one)
    assert "/mine.py:first" in told
    assert "/directional-d" not in told, "the other policies are not run again"
    policies = {row["policy"] for row in read_rows(out / "setups.csv")}
    assert policies == {"directional-d", "random", "mine.py:first"}
    mine.write_text("def first(candidates):\n    return candidates[:, 0]\n")
    assert "/mine.py:first" in done(capsys, *one), "another file is another policy"


def test_no_set_of_a_study_is_above_its_bound(tmp_path, figures, capsys):
    size = certificate.CertificateSize(
        **vars(FEW), counts=(2,), shares=(0.8,), sets=3, batches=1, batch=2, views=2, fitted=100,
        training=certificate.TRAINING[:1],
    )  # fmt: skip
    out = tmp_path / "out"
    done(capsys, "certificate", out, "--rocks", 1, sizes={"quick": size})
    rows = read_rows(out / "certificate.csv")
    assert [row["policy"] for row in rows] == [*certificate.POLICIES]
    for row in rows:
        kinds = ("plan", "greedy", "farthest", "random", "random_best", "best")
        shares = {key: row[key] for key in kinds}
        assert max(shares.values()) <= 1 + 1e-9
        assert shares["best"] >= shares["plan"] >= shares["random"] > 0
    curve = read_rows(out / "certificate-curve.csv")
    at = {(row["rock"], row["views"], row["kind"]): row["percent"] for row in curve}
    assert all(0 < value <= at[(*key[:2], "bound")] <= 100.1 for key, value in at.items())
    assert (out / "certificate.png").is_file()


def test_flights_keep_their_length_and_are_compared_with_even_spacing(tmp_path, capsys):
    out = tmp_path / "out"
    done(capsys, "flights", out, "--rocks", 1, sizes={"quick": replace(FEW, passes=1)})
    rows = read_rows(out / "flights.csv")
    even = [row for row in rows if row["policy"] == flights.EVEN]
    kinds = len(flights.FLIERS) * len(flights.LENGTHS)
    assert len(rows) - len(even) == kinds * len(flights.POOLS)
    assert len(even) == 6 * len(flights.POOLS), "9 candidates"
    cell = next((out / "cells/flights").glob("*/dome-*/result.json"))
    found = json.loads(cell.read_text())["found"]
    for row in found["flights"]:
        assert row["metres"] <= (row["length"] or 1) * found["whole"] * 1.000001
        assert len(set(row["taken"])) == row["images"]
    assert "| dome | 20% | planned tour |" in (out / "flights.md").read_text()


def test_models_of_chosen_views_are_sent_over_a_link(tmp_path, capsys, monkeypatch, short_fits):
    for name, value in (("HALVINGS", 2), ("THINNINGS", 1), ("ROUNDS", 1), ("HOLDS", 2)):
        monkeypatch.setattr(f"mgs.reports.compacting.{name}", value)
    size = link.LinkSize(**vars(FEW) | {"views": (5,), "sent": (500, 4000), "gaussians": 100})
    done(capsys, "link", tmp_path, "--rocks", 1, sizes={"quick": size})
    rows = read_rows(tmp_path / "link.csv")
    assert [(row["views"], row["by"], row["seconds"]) for row in rows] == [
        (5, by, seconds) for by in ("chosen", "evenly spaced") for seconds in (1, 8)
    ]
    less, more = (row["psnr"] for row in rows[:2])
    assert less < more
    assert [row["gain"] for row in rows[2:]] == [0, 0]
    assert "| 5 evenly spaced | +0.00 | +0.00 |" in (tmp_path / "link.md").read_text()


def test_a_fit_with_changed_settings_is_compared_with_the_default(tmp_path, capsys):
    variants = ("default", "means=free", "--sh 1", "poses wrong", "poses wrong, refined")
    chosen = {name: fits.VARIANTS[name] for name in variants}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(fits, "VARIANTS", chosen)
        patched.setattr(fits, "POOLS", {"hemisphere": (4,)})
        size = fits.FitsSize(**vars(replace(FEW, tests=4)))
        done(capsys, "fits", tmp_path, "--rocks", 1, sizes={"quick": size})
    rows = {row["variant"]: row for row in read_rows(tmp_path / "fits.csv")}
    assert tuple(rows) == variants
    assert rows["default"]["test_change"] == 0
    assert all(rows[name]["test_change"] != 0 for name in variants[1:])
    assert rows["poses wrong"]["test"] < rows["default"]["test"]


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


def test_each_draw_has_its_own_pool_and_seeds(tmp_path, capsys, monkeypatch):
    drawn = replace(SETUPS["hemisphere"], frames=4 * 16, seeds=2, drawn=True)
    monkeypatch.setattr(pools, "DRAWN", {"drawn": drawn})
    monkeypatch.setattr(pools, "POLICIES", ("uniform", "random"))
    out = tmp_path / "out"
    done(capsys, "pools", out, "--rocks", 1)
    assert len(read_rows(out / "pools.csv")) == 2, "draws are averaged"
    cells = [json.loads(path.read_text()) for path in out.glob("cells/setup/**/result.json")]
    by_draw = {(cell["arguments"]["settings"]["seed"]): cell["found"] for cell in cells}
    assert len(cells) == 4
    assert {tuple(cell["found"]["taken"][:2]) for cell in cells} == {(0, 1)}
    assert by_draw[0]["path"] != by_draw[1000]["path"]
    folders = cells[0]["arguments"]["dataset"], cells[0]["arguments"]["prior"]
    places = [out / folder for folder in folders]
    names = [
        [frame.name for frame in setups.shared_scene(*places, None, draw)[0].frames]
        for draw in (0, 1000, 0)
    ]
    assert [len(set(of)) for of in names] == [8] * 3
    assert names[0] == names[2]
    assert set(names[0]) != set(names[1])


def test_each_number_of_images_is_a_run_of_its_own(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(curves, "COUNTS", (5, 6))
    monkeypatch.setattr(curves, "SOME", {"one seed": SETUPS["one seed"]})
    monkeypatch.setattr(curves, "POLICIES", ("directional-i", "random"))
    done(capsys, "curves", tmp_path, "--rocks", 1)
    rows = {(row["images"], row["policy"]): row for row in read_rows(tmp_path / "curves.csv")}
    assert list(rows) == [(n, policy) for n in (5, 6) for policy in curves.POLICIES]
    leads = [f"{rows[n, 'directional-i']['test_gain']:+.2f}" for n in (5, 6)]
    line = f"| one seed | random | {' | '.join(leads)} |"
    assert line in (tmp_path / "curves.md").read_text()
    assert (tmp_path / "curves.png").is_file()


@pytest.mark.slow
def test_a_survey_without_errors_changes_nothing(tmp_path, capsys, monkeypatch):
    exact, surveyed = SurveySettings(sensor=0, exact_poses=True), []

    def without_errors(dataset, settings):
        surveyed.append(dataset.root)
        return fly(dataset, exact)

    monkeypatch.setattr(flight, "fly", without_errors)
    out = tmp_path / "out"
    done(capsys, "setups", out, "--rocks", 1)
    done(capsys, "survey", out, "--rocks", 1)
    assert len(surveyed) == 1
    rows, without = (read_rows(out / f"{name}.csv") for name in ("survey", "setups"))
    ring = {row["policy"]: row["test"] for row in without if row["setup"] == "ring"}
    assert {row["policy"]: row["test"] for row in rows} == pytest.approx(ring)


@pytest.mark.slow
def test_rocks_of_ones_own_take_the_place_of_the_others(tmp_path, capsys, monkeypatch):
    rendered = []

    def seen(root, out, scene, seed, size, changes, mesh):
        rendered.append((scene, Path(mesh).name))
        return synthetic.make_dataset(root, out, scene, seed, size)

    monkeypatch.setattr(case, "make_dataset", seen)
    out, meshes = tmp_path / "out", [tmp_path / "one.ply", tmp_path / "two.glb"]
    for mesh in meshes:
        mesh.write_text(mesh.name)
    options = [part for mesh in meshes for part in ("--mesh", mesh)]
    few = {"sizes": {"quick": replace(FEW, policies=("uniform", "random"))}}
    assert "dataset/one-" in done(capsys, "setups", out, *options, **few)
    assert set(rendered) == {("boulder", "one.ply"), ("boulder", "two.glb")}
    assert {row["scene"] for row in read_rows(out / "setups.csv")} == {"one", "two"}
    twice = ["--mesh", meshes[0], "--mesh", tmp_path / "out/../one.ply"]
    many = [part for _ in range(21) for part in ("--mesh", meshes[0])]
    for bad, named in ((["--rocks", 3, *options], "--rocks"), (many, "--mesh"), (twice, "one.ply")):
        assert named in refused(capsys, [out, *bad], out, "setups")
    meshes[0].write_text("another rock")
    again = done(capsys, "setups", out, *options, **few)
    assert "dataset/one-" in again, "another file is another rock"
    assert "/two-" not in again


def test_three_rocks_of_a_scene_take_the_place_of_the_others(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text('description = "mine"')
    chosen = Namespace(mesh=[], scene=["henge", str(mine)], rocks=None, training=False)
    rocks = case.rocks_of(chosen, 8)
    assert [(rock.scene, rock.seed, rock.index, rock.mesh) for rock in rocks] == [
        (scene, seed, 3 * k + i, None)
        for k, scene in enumerate(("henge", "mine"))
        for i, seed in enumerate((11, 12, 13))
    ]
    assert len({rock.name for rock in rocks}) == 6
    made = Case(rocks[3], Size(8, 6, 2, 0)).cells()[0].arguments
    assert (made["scene"], made["seed"], made["mesh"]) == (str(mine), 11, None)
    chosen.scene = ["henge", "henge"]
    fails("leave it out", case.rocks_of, chosen, 8)
    chosen.scene = ["no-such"]
    fails("choose one of", case.rocks_of, chosen, 8)


@pytest.mark.slow
def test_an_oracle_that_sees_the_truth_is_best_in_its_first_choice(tmp_path, capsys):
    size = replace(FEW, images=5, passes=10, setups={"ring": SETUPS["ring"]})
    size = replace(size, policies=("uniform", "random"))
    done(capsys, "oracle", tmp_path, "--rocks", 1, sizes={"quick": size})
    paths = tmp_path.glob("cells/setup/**/result.json")
    found = {path.parent.name: read_json(path)["found"]["test"] for path in paths}
    oracle = found.pop("oracle-0")
    assert len(found) == 1 + size.draws
    assert oracle >= max(found.values()) - 0.1, "its fit is warm, the judge's is not"


def test_a_case_is_the_scene_with_some_keys_changed(tmp_path, monkeypatch):
    monkeypatch.undo()  # nothing is rendered here
    made = []
    render = lambda out, scene, *_, **__: made.append(scene)  # noqa: E731
    monkeypatch.setattr("mgs.synth.rendering.synth_orbit", render)
    monkeypatch.setattr("mgs.load_dataset", lambda folder: ())
    changes = {"rock": {"specular": 0.0}, "orbit": {"kind": "hemisphere", "distances": [1, 2]}}
    for changed in ({}, changes):
        (cell, prior) = Case(Rock("strata", 3), IMAGES, {"density": 0.125}, changes=changed).cells()
        assert cell.name == "dataset/strata-3/8x48x36"
        assert prior.name == "prior/strata-3/8x48x36-0.125"
        case.make_dataset(tmp_path, tmp_path, **json.loads(json.dumps(cell.arguments)))
    usual, changed = made
    assert (changed.rock.specular, changed.orbit.distances) == (0, (1, 2))
    back = {"rock": usual.rock, "orbit": usual.orbit}
    assert changed.model_copy(update=back) == usual


def test_a_prior_is_built_once_and_whole(tmp_path, monkeypatch):
    dataset, out = tmp_path / "dataset", tmp_path / "cell"
    synthetic.orbit(dataset, 8)

    def struck(folder, prior):
        (folder / "mesh.ply").write_text("half of a mesh")
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("mgs.save_prior", struck)
        with pytest.raises(KeyboardInterrupt):
            case.make_prior(tmp_path, out, "dataset", gaussians=200)
    assert not (out / "prior").exists()
    found = case.make_prior(tmp_path, out, "dataset", gaussians=200)
    monkeypatch.setattr("mgs.build_prior", None)
    assert case.make_prior(tmp_path, out, "dataset", gaussians=200) == found
    assert found["gaussians"] == 200


def test_the_command_of_a_row_of_table_1_sets_what_its_run_does():
    for run in table1.table_runs(table1.SIZES["paper"]).values():
        given = re.findall(r"--set (\S+?)=", run.command())
        assert given == ([] if run.policy in table1.ALL_3DGS else [*run.settings()])


def test_a_run_and_3dgs_are_timed_alone_and_measured_on_all_views(tmp_path, monkeypatch):
    monkeypatch.setattr(table1, "in_new_process", lambda task, out, *how: task(*how))
    rock, row = Rock("boulder", 1), "3DGS, random points, twice the steps"
    runs = (
        table1.TableRun(rock, TABLE, "farthest", budget=4),
        table1.TableRun(rock, TABLE, row, seeds=8, budget=0),
    )
    cells = [cell for one in runs for cell in one.cells()]
    results = run_cells(tmp_path, cells, lambda *what: None)
    for cell in (one.cells()[-1] for one in runs):
        found = results[cell.name]
        assert cell.alone
        assert found["images"] == found["all"]["count"] == 8
        assert found["held_out"]["psnr"] is None
        assert found["test"]["count"] == 3
    run, free = (results[one.name] for one in runs)
    folder = cell_folder(tmp_path, runs[0].name) / "run"
    settings = json.loads((folder / "config.json").read_text())["settings"]
    assert settings["train"]["alpha_weight"] == ALPHA_WEIGHT, "as a run by default"
    steps = read_checkpoint(folder).steps
    assert run["seconds"] == pytest.approx(sum(sum(step["seconds"].values()) for step in steps))
    choices = [step["seconds"]["score"] for step in steps[1:]]
    assert run["choice_seconds"] == pytest.approx(sum(choices) / 4)
    assert free["gaussians"] > 0
    assert free["choice_seconds"] is None
    assert free["all"]["psnr"] > 15


LINGERING = """
import time
from pathlib import Path

def linger():
    print("begun", flush=True)
    time.sleep(100)

if __name__ == "__main__":
    from studies.table1 import in_new_process

    in_new_process(linger, Path("cell"))
"""
"""A study with a task that takes long."""


def test_a_study_that_is_killed_leaves_no_process_behind(tmp_path):
    (tmp_path / "study.py").write_text(LINGERING)
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    options = {"env": env, "stdout": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, tmp_path / "study.py"], **options)
    assert process.stdout.readline() == "begun\n"
    process.kill()
    process.communicate(timeout=60)  # returns when the last process that has the pipe has ended


def test_table_1_has_equal_counts_and_the_papers_rows(tmp_path, capsys, monkeypatch):
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

    for name in ("time_policy", "time_3dgs"):
        monkeypatch.setattr(table1, name, timed)
    monkeypatch.setattr(table1, "FIGURE_POLICIES", ())
    out, table, sizes = tmp_path / "out", tmp_path / "out/table1.md", {"quick": TABLE}

    def rows():
        return {row["row"]: row for row in read_rows(out / "table1.csv")}

    study("table1", out, exit_code=130, sizes=sizes)
    assert "run the same command again to continue" in capsys.readouterr().err
    assert list(rows()) == ["d-optimal", "random, draw 1"]
    assert "| random, mean of 1 | 6 |" in table.read_text()
    left = "random, draw 2; coverage, fewer images; all views; 3DGS; 3DGS, random points"
    assert f"Not done yet: {left}.\n" in table.read_text()
    done(capsys, "table1", out, sizes=sizes)
    images = {"d-optimal": 6, "random, draw 1": 6, "random, draw 2": 6, "coverage, fewer images": 5}
    images |= dict.fromkeys(("all views", "3DGS", "3DGS, random points"), 8)
    assert {name: row["images"] for name, row in rows().items()} == images
    text = table.read_text()
    theirs = "| the paper's D-Optimal NBV, on its rock | 54 | – | – | 25.97 | 0.9654 |"
    ours = "22.00 | {0} | 0.9000 | 0.50 |"
    assert theirs in text
    assert "| d-optimal | 6 | 20.20 | " + ours.format("20.20") in text
    assert "| random, mean of 2 | 6 | 20.70 | " + ours.format("20.70") in text
    assert "Not done yet" not in text
    line = rows()["random, draw 2"]["command"]
    assert line.startswith("mgs nbv cells/dataset/boulder-0/circle-1/8x48x36/dataset --prior ")
    assert line.endswith("--set policy=random --set seeds=4 --set budget=2 --set seed=1000")
    done(capsys, "table1", out, "--batch", 2, sizes=sizes)
    assert "--set policy=d-optimal --set batch=2" in rows()["d-optimal"]["command"]
    batches = [settings.get("batch") for settings in asked]
    assert batches == [None] * 8 + [2] * 5  # 3DGS is no run


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
    value = {"directional-i": 26.0, "cover": 25.8, "random": 25.0, "oracle": 26.25}
    rows = made_up(value, ("a", "b", "c", "c"))
    rows[8]["test"] += 0.3  # directional-i on one of two rocks of the third scene
    found = setups.leads_of(rows, "directional-i", "test")
    assert [lead["setup"] for lead in found] == ["ring", "ring", "mean", "mean"]
    leads = {lead["policy"]: lead for lead in found[:2]}
    assert set(leads) == {"cover", "random"}
    assert [leads[p]["scenes"] for p in leads] == [3, 3]
    assert leads["cover"]["lead"] == pytest.approx((0.2 + 0.2 + 0.35) / 3)
    assert [leads[p]["p"] for p in leads] == [0.25, 0.25]
    assert [leads[p]["p_holm"] for p in leads] == [1.0, 1.0]
    text = setups.tables(rows)
    assert "| directional-i | +1.00 |" in text
    assert "| cover | +0.25 | +0.25 [" in text
    assert "| cover | 64% |" in text
    one = setups.leads_of(made_up(value, ("a",)), "directional-i", "test")
    assert {lead["p_holm"] for lead in one} == {lead["lead_low"] for lead in one} == {None}


BAD = {
    "--rocks": "--rocks 13; --rocks x", "--scheduler": "--workers 2 --scheduler tcp://x:1",
    "--policy uniform": "--policy uniform", "angle": f"--policy {OWN} --policy {OWN}",
    "none.glb": "--mesh none.glb", "--scale": "--scale huge", "--images": "--images 4",
}  # fmt: skip
"""Word of the line -> options."""


@pytest.mark.parametrize("named", BAD)
def test_bad_options_are_one_line(capsys, tmp_path, named):
    for options in BAD[named].split(";"):
        given = [tmp_path / "out", *options.split()]
        assert named in refused(capsys, given, tmp_path, "setups")


def test_a_folder_of_another_scale_or_of_something_else_is_refused(capsys, tmp_path):
    assert "full" in refused(capsys, [occupied(tmp_path / "full")], tmp_path, "setups")
    (tmp_path / "paper").mkdir()
    write_json(tmp_path / "paper/study.json", {"scale": "paper"})
    assert "--scale paper" in refused(capsys, [tmp_path / "paper"], tmp_path, "setups")


def test_every_row_of_table_1_names_a_policy_that_there_is():
    from mgs.run.policy_file import policy_of

    for size in table1.SIZES.values():
        for label, run in table1.table_runs(size).items():
            assert run.policy in table1.ALL_3DGS or policy_of(run.policy).name, label
