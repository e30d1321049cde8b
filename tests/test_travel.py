"""Moves from view to view: scores over travel costs, path lengths, nearest poses."""

import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tiny import run

from mgs.errors import InputError
from mgs.policy import criteria
from mgs.policy import poses as pose_policies

METRES = st.floats(-100, 100)


@given(
    arrays(np.float64, (4, 3), elements=METRES),
    arrays(np.float64, 3, elements=METRES),
    st.floats(0.1, 100),
    st.floats(0.1, 10),
)
def test_cost_of_an_image_and_of_the_way_to_it(positions, here, travel, factor):
    cost = pose_policies.travel_cost(positions, here, travel)
    distance = np.linalg.norm(positions - here, axis=1)
    np.testing.assert_allclose(travel * (cost - 1), distance, atol=1e-6)
    assert (cost >= 1).all()
    assert pose_policies.travel_cost(here[None], here, travel) == 1
    scaled = pose_policies.travel_cost(factor * positions, factor * here, factor * travel)
    np.testing.assert_allclose(cost, scaled, rtol=1e-6)


@pytest.mark.parametrize("travel", [0.01, 1.5])
@pytest.mark.parametrize("batch", [1, 2])
def test_the_choice_is_the_best_gain_for_its_cost(loaded, tmp_path, travel, batch):
    """The recorded score remains the policy's own. With travel = 0.01 m, the gain per metre
    decides."""
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
    monkeypatch.setitem(pose_policies.POSE_POLICIES, "mine", negative)
    with pytest.raises(InputError, match="policy mine: returned negative scores, which travel"):
        run(tmp_path / "run", loaded, policy="mine", travel=1.0)
    assert len(run(tmp_path / "free", loaded, policy="mine").taken) == 8


def test_moves_can_be_limited_to_the_nearest_poses(loaded, tmp_path):
    """Twelve poses on a circle; 0, 4 and 8 are seeds, so 7 and 9 are nearest to the last."""
    given = {"policy": "farthest", "budget": 6}
    state = run(tmp_path / "run", loaded, nearest=2, **given)
    positions = np.array([frame.camera.position for frame in loaded.frames])
    assert state.taken[3] in (7, 9)
    for step in range(3, 9):
        left = [i for i in range(12) if i not in state.taken[:step]]
        here = positions[state.taken[step - 1]]
        near = [left[k] for k in pose_policies.nearest_poses(positions[left], here, 2)]
        assert len(near) == 2
        assert state.taken[step] in near
    free = run(tmp_path / "free", loaded, **given)
    wide = run(tmp_path / "wide", loaded, nearest=12, **given)
    assert wide.taken == free.taken != state.taken


@pytest.mark.parametrize(
    ("count", "nearest"),
    [(1, [0]), (2, [0, 2]), (3, [0, 2, 3]), (9, [0, 1, 2, 3, 4])],
)
def test_the_nearest_poses(count, nearest):
    """Ties go to the first pose."""
    positions = np.array([[0.0, 0, 0], [3, 0, 0], [1, 0, 0], [-1, 0, 0], [9, 0, 0]])
    assert pose_policies.nearest_poses(positions, np.zeros(3), count) == nearest
