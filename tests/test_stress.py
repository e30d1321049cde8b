"""`mgs stress`: the rule of the verdicts both ways on made-up numbers, the faults, and a small run
of the whole."""

import csv
import json

import numpy as np
import pytest
import synthetic
import tiny
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from mgs.cli.app import main
from mgs.data.dataset import load_dataset, write_transforms
from mgs.metrics import agreement
from mgs.prior.build import build_prior, save_prior
from mgs.prior.settings import PriorSettings
from mgs.study.stress import alarms, endurance, faults, numbers, registry, spread
from mgs.study.stress.convergence import CONVERGENCE
from mgs.study.stress.experiment import Experiment, Panel, rock_cell
from mgs.study.stress.lab import PRESETS, greedy, open_lab
from mgs.study.stress.scales import SCALES
from mgs.study.stress.verdict import Claim, Outcome, interval, judged, outcome, paired, roc_area
from mgs.study.sweep import Cell, cell_folder

EFFECTS = st.lists(st.floats(-100, 100), min_size=2, max_size=9)


def claim(side, bound=1.0):
    return Claim("it is so", lambda rows: [row["x"] for row in rows], "dB", side, bound, "rock")


@pytest.mark.parametrize(
    ("values", "above", "below"),
    [
        ([2.0, 2.1, 1.9], "holds", "fails"),
        ([0.0, 0.1, -0.1], "fails", "holds"),
        ([0.0, 2.0, 1.1], "depends", "depends"),
        ([5.0], "depends", "depends"),
        ([], "depends", "depends"),
        ([1.0, 1.0], "holds", "holds"),  # on the bound itself
    ],
)
def test_a_verdict_follows_from_the_interval_alone(values, above, below):
    rows = [{"x": value} for value in values]
    assert judged(claim("above"), rows)["verdict"] == above
    assert judged(claim("below"), rows)["verdict"] == below
    assert judged(claim("above"), rows)["runs"] == len(values)


def test_the_interval_is_students():
    assert interval([1.0]) is None
    assert interval([0.0, 2.0]) == pytest.approx(
        (1 - 12.706, 1 + 12.706), abs=1e-3
    )  # t(0.975, 1) = 12.706, error 1


@given(EFFECTS, st.floats(-100, 100))
def test_turned_round_a_claim_has_the_same_verdict(values, bound):
    mirrored = interval([-value for value in values])
    assert outcome("above", bound, interval(values)) == outcome("below", -bound, mirrored)


@given(EFFECTS, st.floats(-100, 100))
def test_a_claim_and_its_opposite_never_both_fail(values, bound):
    both = {outcome("above", bound, interval(values)), outcome("below", bound, interval(values))}
    assert both != {Outcome.FAILS}


def test_runs_are_paired_by_their_name():
    rows = [
        {"run": "a", "kind": "x", "v": 3.0}, {"run": "a", "kind": "y", "v": 1.0}, {"run": "b", "kind": "x", "v": 9.0},
        {"run": "c", "kind": "y", "v": 1.0}, {"run": "c", "kind": "x", "v": 1.5},
    ]  # fmt: skip
    assert paired("v", {"kind": "x"}, {"kind": "y"})(rows) == [2.0, 0.5]


def test_the_roc_area_is_the_probability_that_a_failed_run_has_the_larger_value():
    assert roc_area([1, 2, 3, 4], [False, False, True, True]) == 1
    assert roc_area([3, 4, 1, 2], [False, False, True, True]) == 0
    assert roc_area([1, 1], [True, False]) == 0.5
    assert roc_area([1, 2], [True, True]) is None


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), min_size=1, max_size=12))
def test_a_sign_turned_round_has_the_other_area(pairs):
    values, failed = [value for value, _ in pairs], [bad for _, bad in pairs]
    area, other = roc_area(values, failed), roc_area([-value for value in values], failed)
    assert area is None or area + other == pytest.approx(1)


def test_agreement_of_rankings():
    reference = np.array([1.0, 2.0, 4.0])
    assert agreement(reference, reference) == {"tau": 1, "regret": 0}
    assert agreement(np.array([3.0, 2.0, 1.0]), reference) == {"tau": -1, "regret": 0.75}
    assert agreement(np.zeros(3), reference)["tau"] == 0


