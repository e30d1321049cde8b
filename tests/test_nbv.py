"""The loop in a folder, on tests/tiny.py: single views, batches, nearby views, resumed runs."""

import json
import math
import shutil
import signal
import subprocess
import sys
import time
import weakref
from dataclasses import replace

import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from program import steps, timeless
from refusals import fails
from tiny import resume, run

from mgs import load_dataset, load_prior, read_ply
from mgs.fit.stopping import StopReason
from mgs.policy import criteria, poses
from mgs.run import folder as run_folder
from mgs.run import nbv, policies

OF_A_FIT = {"uncertainty", "iterations", "loss", "stop_reason"}


@pytest.fixture(scope="module")
def uninterrupted(loaded, tmp_path_factory):
    """A whole run, its PLY and its steps."""
    out = tmp_path_factory.mktemp("whole") / "run"
    return run(out, loaded, seed=3), (out / "gaussians.ply").read_bytes(), steps(out)


def test_a_fit_loads_its_prior_once_and_decides_its_own_start(
    dataset, prior, tmp_path, monkeypatch
):
    loads = []
    monkeypatch.setattr(nbv, "load_prior", lambda path: (loads.append(path), load_prior(path))[1])
    started = nbv.start_fit(dataset, tmp_path / "run", prior=prior)
    assert (loads, "prior" in vars(started)) == ([prior], True)
    for name, value in {"source": "hull", "loose": 1.0, "parts": 2.0, "live": None}.items():
        fails(f"fit: {name} is", nbv.start_fit, dataset, tmp_path / "other", **{name: value})


def test_views_are_the_best_at_the_model_and_given_the_batch_so_far(loaded, tmp_path):
    """Every view has the largest gain, given the information of those before it at one model."""
    before = run(tmp_path / "seeds", loaded, budget=0)
    state = run(tmp_path / "run", loaded, budget=3, batch=3)
    lam, taken = criteria.regularisation(tiny.GROUPS), list(before.taken)

    def information(model, views):
        return [tiny.fisher(model, loaded.frames[i].camera).astype(float) for i in views]

    H = before.H
    np.testing.assert_allclose(H, sum(information(before.gaussians, taken)))
    for line in state.steps[1:]:
        left = [i for i in range(len(loaded)) if i not in taken]
        F = information(before.gaussians, left)
        gains = [criteria.d_optimal(one, H, lam) for one in F]
        best = int(np.argmax(gains))
        assert line["frame"] == left[best]
        assert line["score"] == line["information_gain"] == gains[best]
        H, taken = H + F[best], [*taken, left[best]]
    np.testing.assert_allclose(state.H, sum(information(state.gaussians, taken)))


def test_fits_start_in_the_colours_of_all_images_taken(loaded, tmp_path):
    """The model moves with the prior's colours."""
    handed, fitted = [], []

    def initial(frames):
        g, count = tiny.initial(frames), np.float32(len(frames))
        return replace(g, sh=g.sh + count)

    def fit(gaussians, start, *others):
        handed.append((gaussians, start))
        found = tiny.fit(gaussians, start, *others)
        fitted.append(found.gaussians)
        return found

    run(tmp_path / "run", loaded, parts={"initial": initial, "fit": fit}, budget=2)
    assert len(handed) == 3
    for step, (model, start) in enumerate(handed):
        np.testing.assert_array_equal(start.sh, initial([None] * (3 + step)).sh)
        expected = start.sh if step == 0 else fitted[step - 1].sh + np.float32(1)
        np.testing.assert_allclose(model.sh, expected, atol=1e-5)
        np.testing.assert_array_equal(model.means, start.means)


def test_a_tie_goes_to_the_farthest_camera(loaded, tmp_path):
    """Views spread where every view sees everything and coverage has no preference."""
    same = {"fisher": lambda *_: np.ones((tiny.POINTS, 11), np.float32)}
    state = run(tmp_path / "run", loaded, parts=same, policy="coverage", seeds=1, budget=3)
    assert [line["score"] for line in state.steps[1:]] == [0, 0, 0]
    assert sorted(state.taken) == [0, 3, 6, 9]


