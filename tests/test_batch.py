"""Views chosen together, before their images are read (more in test_nbv.py)."""

import pytest
import tiny
from program import steps
from tiny import run

from mgs.policy import criteria
from mgs.policy.registry import policy_names
from mgs.run import problem, recording

OF_A_FIT = {"uncertainty", "iterations", "loss", "stop_reason"}
AT_THE_MODEL = {"d-optimal", "t-optimal", "a-optimal", "e-optimal", "fisherrf"}
AT_THE_MODEL |= {"i-optimal", "block-d", "paper"}
"""Policies that use information at the fitted model."""


def test_a_step_is_a_view_and_the_last_of_a_batch_has_its_fit(loaded, tmp_path):
    fits, seen = [], []

    def fit(gaussians, start, cameras, *rest):
        fits.append(len(cameras))
        return tiny.fit(gaussians, start, cameras, *rest)

    def on_step(state):
        seen.append(len(state.taken))

    out, parts = tmp_path / "run", tiny.operations(fit=fit)
    settings = tiny.start(out, loaded, batch=2, evaluate_every=3)
    state = recording.run(out, settings, loaded, parts, tiny.silent, on_step)
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
def test_a_batch_measures_each_candidate_once_if_there_is_room(loaded, tmp_path, monkeypatch, room):
    measured = []

    def fisher(gaussians, camera):
        measured.append((gaussians.sh.tobytes(), camera.key))
        return tiny.fisher(gaussians, camera)

    monkeypatch.setattr(problem, "VIEW_BYTES", room)
    parts = tiny.operations(fisher=fisher, exact=tiny.fisher)
    views = {"budget": 6, "batch": 3, "policy": "d-optimal"}
    state = run(tmp_path / "run", loaded, parts, **views)
    assert state.taken == run(tmp_path / "as before", loaded, **views).taken
    candidates = 9 + 6  # of two batches
    taken = 3 + 6 + 9  # views whose information is summed after three fits
    again = 0 if room else (8 + 7) + (5 + 4) + 6
    assert len(measured) == candidates + taken + again
    assert len(set(measured)) == candidates + taken


@pytest.mark.parametrize(
    ("policy", "nearest"), [("d-optimal", 3), *((name, None) for name in policy_names())]
)
def test_a_batch_counts_as_taken_for_every_policy(loaded, tmp_path, policy, nearest):
    """A batch has the views that are chosen one by one, where fits do not change the policy."""
    assert set(policy_names()) >= AT_THE_MODEL
    parts = tiny.operations()
    if policy in AT_THE_MODEL:
        parts = tiny.operations(fit=lambda g, *rest: tiny.Fit(g, 0.1, 1))
    one, three = (
        run(tmp_path / str(batch), loaded, parts, policy=policy, nearest=nearest, batch=batch)
        for batch in (1, 3)
    )
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
