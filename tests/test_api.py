"""The public names of `mgs`: present, lazy, typed, and silent."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny

import mgs

ROOT = Path(__file__).parent.parent


def test_public_names_are_present_and_documented():
    values = {name: getattr(mgs, name) for name in mgs.__all__}
    assert [name for name, value in values.items() if not value.__doc__] == []
    assert all(value.__module__.startswith("mgs.") for value in values.values())
    assert set(values) <= set(dir(mgs))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'mgs' has no attribute 'rendr'"):
        _ = mgs.rendr


def test_importing_loads_nothing_and_leaves_the_variant_alone():
    program = (
        "import sys, mgs; assert not {'mitsuba', 'drjit', 'numpy'} & set(sys.modules); mgs.render\n"
        "import mitsuba as mi; assert mi.variant() is None"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_no_module_hides_behind_a_function_of_its_name():
    """Else `mgs.splat.render` is a function or a module, as it was imported."""
    for folder in {path.parent for path in (ROOT / "mgs").rglob("*.py")}:
        package = ".".join(folder.relative_to(ROOT).parts)
        module = __import__(package, fromlist=["_"])
        for path in folder.glob("*.py"):
            if path.stem != "__init__" and path.stem != "__main__":
                found = getattr(module, path.stem, None)
                assert found is None or found.__class__.__name__ == "module", (
                    f"{package}.{path.stem}"
                )


def test_the_whole_way_from_python(dataset, prior, tmp_path, capsys):
    """Nothing is printed, callbacks are called, and the state is what the folder holds."""
    steps, stages = [], set()
    state = mgs.run_nbv(
        dataset,
        tmp_path / "run",
        prior=prior,
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
    assert mgs.read_ply(tmp_path / "run/gaussians.ply") == state.gaussians
    again = mgs.resume_nbv(tmp_path / "run")
    assert again.gaussians == state.gaussians
    assert again.taken == state.taken
    frames = mgs.load_dataset(dataset).frames
    metrics = mgs.evaluate(state.gaussians, frames, [frames[i].name for i in state.taken])
    assert metrics["images"] == 5
    information = mgs.fisher(state.gaussians, frames[0].camera)
    assert information.shape == (tiny.POINTS, 11)
    assert isinstance(information, np.ndarray)
    with pytest.raises(mgs.InputError, match="holds a run"):
        mgs.run_nbv(dataset, tmp_path / "run", prior=prior)