@pytest.mark.parametrize(
    ("policy", "batch"), [("d-optimal", 1), *((name, 2) for name in policies.POLICIES)]
)
def test_a_run_reads_the_images_of_its_choices_and_writes_what_it_did(
    dataset, tmp_path, policy, batch
):
    """The files of a frame exist only once it, or its batch, is chosen."""
    known, hidden, made = load_dataset(dataset), dataset.rename(tmp_path / "hidden"), []

    def capture(frame):
        made.append(frame.name)
        for path in (frame.image_path, frame.depth_path, frame.mask_path):
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(hidden / path.relative_to(dataset), path)
        return frame

    parts = {"capture": capture}
    state = run(tmp_path / "run", known, parts=parts, policy=policy, batch=batch)
    names = [known.frames[i].name for i in state.taken]
    assert list(dict.fromkeys(made)) == names
    lines = steps(tmp_path / "run")
    assert [line["step"] for line in lines] == list(range(6))
    assert (lines[0]["seeds"], lines[0]["seed_names"]) == (state.taken[:3], names[:3])
    assert [line["frame"] for line in lines[1:]] == state.taken[3:]
    assert [line["name"] for line in lines[1:]] == names[3:]
    assert [line["images"] for line in lines] == list(range(3, 9))
    assert {"capture", "fit", "information"} <= set(lines[-1]["seconds"])
    config = json.loads((tmp_path / "run/config.json").read_text())
    assert config["settings"]["policy"] == policy
    assert {"mgs", "python", "mitsuba", "drjit", "numpy"} == set(config["versions"]) - {"commit"}
    model = read_ply(tmp_path / "run/gaussians.ply")
    np.testing.assert_array_equal(model.means, state.gaussians.means)


def test_one_candidate_in_memory_at_a_time(loaded, tmp_path):
    alive: list[weakref.ref] = []

    def fisher(gaussians, camera):
        assert sum(ref() is not None for ref in alive) <= 1
        F = tiny.fisher(gaussians, camera)
        alive.append(weakref.ref(F))
        return F

    run(tmp_path / "run", loaded, parts={"fisher": fisher})
    assert len(alive) > 50


