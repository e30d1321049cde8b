"""The whole paper in a few calls, at a small size: rock, prior, views by five policies, report."""

import pytest

import mgs


@pytest.mark.usefixtures("coarse_priors")
def test_the_whole_paper_in_a_few_calls(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rock = mgs.synth_orbit("rock", "boulder", frames=10, size=(64, 48), spp=1, test_views=2)
    prior = mgs.build_prior(rock, gaussians=300)
    model = mgs.ModelSettings(train={"passes": 3, "alpha_weight": 0.1}, warm_passes=2)
    scene = mgs.Scene(rock, prior, model)
    policies = mgs.Paper(), mgs.DOptimal(), mgs.Coverage(), mgs.Directional(), mgs.Uniform()
    for policy in policies:
        run = mgs.nbv(scene, policy, seeds=4, budget=2, out=f"runs/{policy.name}")
        assert len(run.state.taken) == 6
        metrics = mgs.evaluate(run)
        assert metrics["test"]["count"] == 2
        assert mgs.diagnose(run)
    written = mgs.report("runs", "paper")
    assert {"table.md", "comparison.png"} <= {path.name for path in written}

    mission, state = mgs.Mission(seeds=4, budget=2), mgs.learn(scene, scene.seeds(4))
    while len(state.taken) < 6:
        view, _ = mgs.choose(scene, state, mgs.DOptimal(), mission)
        state = mgs.learn(scene, (*state.taken, view), before=state)
    chosen = mgs.open_run("runs/d-optimal").state
    assert list(state.taken) == chosen.taken
    assert state.gaussians == chosen.gaussians
