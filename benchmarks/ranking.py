"""Measure how the ranking of candidates depends on the number of passes of a fit.

    python benchmarks/ranking.py OUT.json DATASET...

From four states of a dataset (4 views spread evenly in azimuth; 4, 6 and 8 random ones) the model
is fitted for 5 to 4,000 passes, and each criterion of the fitted model scores all other views.
Compared with the ranking after the longest fit: Kendall's tau, and regret, the share of the best
score that is lost if the shorter fit chooses. Prints means over states and datasets. Fits that are
in OUT.json are not made again.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.bench.fit import STATES, Case, make_case
from mgs.data.dataset import load_dataset
from mgs.files import read_json, write_json
from mgs.fit.settings import ALPHA_WEIGHT
from mgs.metrics import agreement
from mgs.policy.criteria import CRITERIA
from mgs.prior.build import build_prior
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions

PASSES = (5, 10, 20, 40, 50, 100, 150, 300, 500, 1000, 4000)
GAUSSIANS = 10_000
FITTED = [
    name for name, criterion in CRITERIA.items() if criterion.at == "fitted" and name != "e-optimal"
]
"""Criteria compared. e-optimal is 0 while any parameter is unobserved, so it ranks nothing here."""


def measure(case: Case, state: str) -> dict[str, Any]:
    """Fit one state with each number of passes: the scores of all candidates, by passes and
    criterion."""
    found: dict[str, Any] = {}
    for passes in PASSES:
        model = case.fit(passes=passes, tolerance=0.0).gaussians
        found[str(passes)] = {
            name: case.scores(model, CRITERIA[name].score).tolist() for name in FITTED
        }
        print(state, passes, flush=True)
    return found


def compare(states: dict[str, Any]) -> list[dict[str, Any]]:
    """Tau and regret of each number of passes against the longest fit, means over the states."""
    rows = []
    for passes in map(str, PASSES):
        for name in FITTED:
            found = [
                agreement(np.array(state[passes][name]), np.array(state[str(PASSES[-1])][name]))
                for state in states.values()
            ]
            means = {key: float(np.mean([one[key] for one in found])) for key in ("tau", "regret")}
            rows.append({"passes": int(passes), "criterion": name} | means)
    return rows


def main(out: Path, roots: list[Path]) -> None:
    """Measure what is missing, write after each state, print."""
    runtime.start()
    states = read_json(out)["states"] if out.is_file() else {}
    for root in roots:
        dataset = load_dataset(root)
        prior, _ = build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))
        for how, count in STATES:
            name = f"{root}: {count} {how}"
            if name not in states:
                states[name] = measure(make_case(dataset, prior, how, count, ALPHA_WEIGHT), name)
                made = {"command": command_line(), "versions": versions()}
                write_json(out, made | {"rows": compare(states), "states": states})
    for row in compare(states):
        print("{passes:5} {criterion:12} tau {tau:.3f} regret {regret:.2%}".format(**row))


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(root) for root in sys.argv[2:]])
