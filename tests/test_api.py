"""The public names of `mgs`: present, lazy, typed, and silent."""

import numpy as np
import pytest
import tiny
import trimesh
from program import python, stop_at
from refusals import fails, refused
from synthetic import pinhole

import mgs
from mgs.progress import listening


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
    assert {"fitting", "information of the training set"} <= stages
    stages.clear()
    with listening(lambda stage, *_: stages.add(stage)):
        mgs.run_nbv(dataset, tmp_path / "built", seeds=3, budget=0, train={"passes": 1})
    assert {"fitting", "information of the training set", "surface samples"} <= stages
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
    (out / "policy.py").write_text("def highest(candidates): ...")
    fails("policy highest: is not as", mgs.resume_nbv, out, policy=highest)


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
    fails("there are 2 cameras, but 1 targets", mgs.fit_gaussians, model, cameras, images[:1])