def test_random_depends_on_the_seed_only(loaded, tmp_path):
    draws = [run(tmp_path / f"{k}", loaded, policy="random", seed=k // 2) for k in range(3)]
    one, same, other = (state.taken for state in draws)
    assert one == same != other


KILLS = {"fisher": 40, "before the lines are written": 1, "while the checkpoint is written": 3}


@pytest.mark.parametrize(("moment", "count"), KILLS.items())
def test_a_killed_run_that_is_resumed_takes_the_same_views(
    loaded, tmp_path, uninterrupted, moment, count
):
    whole, ply, lines = uninterrupted
    out = tmp_path / "run"
    command = [sys.executable, tiny.__file__, loaded.root, out, moment, str(count)]
    process = subprocess.run(command, capture_output=True, text=True)
    assert process.returncode == -signal.SIGKILL, process.stderr
    half = run_folder.read_checkpoint(out)
    # The lines may be one behind the checkpoint, never ahead of it.
    committed = half.steps if half else []
    written = steps(out) if (out / "steps.jsonl").exists() else []
    assert written == committed[: len(written)]
    assert len(committed) - len(written) <= 1
    assert resume(out, loaded).taken == whole.taken
    assert timeless(steps(out)) == timeless(lines)
    assert (out / "gaussians.ply").read_bytes() == ply
    assert not list(out.glob(".*"))


@pytest.mark.parametrize(
    ("images", "batch", "kept", "named"),
    [
        (3, 1, 0, "the fit to the seeds"),
        (7, 2, 3, "the fit of step 4 diverged.*; steps 0 to 2 are kept"),
    ],
)
def test_a_fit_that_diverges_ends_the_run_which_can_go_on(
    loaded, tmp_path, images, batch, kept, named
):
    def fit(gaussians, start, cameras, *rest):
        found = tiny.fit(gaussians, start, cameras, *rest)
        if len(cameras) < images:
            return found
        found.gaussians.sh[:] = np.nan
        return replace(found, losses=(0.01234, 0.5, math.nan), stop_reason=StopReason.DIVERGED)

    out = tmp_path / "run"
    said = fails(named, run, out, loaded, parts={"fit": fit}, batch=batch)
    assert "diverged: its loss was 0.0123 at the start, and 0.5, nan in the last passes" in said
    assert f"`train.rates` in {out / 'config.json'}" in said
    assert ((out / "steps.jsonl").exists() and len(steps(out))) == kept
    run(tmp_path / "whole", loaded, batch=batch)
    resume(out, loaded)
    assert (out / "gaussians.ply").read_bytes() == (tmp_path / "whole/gaussians.ply").read_bytes()


def test_a_choice_takes_the_seconds_of_its_policy(loaded, tmp_path, monkeypatch):
    def slow(candidates, taken, centre):
        time.sleep(0.05)
        return np.ones(len(candidates))

    monkeypatch.setitem(policies.POLICIES, "slow", policies.Poses("slow", slow))
    state = run(tmp_path / "run", loaded, policy="slow", batch=2, budget=2)
    assert all(step["seconds"]["score"] >= 0.05 for step in state.steps[1:])


@pytest.mark.parametrize("score", [math.nan, math.inf])
def test_a_policy_that_returns_no_number_is_named(loaded, tmp_path, monkeypatch, score):
    mine = policies.Information("mine", lambda F, H, lam: score)
    monkeypatch.setitem(policies.POLICIES, "mine", mine)
    fails("policy mine: .*NaN or infinite", run, tmp_path / "run", loaded, policy="mine")
    assert len(steps(tmp_path / "run")) == 1


def test_a_step_is_a_view_and_the_last_of_a_batch_has_its_fit(loaded, tmp_path):
    fits, seen = [], []

    def fit(gaussians, start, cameras, *rest):
        fits.append(len(cameras))
        return tiny.fit(gaussians, start, cameras, *rest)

    def on_step(state):
        seen.append(len(state.taken))

    out, values = tmp_path / "run", {"batch": 2, "evaluate_every": 3}
    state = run(out, loaded, on_step=on_step, parts={"fit": fit}, **values)
    assert fits == seen == [3, 5, 7, 8], "the budget of 5 views is no multiple of 2"
    lines = steps(out)
    assert [set(line) >= OF_A_FIT for line in lines] == [True, False, True, False, True, True]
    assert all(OF_A_FIT & set(line) in (set(), OF_A_FIT) for line in lines)
    # Step 3 is in the second batch, so it is evaluated at the end of that.
    assert ["psnr" in line for line in lines] == [True, False, False, False, True, False]
    covered, start = [line["coverage"] for line in lines], tiny.initial([])
    whole = sum(tiny.fisher(start, loaded.frames[i].camera).astype(float) for i in state.taken)
    assert covered[-1] == criteria.coverage(whole, criteria.regularisation(tiny.GROUPS))
    assert covered == sorted(covered)


@pytest.mark.parametrize("room", [1 << 30, 0], ids=["kept", "no room"])
def test_a_batch_measures_each_candidate_once_if_there_is_room(loaded, tmp_path, room):
    measured = []

    def fisher(gaussians, camera):
        measured.append((gaussians.sh.tobytes(), camera.key))
        return tiny.fisher(gaussians, camera)

    parts = {"fisher": fisher, "exact": tiny.fisher, "keep": room}
    views = {"budget": 6, "batch": 3, "policy": "d-optimal"}
    state = run(tmp_path / "run", loaded, parts=parts, **views)
    assert state.taken == run(tmp_path / "as before", loaded, **views).taken
    candidates = 9 + 6  # of two batches
    taken = 3 + 6 + 9  # views whose information is summed after three fits
    again = 0 if room else (8 + 7) + (5 + 4) + 6
    assert len(measured) == candidates + taken + again
    assert len(set(measured)) == candidates + taken


@pytest.mark.parametrize(
    ("policy", "nearest"), [("d-optimal", 3), *((name, None) for name in policies.POLICIES)]
)
def test_a_batch_counts_as_taken_for_every_policy(loaded, tmp_path, policy, nearest):
    """A batch has the views that are chosen one by one, where fits do not change the policy."""
    parts = {}
    if policies.POLICIES[policy].needs_fit:
        parts = {"fit": lambda g, *rest: tiny.Fit(g, 0.1, 1)}
    given = {"parts": parts, "policy": policy, "nearest": nearest}
    one, three = (run(tmp_path / str(n), loaded, **given, batch=n) for n in (1, 3))
    assert one.taken == three.taken
    for line, other in zip(one.steps[1:], three.steps[1:], strict=True):
        assert line["score"] == pytest.approx(other["score"], rel=1e-5, abs=1e-9)


def test_a_batch_ends_before_a_view_below_the_gain_limit(loaded, tmp_path):
    """The run ends only if the gain is below the limit at the model fitted to the batch, too."""
    whole = run(tmp_path / "whole", loaded, batch=3)
    gains = [line["information_gain"] for line in whole.steps[1:]]
    limit = (gains[1] + gains[2]) / 2
    assert gains[1] > limit > gains[2]
    state = run(tmp_path / "run", loaded, batch=3, stop_gain=limit)
    assert state.taken[:5] == whole.taken[:5]
    assert "loss" in state.steps[2]
    assert all(line["information_gain"] >= limit for line in state.steps[1:])
    ended = state.steps[-1]["ended"]
    assert (ended["reason"], ended["views"]) == ("gain", len(state.taken) - 3)
    assert ended["information_gain"] < limit
    assert len(state.taken) < len(whole.taken)


def metres(*shape):
    return arrays(np.float64, shape, elements=st.floats(-100, 100))


@given(metres(4, 3), metres(3), st.floats(0.1, 100), st.floats(0.1, 10))
def test_cost_of_an_image_and_of_the_way_to_it(positions, here, travel, factor):
    cost = poses.travel_cost(positions, here, travel)
    distance = np.linalg.norm(positions - here, axis=1)
    np.testing.assert_allclose(travel * (cost - 1), distance, atol=1e-6)
    assert (cost >= 1).all()
    assert poses.travel_cost(here[None], here, travel) == 1
    scaled = poses.travel_cost(factor * positions, factor * here, factor * travel)
    np.testing.assert_allclose(cost, scaled, rtol=1e-6)


@pytest.mark.parametrize("travel", [0.01, 1.5])
@pytest.mark.parametrize("batch", [1, 2])
def test_the_choice_is_the_best_gain_for_its_cost(loaded, tmp_path, travel, batch):
    """The recorded score is the policy's own. With 0.01 m, the gain per metre decides."""
    state = run(tmp_path / "run", loaded, travel=travel, batch=batch, budget=2)
    seeds = run(tmp_path / "seeds", loaded, budget=0)
    first = run(tmp_path / "first", loaded, travel=travel, budget=1)
    cameras = [frame.camera for frame in loaded.frames]
    positions = np.array([camera.position for camera in cameras])
    lam = criteria.regularisation(tiny.GROUPS)
    models = [(seeds.gaussians, seeds.H), (first.gaussians, first.H)]
    if batch == 2:
        F = tiny.fisher(seeds.gaussians, cameras[first.taken[-1]])
        models[1] = (seeds.gaussians, seeds.H + F)
    for step, (model, H) in zip(state.steps[1:], models, strict=True):
        taken = state.taken[: step["images"] - 1]
        left = [i for i in range(len(loaded)) if i not in taken]
        gains = np.array([criteria.d_optimal(tiny.fisher(model, cameras[i]), H, lam) for i in left])
        distance = np.linalg.norm(positions[left] - positions[taken[-1]], axis=1)
        worth = gains / (distance if travel == 0.01 else 1 + distance / travel)
        chosen = left.index(step["frame"])
        assert worth[chosen] == pytest.approx(worth.max(), rel=0.01)
        assert step["score"] == step["information_gain"] == pytest.approx(gains[chosen])


def test_what_cannot_be_divided_by_a_cost_is_refused(loaded, tmp_path, monkeypatch):
    negative = lambda candidates, *rest: -np.ones(len(candidates))  # noqa: E731
    monkeypatch.setitem(policies.POLICIES, "mine", policies.Poses("mine", negative))
    fails("negative scores", run, tmp_path / "run", loaded, policy="mine", travel=1.0)
    assert len(run(tmp_path / "free", loaded, policy="mine").taken) == 8


def test_moves_can_be_limited_to_the_nearest_poses(loaded, tmp_path):
    """Twelve poses on a circle; 0, 4 and 8 are seeds, so 7 and 9 are nearest to the last."""
    far = {"policy": "farthest", "budget": 6}
    state = run(tmp_path / "run", loaded, nearest=2, **far)
    positions = np.array([frame.camera.position for frame in loaded.frames])
    assert state.taken[3] in (7, 9)
    for step in range(3, 9):
        left = [i for i in range(12) if i not in state.taken[:step]]
        here = positions[state.taken[step - 1]]
        near = [left[k] for k in poses.nearest_poses(positions[left], here, 2)]
        assert len(near) == 2
        assert state.taken[step] in near
    free = run(tmp_path / "free", loaded, **far)
    wide = run(tmp_path / "wide", loaded, nearest=12, **far)
    assert wide.taken == free.taken != state.taken


def test_the_nearest_poses():
    positions = np.array([[0.0, 0, 0], [3, 0, 0], [1, 0, 0], [-1, 0, 0], [9, 0, 0]])
    for count, nearest in ((1, [0]), (2, [0, 2]), (3, [0, 2, 3]), (9, [0, 1, 2, 3, 4])):
        assert poses.nearest_poses(positions, np.zeros(3), count) == nearest