def fit_rows(kind, values):
    """Rows of the experiment on convergence for two runs with these qualities after 1, 2, 3 ...
    passes."""
    return [
        {
            "run": run,
            "fit": kind,
            "criterion": "d-optimal",
            "passes": p,
            "psnr_mask": v + 0.01 * run,
            "tau": 1.0,
            "regret": 0.0,
        }
        for run in (0, 1)
        for p, v in enumerate(values, 1)
    ]


def test_overfitting_is_what_the_longest_fit_lost():
    no_prior, with_prior = CONVERGENCE.claims[2:]
    assert judged(no_prior, fit_rows("no prior", [20, 25, 23]))["verdict"] == "holds"
    assert judged(no_prior, fit_rows("no prior", [20, 23, 25]))["verdict"] == "fails"
    assert judged(with_prior, fit_rows("with the prior", [20, 23, 25]))["verdict"] == "holds"
    assert judged(with_prior, fit_rows("with the prior", [20, 25, 23]))["verdict"] == "fails"


def test_one_lambda_is_judged_by_its_worst_value():
    def rows(worst):
        exponents = range(-10, 3)
        return [
            {
                "run": run,
                "what": "one lambda",
                "setting": 10.0**e,
                "regret": worst if e == 2 else 0.0,
                "tau": 1.0,
            }
            for run in "ab"
            for e in exponents
        ]

    assert judged(SCALES.claims[0], rows(0.5))["verdict"] == "fails"
    assert judged(SCALES.claims[0], rows(0.01))["verdict"] == "holds"


def test_memory_that_grows_is_told_from_memory_that_levels_off():
    (bounded,) = endurance.ENDURANCE.claims
    level = [{"step": i, "megabytes": 500 + 100 * min(i, 40)} for i in range(100)]
    leak = [{"step": i, "megabytes": 500.0 + i} for i in range(100)]
    assert judged(bounded, level)["verdict"] == "holds"
    assert judged(bounded, leak)["verdict"] == "fails"
    assert judged(bounded, leak)["effect"] == pytest.approx(1, abs=0.05)


def alarm_rows(sign_of_failed):
    """Runs of three scenes: one clean, one failed by exposure, one harmless; the sign of the failed
    one is given."""
    rows = []
    for scene in "abc":
        clean = {"scene": scene, "run": scene, "size": 6, "fault": "none", "failed": False}
        rows.append(clean | {"sign exposure": 0.01, "sign coverage": 0.05})
        rows.append(
            {
                "scene": scene,
                "fault": "exposure",
                "failed": True,
                "sign exposure": sign_of_failed,
                "sign coverage": 0.05,
            }
        )
        rows.append(
            {
                "scene": scene,
                "fault": "exposure",
                "failed": False,
                "sign exposure": 0.02,
                "sign coverage": 0.05,
            }
        )
    return rows


def test_detectors_are_judged_both_ways():
    assert alarms.areas(alarm_rows(0.8), "exposure") == [1.0] * 3
    assert alarms.areas(alarm_rows(0.0), "exposure") == [0.0] * 3
    assert alarms.any_area(alarm_rows(0.8)) == [1.0] * 3
    assert alarms.any_area(alarm_rows(0.0))[0] < 0.5
    assert alarms.caught(alarm_rows(0.8)) == [1.0] * 3
    assert alarms.caught(alarm_rows(0.0)) == [0.0] * 3
    assert alarms.false_alarms(alarm_rows(0.8)) == [0.0] * 3
    noisy = [row | {"sign exposure": 0.9} for row in alarm_rows(0.8)]
    assert alarms.false_alarms(noisy) == [1.0] * 3
    assert alarms.false_alarms(noisy + noisy) == [1.0] * 3, (
        "a clean run of two experiments counts once"
    )
    curve = {(row["false alarms"], row["caught"]) for row in alarms.roc_curves(alarm_rows(0.8))}
    assert {(0.0, 1.0), (1.0, 1.0)} <= curve


def test_the_spread_of_models_is_that_of_their_pixels():
    images = np.zeros((4, 100, 3))
    assert spread.spread_of(images) == 0
    images[::2] = 0.2
    assert spread.spread_of(images) == pytest.approx(0.1)
    assert spread.spread_of(images + np.linspace(0, 1, 100)[None, :, None]) == pytest.approx(0.1), (
        "pixels may differ"
    )


