"""`mgs chart`: fronts, commands of rows, quantisers, cheaper scores, presets; and a whole chart of
a tiny rock."""

import csv
import json
import shlex
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import typer
from hypothesis import given
from hypothesis import strategies as st

from mgs.cli.app import app, main
from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.fit.settings import ALPHA_WEIGHT, COLOURS_ALONE, TrainSettings
from mgs.prior.settings import PriorSettings
from mgs.run.nbv import start_run
from mgs.run.settings import PRESETS, NbvSettings, with_defaults
from mgs.study import oracle, tasks
from mgs.study.chart import core, fit, plan, presets, scoring, sending, study, subject, timing
from mgs.study.chart.pareto import pareto_front
from mgs.study.chart.tables import chart_table

NUMBERS = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=12)


@given(NUMBERS)
def test_a_point_is_on_the_front_unless_another_beats_it(points):
    costs, gains = zip(*points, strict=True)
    on = pareto_front(costs, gains)
    assert on.any()
    for i, (cost, gain) in enumerate(points):
        beaten = any(c <= cost and g >= gain and (c, g) != (cost, gain) for c, g in points)
        assert on[i] != beaten
    best = [max(g for c, g in points if c <= cost) for cost in costs]
    assert all(b == gain for b, gain, lies in zip(best, gains, on, strict=True) if lies)


def test_a_point_that_was_not_measured_is_on_no_front():
    assert pareto_front([1, np.nan, 2], [1, 5, 2]).tolist() == [True, False, True]


def test_times_are_ratios_to_a_reference_that_is_timed_beside_each_call(monkeypatch):
    """A machine that becomes four times as slow: the ratio stays."""
    slowness = iter([1, 1, 4, 4])
    cost = {"reference": 0.5, "work": 2.0}
    monkeypatch.setattr(
        timing, "_clock", lambda call: ((name := call()), cost[name] * (s := next(slowness)), 2 * s)
    )
    result, times = timing.timed(lambda: "work", 2, lambda: "reference")
    assert result == "work"
    assert times["ratio"] == times["ratio_low"] == times["ratio_high"] == 4
    assert times["wall"] == 5
    assert times["reference"] == 1.25
    assert timing.with_seconds([times, {"bytes": 1}], 0.5)[0]["seconds"] == 2
    assert timing.with_seconds([times, {"bytes": 1}], 0.5)[1] == {"bytes": 1}


def test_what_takes_little_time_is_timed_more_often(monkeypatch):
    seconds = {"reference": 0.1, "short": 0.25, "shorter": 0.01}
    monkeypatch.setattr(timing, "_clock", lambda call: ((name := call()), seconds[name], 0.0))
    for name, often in (("short", 4), ("shorter", timing.MOST_REPEATS)):
        calls = []
        timing.timed(lambda name=name, calls=calls: calls.append(1) or name, 2, lambda: "reference")
        assert len(calls) == 1 + often  # the first is not timed


COMMANDS = typer.main.get_command(app).commands


def parsed(line):
    """What a command line of mgs says, by parameter."""
    words = shlex.split(line)
    assert words[0] == "mgs"
    return COMMANDS[words[1]].make_context(words[1], words[2:]).params


@pytest.mark.parametrize("name", plan.PLANS)
def test_commands_of_points_say_what_was_measured(name):
    chosen = plan.PLANS[name]
    for point in {p for points in fit.factors(chosen, True).values() for p in points}:
        said, made = (
            parsed(point.command("DATA", "PRIOR", chosen.seeds)),
            point.settings(chosen.seeds),
        )
        train = made.pop("train")
        rates = dict(pair.split("=") for pair in said["rates"] or [])
        assert said["alpha_weight"] == 0
        given = made | {k: train[k] for k in ("passes", "optimiser")}
        defaults = {**NbvSettings.model_fields, **TrainSettings.model_fields}
        assert {
            key: defaults[key].default if said[key] is None else said[key] for key in given
        } == given
        assert {kind: float(rate) for kind, rate in rates.items()} == train["rates"]
        assert NbvSettings(dataset="DATA", prior="PRIOR", **made, train=train).train_at(
            1
        ).passes == min(point.warm_passes, point.passes)


def test_points_of_different_settings_have_different_cells():
    points = {p for points in fit.factors(plan.PLANS["full"], True).values() for p in points}
    assert len({point.name for point in points}) == len(points)
    cells = [
        c
        for kind in plan.KINDS
        for c in study.cells_of(kind, *_full(), plan.synthetic(plan.PLANS["full"], "boulder"), 3)
    ]
    by_name = {cell.name: cell for cell in cells}
    assert all(by_name[cell.name] == cell for cell in cells)
    assert all(need in by_name for cell in cells for need in cell.needs)
    assert all(cell.alone for cell in cells if "repeats" in cell.arguments)


