"""An oracle that sees the truth: at every step it takes the view whose fit is best on the test
views. It reads the images of all candidates, so it is no policy. It is greedy, so better choices
may exist."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mgs.data.dataset import Dataset
from mgs.evaluation import psnr_measure
from mgs.learning import fit_views
from mgs.run.policies import Policy
from mgs.scene import Scene, State
from mgs.splat import ListCache


class Oracle:
    """Policy that fits to every candidate; its score is the mean PSNR over the test views, dB.

    It reads the images of the candidates. policies: compared with it at each choice; `tried` has a
    row for each choice (`foretold`).
    """

    name, needs_fit = "oracle", True

    def __init__(self, tests: Dataset, policies: Sequence[Policy] = ()) -> None:
        self.measure, self.policies = psnr_measure(tests, ListCache()), policies
        self.tried: list[dict[str, dict[str, float]]] = []

    def __call__(self, scene: Scene, state: State, views: list[int]) -> np.ndarray:
        fits = (fit_views(scene, state.frames, (*state.taken, view), state)[0] for view in views)
        scores = np.array([self.measure(fit.gaussians, [])["psnr"] for fit in fits])
        self.tried.append(foretold(self.policies, scene, state, views, scores))
        return scores


def foretold(
    policies: Sequence[Policy], scene: Scene, state: State, views: list[int], psnr: np.ndarray
) -> dict[str, dict[str, float]]:
    """Compare the scores of policies with the PSNR after the fit to each candidate.

    psnr: mean PSNR of the candidates over the test views [C], dB. Returns for each policy
    "spearman", the rank correlation (0 if all scores are equal), and "regret", dB: the PSNR of the
    best candidate less that of the candidate with the best score.
    """
    from scipy.stats import spearmanr

    rows = {}
    for policy in policies:
        scores = np.asarray(policy(scene, state, views))
        rank = spearmanr(scores, psnr).statistic if np.ptp(scores) > 0 else 0
        regret = psnr.max() - psnr[int(np.argmax(scores))]
        rows[policy.name] = {"spearman": float(rank), "regret": float(regret)}
    return rows


if __name__ == "__main__":
    from studies.commands import start

    start("oracle")
