"""The loop in a folder with the operations of tests/tiny.py, one view or a batch at a time."""

import json
import math
import signal
import subprocess
import sys
import time
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from program import change_settings, steps, timeless
from tiny import resume, run

import mgs.data.frames
import mgs.run.inputs
from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.fit.stopping import StopReason
from mgs.policy import criteria
from mgs.policy.poses import POSE_POLICIES
from mgs.policy.registry import policy_names
from mgs.run import folder as run_folder
from mgs.run import loop
from mgs.splat_ply import read_ply


@pytest.fixture(scope="module")
def dataset(pristine):
    return load_dataset(pristine)


@pytest.fixture(scope="module")
def uninterrupted(dataset, tmp_path_factory):
    """A whole run, its PLY and its steps."""
    out = tmp_path_factory.mktemp("whole") / "run"
    return run(out, dataset, seed=3), (out / "gaussians.ply").read_bytes(), steps(out)


def test_views_are_the_best_at_the_model_and_given_the_batch_so_far(dataset, tmp_path):
    """Every view has the largest gain, given the information of those before it at one model."""
    before = run(tmp_path / "seeds", dataset, budget=0)
    state = run(tmp_path / "run", dataset, budget=3, batch=3)
    lam, taken = criteria.regularisation(tiny.GROUPS), list(before.taken)

    def information(model, views):
        return [tiny.fisher(model, dataset.frames[i].camera).astype(float) for i in views]

    H = before.H
    np.testing.assert_allclose(H, sum(information(before.gaussians, taken)))
    for line in state.steps[1:]:
        left = [i for i in range(len(dataset)) if i not in taken]
        F = information(before.gaussians, left)
        gains = [criteria.d_optimal(one, H, lam) for one in F]
        best = int(np.argmax(gains))
        assert line["frame"] == left[best]
        assert line["score"] == line["information_gain"] == gains[best]
        H, taken = H + F[best], [*taken, left[best]]
    np.testing.assert_allclose(state.H, sum(information(state.gaussians, taken)))


def test_coverage_is_of_the_surface_and_does_not_depend_on_training(dataset, tmp_path):
    def blacken(*arguments):
        fit = tiny.fit(*arguments)
        fit.gaussians.sh[:] = -100  # no information is left at the trained model
        return fit

    state = run(tmp_path / "run", dataset, policy="coverage")
    covered = [line["coverage"] for line in state.steps]
    start, lam = tiny.initial([]), criteria.regularisation(tiny.GROUPS)
    for step, share in enumerate(covered):
        H = sum(tiny.fisher(start, dataset.frames[i].camera) for i in state.taken[: 3 + step])
        assert share == criteria.coverage(H, lam)
    assert covered == sorted(covered)
    assert 0 < covered[0] < covered[-1]
    black = run(tmp_path / "black", dataset, tiny.operations(fit=blacken), policy="coverage")
    assert black.taken == state.taken


def test_fits_start_in_the_colours_of_all_images_taken(dataset, tmp_path):
    """The model moves with the prior's colours; means stay those of the seeds."""
    handed, fitted = [], []

    def initial(frames):
        g, count = tiny.initial(frames), np.float32(len(frames))
        return replace(g, sh=g.sh + count, means=g.means + count)

    def fit(gaussians, start, *others):
        handed.append((gaussians, start))
        found = tiny.fit(gaussians, start, *others)
        fitted.append(found.gaussians)
        return found

    run(tmp_path / "run", dataset, tiny.operations(initial=initial, fit=fit), budget=2)
    assert len(handed) == 3
    for step, (model, start) in enumerate(handed):
        np.testing.assert_array_equal(start.sh, initial([None] * (3 + step)).sh)
        np.testing.assert_array_equal(start.means, initial([None] * 3).means)
        expected = start.sh if step == 0 else fitted[step - 1].sh + np.float32(1)
        np.testing.assert_allclose(model.sh, expected, atol=1e-5)
        np.testing.assert_array_equal(model.means, start.means)


