"""`mgs bench fit`: its figures are those of the fits that it describes."""

from __future__ import annotations

import pytest
import synthetic

from mgs.bench import fit as bench
from mgs.fit.settings import TrainSettings
from mgs.metrics import agreement
from mgs.report.evaluation import evaluate_model
from mgs.splat import as_drjit


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench") / "dataset"
    synthetic.write_dataset(folder)
    synthetic.write_dataset(folder / "test")
    return folder


@pytest.fixture(scope="module")
def make(root):
    """Function of the kind and number of views and the weight of alpha that makes a case."""
    dataset = bench.load_dataset(root)
    prior = bench.build_prior(dataset, gaussians=200)
    return lambda *state: bench.make_case(dataset, prior, *state)


def test_the_figures_are_those_of_the_fits(root, make, monkeypatch):
    monkeypatch.setattr(bench, "SIZES", (200, 400))
    monkeypatch.setattr(bench, "VIEWS", 4)
    monkeypatch.setattr(bench, "STATES", (("even", 3), ("random", 4)))
    monkeypatch.setattr(bench, "LONGER", 3)
    said = []
    found = bench.bench_fit(root, said.append)
    figures, end = found["figures"], found["end"]
    assert figures.keys() == bench.TARGETS.keys()
    assert len(said) == 3
    case = make("even", 4, 0.1)
    fitted = case.fit()
    frames, spacing = case.dataset.frames, case.prior.spacing
    names = [frames[i].name for i in case.taken]
    means = evaluate_model(fitted.gaussians, frames, names, spacing=spacing)["held_out"]
    assert figures["psnr_held_out"] == means["psnr"]
    assert figures["psnr_inside_10k"] == means["psnr_inside"]
    assert figures["psnr_inside_20k"] == found["held_out"][400]["psnr_inside"]
    assert figures["psnr_inside_20k"] != means["psnr_inside"]
    tests = case.dataset.test_views().frames
    on_test = evaluate_model(fitted.gaussians, [], [], test_frames=tests, spacing=spacing)["test"]
    assert found["test"][200] == on_test
    phi = case.objective().phi
    longer = case.fit(passes=3 * fitted.passes, tolerance=0.0)
    assert end["phi"] == phi(as_drjit(fitted.gaussians))
    assert end["found"] == end["phi"] - phi(as_drjit(longer.gaussians)) > 0
    assert figures["predicted_over_found_decrease"] == end["predicted"] / end["found"] > 0
    rows = found["ranking"]
    assert [row["views"] for row in rows] == [3, 4]
    assert figures["ranking_tau"] == pytest.approx(sum(row["tau"] for row in rows) / 2)
    assert found["ranking_tau_half"] == pytest.approx(sum(row["tau_half"] for row in rows) / 2)


def test_alpha_is_part_of_the_fit_and_of_its_objective(make):
    cases = [make("even", 4, weight) for weight in (0, 0.1)]
    assert [case.objective().alpha_weight for case in cases] == [0, 0.1]
    assert cases[0].fit().gaussians != cases[1].fit().gaussians


def test_a_ranking_agrees_with_itself(make, monkeypatch):
    monkeypatch.setattr(bench, "LONGER", 1)
    case = make("random", 4, 0.0)
    shorter = case.fit(passes=TrainSettings().passes // 2, tolerance=0.0)
    scores = [case.scores(fit.gaussians) for fit in (shorter, case.fit())]
    assert bench._ranking(case) == {
        "views": 4,
        "tau_half": agreement(*scores)["tau"],
        "tau": pytest.approx(1),
        "regret": 0,
    }
