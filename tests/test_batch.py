"""Batches: views that are chosen together, before their images are read; on stand-ins
(tests/tiny.py), then by the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from refusals import refused

import mgs.data.dataset
import mgs.run.inputs
from mgs.cli.app import main
from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.fit.stopping import StopReason
from mgs.policy import criteria
from mgs.policy import registry as policies
from mgs.report.writing import write_report
from mgs.run import folder as run_folder
from mgs.run import loop, problem, recording
from mgs.study import case

OF_A_FIT = {"uncertainty", "iterations", "loss", "stop_reason"}
AT_THE_MODEL = {
    "d-optimal",
    "t-optimal",
    "a-optimal",
    "e-optimal",
    "fisherrf",
    "i-optimal",
    "block-d",
    "paper",
}
"""Policies that look at the fitted model; the others look at poses, and at the surface before any
training."""


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    return load_dataset(tiny.write_dataset(tmp_path_factory.mktemp("tiny") / "dataset"))


def run(out: Path, dataset, stations=None, **values) -> run_folder.State:
    return recording.run(
        out, tiny.start(out, dataset, **values), dataset, stations or tiny.operations(), tiny.silent
    )


def lines(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]


def test_a_study_has_a_number_for_each_fit_of_a_run(loaded, tmp_path, monkeypatch):
    measure = lambda gaussians, taken: {"test_psnr": 10 + len(taken), "test_psnr_mask": len(taken)}  # noqa: E731
    state = run(
        tmp_path / "run", loaded, tiny.operations(measure=measure), batch=2, evaluate_every=1
    )
    monkeypatch.setattr(case, "run_or_resume", lambda *arguments: state)
    curves = case.run_policy(tmp_path, tmp_path, "dataset", "prior", {"batch": 2})
    assert curves["taken"] == state.taken
    assert curves["images"] == curves["test_psnr_mask"] == [3, 5, 7, 8]
    assert curves["test_psnr"] == [13, 15, 17, 18]
    assert len(curves["coverage"]) == 4


def test_a_step_is_a_view_and_the_last_of_a_batch_has_its_fit(loaded, tmp_path):
    fits, told = [], []

    def fit(gaussians, start, cameras, *rest):
        fits.append(len(cameras))
        return tiny.fit(gaussians, start, cameras, *rest)

    settings = tiny.start(tmp_path / "run", loaded, batch=2, evaluate_every=3)
    stations = tiny.operations(fit=fit)
    on_step = lambda state: told.append(len(state.taken))  # noqa: E731
    state = recording.run(tmp_path / "run", settings, loaded, stations, tiny.silent, on_step)
    assert fits == told == [3, 5, 7, 8], "the budget of 5 views is no multiple of 2"
    steps = lines(tmp_path / "run")
    assert [step["step"] for step in steps] == list(range(6))
    assert [step["images"] for step in steps] == list(range(3, 9))
    assert [step["frame"] for step in steps[1:]] == state.taken[3:]
    assert [set(step) >= OF_A_FIT for step in steps] == [True, False, True, False, True, True]
    assert all(OF_A_FIT & set(step) in (set(), OF_A_FIT) for step in steps)
    assert ["psnr" in step for step in steps] == [True, False, False, False, True, False], (
        "step 3 lies in the second batch"
    )
    covered = [step["coverage"] for step in steps]
    whole = sum(
        tiny.fisher(tiny.initial([]), loaded.frames[i].camera).astype(float) for i in state.taken
    )
    assert covered[-1] == criteria.coverage(whole, criteria.regularisation(tiny.GROUPS))
    assert covered == sorted(covered)


def test_a_batch_is_chosen_greedily_at_one_model(loaded, tmp_path):
    """Each view of a batch has the largest gain, given the information that the ones before it have
    about the same model."""
    seeds = run(tmp_path / "seeds", loaded, budget=0)
    state = run(tmp_path / "run", loaded, budget=3, batch=3)
    H, lam, taken = seeds.H, criteria.regularisation(tiny.GROUPS), list(seeds.taken)
    for step in state.steps[1:]:
        left = [i for i in range(len(loaded)) if i not in taken]
        F = [tiny.fisher(seeds.gaussians, loaded.frames[i].camera) for i in left]
        gains = [criteria.d_optimal(one, H, lam) for one in F]
        best = int(np.argmax(gains))
        assert (step["frame"], step["information_gain"]) == (left[best], gains[best])
        H, taken = H + F[best], [*taken, left[best]]
    after = sum(tiny.fisher(state.gaussians, loaded.frames[i].camera).astype(float) for i in taken)
    np.testing.assert_allclose(
        state.H, after, err_msg="after the fit nothing of the prediction is left"
    )


@pytest.mark.parametrize("room", [1 << 30, 0], ids=["kept", "no room"])
def test_a_batch_measures_each_candidate_once_if_there_is_room(loaded, tmp_path, monkeypatch, room):
    measured = []

    def fisher(gaussians, camera):
        measured.append((gaussians.sh.tobytes(), camera.key))
        return tiny.fisher(gaussians, camera)

    monkeypatch.setattr(problem, "IMAGE_BYTES", room)
    state = run(
        tmp_path / "run",
        loaded,
        replace(tiny.operations(), fisher=fisher, exact=tiny.fisher),
        budget=6,
        batch=3,
    )
    assert state.taken == run(tmp_path / "as before", loaded, budget=6, batch=3).taken
    left, taken = (
        9 + 6,
        3 + 6 + 9,
    )  # candidates of two batches; views whose information is summed after three fits
    again = 0 if room else (8 + 7) + (5 + 4) + 6
    assert len(measured) == left + taken + again
    assert len(set(measured)) == left + taken


def test_what_a_pose_sees_of_the_surface_is_measured_once_for_all_choices(loaded, tmp_path):
    measured = []

    def exact(gaussians, camera):
        measured.append(camera.key)
        return tiny.fisher(gaussians, camera)

    run(
        tmp_path / "run",
        loaded,
        replace(tiny.operations(), exact=exact),
        policy="coverage",
        budget=4,
    )
    taken, candidates = 3 + 4, 12 - 3
    assert len(measured) == taken + candidates


def test_the_policies_that_look_at_the_model_are_known():
    assert set(policies.policy_names()) >= AT_THE_MODEL


@pytest.mark.parametrize("policy", policies.policy_names())
@pytest.mark.parametrize("nearest", [None, 3])
def test_a_batch_counts_as_taken_for_every_policy(loaded, tmp_path, policy, nearest):
    """Where the fit changes nothing that a policy looks at, a batch has the views that are chosen
    one by one."""
    stations = (
        tiny.operations()
        if policy not in AT_THE_MODEL
        else tiny.operations(fit=lambda g, *rest: tiny.Fit(g, 0.1, 1))
    )
    runs = [
        run(tmp_path / str(k), loaded, stations, policy=policy, nearest=nearest, batch=k)
        for k in (1, 3)
    ]
    assert runs[0].taken == runs[1].taken
    for one, other in zip(*(state.steps[1:] for state in runs), strict=True):
        assert one["score"] == pytest.approx(other["score"], rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("policy", policies.policy_names())
def test_no_image_is_read_before_the_batch_is_complete(loaded, tmp_path, monkeypatch, policy):
    opened: set[str] = set()
    places = [
        (mgs.data.dataset, "read_png"), (mgs.data.dataset, "read_mask"), (mgs.data.dataset, "read_exr"),
        (mgs.run.inputs, "file_digest"),
    ]  # fmt: skip
    for module, name in places:
        function = getattr(module, name)
        monkeypatch.setattr(
            module, name, lambda path, f=function: opened.add(Path(path).stem) or f(path)
        )
    at_choice = []
    choose = loop.choose

    def watched(problem, state, fisher=None):
        at_choice.append((set(opened), len(state.taken)))
        return choose(problem, state, fisher)

    monkeypatch.setattr(loop, "choose", watched)
    state = run(tmp_path / "run", loaded, policy=policy, batch=2)
    names = [loaded.frames[i].name for i in state.taken]
    assert [count for _, count in at_choice] == [3, 4, 5, 6, 7]
    assert [seen for seen, _ in at_choice] == [set(names[:known]) for known in (3, 3, 5, 5, 7)]


@pytest.mark.parametrize("when", [2, 3])
def test_a_batch_that_was_interrupted_is_chosen_again(loaded, tmp_path, when):
    whole = run(tmp_path / "whole", loaded, batch=2)
    calls = []

    def fit(*arguments):
        calls.append(1)
        if len(calls) == when:
            raise KeyboardInterrupt
        return tiny.fit(*arguments)

    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        run(out, loaded, tiny.operations(fit=fit), batch=2)
    assert len(lines(out)) == 1 + 2 * (when - 2), "a batch is finished as a whole, or not at all"
    state = recording.run(
        out, run_folder.read_settings(out), loaded, tiny.operations(), tiny.silent
    )
    assert state.taken == whole.taken
    assert (out / "gaussians.ply").read_bytes() == (tmp_path / "whole/gaussians.ply").read_bytes()


def test_a_batch_is_closed_before_a_view_that_would_tell_little(loaded, tmp_path):
    """Whether the run ends is asked at the model that was fitted to what the batch has."""
    whole = run(tmp_path / "whole", loaded, batch=3)
    gains = [step["information_gain"] for step in whole.steps[1:]]
    limit = (gains[1] + gains[2]) / 2
    assert gains[1] > limit > gains[2]
    state = run(tmp_path / "run", loaded, batch=3, stop_gain=limit)
    assert state.taken[:5] == whole.taken[:5]
    assert "loss" in state.steps[2]
    assert all(step["information_gain"] >= limit for step in state.steps[1:])
    ended = state.steps[-1]["ended"]
    assert (ended["reason"], ended["views"]) == ("gain", len(state.taken) - 3)
    assert ended["information_gain"] < limit
    assert len(state.taken) < len(whole.taken)


def test_a_batch_whose_fit_diverges_is_named_by_its_last_step(loaded, tmp_path):
    def fit(gaussians, start, cameras, *rest):
        found = tiny.fit(gaussians, start, cameras, *rest)
        return (
            found
            if len(cameras) < 7
            else replace(found, losses=(0.1, 0.5), stop_reason=StopReason.DIVERGED)
        )

    with pytest.raises(InputError, match=r"the fit of step 4 diverged.*; steps 0 to 2 are kept"):
        run(tmp_path / "run", loaded, tiny.operations(fit=fit), batch=2)
    assert len(lines(tmp_path / "run")) == 3


def test_a_batch_of_no_views_is_one_line(dataset, prior, tmp_path, capsys):
    said = refused(
        capsys, ["nbv", dataset, "--prior", prior, "--out", tmp_path / "run", "--batch", "0"]
    )
    assert "--batch 0: Input should be greater than or equal to 1" in said
    assert not (tmp_path / "run").exists()


def test_table_report_and_page_of_a_run_in_batches(dataset, prior, tmp_path, capsys):
    out = tmp_path / "run"
    for arguments in (
        [
            "nbv",
            dataset,
            "--prior",
            prior,
            "--budget",
            "3",
            "--batch",
            "2",
            "--passes",
            "1",
            "--evaluate-every",
            "1",
            "--out",
            out,
        ],
        ["eval", out],
        ["report", out, "--out", tmp_path / "report", "--html", tmp_path / "page.html"],
    ):
        with pytest.raises(SystemExit) as stop:
            main([str(argument) for argument in arguments])
        shown = capsys.readouterr()
        assert stop.value.code == 0, shown.err
        if arguments[0] == "nbv":
            rows = [
                line.split()
                for line in shown.out.splitlines()
                if line.split() and line.split()[0].isdigit()
            ]
            assert [row[0] for row in rows] == ["0", "1", "2", "3"]
            assert ["pass-limit" in row for row in rows] == [True, False, True, True]
    assert len(write_report(tmp_path / "again", [out])) == 7
