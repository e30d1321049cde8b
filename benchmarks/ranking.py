"""Does the choice of views depend on how long one fits? `python benchmarks/ranking.py PREFIX
DATASET...`

From each of four states of a dataset (4 views spread evenly in azimuth; 4, 6 and 8 random ones) the
model is fitted for 5 to 4,000 passes, and every other view is scored by each criterion that looks
at the fitted model. Compared with the ranking after
the longest fit: Kendall's tau; and regret, the share of the longest fit's best score that is lost
if the shorter fit chooses.

What could a run know of this when its fit stops? Measured for that are tau with the ranking after
half as many passes, in a fit of that length, and the Newton decrease, by which the objective is
predicted to fall yet (`mgs.report.convergence`).

Writes PREFIX.json, and PREFIX.png. Fits that are in PREFIX.json already are not made again.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.data.dataset import Dataset, load_dataset, target_of
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.objective import newton_decrease, objective
from mgs.fit.settings import TrainSettings
from mgs.gaussians import Gaussians
from mgs.metrics import agreement
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.policy.criteria import CRITERIA, regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.convergence import CG_ITERATIONS
from mgs.seeds import generator
from mgs.splat import ListCache, as_drjit, fisher, groups

STATES = {"4 even": 4, "4 random": 4, "6 random": 6, "8 random": 8}
PASSES = (5, 10, 20, 40, 50, 100, 150, 300, 500, 1000, 4000)
HALVES = {2 * passes: passes for passes in PASSES if 2 * passes in PASSES}
"""Lengths of a fit of which half is there, too."""
GAUSSIANS = 10_000
FITTED = [
    name for name, criterion in CRITERIA.items() if criterion.at == "fitted" and name != "e-optimal"
]
"""Criteria compared. e-optimal is 0 while any parameter stays unobserved, so it ranks nothing
here."""


def views_of(state: str, positions: np.ndarray, centre: np.ndarray) -> list[int]:
    """Frames of a state."""
    count = STATES[state]
    if state.endswith("even"):
        return seed_views(positions, centre, count)
    return sorted(
        generator(0, f"ranking/{state}").choice(len(positions), count, replace=False).tolist()
    )


def scores(
    model: Gaussians, taken: list[int], dataset: Dataset, lam: np.ndarray, cache: ListCache
) -> dict[str, list[float]]:
    """The score of each view that is not taken, by each criterion of FITTED."""
    cameras = [frame.camera for frame in dataset.frames]
    H = np.sum([fisher(model, cameras[i], cache=cache) for i in taken], axis=0, dtype=np.float64)
    found: dict[str, list[float]] = {name: [] for name in FITTED}
    for i in (i for i in range(len(cameras)) if i not in taken):
        F = fisher(model, cameras[i], cache=cache)
        for name in FITTED:
            found[name].append(CRITERIA[name].score(F, H, lam))
    return found


def study(root: Path, state: str, lengths: list[int]) -> list[dict[str, Any]]:
    """One record per number of passes: loss, scores, and the share of the objective by which it is
    predicted to fall yet."""
    dataset, cache, lam = load_dataset(root), ListCache(), regularisation(groups(0))
    prior, _ = build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))
    positions = np.array([frame.camera.position for frame in dataset.frames])
    taken = views_of(state, positions, prior.points.mean(0))
    frames = [dataset.frames[i] for i in taken]
    start, by_kind = (
        initial_gaussians(prior, frames)[0],
        {kind: float(lam[c][0]) for kind, c in groups(0).items()},
    )
    cameras, targets = [frame.camera for frame in frames], [target_of(frame) for frame in frames]
    goal, records = objective(start, cameras, targets, start, by_kind, cache), []
    for passes in lengths:
        found = fit(
            start,
            cameras,
            targets,
            TrainSettings(passes=passes, tolerance=0.0),
            cache=cache,
            start=start,
            lam=by_kind,
        )
        values = scores(found.gaussians, taken, dataset, lam, cache)
        record = {
            "dataset": str(root),
            "state": state,
            "views": taken,
            "passes": passes,
            "loss": found.loss,
            "scores": values,
        }
        model = as_drjit(found.gaussians)
        decrease = newton_decrease(goal, model, CG_ITERATIONS)[-1] / goal.phi(model)
        records.append(record | {"predicted_decrease": decrease})
        print(root, state, passes, f"loss {found.loss:.4g}", flush=True)
    return records


def compared(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Kendall's tau and regret of each record against the longest fit of its state, by criterion;
    and what a run could know: "tau_half", tau with the fit of half the length, where there is one,
    and "predicted_decrease", against the "found_decrease", the share by which the loss of the
    longest fit is lower (`mgs.fit.fitting.Fit`)."""
    found = []
    for record in records:
        of_state = {
            r["passes"]: r
            for r in records
            if (r["dataset"], r["state"]) == (record["dataset"], record["state"])
        }
        half, longest = of_state.get(HALVES.get(record["passes"], 0)), of_state[max(of_state)]
        decrease = {
            "predicted_decrease": record.get("predicted_decrease"),
            "found_decrease": 1 - longest["loss"] / record["loss"],
        }
        for name in FITTED:
            mine, end = (np.array(r["scores"][name]) for r in (record, longest))
            row = (
                {key: record[key] for key in ("dataset", "state", "passes")}
                | decrease
                | {"criterion": name}
            )
            known = (
                {}
                if half is None
                else {"tau_half": agreement(np.array(half["scores"][name]), mine)["tau"]}
            )
            found.append(row | agreement(mine, end) | known)
    return found


