"""The public names of `mgs`: present, lazy, typed, silent, and enough for the whole paper."""

from dataclasses import replace

import numpy as np
import pytest
import tiny
import trimesh
from program import python, stop_at
from refusals import fails, refused
from synthetic import pinhole

import mgs
from mgs.evaluation import render_view
from mgs.progress import listening

pytestmark = pytest.mark.usefixtures("coarse_priors")


def test_public_names_are_present_and_documented():
    values = {name: getattr(mgs, name) for name in mgs.__all__}
    assert [name for name, value in values.items() if not value.__doc__] == []
    assert all(value.__module__.startswith("mgs.") for value in values.values())
    assert set(values) <= set(dir(mgs))


def test_importing_loads_nothing_and_leaves_the_variant_alone():
    program = (
        "import sys, mgs; assert not {'mitsuba', 'drjit', 'numpy'} & set(sys.modules); mgs.render\n"
        "import mitsuba as mi; assert mi.variant() is None"
    )
    python(program, check=True)


def test_a_scene_needs_what_is_loaded(dataset, prior):
    for given in ((dataset, prior), (mgs.load_dataset(dataset), prior)):
        with pytest.raises(TypeError, match="load_prior"):
            mgs.Scene(*given)


def test_the_whole_way_from_python(dataset, prior, tmp_path, capsys):
    """Nothing is printed, callbacks are called, and the state is what the folder holds."""
    steps, stages = [], set()
    loaded, known = mgs.load_dataset(dataset), mgs.load_prior(prior)
    run = mgs.run_nbv(
        loaded,
        tmp_path / "run",
        prior=known,
        budget=2,
        seeds=3,
        policy="farthest",
        train={"passes": 2},
        on_step=lambda state: steps.append(len(state.taken)),
        progress=lambda stage, done, total: stages.add(stage),
    )
    assert capsys.readouterr() == ("", "")
    assert steps == [3, 4, 5]
    informed = {"information of the training set", "information of the surface"}
    assert {"fitting", *informed} <= stages
    stages.clear()
    with listening(lambda stage, *_: stages.add(stage)):
        mgs.run_nbv(dataset, tmp_path / "built", seeds=3, budget=0, train={"passes": 1})
    assert {"fitting", *informed, "surface samples"} <= stages
    assert mgs.read_ply(tmp_path / "run/gaussians.ply") == run.gaussians
    again = mgs.resume_nbv(tmp_path / "run")
    assert again.gaussians == run.gaussians
    assert again.state.taken == run.state.taken
    assert np.array_equal(again.prior.points, known.points)
    metrics = mgs.evaluate(run)
    assert metrics["images"] == 5
    taken = [frame.name for frame in run.taken]
    same = mgs.evaluate(run.gaussians, loaded, trained=taken)
    files = [mgs.evaluate(tmp_path / "run/gaussians.ply", given) for given in (None, dataset)]
    fails("has no frame typo", mgs.evaluate, run.gaussians, loaded, trained=[*taken, "typo"])
    for found in (same, *files):
        assert found["held_out"].items() <= metrics["held_out"].items()
    information = mgs.fisher(run.gaussians, loaded.frames[0].camera)
    assert information.shape == (tiny.POINTS, 11)
    assert isinstance(information, np.ndarray)
    already = r"run is there already; .* with `force`; `mgs nbv --resume "
    fails(already, mgs.run_nbv, dataset, tmp_path / "run", prior=prior)
    fails("^seeds = 0: ", mgs.run_nbv, dataset, tmp_path / "other", prior=prior, seeds=0)


def highest(candidates):
    """Score of each candidate: its height."""
    return candidates[:, 2] + 0.1 * candidates[:, 0]


