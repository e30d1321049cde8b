"""The predicted further fall of the objective of a fit, against longer fits and the minimum."""

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
from mgs.run.settings import NbvSettings
from mgs.splat import as_drjit, groups
from studies.convergence import CONVERGED_SHARE, remaining_decrease


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Settings, prior, frames, start and lam of a fit to four views of the tiny sphere."""
    root = tiny.write_dataset(tmp_path_factory.mktemp("convergence") / "dataset")
    dataset = load_dataset(root)
    prior = load_prior(tiny.write_prior(root.parent / "prior"))
    settings = NbvSettings(dataset=root, prior=root, seeds=2)
    frames = [dataset.frames[i] for i in (0, 6, 3, 9)]
    seen = initial_gaussians(prior, frames)[0]
    start = replace(initial_gaussians(prior, frames[:2])[0], sh=seen.sh)
    lam = settings.regularisation(groups(0))
    return settings, prior, frames, start, {kind: float(lam[c][0]) for kind, c in groups(0).items()}


def images(case):
    """Cameras and targets of the fit."""
    frames = case[2]
    return [frame.camera for frame in frames], [target_of(frame) for frame in frames]


def fitted(case, passes, lam=None, decay=0.01):
    _, _, _, start, own = case
    train = TrainSettings(passes=passes, tolerance=0.0, decay=decay)
    return fit(start, *images(case), train, start=start, lam=lam or own).gaussians


def remaining(case, model, **changes):
    settings, prior, frames, *_ = case
    given = settings.model_copy(update=changes)
    return remaining_decrease(model, given, prior, frames, images(case)[0])


def test_a_short_fit_is_called_early_and_a_long_one_comes_nearer(case):
    model = fitted(case, 2)
    short, long = remaining(case, model), remaining(case, fitted(case, 120))
    assert not short["converged"]
    assert short["predicted_decrease"] > 3 * long["predicted_decrease"] > 0
    assert long["phi"] < short["phi"]
    phi = objective(model, *images(case), *case[3:]).phi(as_drjit(model))
    assert short["phi"] == pytest.approx(phi, rel=1e-6), "the objective of the run"


@pytest.mark.slow
def test_converged_is_said_at_the_minimum_alone(case):
    """With a prior so strong that the objective is almost quadratic, the minimum is found; a step
    away from it, it is not."""
    found = fitted(case, 300, dict.fromkeys(groups(0), 50.0), 1e-3)
    at_minimum = remaining(case, found, lam=50.0)
    assert at_minimum["converged"]
    assert at_minimum["predicted_decrease"] < CONVERGED_SHARE
    found.sh = found.sh + np.float32(0.5)
    away = remaining(case, found, lam=50.0)
    assert not away["converged"]
    left = away["phi"] * (1 - away["predicted_decrease"])
    assert left == pytest.approx(at_minimum["phi"], rel=0.1)
