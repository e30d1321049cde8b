"""Numerics of the criteria: information near zero, ties, blocks that are nearly singular, single
precision."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mgs.metrics import agreement
from mgs.policy.criteria import d_optimal, e_optimal
from mgs.splat import fisher
from mgs.study.stress.experiment import Experiment, Panel, cells_per_rock, turns
from mgs.study.stress.lab import Array, open_lab
from mgs.study.stress.verdict import Claim, single

LAMBDAS = (1e-10, 1e-8, 1e-6, 1e-4, 1e-2)
STATES = {"1 view": 1, "4 views": 4}


def numerics(root: Path, out: Path, scene: str, turns_: int) -> dict[str, Any]:
    """What each criterion makes of the information of one view and of four."""
    lab, rows = open_lab(root, scene), []
    for suffix, turn in turns(turns_):
        for state, count in STATES.items():
            taken = lab.even(count, turn)
            left, model, lam = lab.left(taken), lab.fit(taken).gaussians, lab.lam()
            H: Array = np.sum(lab.information(model, taken), axis=0)
            Fs = lab.information(model, left)
            of_each = [fisher(model, lab.cameras[i], "block", cache=lab.cache) for i in taken]
            blocks: Array = np.sum(of_each, axis=0, dtype=np.float64)
            exact = np.array([d_optimal(F, H, lam) for F in Fs])
            smallest = np.array([e_optimal(F, H, lam) for F in Fs])
            one = {"run": f"{scene}, {suffix}", "state": state}
            rows.append({
                **one, "what": "criteria", "e_tied": float((smallest == smallest.max()).mean()),
                "float32": agreement(np.array([_in_float32(F, H, lam) for F in Fs]), exact)["tau"],
            })  # fmt: skip
            for value in LAMBDAS:
                single_lam = np.full_like(lam, value)
                rows.append({
                    **one, "what": "lambda", "lambda": value,
                    "t_share": max(_top_share(F, H, single_lam) for F in Fs),
                    "d_share": max(_top_share(F, H, single_lam, logarithm=True) for F in Fs),
                    "not_positive_32": _not_positive(blocks, value, np.float32),
                    "not_positive_64": _not_positive(blocks, value, np.float64),
                })  # fmt: skip
    return {"rows": rows}


def _in_float32(F: Array, H: Array, lam: Array) -> float:
    """Eq. 7 with every number and every sum in single precision."""
    F, H, lam = F.astype(np.float32), H.astype(np.float32), lam.astype(np.float32)
    return float(np.log1p(F / (H + lam)).mean(dtype=np.float32))


def _top_share(F: Array, H: Array, lam: Array, logarithm: bool = False) -> float:
    """The share of a candidate's T-optimal score (or of Eq. 7, with the logarithm) that the largest
    1 % of its terms make."""
    terms = np.log1p(F / (H + lam)) if logarithm else F / ((H + lam) * (H + F + lam))
    ordered = np.sort(terms, axis=None)
    total = float(ordered.sum())
    return float(ordered[-max(1, len(ordered) // 100) :].sum() / total) if total > 0 else 1.0


def _not_positive(blocks: Array, lam: float, kind: Any) -> float:
    """The share of 11x11 blocks that are not positive definite in this precision, so that their log
    det cannot be taken."""
    matrices = (blocks + lam * np.eye(blocks.shape[1])).astype(kind)
    return float((np.linalg.eigvalsh(matrices)[:, 0] <= 0).mean())


_ONE, _FOUR = {"state": "1 view"}, {"state": "4 views"}
_TINY = {"what": "lambda", "lambda": 1e-10}

NUMERICS = Experiment(
    "Where do the criteria break numerically?",
    cells_per_rock("numerics", f"{__name__}:numerics", lambda preset: {"turns_": preset.turns}),
    (
        Claim("Near H = 0 (one view, lambda 1e-10) 1 % of the terms make at least half of a T-optimal score (the paper's "
              "A-optimal).",
              single("t_share", _ONE | _TINY), "share", "above", 0.5, "rock and set of views"),
        Claim("In the same state 1 % of the terms make at most a tenth of a D-optimal score.",
              single("d_share", _ONE | _TINY), "share", "below", 0.1, "rock and set of views"),
        Claim("After four views E-optimality cannot choose: at least half of the candidates tie for the largest score.",
              single("e_tied", _FOUR | {"what": "criteria"}), "share", "above", 0.5,
              "rock and set of views"),
        Claim("With lambda 1e-10, rounding to float32 makes at least 1 % of the 11x11 blocks indefinite after four views.",
              single("not_positive_32", _FOUR | _TINY), "share", "above", 0.01, "rock and set of views"),
        Claim("Kept in float64, none of these blocks is indefinite.",
              single("not_positive_64", _FOUR | _TINY), "share", "below", 0.0, "rock and set of views"),
        Claim("Eq. 7 in float32 ranks candidates as float64 does: Kendall's tau is at least 0.99.",
              single("float32", _FOUR | {"what": "criteria"}), "tau", "above", 0.99,
              "rock and set of views"),
    ),
    (
        Panel("lambda", "t_share", "lambda", "share of a T-optimal score in 1 % of terms", "state", True,
              (("what", "lambda"),)),
        Panel("lambda", "not_positive_32", "lambda", "indefinite blocks, float32 (share)", "state", True,
              (("what", "lambda"),)),
        Panel("state", "e_tied", "information of", "candidates tied, E-optimal (share)", None, False,
              (("what", "criteria"),)),
    ),
)  # fmt: skip
