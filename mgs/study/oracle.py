"""An oracle that sees the truth: at every step it takes the view whose fit is best on the test
views. It reads the images of all candidates, so it is no policy. It is greedy, so better choices
may exist."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mgs.data.dataset import Dataset
from mgs.run import recording
from mgs.run.loop import Chooser, fit_views
from mgs.run.operations import operations_of, psnr_measure
from mgs.run.problem import Problem, no_progress
from mgs.run.state import Fitted
from mgs.splat import ListCache
from mgs.study.case import begun_run, curves_of, test_views_of


def oracle(tests: Dataset) -> Chooser:
    """Chooser that fits to every candidate in reach; its score is the mean PSNR over the test
    views, dB. Of equals it takes the first."""
    measure = psnr_measure(tests, ListCache())

    def choose(problem: Problem, state: Fitted, fisher: Any = None) -> tuple[int, float]:
        left = problem.reachable(state.taken)
        fits = (fit_views(problem, [*state.taken, frame], state) for frame in left)
        scores = [measure(fit.gaussians, [])["psnr"] for fit in fits]
        best = max(range(len(left)), key=lambda k: scores[k])
        return left[best], scores[best]

    return choose


def run_oracle(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """Task: start or resume a run of the oracle; returns what `mgs.study.case.run_policy` does.
    settings: without a policy. Raises InputError if there are no test views."""
    given = {"policy": "random", "evaluate_every": 1, **settings}
    run = begun_run(root, out, dataset, prior, given)
    chooser = oracle(test_views_of(run.dataset))
    operations = operations_of(run.dataset, run.prior, run.settings)
    state = recording.run(
        run.folder, run.settings, run.dataset, operations, no_progress, chooser=chooser
    )
    return curves_of(state)
