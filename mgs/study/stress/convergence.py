"""Choosing before the fit has converged, and fitting for too long."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mgs.metrics import agreement
from mgs.policy.criteria import Score, d_optimal, fisherrf, t_optimal
from mgs.study.stress.experiment import Experiment, Panel, cells_per_rock, turns
from mgs.study.stress.lab import open_lab
from mgs.study.stress.verdict import Claim, Row, runs_of, single

SCORES: dict[str, Score] = {"d-optimal": d_optimal, "fisherrf": fisherrf, "t-optimal": t_optimal}
EARLY = 5
"""Passes of a choice that is made too early; the default of the first fit is twice as many."""


def convergence(
    root: Path, out: Path, scene: str, turns_: int, passes: list[int]
) -> dict[str, Any]:
    """Fits of several lengths to four views, with and without the prior on the parameters: quality
    on the test views, and how the ranking of candidates agrees with that of the longest fit."""
    lab, rows = open_lab(root, scene), []
    for suffix, turn in turns(turns_):
        taken = lab.even(4, turn)
        start, left = lab.start(taken), lab.left(taken)
        for with_prior in (True, False):
            kind = "with the prior" if with_prior else "no prior"
            models = [
                lab.fit(taken, p, with_prior=with_prior, start=start).gaussians for p in passes
            ]
            for name, score in SCORES.items():
                scores = [lab.scores(model, taken, left, score) for model in models]
                for count, model, found in zip(passes, models, scores, strict=True):
                    quality = lab.quality(model) if name == "d-optimal" else {}
                    rows.append({
                        "run": f"{scene}, {suffix}", "fit": kind, "criterion": name, "passes": count, **quality,
                        **agreement(found, scores[-1]),
                    })  # fmt: skip
    return {"rows": rows}


def _lost(kind: str) -> Any:
    """How much rock PSNR the longest fit has lost against the best length, run by run."""

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
        "convergence", f"{__name__}:convergence", lambda preset: {"turns_": preset.turns, "passes": list(preset.passes)}
    ),
    (
        Claim("A ranking after 5 passes is arbitrary: Kendall's tau with the longest fit is at most 0.3 (paper, section III).",
              single("tau", _EARLY), "tau", "below", 0.3, "rock and set of views"),
        Claim("The view chosen after 5 passes costs at most 5 % of the best information gain.",
              single("regret", _EARLY), "share", "below", 0.05, "rock and set of views"),
        Claim("Without a prior on the parameters, the longest fit has lost 0.3 dB or more of rock PSNR on the test views.",
              _lost("no prior"), "dB", "above", 0.3, "rock and set of views"),
        Claim("With the prior, the longest fit has lost at most 0.3 dB.",
              _lost("with the prior"), "dB", "below", 0.3, "rock and set of views"),
    ),
    (
        Panel("passes", "psnr_mask", "passes", "rock PSNR on test views (dB)", "fit", True, (("criterion", "d-optimal"),)),
        Panel("passes", "tau", "passes", "Kendall's tau with the longest fit", "criterion", True, (("fit", "with the prior"),)),
        Panel("passes", "regret", "passes", "regret (share)", "criterion", True, (("fit", "with the prior"),)),
    ),
)  # fmt: skip