def _full():
    return plan.PLANS["full"], "full"


def test_presets_are_points_of_the_chart_and_of_the_study_of_other_scenes():
    for chosen in plan.PLANS.values():
        assert set(fit.preset_points(chosen)) == set(PRESETS)
        assert set(fit.preset_points(chosen).values()) <= set(fit.crossed_runs(chosen))


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_gives_defaults_and_what_is_given_wins(name):
    row = PRESETS[name]
    usual = {"passes": row.passes, "alpha_weight": ALPHA_WEIGHT}
    assert with_defaults({}, row)["train"] == usual
    given = {"passes": 9, "optimiser": "adam", "alpha_weight": 0.0}
    assert with_defaults({"warm_passes": 7, "train": given}, row) == {
        "warm_passes": 7,
        "train": given,
    }
    assert with_defaults({"train": TrainSettings(optimiser="adam")}, row)["train"] == usual | {
        "optimiser": "adam"
    }


class Begun(Exception):
    """A run began with these settings."""


def test_studies_fit_colours_alone(dataset, prior, tmp_path, monkeypatch):
    """What they begin runs with, wherever they begin them."""

    def begin(*_, train, **__):
        raise Begun(train["alpha_weight"])

    monkeypatch.setattr("mgs.run.nbv.run_nbv", begin)
    monkeypatch.setattr(tasks, "run_nbv", begin)
    monkeypatch.setattr(oracle, "start_run", begin)
    for module in (tasks, oracle):
        monkeypatch.setattr(module, "dataset_of", lambda root, name: dataset)
    settings, where = {"train": {"passes": 2}}, (tmp_path, tmp_path / "out", dataset, prior)
    (tmp_path / "out").mkdir()
    for call in (
        lambda: fit.measure(tmp_path, tmp_path / "out", dataset, dataset, prior, settings, 1),
        lambda: scoring.make_states(*where, 3),
        lambda: sending.measure(*where, 3, "quick"),
        lambda: tasks.run_or_resume(*where, {}),
        lambda: tasks.run_or_resume(*where, settings),
        lambda: oracle.run_oracle(*where, settings),
    ):
        with pytest.raises(Begun) as begun:
            call()
        assert begun.value.args == (0,)


def test_what_is_no_table_of_settings_is_left_to_be_refused():
    for wrong in (None, "fast", 3):
        assert with_defaults({"train": wrong}) == {"train": wrong}


def test_a_run_without_a_preset_fits_alpha_too_unless_it_says_not_to():
    assert with_defaults({"budget": 3}) == {"budget": 3, "train": {"alpha_weight": ALPHA_WEIGHT}}
    assert (
        with_defaults({"train": COLOURS_ALONE})["train"] == COLOURS_ALONE == {"alpha_weight": 0.0}
    )


def test_a_run_with_a_preset_writes_what_it_came_to(dataset, prior, tmp_path, monkeypatch):
    start_run(dataset, tmp_path / "run", prior=prior, preset="fast", seeds=3, warm_passes=4)
    settings = json.loads((tmp_path / "run/config.json").read_text())["settings"]
    assert settings["train"]["passes"] == PRESETS["fast"].passes
    assert settings["warm_passes"] == 4
    with pytest.raises(
        InputError, match="--preset 'best': unknown; choose one of fast, balanced, accurate"
    ):
        start_run(dataset, tmp_path / "other", prior=prior, preset="best")
    asked = []

    def build(frames, given, on_stage):
        asked.append(given)
        raise InputError("enough")

    monkeypatch.setattr("mgs.run.nbv.build_prior", build)
    for options in ({"preset": "accurate"}, {"preset": "accurate", "gaussians": 50}):
        with pytest.raises(InputError, match="enough"):
            start_run(dataset, tmp_path / "built", seeds=3, **options)
    assert [(given.density, given.gaussians) for given in asked] == [
        (PRESETS["accurate"].density, None),
        (PRESETS["accurate"].density, 50),
    ]


def test_the_density_of_a_prior_is_samples_for_each_pixel():
    from mgs.data.meshes import Mesh
    from mgs.prior.build import _samples

    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    square = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.ones(2, bool))
    counts = [len(_samples(square, PriorSettings(density=d), None, 0.05)[0]) for d in (1, 4)]
    assert counts[1] / counts[0] == pytest.approx(4, rel=0.05)
    with pytest.raises(InputError, match="density 0 must be positive"):
        PriorSettings(density=0)


