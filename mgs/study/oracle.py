"""An oracle that sees the truth: at every step it takes the view whose fit is best on the test
views. It reads the images of all candidates, so it is no policy. It is greedy, so better choices
may exist."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mgs.data.dataset import Dataset
from mgs.evaluation import psnr_measure
from mgs.run.loop import Chooser, fit_views
from mgs.run.problem import Problem
from mgs.run.state import Fitted
from mgs.splat import ListCache


def oracle(
    tests: Dataset,
    tell: Callable[[Problem, Fitted, list[int], list[float]], None] = lambda *tried: None,
) -> Chooser:
    """Chooser that fits to every candidate in reach; its score is the mean PSNR over the test
    views, dB. Of equals it takes the first. tell: callback at each choice, with the
    problem, the state, the candidates and their scores."""
    measure = psnr_measure(tests, ListCache())

    def choose(problem: Problem, state: Fitted, fisher: Any = None) -> tuple[int, float]:
        left = problem.reachable(state.taken)
        fits = (fit_views(problem, [*state.taken, frame], state) for frame in left)
        scores = [measure(fit.gaussians, [])["psnr"] for fit in fits]
        tell(problem, state, left, scores)
        best = max(range(len(left)), key=lambda k: scores[k])
        return left[best], scores[best]

    return choose


def foretold(
    policies: Sequence[str], problem: Problem, state: Fitted, left: list[int], psnr: Sequence[float]
) -> dict[str, dict[str, float]]:
    """Compare the scores of policies with the PSNR after the fit to each candidate.

    left: candidates [C]; psnr: their mean PSNR over the test views [C], dB. Returns for each policy
    "spearman", the rank correlation (0 if all scores are equal), and "regret", dB: the PSNR of the
    best candidate less that of the candidate with the best score.
    """
    from scipy.stats import spearmanr

    fisher, found = problem.view_information(state.gaussians), {}
    for policy in policies:
        asked = problem.with_settings(policy=policy)
        scores = np.asarray(asked.policy(asked.context(state, left, fisher)))
        rank = spearmanr(scores, psnr).statistic if np.ptp(scores) > 0 else 0
        regret = max(psnr) - psnr[int(np.argmax(scores))]
        found[policy] = {"spearman": float(rank), "regret": regret}
    return found