def draw(path: Path, rows: list[dict[str, Any]]) -> None:
    """Tau and regret against passes: the mean over states as a line, each state as a dot."""
    import matplotlib

    colours = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
    with matplotlib.rc_context(STYLE):
        figure = new_figure(7.2, 3.1)
        axes = figure.subplots(1, 2)
        for name, colour in zip(FITTED, colours, strict=False):
            for axis, key, scale in zip(axes, ("tau", "regret"), (1, 100), strict=True):
                values = {
                    p: [scale * r[key] for r in rows if (r["criterion"], r["passes"]) == (name, p)]
                    for p in PASSES[:-1]
                }
                axis.plot(
                    list(values), [np.mean(v) for v in values.values()], color=colour, label=name
                )
                for passes, dots in values.items():
                    axis.plot(
                        [passes] * len(dots), dots, ".", color=colour, alpha=0.4, markersize=4
                    )
        axes[0].set(ylabel=f"Kendall's tau with {PASSES[-1]:,} passes")
        axes[1].set(ylabel="regret (%)")
        for axis in axes:
            axis.set(xscale="log", xlabel="passes of the fit")
        axes[0].legend()
        save_figure(figure, path)


def main(prefix: Path, roots: list[Path]) -> None:
    """Compute what is missing, write after every state, draw."""
    runtime.start()
    path = prefix.with_suffix(".json")
    records = json.loads(path.read_text())["records"] if path.is_file() else []
    for state in STATES:
        for root in roots:
            done = [
                r["passes"] for r in records if (r["dataset"], r["state"]) == (str(root), state)
            ]
            if left := [passes for passes in PASSES if passes not in done]:
                records += study(root, state, left)
                made = {
                    "command": command_line(),
                    "machine": runtime.processor(),
                    "versions": versions(),
                }
                write_json(path, made | {"rows": compared(records), "records": records})
    rows = compared(records)
    for passes in PASSES:
        for name in FITTED:
            of = [r for r in rows if (r["criterion"], r["passes"]) == (name, passes)]
            tau, regret = (np.mean([r[key] for r in of]) for key in ("tau", "regret"))
            print(f"{passes:5} {name:12} tau {tau:.3f} regret {regret:.2%}")
    draw(prefix.with_suffix(".png"), rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(root) for root in sys.argv[2:]])
