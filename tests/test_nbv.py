"""The loop alone, on NumPy stand-ins for its stations (tests/tiny.py); the real stations meet in
test_end_to_end.py."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny

from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.fit.stopping import StopReason
from mgs.policy import criteria
from mgs.policy import registry as policies
from mgs.run import folder as run_folder
from mgs.run import loop, recording
from mgs.splat_ply import read_ply


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return load_dataset(tiny.write_dataset(tmp_path_factory.mktemp("tiny") / "dataset"))


def run(out, dataset, stations=None, **values):
    settings = tiny.start(out, dataset, **values)
    return recording.run(out, settings, dataset, stations or tiny.operations(), tiny.silent)


def lines(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]


def timeless(steps: list[dict]) -> list[dict]:
    return [{key: value for key, value in step.items() if key != "seconds"} for step in steps]


@pytest.mark.parametrize("policy", policies.policy_names())
def test_run_writes_what_it_did(dataset, tmp_path, policy):
    state = run(tmp_path / "run", dataset, policy=policy)
    steps = lines(tmp_path / "run")
    assert [step["step"] for step in steps] == list(range(6))
    assert steps[0]["seeds"] == state.taken[:3]
    assert steps[0]["seed_names"] == [dataset.frames[i].name for i in state.taken[:3]]
    assert [step["frame"] for step in steps[1:]] == state.taken[3:]
    assert [step["name"] for step in steps[1:]] == [dataset.frames[i].name for i in state.taken[3:]]
    assert len(set(state.taken)) == len(state.taken)
    assert [step["images"] for step in steps] == list(range(3, 9))
    assert all(step["stop_reason"] == "settled" and step["iterations"] == 7 for step in steps)
    assert {"capture", "fit", "information"} <= set(steps[1]["seconds"])
    assert "psnr" not in steps[1]
    config = json.loads((tmp_path / "run/config.json").read_text())
    assert config["settings"]["policy"] == policy
    assert {"mgs", "python", "mitsuba", "drjit", "numpy"} == set(config["versions"]) - {"commit"}
    np.testing.assert_array_equal(
        read_ply(tmp_path / "run/gaussians.ply").means, state.gaussians.means
    )


def test_d_optimal_takes_the_best_candidate_at_every_step(dataset, tmp_path):
    state = run(tmp_path / "run", dataset, budget=1)
    before = recording.run(
        tmp_path / "seeds",
        tiny.start(tmp_path / "seeds", dataset, budget=0),
        dataset,
        tiny.operations(),
        tiny.silent,
    )
    lam = criteria.regularisation(tiny.GROUPS)
    H = sum(
        tiny.fisher(before.gaussians, dataset.frames[i].camera).astype(float) for i in before.taken
    )
    np.testing.assert_allclose(before.H, H)
    left = [i for i in range(len(dataset)) if i not in before.taken]
    gains = [
        criteria.d_optimal(tiny.fisher(before.gaussians, dataset.frames[i].camera), H, lam)
        for i in left
    ]
    assert state.taken[-1] == left[int(np.argmax(gains))]
    assert state.steps[-1]["score"] == state.steps[-1]["information_gain"] == max(gains)


def test_coverage_is_of_the_surface_and_does_not_depend_on_training(dataset, tmp_path):
    def forgetful(*arguments):
        fit = tiny.fit(*arguments)
        fit.gaussians.sh[:] = -100  # black: no information is left at the trained model
        return fit

    state = run(tmp_path / "run", dataset, policy="coverage")
    covered = [step["coverage"] for step in state.steps]
    start, lam = tiny.initial([]), criteria.regularisation(tiny.GROUPS)
    for step, share in enumerate(covered):
        H = sum(tiny.fisher(start, dataset.frames[i].camera) for i in state.taken[: 3 + step])
        assert share == criteria.coverage(H, lam)
    assert covered == sorted(covered)
    assert 0 < covered[0] < covered[-1]
    forgot = run(tmp_path / "forgot", dataset, tiny.operations(fit=forgetful), policy="coverage")
    assert forgot.taken == state.taken


def test_fits_start_in_the_colours_of_all_images_taken(dataset, tmp_path):
    """Before every fit the prior's colours are those of all frames taken, and the model moves with
    them; the surface that is scored, and the means, stay those of the seeds."""
    handed, drawn = [], []

    def initial(frames):
        g = tiny.initial(frames)
        return replace(
            g, sh=g.sh + np.float32(len(frames)), means=g.means + np.float32(len(frames))
        )

    def fit(gaussians, start, *others):
        handed.append((gaussians, start))
        found = tiny.fit(gaussians, start, *others)
        drawn.append(found.gaussians)
        return found

    run(tmp_path / "run", dataset, tiny.operations(initial=initial, fit=fit), budget=2)
    assert len(handed) == 3
    for step, (model, start) in enumerate(handed):
        np.testing.assert_array_equal(start.sh, initial([None] * (3 + step)).sh)
        np.testing.assert_array_equal(start.means, initial([None] * 3).means)
        expected = (
            start if step == 0 else replace(drawn[step - 1], sh=drawn[step - 1].sh + np.float32(1))
        )
        np.testing.assert_allclose(model.sh, expected.sh, atol=1e-5)
        np.testing.assert_array_equal(model.means, start.means)


def test_a_tie_goes_to_the_farthest_camera(dataset, tmp_path):
    """Where every view sees everything, coverage has nothing to say after the seeds: the views must
    spread all the same."""
    stations = tiny.operations(
        fisher=lambda gaussians, camera: np.ones((tiny.POINTS, 11), np.float32)
    )
    state = run(tmp_path / "run", dataset, stations, policy="coverage", seeds=1, budget=3)
    assert [step["score"] for step in state.steps[1:]] == [0, 0, 0]
    assert sorted(state.taken) == [0, 3, 6, 9]


@pytest.mark.parametrize("policy", policies.policy_names())
def test_candidate_images_are_never_read_before_they_are_chosen(
    dataset, tmp_path, monkeypatch, policy
):
    """Every image that is opened is logged; at each choice the opened ones must be exactly those
    taken."""
    import mgs.data.dataset
    import mgs.run.inputs

    opened: set[str] = set()
    places = [
        (mgs.data.dataset, "read_png"),
        (mgs.data.dataset, "read_mask"),
        (mgs.data.dataset, "read_exr"),
        (mgs.run.inputs, "file_digest"),
    ]
    for module, name in places:
        function = getattr(module, name)
        monkeypatch.setattr(
            module, name, lambda path, f=function: opened.add(Path(path).stem) or f(path)
        )
    at_choice = []
    choose = loop.choose

    def watched(problem, state, fisher=None):
        at_choice.append((set(opened), {dataset.frames[i].name for i in state.taken}))
        return choose(problem, state, fisher)

    monkeypatch.setattr(loop, "choose", watched)
    state = run(tmp_path / "run", dataset, policy=policy)
    assert len(at_choice) == 5
    assert all(seen == taken for seen, taken in at_choice)
    assert opened == {dataset.frames[i].name for i in state.taken}


def test_poisoned_candidates_do_not_change_the_choice(tmp_path):
    """The files of views that are never chosen may hold anything: same views, same model."""
    root = tiny.write_dataset(tmp_path / "dataset")
    dataset = load_dataset(root)
    clean = run(tmp_path / "clean", dataset)
    for i, frame in enumerate(dataset.frames):
        if i not in clean.taken:
            for path in (frame.image_path, frame.depth_path, frame.mask_path):
                path.write_bytes(b"poison")
    poisoned = run(tmp_path / "poisoned", dataset)
    assert poisoned.taken == clean.taken
    np.testing.assert_array_equal(poisoned.gaussians.sh, clean.gaussians.sh)


def test_one_candidate_in_memory_at_a_time(dataset, tmp_path):
    """Streaming: when the next candidate's information is asked for, the previous one has been let
    go."""
    import weakref

    alive: list[weakref.ref] = []

    def fisher(gaussians, camera):
        assert sum(ref() is not None for ref in alive) <= 1
        F = tiny.fisher(gaussians, camera)
        alive.append(weakref.ref(F))
        return F

    run(tmp_path / "run", dataset, tiny.operations(fisher=fisher))
    assert len(alive) > 50


def test_random_depends_on_the_seed_only(dataset, tmp_path):
    taken = [
        run(tmp_path / str(i), dataset, policy="random", seed=seed).taken
        for i, seed in enumerate((1, 1, 2))
    ]
    assert taken[0] == taken[1]
    assert taken[0] != taken[2]


def test_evaluation_is_logged_and_changes_nothing(dataset, tmp_path):
    plain = run(tmp_path / "plain", dataset)
    measured = run(tmp_path / "measured", dataset, evaluate_every=2)
    assert ["psnr" in step for step in measured.steps] == [True, False, True, False, True, False]
    assert measured.taken == plain.taken


MOMENTS = [
    ("initial", 1),
    ("fit", 1),
    ("fit", 4),
    ("fisher", 2),
    ("fisher", 40),
    ("before the lines are written", 1),
    ("before the lines are written", 3),
    ("while the checkpoint is written", 1),
    ("while the checkpoint is written", 3),
]


@pytest.fixture(scope="module")
def uninterrupted(dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "run"
    return run(out, dataset, seed=3), (out / "gaussians.ply").read_bytes(), lines(out)


@pytest.mark.parametrize(("moment", "count"), MOMENTS)
def test_killed_at_any_moment_then_resumed_takes_the_same_views(
    dataset, tmp_path, uninterrupted, moment, count
):
    whole, ply, steps = uninterrupted
    out = tmp_path / "run"
    command = [
        sys.executable,
        tiny.__file__,
        str(dataset.root),
        str(out),
        "d-optimal",
        moment,
        str(count),
    ]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == -signal.SIGKILL, process.stderr
    half = run_folder.read_checkpoint(out)
    # The lines may lag behind the checkpoint, never run ahead of it or differ.
    committed = half.steps if half else []
    written = lines(out) if (out / "steps.jsonl").exists() else []
    assert written == committed[: len(written)]
    assert len(committed) - len(written) <= 1
    resumed = recording.run(
        out, run_folder.read_settings(out), dataset, tiny.operations(), tiny.silent
    )
    assert resumed.taken == whole.taken
    assert timeless(lines(out)) == timeless(steps)
    assert (out / "gaussians.ply").read_bytes() == ply
    assert not list(out.glob(".*"))


def test_interrupted_by_the_keyboard_then_resumed(dataset, tmp_path, uninterrupted):
    calls = []

    def fit(*arguments):
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return tiny.fit(*arguments)

    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        run(out, dataset, tiny.operations(fit=fit), seed=3)
    assert len(lines(out)) == 3
    assert (
        recording.run(
            out, run_folder.read_settings(out), dataset, tiny.operations(), tiny.silent
        ).taken
        == uninterrupted[0].taken
    )


@pytest.mark.parametrize(
    ("broken", "named"),
    [
        (0, "the fit to the seeds"),
        (1, "the fit of step 1 .*step 0 is kept"),
        (3, "steps 0 to 2 are kept"),
    ],
)
def test_a_fit_that_diverges_ends_the_run_which_can_go_on(
    dataset, tmp_path, uninterrupted, broken, named
):
    def fit(gaussians, start, cameras, *rest):
        found = tiny.fit(gaussians, start, cameras, *rest)
        if len(cameras) < 3 + broken:
            return found
        found.gaussians.sh[:] = np.nan
        return replace(found, losses=(0.01234, 0.5, math.nan), stop_reason=StopReason.DIVERGED)

    out = tmp_path / "run"
    with pytest.raises(InputError, match=named) as stop:
        run(out, dataset, tiny.operations(fit=fit), seed=3)
    said = str(stop.value)
    assert "diverged: its loss was 0.0123 at the start, and 0.5, nan in the last passes" in said
    assert f"`train.rates` in {out / 'config.json'}" in said
    assert f"mgs nbv --resume {out}" in said
    assert "\n" not in said
    assert ((out / "steps.jsonl").exists() and len(lines(out))) == broken
    resumed = recording.run(
        out, run_folder.read_settings(out), dataset, tiny.operations(), tiny.silent
    )
    assert resumed.taken == uninterrupted[0].taken
    assert (out / "gaussians.ply").read_bytes() == uninterrupted[1]


def test_resuming_a_finished_run_changes_nothing(dataset, tmp_path):
    state = run(tmp_path / "run", dataset)
    before = (tmp_path / "run/steps.jsonl").read_bytes()

    def never(*arguments):
        raise AssertionError("nothing is left to do")

    again = recording.run(
        tmp_path / "run",
        run_folder.read_settings(tmp_path / "run"),
        dataset,
        tiny.operations(fit=never, fisher=never),
        tiny.silent,
    )
    assert again.taken == state.taken
    assert (tmp_path / "run/steps.jsonl").read_bytes() == before


@pytest.mark.parametrize("score", [math.nan, math.inf])
def test_a_policy_that_gives_no_number_is_named(dataset, tmp_path, monkeypatch, score):
    monkeypatch.setitem(criteria.CRITERIA, "mine", criteria.Criterion(lambda F, H, lam: score))
    with pytest.raises(InputError, match="policy mine: returned a score that is NaN or infinite"):
        run(tmp_path / "run", dataset, policy="mine")
    assert len(lines(tmp_path / "run")) == 1


def test_damaged_or_missing_runs_are_told_apart(dataset, tmp_path):
    with pytest.raises(InputError, match=r"holds no run"):
        run_folder.read_settings(tmp_path)
    out = tmp_path / "run"
    run(out, dataset, budget=0)
    run_folder.check_same_frames(out, dataset)
    other = load_dataset(tiny.write_dataset(tmp_path / "other", frames=5))
    with pytest.raises(InputError, match="frames differ"):
        run_folder.check_same_frames(out, other)
    (out / "checkpoint.npz").write_bytes((out / "checkpoint.npz").read_bytes()[:100])
    with pytest.raises(InputError, match="not a readable checkpoint"):
        run_folder.read_checkpoint(out)
    (out / "config.json").write_text("{}")
    with pytest.raises(InputError, match="no settings"):
        run_folder.read_settings(out)


@pytest.mark.parametrize(
    ("values", "message"),
    [({"seeds": 13}, "fewer than 13 seeds"), ({"budget": 10}, "9 candidates")],
)
def test_counts_are_checked_before_anything_is_written(dataset, tmp_path, values, message):
    with pytest.raises(InputError, match=message):
        tiny.start(tmp_path / "run", dataset, **values)
    assert not (tmp_path / "run").exists()
