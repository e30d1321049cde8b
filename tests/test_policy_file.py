"""Policies in a user's file."""

import json

import pytest
import tiny
from program import change_settings
from refusals import fails, refused

import mgs
from mgs import load_dataset, open_run, start_run
from mgs.run.policy_file import check_policy, policy_of

FUNCTIONS = """
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

def poses(candidates, taken):
    return np.linalg.norm(candidates[:, None] - taken, axis=2).min(axis=1).round(9)

def information(F, H, lam):
    return float(np.log1p(F / (H + lam)).mean(dtype=np.float64))

def surface(surface_F, surface_H, surface_lam):
    seen = lambda H: (H[:, :3] > surface_lam[:3]).any(axis=1)
    return float((seen(surface_H + surface_F) & ~seen(surface_H)).sum())

def draw(rng, candidates):
    return rng.random(len(candidates))

@dataclass
class Height:
    ground: float

    def __call__(self, position: np.ndarray) -> float:
        return float(position[2] - self.ground)

def everything(scene, state, views, seen, seen_taken, points, candidate, centre):
    assert seen.shape == (len(views), len(points))
    assert seen_taken.shape == (len(state.taken), len(points))
    dome = scene.surface(state).dome
    assert len(dome.positions) == len(dome.seen)
    return Height(centre[2])(candidate)

def wrong(F, photos):
    return 0.0

def broken(candidates):
    return 1 / 0

def few(candidates):
    return [1.0]

number = 3

def words(F, unused=2):
    return "a"

class Stops:
    def __init__(self):
        exit(0)

class Lost:
    needs_fit = False

    def __call__(self, views):
        return [0.0] * len(views)

    def plan(self, planned, *_):
        return planned

    def relaxation(self, *_):
        return 0.0

def large(views):
    return [10**400] * len(views)

def changes(F, lam):
    lam += 1
    return 0.0

def changes_one(surface_F):
    surface_F += 1
    return 0.0

from mgs.run.policies import Coverage

def turned(views):
    return np.full(len(views), 1 + 2j)
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "mine.py").write_text(FUNCTIONS)
    return tmp_path / "mine.py"


def run(out, dataset, **values):
    return tiny.run(out, dataset, **({"budget": 3} | values))


SAME = {"poses": "farthest", "information": "d-optimal", "surface": "coverage"}


@pytest.mark.parametrize(("function", "same"), SAME.items())
def test_arguments_are_passed_by_parameter_name(loaded, file, tmp_path, function, same):
    ours = run(tmp_path / "ours", loaded, policy=f"{file}:{function}")
    theirs = run(tmp_path / "theirs", loaded, policy=same)
    assert ours.taken == theirs.taken
    assert [step["score"] for step in ours.steps] == [step["score"] for step in theirs.steps]


def test_a_function_can_use_scene_and_state_and_classes(loaded, file, tmp_path):
    state = run(tmp_path / "run", loaded, policy=f"{file}:everything")
    assert [step["score"] for step in state.steps[1:]] == pytest.approx([1.5] * 3)


def test_draws_do_not_depend_on_the_folder_of_the_file(loaded, file, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    paths = file, tmp_path / "elsewhere/mine.py"
    paths[1].write_text(FUNCTIONS)
    one, other = (run(tmp_path / str(k), loaded, policy=f"{paths[k]}:draw") for k in (0, 1))
    assert one.taken == other.taken


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("mine.py:nothing", r"has no function nothing"),
        ("mine.py:number", r"has no function number"),
        ("mine.py:wrong", r"unknown parameter photos; choose from rng, F, "),
        ("missing.py:poses", r"no such file .*missing\.py; correct the path"),
        ("bad.py:poses", r"line 2 of .*bad\.py failed: SyntaxError"),
        ("worse.py:poses", r"line 3 of .*worse\.py failed: ModuleNotFoundError: No module named"),
        ("mine.py:Stops", r"line 51 of .*mine\.py failed: SystemExit: 0"),
        ("exit.py:poses", r"line 1 of .*exit\.py failed: SystemExit: 0"),
    ],
)
def test_a_policy_that_cannot_be_loaded_is_one_line(dataset, file, tmp_path, name, message):
    (tmp_path / "bad.py").write_text("x = 1\ndef (:\n")
    (tmp_path / "worse.py").write_text("\n\nimport nothing_like_it\n")
    (tmp_path / "exit.py").write_text("raise SystemExit(0)\n")
    prior, out, policy = tiny.write_prior(tmp_path / "prior"), tmp_path / "run", tmp_path / name
    fails(message, mgs.run_nbv, dataset, out, prior=prior, policy=str(policy))
    assert not out.exists()


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("broken", r"line 39 of .*mine\.py failed: ZeroDivisionError: division by zero"),
        ("few", r"returned scores of shape \(1,\) for 9 candidates"),
        ("words", r"returned no numbers \(.*'a'\); return one for each candidate"),
        ("large", r"returned no numbers \(int too large"),
        ("turned", r"returned no numbers \(they are complex\)"),
        ("changes", r"line 69 of .*mine\.py failed: ValueError: output array is read-only"),
        ("changes_one", r"line 73 of .*mine\.py failed: ValueError: output array is read-only"),
    ],
)
def test_a_policy_that_fails_keeps_the_steps_before(loaded, file, tmp_path, function, message):
    fails(message, run, tmp_path / "run", loaded, policy=f"{file}:{function}")
    assert len((tmp_path / "run/steps.jsonl").read_text().splitlines()) == 1


def test_an_error_in_a_plan_or_a_relaxation_is_one_line(file):
    lost = policy_of(f"{file}:Lost")
    fails(r"mine\.py failed: TypeError", lost.plan, None, None, [], 1, None)
    fails("plan returned views that are no candidates", lost.plan, [7], None, [5, 6], 1, None)
    fails("relaxation returned float, no Relaxation", lost.relaxation, None, None, [5, 6])


def test_an_object_in_a_file_keeps_its_bound(loaded, file, tmp_path):
    rules = {"own": f"{file}:Coverage", "ours": "coverage"}
    first = [run(tmp_path / key, loaded, policy=rule).steps[0] for key, rule in rules.items()]
    own, ours = (step["certificate"] for step in first)
    assert own == ours | {"criterion": "mine.py:Coverage"}


def test_a_run_goes_on_with_the_same_file_only(dataset, file, tmp_path, monkeypatch):
    """config.json has the whole path, a run's name the file's name only."""
    prior, out, half = tiny.write_prior(tmp_path / "prior"), tmp_path / "run", tmp_path / "half"
    monkeypatch.chdir(tmp_path)
    start_run(dataset, out, prior=prior, policy="mine.py:poses", budget=3, seeds=3)
    config = json.loads((out / "config.json").read_text())
    assert config["settings"]["policy"] == f"{file}:poses"
    loaded = load_dataset(dataset)
    run(half, loaded, policy=f"{file}:poses", budget=1)
    assert open_run(half).label == "mine.py:poses"
    settings = open_run(half).settings.model_copy(update={"budget": 2})
    further = lambda: tiny.go(half, settings, loaded)  # noqa: E731
    file.write_text(FUNCTIONS + "\n")
    fails(r"mine\.py:poses: its file has changed since .*half was", further)
    file.write_text(FUNCTIONS)
    assert len(further().taken) == 5


def test_a_name_is_checked_without_running_its_file(tmp_path):
    (tmp_path / "loud.py").write_text("raise SystemExit\n\ndef loud(candidates): ...\n")
    check_policy(f"{tmp_path}/loud.py:loud")
    fails("unknown; choose one", check_policy, "best")


def test_a_file_is_executed_once_until_it_changes(tmp_path):
    path, log = tmp_path / "mine.py", tmp_path / "log"
    source = f"with open({str(log)!r}, 'a') as log: log.write('x')\ndef poses(taken): ...\n"
    for count, text in enumerate([source, source + "# changed\n"], start=1):
        path.write_text(text)
        policy_of(f"{path}:poses")
        policy_of(f"{path}:poses")
        assert log.read_text() == count * "x"


def test_a_run_folder_runs_no_program_that_was_not_named(dataset, file, tmp_path, capsys):
    """A stranger's run names a policy file: it is not executed, neither before nor after checks."""
    prior, out = tiny.write_prior(tmp_path / "prior"), tmp_path / "run"
    start_run(dataset, out, prior=prior, policy=f"{file}:poses", budget=2, seeds=3)
    evil, proof = tmp_path / "evil.py", tmp_path / "proof"
    evil.write_text(f"open({str(proof)!r}, 'w')\ndef f(candidates): return [1] * len(candidates)\n")
    change_settings(out, policy=f"{evil}:f")
    for options in ([], ["--policy", f"{file}:poses"]):
        said = refused(capsys, ["nbv", "--resume", out, *options], tmp_path)
        assert f"{evil}:f" in said
    assert not proof.exists()
    change_settings(out, policy=f"{file}:poses")
    assert len(mgs.resume_nbv(out, policy=f"{file}:poses").state.taken) == 5
