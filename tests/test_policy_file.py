"""Policies in files of the user's own, and moves to the nearest poses only."""

from __future__ import annotations

import json

import numpy as np
import pytest
import tiny

import mgs
from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.policy import criteria
from mgs.policy import from_file as policy_file
from mgs.policy import poses as pose_policies
from mgs.policy.registry import check_policy, policy_named
from mgs.report.runs import read_run
from mgs.run import loop
from mgs.run.nbv import start_run
from mgs.run.settings import NbvSettings

FUNCTIONS = """
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

def poses(candidates, taken):
    return np.linalg.norm(candidates[:, None] - taken, axis=2).min(axis=1).round(9)

def information(F, H, lam):
    return float(np.log1p(F / (H + lam)).mean(dtype=np.float64))

def surface(surface_F, surface_H, prior_lam):
    seen = lambda H: (H[:, :3] > prior_lam[:3]).any(axis=1)
    return float((seen(surface_H + surface_F) & ~seen(surface_H)).sum())

def draw(rng, candidates):
    return rng.random(len(candidates))

def everything(context, seen, seen_taken, points, candidate, centre):
    assert seen.shape == (len(context.candidate_frames), len(points))
    assert seen_taken.shape == (len(context.taken_frames), len(points))
    assert len(context.dome().positions) == len(context.dome().seen)
    return float(candidate[2] - centre[2])

def wrong(F, photos):
    return 0.0

@dataclass
class Height:
    weight: float

    def __call__(self, candidates: np.ndarray) -> np.ndarray:
        return self.weight * candidates[:, 2]

def higher(candidates):
    return Height(2.0)(candidates)

def broken(candidates):
    return 1 / 0

def few(candidates):
    return [1.0]

number = 3
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "mine.py").write_text(FUNCTIONS)
    return tmp_path / "mine.py"


def run(out, dataset, **values):
    settings = tiny.start(out, dataset, **({"budget": 3} | values))
    return loop.run(out, settings, dataset, tiny.stations(), tiny.silent)


@pytest.mark.parametrize(
    ("function", "same"),
    [("poses", "farthest"), ("information", "d-optimal"), ("surface", "coverage")],
)
def test_a_function_is_told_what_it_asks_for(dataset, file, tmp_path, function, same):
    loaded = load_dataset(dataset)
    ours = run(tmp_path / "ours", loaded, policy=f"{file}:{function}")
    theirs = run(tmp_path / "theirs", loaded, policy=same)
    assert ours.taken == theirs.taken
    assert [step["score"] for step in ours.steps] == [step["score"] for step in theirs.steps]


def test_a_function_can_ask_for_everything(dataset, file, tmp_path):
    state = run(tmp_path / "run", load_dataset(dataset), policy=f"{file}:everything")
    assert [step["score"] for step in state.steps[1:]] == pytest.approx([1.5] * 3)


def test_a_file_can_hold_classes(dataset, file, tmp_path):
    state = run(tmp_path / "run", load_dataset(dataset), policy=f"{file}:higher", budget=1)
    assert state.steps[1]["score"] == pytest.approx(2 * tiny.orbit()[state.taken[-1]].position[2])


def test_draws_do_not_depend_on_the_folder_of_the_file(dataset, file, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/mine.py").write_text(FUNCTIONS)
    paths = (file, tmp_path / "elsewhere/mine.py")
    runs = [
        run(tmp_path / f"run{i}", load_dataset(dataset), policy=f"{path}:draw")
        for i, path in enumerate(paths)
    ]
    assert runs[0].taken == runs[1].taken


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("mine.py:nothing", r"has no function nothing"),
        ("mine.py:number", r"has no function number"),
        (
            "mine.py:wrong",
            r"unknown parameter photos; choose from F, ",
        ),
        ("missing.py:poses", r"no such file .*missing\.py; correct the path"),
        ("bad.py:poses", r"line 2 of .*bad\.py failed: SyntaxError"),
        (
            "worse.py:poses",
            r"line 3 of .*worse\.py failed: ModuleNotFoundError: No module named 'nothing_like_it'",
        ),
    ],
)
def test_a_policy_that_cannot_be_loaded_is_one_line(dataset, file, tmp_path, name, message):
    (tmp_path / "bad.py").write_text("x = 1\ndef (:\n")
    (tmp_path / "worse.py").write_text("\n\nimport nothing_like_it\n")
    with pytest.raises(InputError, match=message) as found:
        mgs.run_nbv(
            dataset,
            tmp_path / "run",
            prior=tiny.write_prior(tmp_path / "prior"),
            policy=str(tmp_path / name),
        )
    assert "\n" not in str(found.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("broken", r"line 41 of .*mine\.py failed: ZeroDivisionError: division by zero"),
        ("few", r"gave scores of shape \(1,\) to 9 candidates"),
    ],
)
def test_a_policy_that_fails_keeps_the_steps_before(dataset, file, tmp_path, function, message):
    with pytest.raises(InputError, match=message):
        run(tmp_path / "run", load_dataset(dataset), policy=f"{file}:{function}")
    assert len((tmp_path / "run/steps.jsonl").read_text().splitlines()) == 1


def test_a_run_goes_on_with_the_same_file_only(dataset, file, tmp_path, monkeypatch):
    """The path is kept whole, and is left out where the run is named."""
    prior, out = tiny.write_prior(tmp_path / "prior"), tmp_path / "run"
    monkeypatch.chdir(tmp_path)
    start_run(dataset, out, prior=prior, policy="mine.py:poses", budget=3, seeds=3)
    config = json.loads((out / "config.json").read_text())
    assert config["settings"]["policy"] == f"{file}:poses"
    run(tmp_path / "half", load_dataset(dataset), policy=f"{file}:poses", budget=1)
    assert read_run(tmp_path / "half").policy == "mine.py:poses"
    file.write_text(FUNCTIONS + "\n")
    settings = NbvSettings(
        dataset=dataset, prior=dataset, budget=2, seeds=3, policy=f"{file}:poses"
    )
    with pytest.raises(
        InputError, match=r"mine\.py:poses: its file has changed since .*half was started"
    ):
        loop.run(tmp_path / "half", settings, load_dataset(dataset), tiny.stations(), tiny.silent)
    file.write_text(FUNCTIONS)
    state = loop.run(
        tmp_path / "half", settings, load_dataset(dataset), tiny.stations(), tiny.silent
    )
    assert len(state.taken) == 5


def test_names_in_files_and_in_tables():
    assert policy_file.absolute("d-optimal") == policy_file.label("d-optimal") == "d-optimal"
    assert policy_file.label("/a/b/mine.py:best") == "mine.py:best"
    with pytest.raises(InputError, match=r"--policy mine\.py: unknown; choose one of d-optimal"):
        policy_named("mine.py")


def test_moves_can_be_limited_to_the_nearest_poses(dataset, tmp_path):
    """Twelve poses on a circle, of which 0, 4 and 8 are seeds: from 8 the two nearest are 7 and
    9."""
    loaded = load_dataset(dataset)
    state = run(tmp_path / "run", loaded, policy="farthest", nearest=2, budget=6)
    positions = np.array([frame.camera.position for frame in loaded.frames])
    assert state.taken[3] in (7, 9)
    for step in range(3, 9):
        left = [i for i in range(12) if i not in state.taken[:step]]
        near = [
            left[k]
            for k in pose_policies.nearest_poses(
                positions[left], positions[state.taken[step - 1]], 2
            )
        ]
        assert len(near) == 2
        assert state.taken[step] in near
    free = run(tmp_path / "free", loaded, policy="farthest", budget=6)
    wide = run(tmp_path / "wide", loaded, policy="farthest", nearest=12, budget=6)
    assert wide.taken == free.taken != state.taken


def test_the_nearest_poses():
    positions = np.array([[0.0, 0, 0], [3, 0, 0], [1, 0, 0], [-1, 0, 0], [9, 0, 0]])
    assert pose_policies.nearest_poses(positions, np.zeros(3), 1) == [0]
    assert pose_policies.nearest_poses(positions, np.zeros(3), 2) == [
        0,
        2,
    ]  # of equal distances the first
    assert pose_policies.nearest_poses(positions, np.zeros(3), 3) == [0, 2, 3]
    assert pose_policies.nearest_poses(positions, np.zeros(3), 9) == [0, 1, 2, 3, 4]


def test_nearest_zero_is_refused(dataset, tmp_path):
    with pytest.raises(InputError, match="--nearest 0: "):
        mgs.run_nbv(
            dataset, tmp_path / "run", prior=tiny.write_prior(tmp_path / "prior"), nearest=0
        )


def test_criteria_are_the_same_through_an_outlook(dataset, tmp_path):
    """The score of a step is that of the function itself, on the information of the state before
    it."""
    loaded = load_dataset(dataset)
    state = run(tmp_path / "run", loaded, policy="fisherrf", budget=1)
    seeds = run(tmp_path / "seeds", loaded, policy="fisherrf", budget=0)
    F = tiny.fisher(seeds.gaussians, loaded.frames[state.taken[3]].camera)
    lam = criteria.regularisation(tiny.GROUPS)
    assert state.steps[1]["score"] == criteria.fisherrf(F, seeds.H, lam)


def test_a_name_is_checked_without_running_its_file(file, tmp_path):
    (tmp_path / "loud.py").write_text("raise SystemExit\n\ndef loud(candidates): ...\n")
    (tmp_path / "bad.py").write_text("def (:\n")
    check_policy("d-optimal")
    check_policy(f"{tmp_path}/loud.py:loud")
    for name, message in [
        (f"{file}:nothing", "has no function nothing"),
        (f"{tmp_path}/bad.py:poses", "line 1 of .* failed: SyntaxError"),
        ("missing.py:poses", "no such file"),
        ("best", "unknown; choose one of d-optimal"),
    ]:
        with pytest.raises(InputError, match=message):
            check_policy(name)


def test_a_file_is_executed_once_until_it_changes(tmp_path):
    path, log = tmp_path / "mine.py", tmp_path / "log"
    source = f"with open({str(log)!r}, 'a') as log: log.write('x')\ndef poses(taken): ...\n"
    for count, text in enumerate([source, source + "# changed\n"], start=1):
        path.write_text(text)
        policy_named(f"{path}:poses")
        policy_named(f"{path}:poses")
        assert log.read_text() == count * "x"
