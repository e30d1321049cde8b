"""The loop in a few lines of a user's own program takes the views of `mgs.run_nbv`."""

from pathlib import Path

import numpy as np
import pytest
import synthetic

import mgs
from mgs.gaussians import ARRAYS
from mgs.run.planning import surface_information


def loop_by_hand(run: mgs.Run) -> mgs.Fitted:
    """Fit, information, choose, again; the state after the last fit."""
    problem = mgs.problem_of(run)
    taken, state = list(problem.seeds), None
    for _ in range(run.settings.budget + 1):
        if state is not None:
            frame, _ = mgs.choose(problem, state)
            taken = [*state.taken, frame]
        new = taken[len(state.taken) :] if state else taken
        fit = mgs.fit_views(problem, taken, state)
        state = mgs.Fitted(
            gaussians=fit.gaussians,
            H=mgs.information(problem, fit.gaussians, taken),
            surface=surface_information(problem, new, state),
            taken=taken,
        )
    return state


@pytest.fixture(scope="module")
def rock(tmp_path_factory) -> Path:
    """A dataset of a rock with its prior."""
    root = tmp_path_factory.mktemp("rock")
    synthetic.write_dataset(root, synthetic.orbit_cameras(8, 48, 36))
    prior = mgs.prior_from_mesh(root / "rock.glb", mgs.PriorSettings(gaussians=200))
    mgs.save_prior(root / "prior", prior)
    return root


@pytest.mark.parametrize("policy", ["d-optimal", "directional-i"])
def test_a_loop_by_hand_gives_the_same_views_and_gaussians(rock, tmp_path, policy):
    settings = {"policy": policy, "seeds": 3, "budget": 2, "train": {"passes": 3}}
    whole = mgs.run_nbv(rock, tmp_path / "run", **settings).state
    ours = loop_by_hand(mgs.start_run(rock, tmp_path / "hand", **settings))
    assert ours.taken == whole.taken
    np.testing.assert_array_equal(ours.H, whole.H)
    np.testing.assert_array_equal(ours.surface, whole.surface)
    for name in ARRAYS:
        one, other = (getattr(state.gaussians, name) for state in (ours, whole))
        np.testing.assert_array_equal(one, other, err_msg=name)
