"""benchmarks/criteria.py: what it compares, and that it continues where it was interrupted."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import tiny

import mgs
from mgs.errors import InputError
from mgs.policy.registry import policy_names


@pytest.fixture(scope="module")
def benchmark():
    """benchmarks/criteria.py as a module."""
    path = Path(__file__).parent.parent / "benchmarks/criteria.py"
    spec = importlib.util.spec_from_file_location("criteria_study", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run with the seeds alone of a tiny dataset with test views."""
    root = tmp_path_factory.mktemp("study")
    tiny.write_dataset(root / "data", frames=8)
    tiny.write_dataset(root / "data/test", frames=3)
    prior = tiny.write_prior(root / "prior")
    settings = {"budget": 0, "seeds": 3, "train": {"passes": 3}}
    mgs.run_nbv(root / "data", root / "run", prior=prior, **settings)
    return root / "run"


def test_an_interrupted_study_ends_as_another(benchmark, run, tmp_path, monkeypatch):
    whole = benchmark.study(tmp_path / "whole.json", [run], 2, policy_names())
    state = whole["states"][str(run)]
    assert state["metric"] == "test_psnr_mask"
    assert set(state["scores"]) == {*policy_names(), "(farthest)"}
    assert all(len(state["psnr"][name]) == 2 for name in state["candidates"])
    assert np.ptp(state["result"]["gains"]) > 0
    measured, calls = benchmark.Bench.measured, []

    def dying(bench, *arguments):
        calls.append(arguments)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return measured(bench, *arguments)

    monkeypatch.setattr(benchmark.Bench, "measured", dying)
    with pytest.raises(KeyboardInterrupt):
        benchmark.study(tmp_path / "again.json", [run], 2, ["random"])
    again = benchmark.study(tmp_path / "again.json", [run], 2, policy_names())
    interrupted = 1
    assert len(calls) == 1 + 2 * 5 + interrupted  # the start, five candidates in two orders
    assert again == json.loads((tmp_path / "again.json").read_text())
    assert again["states"] == whole["states"]
    text = benchmark.table(again, [run])
    assert {line.split()[0] for line in text.splitlines()[1:]} == {*policy_names(), "(ceiling)"}


def test_another_state_is_refused(benchmark, run, tmp_path):
    found = benchmark.study(tmp_path / "out.json", [run], 1, ["farthest"])
    found["states"][str(run)]["model"] = "another"
    (tmp_path / "out.json").write_text(json.dumps(found))
    with pytest.raises(InputError, match=r"holds another state of .*run; write to a new file"):
        benchmark.study(tmp_path / "out.json", [run], 1, ["farthest"])


def test_what_is_compared(benchmark):
    """Perfect, opposite and constant scores (whose choice is the farthest view), in two orders."""
    psnr = {"start": 20.0, "a": [20.1, 20.2], "b": [20.4, 20.3], "c": [20.2, 20.6]}
    scores = {"good": [1, 2, 3], "bad": [3, 2, 1], "none": [0, 0, 0], "(farthest)": [1, 5, 2]}
    record = {"candidates": ["a", "b", "c"], "psnr": psnr, "scores": scores}
    found = benchmark.compare(record, 2)
    assert found["gains"] == pytest.approx([0.15, 0.35, 0.4])
    assert found["spearman"] == {"good": pytest.approx(1), "bad": pytest.approx(-1), "none": None}
    assert found["regret"] == {"good": 0, "bad": pytest.approx(0.25), "none": pytest.approx(0.05)}
    assert found["agreement"] == pytest.approx(0.5)  # ranks 1 3 2 and 1 2 3
    assert found["ceiling"] == pytest.approx(np.sqrt(2 * 0.5 / 1.5))
    assert benchmark.compare(record, 1)["spearman"]["good"] == pytest.approx(0.5)
    assert "ceiling" not in benchmark.compare(record, 1)
