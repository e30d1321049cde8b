"""Whether a fit has converged is said of the objective, not of how its loss moved: and it is
true."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from mgs.data.dataset import load_dataset, target_of
from mgs.fit.fitting import fit
from mgs.fit.objective import objective
from mgs.fit.settings import TrainSettings
from mgs.prior.build import load_prior
from mgs.prior.initial import initial_gaussians
from mgs.report.convergence import CONVERGED_SHARE, remaining_decrease
from mgs.run.ending import fit_line
from mgs.run.settings import NbvSettings
from mgs.splat import as_drjit, groups


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Settings, prior, frames, start and lam of a fit to four views of the tiny sphere."""
    root = tiny.write_dataset(tmp_path_factory.mktemp("convergence") / "dataset")
    dataset = load_dataset(root)
    prior = load_prior(tiny.write_prior(root.parent / "prior"))
    settings = NbvSettings(dataset=root, prior=root, seeds=2)
    frames = [dataset.frames[i] for i in (0, 6, 3, 9)]
    start = replace(
        initial_gaussians(prior, frames[:2])[0], sh=initial_gaussians(prior, frames)[0].sh
    )
    lam = settings.regularisation(groups(0))
    return settings, prior, frames, start, {kind: float(lam[c][0]) for kind, c in groups(0).items()}


def fitted(case, passes):
    _, _, frames, start, lam = case
    cameras, targets = [frame.camera for frame in frames], [target_of(frame) for frame in frames]
    return fit(
        start,
        cameras,
        targets,
        TrainSettings(passes=passes, tolerance=0.0, decay=0.01),
        start=start,
        lam=lam,
    ).gaussians


def test_a_short_fit_is_called_early_and_a_long_one_comes_nearer(case):
    settings, prior, frames, _, _ = case
    short, long = (
        remaining_decrease(fitted(case, passes), settings, prior, frames) for passes in (2, 300)
    )
    assert not short["converged"]
    assert short["predicted_decrease"] > 3 * long["predicted_decrease"] > 0
    assert long["phi"] < short["phi"]


def test_phi_is_the_objective_of_the_run(case):
    settings, prior, frames, start, lam = case
    model = fitted(case, 2)
    goal = objective(model, [f.camera for f in frames], [target_of(f) for f in frames], start, lam)
    assert remaining_decrease(model, settings, prior, frames)["phi"] == pytest.approx(
        goal.phi(as_drjit(model)), rel=1e-6
    )


def test_converged_is_said_at_the_minimum_alone(case):
    """With a prior so strong that the objective is almost quadratic, the minimum is found; a step
    away from it, it is not."""
    settings, prior, frames, start, _ = case
    strong = settings.model_copy(update={"lam": 50.0})
    by_kind = dict.fromkeys(groups(0), 50.0)
    cameras, targets = [frame.camera for frame in frames], [target_of(frame) for frame in frames]
    train = TrainSettings(passes=300, tolerance=0.0, decay=1e-3)
    found = fit(start, cameras, targets, train, start=start, lam=by_kind).gaussians
    at_minimum = remaining_decrease(found, strong, prior, frames)
    assert at_minimum["converged"]
    assert at_minimum["predicted_decrease"] < CONVERGED_SHARE
    found.sh = found.sh + np.float32(0.5)
    away = remaining_decrease(found, strong, prior, frames)
    assert not away["converged"]
    assert away["phi"] * (1 - away["predicted_decrease"]) == pytest.approx(
        at_minimum["phi"], rel=0.1
    )


def test_what_is_printed_says_which(case):
    line = fit_line({"phi": 1.0, "predicted_decrease": 0.31, "converged": False}, "pass-limit")
    assert "stopped early (pass-limit)" in line
    assert "31 %" in line
    assert "converged" not in line
    assert "converged" in fit_line(
        {"phi": 1.0, "predicted_decrease": 0.004, "converged": True}, "settled"
    )