def test_every_claim_names_what_its_panels_and_bounds_need():
    for name, experiment in registry.EXPERIMENTS.items():
        assert experiment.claims, name
        assert experiment.panels
        for one in experiment.claims:
            assert one.hypothesis.endswith(".")
            assert np.isfinite(one.bound)
            assert judged(one, [])["verdict"] == "depends"


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A study's folder with two small rocks, as the cells of datasets leave them."""
    folder = tmp_path_factory.mktemp("study")
    for name in ("ellipsoid-0", "ellipsoid-1"):
        out = cell_folder(folder, f"dataset/{name}")
        dataset = synthetic.write_dataset(out / "dataset", synthetic.orbit_cameras(10, 48, 36))
        tests = synthetic.write_dataset(
            out / "dataset/test", synthetic.orbit_cameras(3, 48, 36, altitude=2.0)
        )
        write_transforms(out / "dataset/test", tests.frames)
        save_prior(out / "prior", build_prior(dataset, PriorSettings(gaussians=300))[0])
    return folder


@pytest.fixture
def frame(root):
    return faults.captured(
        load_dataset(cell_folder(root, "dataset/ellipsoid-0") / "dataset").frames[0]
    )


@pytest.mark.parametrize("name", faults.IMAGE_FAULTS)
def test_a_fault_of_images_is_a_pure_function_that_grows_with_its_size(frame, name):
    function, sizes = faults.IMAGE_FAULTS[name]
    before = [a.copy() for a in (frame.pixels, frame.rgba, frame.z, frame.rock)]
    changes = []
    for size in sizes:
        spoiled, again = (function(frame, size, np.random.default_rng(3)) for _ in range(2))
        for field in ("pixels", "rgba", "z", "rock"):
            assert np.array_equal(getattr(spoiled, field), getattr(again, field))
            assert getattr(spoiled, field).shape == getattr(frame, field).shape
            assert np.isfinite(getattr(spoiled, field)).all()
        moved = np.abs(spoiled.camera.world_to_camera - frame.camera.world_to_camera).sum()
        changed = [
            np.abs(a.astype(float) - b).sum()
            for a, b in ((spoiled.rgba, frame.rgba), (spoiled.z, frame.z))
        ]
        changes.append(moved + sum(changed))
    assert 0 < changes[0] < changes[1] < changes[2]
    assert all(
        np.array_equal(a, b)
        for a, b in zip(before, (frame.pixels, frame.rgba, frame.z, frame.rock), strict=True)
    )


@pytest.mark.parametrize("name", faults.PRIOR_FAULTS)
def test_a_fault_of_the_prior_leaves_the_prior_as_it_was(root, name):
    function, sizes = faults.PRIOR_FAULTS[name]
    prior = open_lab(root, "ellipsoid-0").prior
    before, moved = prior.points.copy(), []
    for size in sizes:
        spoiled = function(prior, size, np.random.default_rng(1))
        assert len(spoiled.points) == len(spoiled.normals)
        assert spoiled.backed <= len(spoiled.points)
        lost = len(prior.points) - len(spoiled.points)
        moved.append(lost or float(np.linalg.norm(spoiled.points - prior.points, axis=1).mean()))
    assert 0 < moved[0] < moved[1] < moved[2]
    assert np.array_equal(prior.points, before)


def test_signs_of_a_good_fit_and_of_a_shifted_prior(root):
    lab = open_lab(root, "ellipsoid-0")
    _, good = faults.signs_of(lab, lab.even(5))
    shifted = faults.shifted(lab.prior, 0.4, np.random.default_rng(0))
    _, bad = faults.signs_of(lab.changed(prior=shifted), lab.even(5))
    assert bad["prior"] > 2 * good["prior"]


def test_even_views_turn(root):
    lab = open_lab(root, "ellipsoid-0")
    assert lab.even(5) == [0, 2, 4, 6, 8]
    assert sorted(lab.even(5, 0.5)) == [1, 3, 5, 7, 9]


def test_greedy_takes_only_what_is_allowed(root):
    lab = open_lab(root, "ellipsoid-0")
    for policy in ("d-optimal", "uniform"):
        views = greedy(lab, [0], [0, 1, 2, 3], 2, policy)
        assert len(set(views)) == 3
        assert set(views) <= {0, 1, 2, 3}


