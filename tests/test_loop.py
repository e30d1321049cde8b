"""The loop in a few lines of a user's own program takes the views of `mgs.run_nbv`."""

import numpy as np
import pytest

import mgs
from mgs.run.planning import surface_information


def loop_by_hand(run: mgs.Run) -> mgs.Fitted:
    """Fit, information, choose, again; the state after the last fit."""
    problem = mgs.problem_of(run)
    taken, new, state = problem.seeds, problem.seeds, None
    for _ in range(run.settings.budget + 1):
        if state is not None:
            new = [mgs.choose(problem, state)[0]]
            taken = [*state.taken, *new]
        fit = mgs.fit_views(problem, taken, state)
        state = mgs.Fitted(
            gaussians=fit.gaussians,
            H=mgs.information(problem, fit.gaussians, taken),
            surface=surface_information(problem, new, state),
            taken=taken,
        )
    return state


@pytest.mark.parametrize("policy", ["d-optimal", "directional-i"])
def test_a_loop_by_hand_gives_the_same_views_and_gaussians(dataset, prior, tmp_path, policy):
    settings = {"prior": prior, "policy": policy, "seeds": 3, "budget": 2, "train": {"passes": 3}}
    whole = mgs.run_nbv(dataset, tmp_path / "run", **settings).state
    ours = loop_by_hand(mgs.start_run(dataset, tmp_path / "hand", **settings))
    assert ours.taken == whole.taken
    np.testing.assert_array_equal(ours.H, whole.H)
    np.testing.assert_array_equal(ours.surface, whole.surface)
    assert ours.gaussians == whole.gaussians
