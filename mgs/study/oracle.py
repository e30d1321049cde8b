"""An oracle that sees the truth: at every step it takes the view whose fit is best on the test
views. It reads the images of all candidates, so it is no policy. It is greedy, so better choices
may exist."""

from __future__ import annotations

from typing import Any

from mgs.data.dataset import Dataset
from mgs.run.loop import Chooser, fit_views
from mgs.run.operations import psnr_measure
from mgs.run.problem import Problem
from mgs.run.state import Fitted
from mgs.splat import ListCache


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
