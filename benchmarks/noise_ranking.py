"""Does the choice of views depend on the noise that is assumed? `python benchmarks/noise_ranking.py
OUT.json DATASET...`

In the states of benchmarks/ranking.py `d-optimal` ranks every other view, as it does by default,
and with other assumptions:

- "sigma": another standard deviation of the pixels' noise. Lambda changes with it, in the fit and
in the score.
- "alpha in F": alpha as a fourth channel of every pixel, for the views taken and for the candidates
alike. The weight is the
  ratio of the variances of the noise, (sigma_rgb / sigma_alpha)^2.
- "alpha in lambda": the prior's mesh says at every pose what is opaque, so what alpha says there is
known before any image: its
  information at all poses of the dataset is added to lambda, and no view adds more of it.
- "alpha in the fit": models that were fitted to alpha, too, as runs are by default; the score
leaves it out.

Compared with the default: Kendall's tau; and regret, the share of the best score (as the default
has it) that is lost.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from ranking import GAUSSIANS, STATES, views_of

from mgs import runtime
from mgs.data.dataset import Dataset, load_dataset, target_of
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.gaussians import Gaussians
from mgs.metrics import agreement
from mgs.policy.criteria import d_optimal, lam_by_kind, regularisation
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.splat import ListCache, fisher, groups

SIGMAS = (0.005, 0.01, 0.02, 0.04, 0.08)
DEFAULT = 0.02
WEIGHTS = (0.03, 0.3, 1.0, 10.0, 100.0)
FIT_WEIGHTS = (0.03, 0.1, 0.3, 1.0)


def information(
    model: Gaussians, dataset: Dataset, cache: ListCache, weight: float = 0.0
) -> np.ndarray:
    """F of every frame [V,N,11], float64, with alpha observed by this weight."""
    return np.array(
        [fisher(model, frame.camera, cache=cache, alpha_weight=weight) for frame in dataset.frames],
        np.float64,
    )


def scored(F: np.ndarray, taken: list[int], lam: np.ndarray) -> list[float]:
    """Eq. 7 of each view that is not taken; F: [V,N,11], lam: [11] or [N,11]."""
    H = F[taken].sum(axis=0)
    return [float(d_optimal(F[i], H, lam)) for i in range(len(F)) if i not in taken]


def assumptions(dataset: Dataset, state: str) -> Iterator[tuple[str, float, list[float]]]:
    """Scores of the candidates in a state under each assumption: its name, its number, and the
    scores."""
    cache, (prior, _) = ListCache(), build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))
    taken = views_of(
        state, np.array([frame.camera.position for frame in dataset.frames]), prior.points.mean(0)
    )
    frames = [dataset.frames[i] for i in taken]
    start, cameras = initial_gaussians(prior, frames)[0], [frame.camera for frame in frames]
    targets = [target_of(frame) for frame in frames]
    for sigma in SIGMAS:
        lam = regularisation(groups(0), sigma)
        by_kind = lam_by_kind(lam, groups(0))
        model = fit(
            start, cameras, targets, TrainSettings(), cache=cache, start=start, lam=by_kind
        ).gaussians
        F = information(model, dataset, cache)
        yield "sigma", sigma, scored(F, taken, lam)
        if sigma == DEFAULT:
            default = model, F, lam
    model, F, lam = default
    for weight in WEIGHTS:
        observed = information(model, dataset, cache, weight)
        yield "alpha in F", weight, scored(observed, taken, lam)
        yield "alpha in lambda", weight, scored(F, taken, lam + (observed - F).sum(axis=0))
    by_kind = lam_by_kind(lam, groups(0))
    with_alpha = [target_of(frame, with_alpha=True) for frame in frames]
    for weight in FIT_WEIGHTS:
        train = TrainSettings(alpha_weight=weight)
        model = fit(
            start, cameras, with_alpha, train, cache=cache, start=start, lam=by_kind
        ).gaussians
        yield "alpha in the fit", weight, scored(information(model, dataset, cache), taken, lam)


def study(root: Path, state: str) -> list[dict[str, Any]]:
    """One record per assumption: scores, and how they compare with the default's."""
    found = list(assumptions(load_dataset(root), state))
    default = next(
        np.array(scores) for name, number, scores in found if (name, number) == ("sigma", DEFAULT)
    )
    records = []
    for name, number, scores in found:
        mine = np.array(scores)
        record = {
            "dataset": str(root),
            "state": state,
            "assumption": name,
            "number": number,
            "scores": scores,
        }
        records.append(
            record
            | agreement(mine, default)
            | {"same": int(mine.argmax()) == int(default.argmax())}
        )
    return records


def main(out: Path, roots: list[Path]) -> None:
    """Compute, write, print the means."""
    runtime.start()
    records = [record for root in roots for state in STATES for record in study(root, state)]
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(out, made | {"records": records})
    for key in dict.fromkeys((record["assumption"], record["number"]) for record in records):
        of = [record for record in records if (record["assumption"], record["number"]) == key]
        tau, regret, same = (
            np.mean([record[name] for record in of]) for name in ("tau", "regret", "same")
        )
        print(
            f"{key[0]:16} {key[1]:7g}  tau {tau:.2f}  regret {regret:.2%}  the same view {same:.0%}"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(root) for root in sys.argv[2:]])
