"""What it costs to go to a view: scores over costs, and the length of the path."""

from __future__ import annotations

import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from refusals import refused

from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.policy import criteria
from mgs.policy import poses as pose_policies
from mgs.run import folder as run_folder
from mgs.run import recording

METRES = st.floats(-100, 100)


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    return load_dataset(tiny.write_dataset(tmp_path_factory.mktemp("tiny") / "dataset"))


def run(out, dataset, **values) -> run_folder.State:
    return recording.run(
        out, tiny.start(out, dataset, **values), dataset, tiny.operations(), tiny.silent
    )


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
    assert pose_policies.travel_cost(here[None], here, travel) == 1, (
        "an image where the camera is costs one image"
    )
    scaled = pose_policies.travel_cost(factor * positions, factor * here, factor * travel)
    np.testing.assert_allclose(cost, scaled, rtol=1e-6, err_msg="whatever the unit of length")


@given(arrays(np.float64, (5, 3), elements=METRES))
def test_a_path_is_as_long_there_as_back_and_no_shorter_than_a_straight_line(positions):
    length = pose_policies.path_length(positions)
    assert length == pytest.approx(pose_policies.path_length(positions[::-1]))
    assert length >= np.linalg.norm(positions[-1] - positions[0]) - 1e-9
    assert length == pytest.approx(
        pose_policies.path_length(positions[:3]) + pose_policies.path_length(positions[2:])
    )
    assert pose_policies.path_length(positions[:1]) == 0


@pytest.mark.parametrize("travel", [0.01, 1.5])
@pytest.mark.parametrize("batch", [1, 2])
def test_the_choice_is_the_best_gain_for_its_cost(loaded, tmp_path, travel, batch):
    """With a short distance it is the gain per metre; the recorded score remains the policy's
    own."""
    state = run(tmp_path / "run", loaded, travel=travel, batch=batch, budget=2)
    seeds = run(tmp_path / "seeds", loaded, budget=0)
    first = run(tmp_path / "first", loaded, travel=travel, budget=1)
    lam, positions = (
        criteria.regularisation(tiny.GROUPS),
        np.array([camera.position for camera in tiny.orbit()]),
    )
    after_one = (first.gaussians, first.H)
    if batch == 2:
        F = tiny.fisher(seeds.gaussians, loaded.frames[first.taken[-1]].camera)
        after_one = (seeds.gaussians, seeds.H + F)
    for step, (model, H) in zip(
        state.steps[1:], [(seeds.gaussians, seeds.H), after_one], strict=True
    ):
        taken = state.taken[: step["images"] - 1]
        left = [i for i in range(len(loaded)) if i not in taken]
        gains = np.array(
            [criteria.d_optimal(tiny.fisher(model, loaded.frames[i].camera), H, lam) for i in left]
        )
        distance = np.linalg.norm(positions[left] - positions[taken[-1]], axis=1)
        worth = gains / (distance if travel == 0.01 else 1 + distance / travel)
        best = int(np.argmax(np.round(worth, 12)))
        assert worth[left.index(step["frame"])] == pytest.approx(worth[best], rel=0.01)
        assert (
            step["score"]
            == step["information_gain"]
            == pytest.approx(gains[left.index(step["frame"])])
        )


def test_dear_travel_makes_the_path_shorter_and_cheap_travel_changes_nothing(loaded, tmp_path):
    positions = np.array([frame.camera.position for frame in loaded.frames])
    paths, taken = {}, {}
    for travel in (None, 1e6, 0.1):
        taken[travel] = run(tmp_path / str(travel), loaded, travel=travel).taken
        paths[travel] = pose_policies.path_length(positions[taken[travel]])
    assert taken[None] == taken[1e6]
    assert paths[0.1] < paths[None]


def test_what_cannot_be_divided_by_a_cost_is_refused(loaded, tmp_path, monkeypatch):
    monkeypatch.setitem(
        pose_policies.POSE_POLICIES, "mine", lambda candidates, *rest: -np.ones(len(candidates))
    )
    with pytest.raises(
        InputError,
        match="policy mine: returned negative scores, which --travel cannot divide",
    ):
        run(tmp_path / "run", loaded, policy="mine", travel=1.0)
    assert len(run(tmp_path / "free", loaded, policy="mine").taken) == 8


@pytest.mark.parametrize(
    ("travel", "said"),
    [("0", "greater than or equal to"), ("-1", "greater"), ("nan", ""), ("far", "")],
)
def test_a_distance_that_is_none_is_one_line(dataset, prior, tmp_path, capsys, travel, said):
    line = refused(
        capsys, ["nbv", dataset, "--prior", prior, "--out", tmp_path / "run", "--travel", travel]
    )
    assert "--travel" in line
    assert said in line
    assert not (tmp_path / "run").exists()
