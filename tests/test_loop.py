"""The loop in a few lines of a user's own program takes the views of `mgs.run_nbv`."""

import numpy as np
import pytest

import mgs


@pytest.mark.parametrize("policy", [mgs.DOptimal(), mgs.Directional()], ids=lambda p: p.name)
def test_a_loop_in_memory_gives_the_same_views_and_gaussians(dataset, prior, tmp_path, policy):
    settings = {"policy": policy, "seeds": 3, "budget": 2, "train": {"passes": 3}}
    whole = mgs.run_nbv(dataset, tmp_path / "run", prior=prior, **settings).state
    model = mgs.ModelSettings(train={"passes": 3, "alpha_weight": 0.1})
    scene = mgs.Scene(mgs.load_dataset(dataset), mgs.load_prior(prior), model)
    state = mgs.learn(scene, scene.seeds(3))
    while len(state.taken) < 5:
        view, _ = mgs.choose(scene, state, policy, mgs.Mission(seeds=3, budget=2))
        state = mgs.learn(scene, (*state.taken, view), before=state)
    assert list(state.taken) == whole.taken
    np.testing.assert_array_equal(state.H, whole.H)
    np.testing.assert_array_equal(state.surface, whole.surface)
    assert state.gaussians == whole.gaussians
