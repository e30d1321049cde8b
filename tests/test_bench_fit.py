"""`mgs bench fit`: the figures are those of the fits that it says it makes."""

from __future__ import annotations

import pytest
import synthetic

from mgs.bench import fit as bench
from mgs.fit.settings import TrainSettings
from mgs.metrics import agreement
from mgs.report.evaluation import evaluate


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench") / "dataset"
    synthetic.write_dataset(folder)
    synthetic.write_dataset(folder / "test")
    return folder


@pytest.fixture
def small(monkeypatch):
    """Everything at a size that takes seconds."""
    monkeypatch.setattr(bench, "SIZES", (200, 400))
    monkeypatch.setattr(bench, "VIEWS", 4)
    monkeypatch.setattr(bench, "STATES", (("even", 3), ("random", 4)))
    monkeypatch.setattr(bench, "OLD_PASSES", 2)
    monkeypatch.setattr(bench, "TRIED_PASSES", (1, 20))
    monkeypatch.setattr(bench, "LONGER", 3)


def test_the_figures_are_those_of_the_fits(root, small):
    said = []
    found = bench.bench_fit(root, said.append)
    assert found["figures"].keys() == bench.TARGETS.keys()
    assert len(said) == 4
    case = bench._case(bench.load_dataset(root), 200, "even", 4, 0.1)
    fitted = case.fit(case.start, case.taken, TrainSettings())
    names = [case.dataset.frames[i].name for i in case.taken]
    means = evaluate(fitted.gaussians, case.dataset.frames, names, spacing=case.prior.spacing)[
        "held_out"
    ]
    figures = found["figures"]
    assert (figures["psnr_held_out"], figures["psnr_inside_10k"]) == (
        means["psnr"],
        means["psnr_inside"],
    )
    assert (
        figures["psnr_inside_20k"] == found["held_out"][400]["psnr_inside"] != means["psnr_inside"]
    )
    tests = case.dataset.test_views().frames
    assert (
        found["test"][200]
        == evaluate(fitted.gaussians, [], [], test_frames=tests, spacing=case.prior.spacing)["test"]
    )
    end = found["end"]
    assert end["phi"] == case.phi(fitted.gaussians)
    longer = case.fit(
        case.start, case.taken, TrainSettings(passes=3 * fitted.passes, tolerance=0.0)
    )
    assert end["found"] == end["phi"] - case.phi(longer.gaussians) > 0
    assert figures["predicted_over_found_decrease"] == end["predicted"] / end["found"] > 0
    assert figures["ranking_tau"] == pytest.approx(
        sum(state["tau"] for state in found["ranking"]) / 2
    )
    assert [state["views"] for state in found["ranking"]] == [3, 4]
    assert found["ranking_tau_half"] == pytest.approx(
        sum(state["tau_half"] for state in found["ranking"]) / 2
    )


def test_passes_are_those_of_the_first_fit_that_reaches_the_objective(root, small, monkeypatch):
    case = bench._case(bench.load_dataset(root), 200, "even", 4, 0.1)
    found = bench.passes_to(case, case.start)
    assert found["share"] == found["tried"][-1]["passes"] / 2
    assert found["share_of_seconds"] == found["tried"][-1]["seconds"] / found["old"]["seconds"]
    assert found["tried"][-1]["phi"] <= found["old"]["phi"]
    assert all(one["phi"] > found["old"]["phi"] for one in found["tried"][:-1])
    monkeypatch.setattr(bench, "OLD_PASSES", 60)
    monkeypatch.setattr(bench, "TRIED_PASSES", (1,))
    missed = bench.passes_to(case, case.start)
    assert missed["share"] is missed["share_of_seconds"] is None


def test_alpha_is_part_of_the_fit_and_of_its_objective(root):
    dataset = bench.load_dataset(root)
    models = {}
    for weight in (0.0, 0.1):
        case = bench._case(dataset, 200, "even", 4, weight)
        models[weight] = case.fit(case.start, case.taken, TrainSettings()).gaussians
        assert case.objective(case.taken).alpha_weight == weight
    assert models[0.0] != models[0.1]


def test_a_ranking_agrees_with_itself(root, small, monkeypatch):
    monkeypatch.setattr(bench, "LONGER", 1)
    case = bench._case(bench.load_dataset(root), 200, "random", 4, 0.0)
    found = bench._ranking(case)
    shorter = case.fit(
        case.start, case.taken, TrainSettings(passes=TrainSettings().passes // 2, tolerance=0.0)
    )
    stopped = case.fit(case.start, case.taken, TrainSettings())
    scores = [bench._scores(case, model.gaussians) for model in (shorter, stopped)]
    assert found == {
        "views": 4,
        "tau_half": agreement(*scores)["tau"],
        "tau": pytest.approx(1),
        "regret": 0,
    }