def test_a_function_is_a_policy_that_a_resumed_run_asks_for(dataset, prior, tmp_path, capsys):
    out, given = tmp_path / "run", {"prior": prior, "seeds": 3, "train": {"passes": 1}}
    with pytest.raises(KeyboardInterrupt):
        mgs.run_nbv(dataset, out, policy=highest, budget=1, on_step=stop_at(), **given)
    assert (out / "policy.py").read_text().startswith("def highest(candidates):")
    fails(r"in Python: mgs\.resume_nbv\(.*policy=highest\)", mgs.resume_nbv, out)
    fails("is not the policy of", mgs.resume_nbv, out, policy=lambda candidates: candidates[:, 0])
    assert "its policy is a Python function" in refused(capsys, ["nbv", "--resume", out], out)
    run = mgs.resume_nbv(out, policy=highest)
    places = np.array([frame.camera.position for frame in run.dataset.frames])
    left = [i for i in range(len(places)) if i not in run.state.taken[:3]]
    assert run.state.taken[3] == max(left, key=lambda i: highest(places)[i])
    assert run.label == "highest"
    fails("parameter view", mgs.start_run, dataset, out / "x", policy=lambda view: 0, **given)
    (out / "policy.py").write_bytes(b"def highest(candidates): ...\xff")
    fails("policy highest: is not as", mgs.resume_nbv, out, policy=highest)


class Lowest:
    def __call__(self, candidates):
        return -candidates[:, 2]


def test_a_run_goes_on_with_an_equal_object(dataset, prior, tmp_path):
    one, other = Lowest(), Lowest()
    mgs.start_run(dataset, tmp_path / "run", prior=prior, seeds=3, budget=1, policy=one)
    assert len(mgs.resume_nbv(tmp_path / "run", policy=other).state.taken) == 4


def test_objects_are_short_in_text_and_have_pictures_in_notebooks(dataset, prior, tmp_path):
    loaded, known = mgs.load_dataset(dataset), mgs.load_prior(prior)
    begun = mgs.start_run(loaded, tmp_path / "begun", prior=known, seeds=3)
    given = {"prior": known, "seeds": 3, "budget": 0, "train": {"passes": 1}}
    run = mgs.run_nbv(loaded, tmp_path / "run", **given)
    for one, text, pictures in (
        (loaded, f"Dataset({dataset}: 12 frames, 16x12)", 6),
        (known, "Prior(40 points, 40 Gaussians, spacing 0.5 m)", 1),
        (begun, f"Run({tmp_path / 'begun'}: directional-i, 0 of 12 views)", 0),
        (run, f"Run({tmp_path / 'run'}: fit, 3 of 3 views)", 4),
        (run.gaussians, "Gaussians(40, SH degree 0)", 1),
        (mgs.render(run.gaussians, loaded.frames[0].camera), "Image(16x12)", 1),
    ):
        assert repr(one) == text
        assert one._repr_html_().startswith(f"<div>{text}</div>")
        assert one._repr_html_().count("<img") == pictures


def test_priors_and_normals_of_arrays(tmp_path):
    ball = trimesh.creation.icosphere(3)
    ball.export(tmp_path / "ball.ply")
    settings = mgs.PriorSettings(gaussians=300, backing=0)
    prior = mgs.prior_from_mesh((ball.vertices, ball.faces[:, ::-1]), settings)
    known = mgs.prior_from_mesh(tmp_path / "ball.ply", settings)
    np.testing.assert_allclose(prior.points, known.points, atol=1e-6)
    model, _ = mgs.initial_gaussians(prior, [])
    camera = pinhole(60, 48, 36, (3, 1, 1))
    image, found = mgs.render(model, camera), mgs.normals(model, camera)
    pixels = np.mgrid[:36, :48][::-1] + 0.5
    rays = (pixels - camera.K[:2, 2, None, None]) / 60 * np.asarray(image.depth)
    points = np.stack([*rays, image.depth], -1) @ camera.world_to_camera[:3, :3] + camera.position
    inside = np.asarray(image.alpha) > 0.9
    assert (found[np.asarray(image.alpha) == 0] == 0).all()
    assert (found[inside] * points[inside]).sum(1).mean() > 0.95
    fails("face 0 names vertex 9 of 3", mgs.prior_from_mesh, (np.eye(3), [[0, 1, 9]]), settings)