def test_a_tie_goes_to_the_farthest_camera(dataset, tmp_path):
    """Views spread where every view sees everything and coverage has no preference."""
    same = tiny.operations(fisher=lambda *_: np.ones((tiny.POINTS, 11), np.float32))
    state = run(tmp_path / "run", dataset, same, policy="coverage", seeds=1, budget=3)
    assert [line["score"] for line in state.steps[1:]] == [0, 0, 0]
    assert sorted(state.taken) == [0, 3, 6, 9]


@pytest.mark.parametrize(
    ("policy", "batch"), [("d-optimal", 1), *((name, 2) for name in policy_names())]
)
def test_a_run_reads_the_images_of_its_choices_and_writes_what_it_did(
    dataset, tmp_path, monkeypatch, policy, batch
):
    """An image is read only once it, or its batch, is chosen."""
    opened, at_choice, choose = set(), [], loop.choose
    for module, name in (
        (mgs.data.frames, "read_png"),
        (mgs.data.frames, "read_mask"),
        (mgs.data.frames, "read_exr"),
        (mgs.run.inputs, "file_digest"),
    ):
        logged = lambda path, f=getattr(module, name): opened.add(Path(path).stem) or f(path)  # noqa: E731
        monkeypatch.setattr(module, name, logged)

    def watched(problem, state, fisher=None):
        at_choice.append((set(opened), len(state.taken)))
        return choose(problem, state, fisher)

    monkeypatch.setattr(loop, "choose", watched)
    state = run(tmp_path / "run", dataset, policy=policy, batch=batch)
    names = [dataset.frames[i].name for i in state.taken]
    known = {1: (3, 4, 5, 6, 7), 2: (3, 3, 5, 5, 7)}[batch]
    assert [count for _, count in at_choice] == [3, 4, 5, 6, 7]
    assert [seen for seen, _ in at_choice] == [set(names[:count]) for count in known]
    assert opened == set(names)
    lines = steps(tmp_path / "run")
    assert [line["step"] for line in lines] == list(range(6))
    assert (lines[0]["seeds"], lines[0]["seed_names"]) == (state.taken[:3], names[:3])
    assert [line["frame"] for line in lines[1:]] == state.taken[3:]
    assert [line["name"] for line in lines[1:]] == names[3:]
    assert [line["images"] for line in lines] == list(range(3, 9))
    fits = [(line["stop_reason"], line["iterations"]) for line in lines if "loss" in line]
    assert fits == [("settled", 7)] * (len(set(known)) + 1)
    assert {"capture", "fit", "information"} <= set(lines[-1]["seconds"])
    config = json.loads((tmp_path / "run/config.json").read_text())
    assert config["settings"]["policy"] == policy
    assert {"mgs", "python", "mitsuba", "drjit", "numpy"} == set(config["versions"]) - {"commit"}
    model = read_ply(tmp_path / "run/gaussians.ply")
    np.testing.assert_array_equal(model.means, state.gaussians.means)


def test_one_candidate_in_memory_at_a_time(dataset, tmp_path):
    alive: list[weakref.ref] = []

    def fisher(gaussians, camera):
        assert sum(ref() is not None for ref in alive) <= 1
        F = tiny.fisher(gaussians, camera)
        alive.append(weakref.ref(F))
        return F

    run(tmp_path / "run", dataset, tiny.operations(fisher=fisher))
    assert len(alive) > 50


def test_random_depends_on_the_seed_only(dataset, tmp_path):
    one, same, other = (
        run(tmp_path / name, dataset, policy="random", seed=seed).taken
        for name, seed in {"a": 1, "b": 1, "c": 2}.items()
    )
    assert one == same != other


@pytest.mark.parametrize(
    ("moment", "count"),
    [
        ("fisher", 40),
        ("before the lines are written", 1),
        ("while the checkpoint is written", 3),
    ],
)
def test_a_killed_run_that_is_resumed_takes_the_same_views(
    dataset, tmp_path, uninterrupted, moment, count
):
    whole, ply, lines = uninterrupted
    out = tmp_path / "run"
    command = [sys.executable, tiny.__file__, dataset.root, out, moment, str(count)]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == -signal.SIGKILL, process.stderr
    half = run_folder.read_checkpoint(out)
    # The lines may be one behind the checkpoint, never ahead of it.
    committed = half.steps if half else []
    written = steps(out) if (out / "steps.jsonl").exists() else []
    assert written == committed[: len(written)]
    assert len(committed) - len(written) <= 1
    assert resume(out, dataset).taken == whole.taken
    assert timeless(steps(out)) == timeless(lines)
    assert (out / "gaussians.ply").read_bytes() == ply
    assert not list(out.glob(".*"))


