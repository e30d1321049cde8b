"""The loop, and the whole paper, in a few lines of a user's own program."""

import numpy as np
import pytest

import mgs
from mgs import initial_gaussians, read_ply
from mgs.evaluation import render_view


def test_a_loop_in_memory_gives_the_same_views_and_gaussians(dataset, prior, tmp_path):
    policy = mgs.Directional()
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


def test_a_run_from_a_prior_in_memory_goes_on_from_its_folder(dataset, tmp_path):
    """Points of files are float32: a run takes its prior as its folder holds it."""
    model = mgs.ModelSettings(train={"passes": 3})
    scene = mgs.Scene(mgs.load_dataset(dataset), mgs.build_prior(dataset, gaussians=300), model)
    for budget, out in ((1, "short"), (2, "whole")):
        mgs.nbv(scene, mgs.Uniform(), out=tmp_path / out, seeds=3, budget=budget)
    config = tmp_path / "short/config.json"
    config.write_text(config.read_text().replace('"budget": 1', '"budget": 2'))
    again, whole = mgs.resume_nbv(tmp_path / "short"), mgs.open_run(tmp_path / "whole")
    assert again.gaussians == whole.state.gaussians
    like = mgs.scene_of(again)
    assert mgs.scene_of(again, like=like) is like
    assert mgs.scene_of(whole, like=like) is not like  # its prior is another folder


def test_a_run_that_blends_srgb(dataset, prior, tmp_path):
    """Pictures and PSNR are like those of a linear run; its PLY says that it holds sRGB."""
    views, errors = {}, {}
    for space in ("linear", "srgb"):
        train = {"passes": 8, "space": space}
        common = {"prior": prior, "policy": "uniform", "seeds": 3, "budget": 2, "train": train}
        run = mgs.run_nbv(dataset, tmp_path / space, **common)
        model = read_ply(tmp_path / space / "gaussians.ply")
        assert model == run.state.gaussians
        assert mgs.open_run(tmp_path / space).state.gaussians == model
        assert model.linear == (space == "linear")
        frame = run.taken[0]
        views[space] = render_view(model, frame.camera)[0]
        errors[space] = np.square(views[space] - frame.masked_rgb()).mean()
    assert errors["srgb"] < 2 * errors["linear"]
    assert not np.array_equal(*views.values())
    start, seen = initial_gaussians(run.prior, run.taken)
    displayed, _ = initial_gaussians(run.prior, run.taken, linear=False)
    linear = displayed.linear_rgb(displayed.rgb)
    np.testing.assert_allclose(linear[seen], start.rgb[seen], atol=1e-5)


@pytest.mark.usefixtures("coarse_rocks", "coarse_priors")
def test_the_whole_paper_in_a_few_calls(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mgs.reports.diagnostics.VIEWS", 1)
    rock = mgs.synth_orbit("rock", "boulder", frames=8, size=(64, 48), spp=1, test_views=2)
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