def test_a_fit_takes_a_loss_of_its_own_and_says_what_is_wrong_with_images(dataset):
    frames = mgs.load_dataset(dataset).frames[:2]
    model, cameras = tiny.initial([]), [frame.camera for frame in frames]
    images = [frame.rgb() for frame in frames]
    few = mgs.TrainSettings(passes=2, tolerance=0, loss="squared")

    def squared(drawn, pixels, weights, size, linear):
        return (drawn - pixels) * (drawn - pixels)

    own, usual = (mgs.fit_gaussians(model, cameras, images, few, loss=f) for f in (squared, None))
    assert own.gaussians == usual.gaussians
    doubled = mgs.fit_gaussians(model, cameras, images, few, loss=lambda *a: 2 * squared(*a))
    np.testing.assert_allclose(doubled.losses[0], 2 * usual.losses[0], rtol=1e-5)
    fails(r"target: .*\[12,16", mgs.fit_gaussians, model, cameras[:1], [np.ones((2, 2, 3))])
    fails("there are 2 cameras and 1 targets", mgs.fit_gaussians, model, cameras, images[:1])
    fails("there are 0 cameras", mgs.fit_gaussians, model, [], [], few)
    names = few.model_copy(update={"loss": "l1"})  # functions of the fits above are no names
    fails("choose one of squared, l1-dssim$", mgs.fit_gaussians, model, cameras, images, names)
    for wrong in ((images[0] * 255).astype(np.uint8), images[0] * np.nan):
        fails("target: is .*give finite floats", mgs.fit_gaussians, model, cameras[:1], [wrong])
    for option in ("lam", "learns"):
        typo = {option: {"color": 1.0}}
        fails("'color': unknown; choose", mgs.fit_gaussians, model, cameras, images, few, **typo)


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
    for taken in ((), (0, 0), (-1,), (12,)):
        fails("give different indices of the 12 frames", mgs.learn, scene, taken)
    fails("begin with those of `before`", mgs.learn, scene, state.taken[::-1], state)
    fails("0 seeds of 12 poses", scene.seeds, 0)


def test_a_loop_in_memory_takes_a_policy_as_a_run_does(dataset, prior):
    model = mgs.ModelSettings(train={"passes": 1})
    scene = mgs.Scene(mgs.load_dataset(dataset), mgs.load_prior(prior), model)
    mission = mgs.Mission(seeds=3, budget=1)
    *_, state = mgs.select_views(scene, highest, mission)
    left = [i for i in range(12) if i not in state.taken[:3]]
    assert state.taken[3] == max(left, key=lambda i: highest(scene.positions(scene.frames))[i])
    assert mgs.choose(scene, state, "random") == mgs.choose(scene, state, mgs.Random())
    state = replace(state, taken=tuple(range(12)))
    fails("no view is left to choose", mgs.choose, scene, state, highest)


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
        model = mgs.read_ply(tmp_path / space / "gaussians.ply")
        assert model == run.state.gaussians
        assert mgs.open_run(tmp_path / space).state.gaussians == model
        assert model.linear == (space == "linear")
        frame = run.taken[0]
        views[space] = render_view(model, frame.camera)[0]
        errors[space] = np.square(views[space] - frame.masked_rgb()).mean()
    assert errors["srgb"] < 2 * errors["linear"]
    assert not np.array_equal(*views.values())
    start, seen = mgs.initial_gaussians(run.prior, run.taken)
    displayed, _ = mgs.initial_gaussians(run.prior, run.taken, linear=False)
    linear = displayed.linear_rgb(displayed.rgb)
    np.testing.assert_allclose(linear[seen], start.rgb[seen], atol=1e-5)


@pytest.mark.usefixtures("coarse_rocks")
def test_the_whole_paper_in_a_few_calls(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mgs.reports.diagnostics.VIEWS", 1)
    rock = mgs.synth_orbit("rock", "boulder", frames=8, size=(48, 36), spp=1, test_views=2)
    prior = mgs.build_prior(rock, gaussians=200)
    model = mgs.ModelSettings(train={"passes": 2, "alpha_weight": 0.1}, warm_passes=1)
    scene = mgs.Scene(rock, prior, model)
    for policy in (mgs.Paper(), mgs.Directional()):
        run = mgs.nbv(scene, policy, seeds=4, budget=1, out=f"runs/{policy.name}")
        assert len(run.state.taken) == 5
        metrics = mgs.evaluate(run)
        assert metrics["test"]["count"] == 2
    assert mgs.diagnose(run)
    written = mgs.report("runs", "paper")
    assert {"table.md", "comparison.png"} <= {path.name for path in written}