INFORMATION = st.lists(st.floats(0, 1e6), min_size=11, max_size=11).map(np.array)


@given(INFORMATION, INFORMATION, st.floats(0.01, 10))
def test_what_is_received_is_half_a_step_off_at_most(row, other, factor):
    H, lam = np.stack([row, other, row + other]), np.full(11, 1e-3)
    rng = np.random.default_rng(0)
    values, base = rng.normal(size=H.shape), rng.normal(size=H.shape)
    for quantiser in sending.QUANTISERS.values():
        steps, told = quantiser(H, lam)
        received, size = sending.quantised(values, base, factor * steps)
        assert (np.abs(received - values) <= factor * steps * (0.5 + 1e-9) + 1e-9).all()
        assert 0 <= told <= 3
        assert 0 <= size <= 33 * np.log2(3) / 8 + 1e-9  # three numbers in each column


def test_steps_follow_the_information_of_a_gaussian():
    """Where all numbers of a Gaussian have information in proportion, a power of two for each
    Gaussian gives the steps."""
    seen, column = np.array([[1.0], [4], [16]]), np.array([[1.0, 9]])
    steps, told = sending.step_of_gaussian(seen * column, np.zeros(2))
    assert steps == pytest.approx(1 / np.sqrt(seen * column))
    assert told == pytest.approx(3 * np.log2(3) / 8)
    assert sending.entropy_bytes(np.zeros(9, int)) == 0


def test_parameters_as_a_matrix_and_back():
    gaussians = tiny.initial([])
    assert sending.as_gaussians(sending.as_matrix(gaussians), gaussians.means) == gaussians


class FakeState:
    """A state whose candidates gain what is in `gains`."""

    def __init__(self, gains, old):
        self.gains, self.old_scores, self.left, self.taken = (
            gains,
            np.array(old, float),
            list(range(len(gains))),
            [],
        )
        self.lam, self.asked = np.ones(1), []

    def summed(self, views, **how):
        return np.zeros((1, 1))

    def information(self, view, **how):
        self.asked.append(view)
        return np.array([[np.expm1(self.gains[view])]])


@given(st.lists(st.tuples(st.floats(0, 5), st.floats(0, 2)), min_size=1, max_size=8))
def test_lazy_scores_choose_the_best_where_old_ones_are_bounds(pairs):
    gains = [gain for gain, _ in pairs]
    state = FakeState(gains, [gain + more for gain, more in pairs])
    scores = scoring.lazy(state)
    assert gains[int(np.argmax(scores))] == pytest.approx(max(gains), abs=1e-9)
    assert len(set(state.asked)) == len(state.asked)


def test_lazy_scores_leave_out_what_cannot_win():
    state = FakeState([3, 1, 0], [3.5, 2, 1])
    assert scoring.lazy(state).tolist() == pytest.approx([3, 2, 1])
    assert state.asked == [0]


def test_the_kernels_are_far_closer_to_the_oracle_than_probes_are():
    small = core.scene(60, (24, 18))
    for name in ("render", "adjoint", "exact", "block"):
        what, make = core.rows_of(plan.PLANS["quick"])[name]
        assert core.error(make(small)(), core.oracle(what, small), what) < 1e-3, name
    what, make = core.rows_of(plan.PLANS["quick"])["hutchinson 4"]
    assert 0.05 < core.error(make(small)(), core.oracle(what, small), what) < 10


def test_the_verdict_on_presets(monkeypatch):
    """A preset that is beaten by a setting of its time by more than 0.1 dB fails."""
    chosen = plan.PLANS["quick"]
    points = fit.crossed_runs(chosen)
    other = next(p for p in points if p not in fit.preset_points(chosen).values())
    run = {"ratio": 1.0, "ratio_low": 1.0, "ratio_high": 1.0, "psnr": 30.0}
    found = {
        f"prior/{scene}-{1 / d:g}": {"gaussians": 9}
        for scene in plan.OTHER_SCENES
        for d in chosen.densities
    }
    for scene, best in zip(plan.OTHER_SCENES, (30.05, 30.5), strict=True):
        found |= {f"fit/{scene}/{p.name}": run for p in points}
        found[f"fit/{scene}/{other.name}"] = run | {"psnr": best}
    rows = presets.rows(chosen, study.Path("OUT"), found, 1.0)
    assert [row["holds"] for row in rows] == [True] * 3 + [False] * 3
    assert rows[-1]["loss"] == pytest.approx(0.5)
    assert (rows[-1]["best_passes"], rows[-1]["best_warm_passes"]) == (
        other.passes,
        other.warm_passes,
    )
    assert all(parsed(row["command"])["passes"] for row in rows)


