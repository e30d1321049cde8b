"""An oracle that looks at the truth: at every step the view whose fit is best on the test views.
What there is to be won.

It is no policy: it reads the images of all candidates, and of the test views. It is greedy, so
another choice could be better still.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mgs.data.dataset import Dataset
from mgs.fit.settings import COLOURS_ALONE
from mgs.run import recording
from mgs.run.folder import open_run
from mgs.run.loop import Chooser, fit_views, reachable
from mgs.run.nbv import start_run
from mgs.run.operations import operations_of, psnr_measure
from mgs.run.problem import Problem, no_progress
from mgs.run.state import Fitted, State
from mgs.splat import ListCache
from mgs.study.case import CURVES, test_views_of


def oracle(tests: Dataset) -> Chooser:
    """A chooser: fits every candidate in reach, takes the best on the test views; its score is the
    mean PSNR over them, dB. Of equals the first."""
    judge = psnr_measure(tests, ListCache())

    def choose(problem: Problem, state: Fitted, fisher: Any = None) -> tuple[int, float]:
        left = reachable(problem, state.taken)
        fits = (fit_views(problem, [*state.taken, frame], state) for frame in left)
        worth = [judge(fit.gaussians, [])["psnr"] for fit in fits]
        best = max(range(len(left)), key=lambda k: worth[k])
        return left[best], worth[best]

    return choose


def run_oracle(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """A task, as `mgs.study.case.run_policy` with the same result. settings: without a policy.
    Goes on where it stopped."""
    run = out / "run"
    if not (run / "config.json").is_file():
        where = root / prior
        given = {
            "policy": "random",
            "evaluate_every": 1,
            **settings,
            "train": {**COLOURS_ALONE, **settings.get("train", {})},
        }
        start_run(root / dataset, run, prior=where, **given)
    state = choose_all(run)
    return {key: [step[key] for step in state.steps] for key in CURVES} | {"taken": state.taken}


def choose_all(folder: Path) -> State:
    """Run or resume the oracle in a run folder to the end of its budget. Raises InputError if there
    are no test views."""
    run = open_run(folder)
    chooser = oracle(test_views_of(run.dataset))
    operations = operations_of(run.dataset, run.prior, run.settings)
    return recording.run(
        folder, run.settings, run.dataset, operations, no_progress, chooser=chooser
    )
