"""The public names of `mgs`: present, lazy, typed, and silent."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny
from refusals import refused

import mgs

ROOT = Path(__file__).parent.parent


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
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


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
    with pytest.raises(mgs.InputError, match="has no frame typo"):
        mgs.evaluate(run.gaussians, loaded, trained=[*taken, "typo"])
    for found in (same, *files):
        assert found["held_out"].items() <= metrics["held_out"].items()
    information = mgs.fisher(run.gaussians, loaded.frames[0].camera)
    assert information.shape == (tiny.POINTS, 11)
    assert isinstance(information, np.ndarray)
    with pytest.raises(
        mgs.InputError, match=r"run is there already; .* with `force`; `mgs nbv --resume "
    ):
        mgs.run_nbv(dataset, tmp_path / "run", prior=prior)
    with pytest.raises(mgs.InputError, match=r"^seeds = 0: must be at least 1"):
        mgs.run_nbv(dataset, tmp_path / "other", prior=prior, seeds=0)


def highest(candidates):
    """Score of each candidate: its height."""
    return candidates[:, 2] + 0.1 * candidates[:, 0]


def test_a_function_is_a_policy_that_a_resumed_run_asks_for(dataset, prior, tmp_path, capsys):
    out, given = tmp_path / "run", {"prior": prior, "seeds": 3, "train": {"passes": 1}}

    def stop(state):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mgs.run_nbv(dataset, out, policy=highest, budget=1, on_step=stop, **given)
    assert (out / "policy.py").read_text().startswith("def highest(candidates):")
    with pytest.raises(mgs.InputError, match=r"in Python: mgs\.resume_nbv\(.*policy=highest\)"):
        mgs.resume_nbv(out)
    with pytest.raises(mgs.InputError, match="is not the policy of"):
        mgs.resume_nbv(out, policy=lambda candidates: candidates[:, 0])
    assert "its policy is a Python function" in refused(capsys, ["nbv", "--resume", out], out)
    run = mgs.resume_nbv(out, policy=highest)
    places = np.array([frame.camera.position for frame in run.dataset.frames])
    left = [i for i in range(len(places)) if i not in run.state.taken[:3]]
    assert run.state.taken[3] == max(left, key=lambda i: highest(places)[i])
    assert run.label == "highest"
    with pytest.raises(mgs.InputError, match="unknown parameter view"):
        mgs.start_run(dataset, tmp_path / "wrong", policy=lambda view: 0, **given)
    (out / "policy.py").write_text("def highest(candidates): ...")
    with pytest.raises(mgs.InputError, match="policy highest: is not as"):
        mgs.resume_nbv(out, policy=highest)


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