TINY = replace(
    plan.PLANS["quick"],
    densities=(plan.DENSITY,),
    passes=(2,),
    image_counts=(3,),
    seeds=3,
    images=4,
    probes=(1,),
    step_sizes=(1, 1e4),
)


@pytest.fixture
def small_study(dataset, tmp_path, monkeypatch):
    """A plan of few points on the tiny dataset, with a prior that is there already and a reference
    that costs nothing."""
    tiny.write_dataset(dataset / "test", frames=3)
    point = fit.Point(4, passes=2)
    some = {
        "crossed": [point, replace(point, learned="colour")],
        "crossed, run": list(fit.preset_points(TINY).values())[:1],
    }
    monkeypatch.setitem(plan.PLANS, "quick", TINY)
    monkeypatch.setattr(fit, "factors", lambda plan, halves: some)
    monkeypatch.setattr(scoring, "STATES", (2, 3))
    few = (
        "exact",
        "block",
        "size 1/2",
        "1/2 of Gaussians",
        "incremental",
        "stale 2",
        "lazy 2",
        "directional-d",
    )
    known = scoring.variants
    monkeypatch.setattr(scoring, "variants", lambda plan: {name: known(plan)[name] for name in few})
    monkeypatch.setattr(timing, "_reference", lambda: lambda: sum(range(1000)))

    def made(root, out, dataset, density):
        if not (out / "prior").exists():
            tiny.write_prior(out / "prior")
        return {"gaussians": tiny.POINTS, "spacing": 0.5}

    monkeypatch.setattr(subject, "make_prior", made)
    return SimpleNamespace(out=tmp_path / "chart", dataset=dataset)


def test_a_chart_is_measured_once_and_written(small_study, capsys):
    out, arguments = small_study.out, ["--dataset", str(small_study.dataset), "--repeats", "1"]
    for _ in range(2):
        with pytest.raises(SystemExit) as ended:
            main(["chart", str(out), "--only", "fit,scoring,bytes", *arguments])
        assert ended.value.code == 0
        told = capsys.readouterr().out
        times = {path: path.stat().st_mtime_ns for path in out.glob("cells/**/result.json")}
    assert "/prior" not in told  # the second time all was there
    assert {path.stat().st_mtime_ns for path in times} == set(times.values())
    written = json.loads((out / "chart.json").read_text())
    assert set(written) == {"fit", "scoring", "bytes", "versions"}
    for kind in ("fit", "scoring", "bytes"):
        rows = list(csv.DictReader((out / f"{kind}.csv").read_text().splitlines()))
        assert len(rows) == len(written[kind]["rows"])
        assert (out / f"{kind}.png").stat().st_size > 10_000
        assert all(parsed(row["command"]) for row in rows)
        command = f"mgs chart {out} --only {kind} --preset quick --repeats 1 --dataset {small_study.dataset}"
        assert written[kind]["command"] == command
        table = {"fit": "front"}.get(kind, kind)
        assert chart_table(table, written)[3].startswith(f"`{command}` on ")
    assert (out / "passes.png").stat().st_size > 10_000
    by_name = {row["variant"]: row for row in written["scoring"]["rows"]}
    assert by_name["exact"]["tau"] == pytest.approx(1)
    assert by_name["exact"]["regret"] == 0
    assert by_name["size 1/2"]["tau"] > 0.5
    assert by_name["lazy 2"]["regret"] < 0.2
    assert by_name["incremental"]["tau"] > 0.3
    fits = written["fit"]["rows"]
    assert [row["total_passes"] for row in fits[:2]] == [2, 2]
    assert any(row["front"] for row in fits)
    coarse = [row for row in written["bytes"]["rows"] if row["quantiser"] == "one step"]
    assert coarse[0]["bytes"] > coarse[1]["bytes"]
    assert coarse[0]["psnr"] > coarse[1]["psnr"]


def test_what_cannot_be_charted_is_said_in_one_line(dataset, tmp_path):
    with pytest.raises(InputError, match="has no test views"):
        study.chart(tmp_path / "out", "quick", ["fit"], 1, dataset)
    with pytest.raises(InputError, match="--preset 'slow': unknown; choose one of quick, full"):
        study.chart(tmp_path / "out", "slow", ["fit"], 1)
    assert not (tmp_path / "out").exists()
    assert load_dataset(dataset)


def test_an_unknown_chart_is_refused(capsys, tmp_path):
    with pytest.raises(SystemExit) as ended:
        main(["chart", str(tmp_path / "out"), "--only", "fit,speed"])
    assert ended.value.code == 2
    assert (
        "--only 'speed': unknown; choose some of fit,scoring,core,bytes,presets"
        in capsys.readouterr().err
    )
