"""Why a run ends, and what a resumed run needs: its prior, poses and files as they were."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
import tiny
from hypothesis import given
from hypothesis import strategies as st
from program import change_settings
from refusals import fails
from tiny import resume, run

from mgs import load_dataset
from mgs.policy import criteria
from mgs.run import folder as run_folder
from mgs.run.ending import run_end
from mgs.run.settings import NbvSettings


@pytest.fixture(scope="module")
def spent(whole):
    """The last state of a run that spent its budget of 5 views."""
    return run_folder.open_run(whole).state


def never(*arguments):
    raise AssertionError("a run that has ended computes nothing")


NUMBERS = st.floats(1e-3, 1 - 1e-3)


@given(
    views=st.integers(0, 5),
    uncertainty=NUMBERS,
    gain=NUMBERS,
    limits=st.tuples(*[st.none() | NUMBERS] * 3),
    predicted=st.none() | NUMBERS,
)
def test_the_first_rule_that_holds_is_the_reason(views, uncertainty, gain, limits, predicted):
    stop_uncertainty, stop_gain, stop_psnr = limits
    limit = {"stop_uncertainty": stop_uncertainty, "stop_gain": stop_gain, "stop_psnr": stop_psnr}
    settings = NbvSettings(dataset=".", prior=".", budget=3, **limit)
    refused = {"name": "kf_0001", "information_gain": gain}
    found = run_end(settings, views, uncertainty, refused, None, predicted)
    holds = {
        "budget": views >= 3,
        "uncertainty": stop_uncertainty is not None and uncertainty <= stop_uncertainty,
        "psnr": None not in (stop_psnr, predicted) and predicted >= stop_psnr,
        "gain": stop_gain is not None and gain < stop_gain,
    }
    reason = next((reason for reason, held in holds.items() if held), None)
    assert (found and found["reason"]) == reason
    # What was recorded is enough to find the same again.
    assert run_end(settings, views, uncertainty, found, None, predicted) == found
    unknown = run_end(settings, views, uncertainty, None, None, predicted)
    assert unknown == (None if reason == "gain" else found)


def test_uncertainty_is_the_variance_left_over_that_of_the_prior():
    rng = np.random.default_rng(0)
    H, lam, noise = rng.exponential(size=(5, 11)), rng.exponential(size=11), 0.3
    posterior, prior = noise**2 / (H + lam), noise**2 / lam
    np.testing.assert_allclose(criteria.uncertainty(H, lam), (posterior / prior).mean(axis=1))
    assert (criteria.uncertainty(np.zeros_like(H), lam) == 1).all()
    assert (criteria.uncertainty(H + 1e-6, lam) < criteria.uncertainty(H, lam)).all()


@pytest.mark.parametrize("rule", ["stop_gain", "stop_uncertainty", "budget"])
def test_a_run_that_ended_goes_on_only_when_its_rule_is_changed(loaded, spent, tmp_path, rule):
    two, three = spent.steps[2:4]
    assert two["uncertainty"] > three["uncertainty"]
    limit, left = (two["information_gain"] + three["information_gain"]) / 2, two["uncertainty"]
    next_view = {"name": three["name"], "information_gain": three["information_gain"]}
    value, changed, reason, numbers = {
        "stop_gain": (limit, None, "gain", {**next_view, "limit": limit}),
        "stop_uncertainty": (left, None, "uncertainty", {"uncertainty": left, "limit": left}),
        "budget": (2, 5, "budget", {}),
    }[rule]
    out = tmp_path / "run"
    state = run(out, loaded, **{rule: value})
    assert state.taken == spent.taken[:5]
    assert "ended" not in state.steps[-2]
    assert state.steps[-1]["ended"] == {"reason": reason, "views": 2, **numbers}
    assert three["name"] not in state.inputs["files"], "the image of a view that was refused"
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    again = resume(out, loaded, fit=never, fisher=never)
    assert again.taken == state.taken
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    change_settings(out, **{rule: changed})
    last = resume(out, loaded)
    assert last.taken == spent.taken
    assert ["ended" in line for line in last.steps] == [False] * 5 + [True]
    np.testing.assert_array_equal(last.gaussians.sh, spent.gaussians.sh)


def other_image(root: Path, name: str) -> None:
    """Replace the image of a frame by that of frame 1."""
    shutil.copy(root / "images/kf_0001.png", root / f"images/{name}.png")


def edit(root: Path, name: str, x: float = 0, **values) -> None:
    """Change a frame's entries in transforms.json, and move its camera by x metres."""

    def change(data):
        record = next(record for record in data["frames"] if name in record["file_path"])
        record["transform_matrix"][0][3] += x
        record.update(values)

    synthetic.edit(root, change)


OTHER = "images/kf_0000.png"
CHANGES = {
    r"images/kf_0004\.png has changed since .*run took it": lambda d: other_image(d, "kf_0004"),
    r"depth/kf_0000\.exr has changed": lambda d: (d / "depth/kf_0000.exr").write_bytes(b"other"),
    r"images/kf_0000\.png has changed": lambda d: edit(d, "kf_0004", rock_file_path=OTHER),
    "the mask of frame kf_0000 has changed": lambda d: edit(d, "kf_0000", mask_path=None),
    "the camera of frame kf_0005 has changed": lambda d: edit(d, "kf_0005", x=1e-6),
}
"""Message, and change of the dataset. Of 12 frames on a circle 0, 4 and 8 are the seeds."""


@pytest.fixture
def half_done(dataset, tmp_path):
    """A dataset and a run of three steps of six."""
    loaded, out = load_dataset(dataset), tmp_path / "run"
    settings = tiny.start(out, loaded).model_copy(update={"budget": 2})
    tiny.go(out, settings, loaded)
    return dataset, out


@pytest.mark.parametrize("message", CHANGES)
def test_a_run_does_not_go_on_from_changed_inputs(half_done, message):
    root, out = half_done
    CHANGES[message](root)
    before = (out / "steps.jsonl").read_text()
    fails(message, tiny.resume, out, load_dataset(root))
    assert (out / "steps.jsonl").read_text() == before


def test_a_run_goes_on_where_images_of_candidates_changed(half_done):
    """And where the dataset moved: config.json names its new folder."""
    root, out = half_done
    taken = run_folder.read_checkpoint(out).taken
    for i in set(range(tiny.FRAMES)) - {1, *taken}:
        other_image(root, f"kf_{i:04d}")
    moved = root.rename(root.parent / "elsewhere")
    change_settings(out, dataset=str(moved))
    assert len(tiny.resume(out, load_dataset(moved)).steps) == 6


def test_a_run_does_not_go_on_from_other_initial_gaussians(half_done):
    root, out = half_done

    def initial(frames):
        g = tiny.initial(frames)
        return replace(g, means=g.means + np.float32(0.01))

    fails("is not the prior that .*run", tiny.resume, out, load_dataset(root), initial=initial)
