"""Experiments on fits: free means on few views, and fits that are too short or too long."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.policy.criteria import Score, d_optimal, fisherrf, t_optimal
from studies.output import Panel
from studies.stress.lab import Array, Experiment, cells_per_rock, open_lab, turns
from studies.verdict import Claim, Effects, Row, paired, runs_of, single

FREE_PASSES = 40
"""Passes of fits with free means: four times the default, since a collapse takes time."""

KINDS = {
    "frozen": ("frozen", True),
    "free": ("free", True),
    "frozen, no prior": ("frozen", False),
    "free, no prior": ("free", False),
}
"""Setting of the means, and whether a prior holds all parameters; the paper has none. Free means
are compared with frozen ones of the same prior, since a fit without one loses quality anyway."""


def free_means(
    root: Path, out: Path, scene: str, dataset: str, prior: str, turns_: int, counts: list[int]
) -> dict[str, Any]:
    """Fits with frozen and with free means on few views: quality, drift of the means in spacings,
    and the ranking of the other views."""
    lab, rows = open_lab(root / dataset, root / prior), []
    for suffix, turn in turns(turns_):
        for count in counts:
            taken = lab.even(count, turn)
            left, start = lab.left(taken), lab.start(taken)
            references: dict[bool, Array] = {}
            for kind, (means, with_prior) in KINDS.items():
                model = lab.fit(taken, FREE_PASSES, means, with_prior, start=start).gaussians
                scores = lab.scores(model, taken, left, means=means)
                reference = references.setdefault(with_prior, scores)
                drift = np.linalg.norm(model.means - start.means, axis=1) / lab.prior.spacing
                row = {"run": f"{scene}, {suffix}", "views": count, "means": kind}
                row |= lab.quality(model) | {"drift": float(np.sqrt(np.mean(drift**2)))}
                rows.append(row | agreement(scores, reference))
    return {"rows": rows}


def _means(views: int, kind: str, other: str) -> Effects:
    return paired("psnr", {"views": views, "means": kind}, {"views": views, "means": other})


FREE_MEANS = Experiment(
    "Do free means collapse on few views?",
    cells_per_rock(
        "free-means",
        f"{__name__}:free_means",
        lambda size: {"turns_": size.turns, "counts": list(size.few_views)},
    ),
    (
        Claim(
            "On 4 views, free means lose 1 dB or more against frozen ones, both without a prior "
            "(paper, section III).",
            _means(4, "free, no prior", "frozen, no prior"), "dB", "below", -1.0,
        ),
        Claim(
            "On 2 views, free means lose 1 dB or more against frozen ones, both without a prior.",
            _means(2, "free, no prior", "frozen, no prior"), "dB", "below", -1.0,
        ),
        Claim(
            "On 4 views, frozen means lose 0.5 dB or more where no prior holds the other "
            "parameters.",
            _means(4, "frozen, no prior", "frozen"), "dB", "below", -0.5,
        ),
        Claim(
            "With the prior on their place, free means lose no more than 0.5 dB on 4 views.",
            _means(4, "free", "frozen"), "dB", "above", -0.5,
        ),
        Claim(
            "On 4 views, freeing the means (no prior) changes the D-optimal ranking: Kendall's tau "
            "is at most 0.8.",
            single("tau", {"views": 4, "means": "free, no prior"}), "tau", "below", 0.8,
        ),
    ),
    (
        Panel("views", "psnr", "views", "PSNR on test views (dB)", "means"),
        Panel("views", "drift", "views", "drift of the means, rms (spacings)", "means"),
        Panel("views", "tau", "views", "Kendall's tau with frozen means, same prior", "means"),
    ),
)  # fmt: skip

SCORES: dict[str, Score] = {"d-optimal": d_optimal, "fisherrf": fisherrf, "t-optimal": t_optimal}

EARLY = 5
"""Passes of a choice made too early; the default of the first fit is twice as many."""


def convergence(
    root: Path, out: Path, scene: str, dataset: str, prior: str, turns_: int, passes: list[int]
) -> dict[str, Any]:
    """Fits of several lengths to four views, with and without a prior on the parameters: quality,
    and agreement of the ranking of candidates with that of the longest fit."""
    lab, rows = open_lab(root / dataset, root / prior), []
    for suffix, turn in turns(turns_):
        taken = lab.even(4, turn)
        start, left = lab.start(taken), lab.left(taken)
        for kind, with_prior in (("with the prior", True), ("no prior", False)):
            fits = [lab.fit(taken, p, with_prior=with_prior, start=start) for p in passes]
            for name, score in SCORES.items():
                scores = [lab.scores(one.gaussians, taken, left, score) for one in fits]
                for count, one, found in zip(passes, fits, scores, strict=True):
                    row: Row = {"run": f"{scene}, {suffix}", "fit": kind, "criterion": name}
                    row |= {"passes": count} | agreement(found, scores[-1])
                    row |= lab.quality(one.gaussians) if name == "d-optimal" else {}
                    rows.append(row)
    return {"rows": rows}


def _lost(kind: str) -> Effects:
    """Effects: PSNR inside the rock that the longest fit has lost against the best length."""

    def effects(rows: Sequence[Row]) -> list[float]:
        wanted = {"fit": kind, "criterion": "d-optimal"}
        lost = []
        for run in runs_of(rows, wanted):
            of = [row for row in rows if row["run"] == run and wanted.items() <= row.items()]
            last = max(of, key=lambda row: row["passes"])
            lost.append(max(row["psnr_mask"] for row in of) - last["psnr_mask"])
        return lost

    return effects


_EARLY = {"fit": "with the prior", "criterion": "d-optimal", "passes": EARLY}

CONVERGENCE = Experiment(
    "What if views are chosen before the fit has converged, and what if it is fitted for too long?",
    cells_per_rock(
        "convergence",
        f"{__name__}:convergence",
        lambda size: {"turns_": size.turns, "passes": list(size.passes)},
    ),
    (
        Claim(
            "A ranking after 5 passes is arbitrary: Kendall's tau with the longest fit is at most "
            "0.3 (paper, section III).",
            single("tau", _EARLY), "tau", "below", 0.3,
        ),
        Claim(
            "The view chosen after 5 passes costs at most 5 % of the best information gain.",
            single("regret", _EARLY), "share", "below", 0.05,
        ),
        Claim(
            "Without a prior on the parameters, the longest fit has lost 0.3 dB or more of rock "
            "PSNR on the test views.",
            _lost("no prior"), "dB", "above", 0.3,
        ),
        Claim(
            "With the prior, the longest fit has lost at most 0.3 dB.",
            _lost("with the prior"), "dB", "below", 0.3,
        ),
    ),
    (
        Panel("passes", "psnr_mask", "passes", "rock PSNR on test views (dB)", "fit", True,
              (("criterion", "d-optimal"),)),
        Panel("passes", "tau", "passes", "Kendall's tau with the longest fit", "criterion", True,
              (("fit", "with the prior"),)),
        Panel("passes", "regret", "passes", "regret (share)", "criterion", True,
              (("fit", "with the prior"),)),
    ),
)  # fmt: skip


def agreement(mine: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Agreement of scores of candidates [C] with reference scores.

    "tau": Kendall's tau, 0 if one of them is constant. "regret": share of the best reference score
    that is lost by taking our best candidate.
    """
    from scipy.stats import kendalltau  # takes half a second, and few programs rank

    constant = np.ptp(mine) == 0 or np.ptp(reference) == 0
    tau = 0.0 if constant else float(kendalltau(mine, reference).statistic)
    best, top = int(np.argmax(mine)), float(reference.max())
    return {"tau": tau, "regret": float((top - reference[best]) / max(abs(top), 1e-300))}
