"""Why a run ends: the rules alone, then the loop on stand-ins (tests/tiny.py), then what people are
told."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from mgs.cli.app import main
from mgs.data.dataset import load_dataset
from mgs.files import write_json
from mgs.policy import criteria
from mgs.report.page_facts import read_shown
from mgs.report.runs import read_run
from mgs.report.tables import markdown_table, table_numbers
from mgs.run import folder as run_folder
from mgs.run import recording
from mgs.run.ending import run_end, why_ended
from mgs.run.settings import NbvSettings


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    return load_dataset(tiny.write_dataset(tmp_path_factory.mktemp("tiny") / "dataset"))


def run(out: Path, dataset, stations=None, **values) -> run_folder.State:
    return recording.run(
        out, tiny.start(out, dataset, **values), dataset, stations or tiny.operations(), tiny.silent
    )


def resume(out: Path, dataset, stations=None, **changes) -> run_folder.State:
    """Go on with a run, with some of its settings changed in its config.json."""
    config = json.loads((out / "config.json").read_text())
    write_json(out / "config.json", config | {"settings": config["settings"] | changes})
    return recording.run(
        out, run_folder.read_settings(out), dataset, stations or tiny.operations(), tiny.silent
    )


def never(*arguments):
    raise AssertionError("a run that has ended does nothing")


NUMBERS = st.floats(1e-3, 1 - 1e-3)


@given(
    views=st.integers(0, 5),
    uncertainty=NUMBERS,
    gain=NUMBERS,
    limits=st.tuples(st.none() | NUMBERS, st.none() | NUMBERS),
)
def test_the_first_rule_that_holds_is_the_reason(views, uncertainty, gain, limits):
    settings = NbvSettings(
        dataset=".", prior=".", budget=3, stop_uncertainty=limits[0], stop_gain=limits[1]
    )
    found = run_end(settings, views, uncertainty, {"name": "kf_0001", "information_gain": gain})
    holds = {
        "budget": views >= 3,
        "uncertainty": limits[0] is not None and uncertainty <= limits[0],
        "gain": limits[1] is not None and gain < limits[1],
    }
    assert (found and found["reason"]) == next(
        (reason for reason, held in holds.items() if held), None
    )
    known = run_end(
        settings, views, uncertainty, found
    )  # what was recorded is enough to find the same again
    assert known == found
    unknown = run_end(settings, views, uncertainty, None)
    assert unknown == (None if found is None or found["reason"] == "gain" else found)


def test_uncertainty_is_the_posteriors_variance_over_the_priors():
    rng = np.random.default_rng(0)
    H, lam = rng.exponential(size=(5, 11)), rng.exponential(size=11)
    noise = 0.3
    posterior, prior = noise**2 / (H + lam), noise**2 / lam
    np.testing.assert_allclose(criteria.uncertainty(H, lam), (posterior / prior).mean(axis=1))
    assert (criteria.uncertainty(np.zeros_like(H), lam) == 1).all()
    assert (criteria.uncertainty(H + 1e-6, lam) < criteria.uncertainty(H, lam)).all()


def test_a_run_stops_before_it_takes_a_view_that_would_tell_little(loaded, tmp_path):
    whole = run(tmp_path / "whole", loaded)
    gains = [step["information_gain"] for step in whole.steps[1:]]
    limit = (gains[1] + gains[2]) / 2
    assert min(gains[:2]) > limit > gains[2]
    fits = []

    def fit(*arguments):
        fits.append(1)
        return tiny.fit(*arguments)

    state = run(tmp_path / "run", loaded, tiny.operations(fit=fit), stop_gain=limit)
    assert state.taken == whole.taken[:5]
    assert len(fits) == 3, "the seeds and two views"
    next_name = loaded.frames[whole.taken[5]].name
    ended = {
        "reason": "gain",
        "views": 2,
        "name": next_name,
        "information_gain": gains[2],
        "limit": limit,
    }
    lines = [json.loads(line) for line in (tmp_path / "run/steps.jsonl").read_text().splitlines()]
    assert ["ended" in line for line in lines] == [False, False, True]
    assert (
        lines[-1]["ended"]
        == run_folder.read_checkpoint(tmp_path / "run").steps[-1]["ended"]
        == ended
    )
    assert next_name not in state.inputs["files"]
    assert whole.steps[-1]["ended"] == {"reason": "budget", "views": 5}


@pytest.mark.parametrize("rule", ["gain", "uncertainty", "budget"])
def test_resuming_a_run_that_has_ended_does_nothing_until_its_rule_is_changed(
    loaded, tmp_path, rule
):
    whole = run(tmp_path / "whole", loaded)
    key, other = {
        "gain": ("stop_gain", None),
        "uncertainty": ("stop_uncertainty", None),
        "budget": ("budget", 5),
    }[rule]
    numbers = whole.steps[2]["uncertainty"], whole.steps[3]["uncertainty"]
    assert numbers[0] > numbers[1]
    gain = (whole.steps[2]["information_gain"] + whole.steps[3]["information_gain"]) / 2
    value = {"gain": gain, "uncertainty": numbers[0], "budget": 2}[rule]
    out = tmp_path / "run"
    state = run(out, loaded, **{key: value})
    assert (len(state.taken), state.steps[-1]["ended"]["reason"]) == (5, rule)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    again = resume(out, loaded, tiny.operations(fit=never, fisher=never))
    assert again.taken == state.taken
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    last = resume(out, loaded, **{key: other})
    assert last.taken == whole.taken
    assert ["ended" in step for step in last.steps] == [False] * 5 + [True]
    np.testing.assert_array_equal(last.gaussians.sh, whole.gaussians.sh)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--alpha-weight", "-1"],
            "--alpha-weight -1.0: Input should be greater than or equal to 0",
        ),
        (["--stop-gain", "0"], "--stop-gain 0.0: Input should be greater than 0"),
        (["--stop-gain", "nan"], "--stop-gain nan: Input should be"),
        (["--stop-uncertainty", "1"], "--stop-uncertainty 1.0: Input should be less than 1"),
        (["--stop-uncertainty", "-0.5"], "--stop-uncertainty -0.5: Input should be greater than 0"),
    ],
)
def test_bad_limits_are_one_line(dataset, prior, tmp_path, capsys, options, message):
    out = tmp_path / "run"
    assert message in refused(
        capsys, ["nbv", dataset, "--prior", prior, "--budget", "1", "--out", out, *options]
    )
    assert not out.exists()


def mgs(capsys, *arguments) -> str:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    shown = capsys.readouterr()
    assert stop.value.code == 0, shown.err
    return shown.out


def test_one_line_says_why_a_run_ended_when_it_ends_when_it_is_resumed_and_in_the_report(
    dataset, prior, tmp_path, capsys
):
    start = ["nbv", dataset, "--prior", prior, "--budget", "2", "--passes", "1"]
    shown = mgs(capsys, *start, "--out", tmp_path / "early", "--stop-gain", "1e3")
    ended = json.loads((tmp_path / "early/steps.jsonl").read_text().splitlines()[-1])["ended"]
    said = f"would gain {ended['information_gain']:.4g} after 0 chosen views, less than --stop-gain 1000"
    line = f"the run has ended: the next view, {ended['name']}, {said}"
    assert shown.count(line) == 1
    assert mgs(capsys, "nbv", "--resume", tmp_path / "early").count(line) == 1
    mgs(capsys, *start, "--out", tmp_path / "whole", "--policy", "random")
    left = mgs(
        capsys,
        *start,
        "--out",
        tmp_path / "known",
        "--policy",
        "uniform",
        "--stop-uncertainty",
        "0.99",
    )
    assert (
        "of the prior's variance is left after 0 chosen views, no more than --stop-uncertainty 0.99"
        in left
    )
    for name in ("early", "whole", "known"):
        mgs(capsys, "eval", tmp_path / name)
    runs = [tmp_path / name for name in ("early", "whole", "known")]
    shown = mgs(capsys, "report", *runs, "--out", tmp_path / "report")
    rows = table_numbers(runs)
    assert f"d-optimal: a path of {rows[0]['path']:.2f} m; {line}\n" in shown
    assert (
        f"random: a path of {rows[1]['path']:.2f} m; the run has ended: its budget is spent, 2 chosen views\n"
        in shown
    )
    assert [row.get("ended") for row in rows] == ["gain", None, "uncertainty"]
    table = [
        [cell.strip() for cell in row.split("|")[1:-1]] for row in markdown_table(rows).splitlines()
    ]
    assert [row[-1] for row in table] == ["ended by", "---:", "gain", "–", "uncertainty"]
    assert "ended by" not in markdown_table(table_numbers(runs[1:2]))
    shown_run = read_shown("early", read_run(tmp_path / "early"), load_dataset(dataset))
    assert f"T{line[1:]}." in shown_run.notes


def test_a_run_that_spent_its_budget_says_so():
    assert why_ended({"reason": "budget", "views": 1}) == "its budget is spent, 1 chosen view"