@pytest.mark.parametrize(("batch", "fits", "kept"), [(1, 4, 3), (2, 3, 3)])
def test_an_interrupted_run_keeps_whole_batches(dataset, tmp_path, batch, fits, kept):
    """Interrupted in a fit, then resumed: the same views and model."""
    run(tmp_path / "whole", dataset, batch=batch)
    calls = []

    def fit(*arguments):
        calls.append(1)
        if len(calls) == fits:
            raise KeyboardInterrupt
        return tiny.fit(*arguments)

    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        run(out, dataset, tiny.operations(fit=fit), batch=batch)
    assert len(steps(out)) == kept
    resume(out, dataset)
    assert timeless(steps(out)) == timeless(steps(tmp_path / "whole"))
    assert (out / "gaussians.ply").read_bytes() == (tmp_path / "whole/gaussians.ply").read_bytes()


@pytest.mark.parametrize(
    ("images", "batch", "kept", "named"),
    [
        (3, 1, 0, "the fit to the seeds"),
        (7, 2, 3, "the fit of step 4 diverged.*; steps 0 to 2 are kept"),
    ],
)
def test_a_fit_that_diverges_ends_the_run_which_can_go_on(
    dataset, tmp_path, images, batch, kept, named
):
    def fit(gaussians, start, cameras, *rest):
        found = tiny.fit(gaussians, start, cameras, *rest)
        if len(cameras) < images:
            return found
        found.gaussians.sh[:] = np.nan
        return replace(found, losses=(0.01234, 0.5, math.nan), stop_reason=StopReason.DIVERGED)

    out = tmp_path / "run"
    with pytest.raises(InputError, match=named) as stop:
        run(out, dataset, tiny.operations(fit=fit), batch=batch)
    said = str(stop.value)
    assert "diverged: its loss was 0.0123 at the start, and 0.5, nan in the last passes" in said
    assert f"`train.rates` in {out / 'config.json'}" in said
    assert "\n" not in said
    assert ((out / "steps.jsonl").exists() and len(steps(out))) == kept
    run(tmp_path / "whole", dataset, batch=batch)
    resume(out, dataset)
    assert (out / "gaussians.ply").read_bytes() == (tmp_path / "whole/gaussians.ply").read_bytes()


def test_a_choice_takes_the_seconds_of_its_policy(dataset, tmp_path, monkeypatch):
    def slow(candidates, taken, centre, rng):
        time.sleep(0.05)
        return rng.random(len(candidates))

    monkeypatch.setitem(POSE_POLICIES, "slow", slow)
    state = run(tmp_path / "run", dataset, policy="slow", batch=2, budget=2)
    assert all(step["seconds"]["score"] >= 0.05 for step in state.steps[1:])


@pytest.mark.parametrize("score", [math.nan, math.inf])
def test_a_policy_that_returns_no_number_is_named(dataset, tmp_path, monkeypatch, score):
    monkeypatch.setitem(criteria.CRITERIA, "mine", criteria.Criterion(lambda F, H, lam: score))
    with pytest.raises(InputError, match="policy mine: returned a score that is NaN or infinite"):
        run(tmp_path / "run", dataset, policy="mine")
    assert len(steps(tmp_path / "run")) == 1


def test_a_run_of_other_frames_or_without_settings_is_named(dataset, tmp_path):
    out = tmp_path / "run"
    run(out, dataset, budget=0)
    other = tiny.write_dataset(tmp_path / "other", frames=5)
    change_settings(out, dataset=str(other))
    with pytest.raises(InputError, match="frames differ"):
        run_folder.open_run(out).dataset  # noqa: B018
    (out / "config.json").write_text("{}")
    with pytest.raises(InputError, match="no settings"):
        run_folder.open_run(out)