def test_an_extreme_case_that_is_not_finite_would_be_found(root, monkeypatch):
    lab = open_lab(root, "ellipsoid-0")
    model = lab.start(lab.even(4))
    assert numbers._tried((model, lab.cameras[0], None))["finite"] == 1
    monkeypatch.setattr(numbers, "fisher", lambda *_: np.array([np.nan]))
    assert numbers._tried((model, lab.cameras[0], None))["finite"] == 0
    spoiled = tiny.Gaussians(
        model.means * np.nan, model.log_scales, model.quats, model.logit_opacities, model.sh
    )
    assert "NaN" in numbers._tried((spoiled, lab.cameras[0], None))["refused"]


CALLS = []


def toy(root, out, scene, lift):
    """A task of one row per run."""
    CALLS.append(scene)
    return {
        "rows": [
            {"run": f"{scene}, {k}", "kind": kind, "x": lift + k / 10}
            for k in (0, 1)
            for kind in ("a", "b")
        ]
    }


def test_a_run_writes_its_files_goes_on_and_keeps_earlier_experiments(tmp_path, monkeypatch):
    def experiment(name, lift):
        def cells(preset):
            return [
                Cell(f"{name}/{scene}", "test_stress:toy", {"scene": scene, "lift": lift})
                for scene in "ab"
            ]

        return Experiment("Is it so?", cells, (claim("above"),), (Panel("kind", "x", "kind", "x"),))

    monkeypatch.setattr(
        registry, "EXPERIMENTS", {"one": experiment("one", 2.0), "two": experiment("two", 0.0)}
    )
    CALLS.clear()
    told = []

    def run(names):
        return registry.run_stress(
            tmp_path, PRESETS["quick"], names, "mgs stress", lambda *a: told.append(a)
        )

    assert [e["name"] for e in run(["one"])["experiments"]] == ["one"]
    verdicts = run(["two"])
    assert [(e["name"], e["claims"][0]["verdict"]) for e in verdicts["experiments"]] == [
        ("one", "holds"),
        ("two", "fails"),
    ]
    assert json.loads((tmp_path / "verdicts.json").read_text()) == verdicts
    assert len(list(csv.DictReader((tmp_path / "stability.csv").read_text().splitlines()))) == 16
    assert "| one | it is so | **holds** | 2.05 (" in (tmp_path / "stability.md").read_text()
    assert (tmp_path / "one.png").is_file()
    run(["one", "two"])
    assert CALLS == ["a", "b", "a", "b"]
    assert len(told) == 4


def test_cells_of_all_experiments_have_tasks_that_are_there_and_needs_that_are_made():
    from importlib import import_module

    for preset in PRESETS.values():
        datasets = {cell.name: cell for cell in registry.datasets(preset)}
        for experiment in registry.EXPERIMENTS.values():
            for cell in [*experiment.cells(preset), *experiment.data(preset)]:
                module, _, function = cell.task.partition(":")
                assert callable(getattr(import_module(module), function))
                assert set(cell.needs) <= set(datasets)
                json.dumps(cell.arguments)
    assert rock_cell("n", "m:f", PRESETS["quick"], "boulder", 0, x=1).arguments == {
        "scene": "boulder-0",
        "x": 1,
    }


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--only", "nothing"], "--only 'nothing': unknown"),
        (["--preset", "huge"], "--preset 'huge': unknown; choose one of"),
    ],
)
def test_what_is_unknown_is_one_line(options, words, tmp_path, capsys):
    assert words in refused(capsys, ["stress", str(tmp_path / "out"), *options])
    assert not (tmp_path / "out").exists()


def test_the_command_prints_its_verdicts(tmp_path, monkeypatch, capsys):
    toy_experiment = Experiment(
        "Is it so?", lambda preset: [Cell("one/a", "test_stress:toy", {"scene": "a", "lift": 2.0})], (claim("above"),),
        (Panel("kind", "x", "kind", "x"),),
    )  # fmt: skip
    monkeypatch.setattr(registry, "EXPERIMENTS", {"one": toy_experiment})
    with pytest.raises(SystemExit) as ended:
        main(["stress", str(tmp_path / "out")])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    assert "holds" in said
    assert "4 runs" in said
