"""Measure which score predicts what a view is really worth.

    python benchmarks/criteria.py OUT.json RUN... [--orders N] [--policy FILE.py:FUNCTION]...

The last state of each run is a state to choose from: `mgs nbv --budget 0` leaves that of the seeds
alone, `--policy random --budget 4` another. Every candidate is really taken: the model is fitted on
with its image. Its gain is the rise of the mean PSNR inside the rock over the test views (over all
views if there are none). For each policy: Spearman's rank correlation of its scores with the gains,
and the regret, the best gain minus that of the view that it chooses, dB.

A fit depends on the order of the images. With `--orders N` each candidate is fitted N times and the
mean counts. The agreement r of the gains of single orders (mean Spearman) then gives the ceiling,
the correlation of the true gains with the measured ones: sqrt(N r / (1 + (N - 1) r)), after
Spearman and Brown. It is approximate, since they speak of Pearson's correlation.

OUT.json is written after each fit. The same command continues where it was interrupted; with more
runs, orders or policies it adds what is missing.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from mgs import runtime
from mgs.errors import InputError
from mgs.files import read_json, write_json
from mgs.policy.poses import farthest_pose
from mgs.policy.registry import policy_named, policy_names
from mgs.provenance import command_line, versions
from mgs.run.folder import open_run
from mgs.run.inputs import array_digest
from mgs.run.loop import fit_views
from mgs.run.nbv import problem_of
from mgs.run.problem import Problem

METRIC = "psnr_mask"


class Bench:
    """Last state of a run, whose candidates can be scored and fitted."""

    def __init__(self, folder: Path) -> None:
        run = open_run(folder)
        self.state, self.dataset, self.settings = run.state, run.dataset, run.settings
        self.metric = f"test_{METRIC}" if self.dataset.test_views() else METRIC
        self.left = [i for i in range(len(self.dataset)) if i not in self.state.taken]
        self.model = array_digest(asdict(self.state.gaussians).values())
        self.operations = problem_of(run).operations

    def problem(self, order: int) -> Problem:
        """Problem of the run; fits take the images in another order for each number."""
        train = self.settings.train.model_copy(update={"seed": self.settings.train.seed + order})
        settings = self.settings.model_copy(update={"train": train})
        return Problem(self.dataset, settings, self.operations)

    def scores(self, policies: Sequence[str]) -> dict[str, list[float]]:
        """Scores of the candidates by policy, and their distance from the views taken, which
        decides ties."""
        problem, found = self.problem(0), {}
        for name in policies:
            context = problem.context(self.state, self.left)  # with its own random draws
            found[name] = np.asarray(policy_named(name)(context), np.float64).tolist()
        farthest = farthest_pose(context.candidates, context.taken, context.centre, context.rng)
        return found | {"(farthest)": farthest.tolist()}

    def measured(self, candidate: int | None, order: int) -> float:
        """PSNR after a fit with the candidate's image too, in this order; None: of the model as it
        is."""
        taken, model = self.state.taken, self.state.gaussians
        if candidate is not None:
            taken = [*taken, candidate]
            model = fit_views(self.problem(order), taken, self.state).gaussians
        return float(self.operations.measure(model, taken)[self.metric])


def study(out: Path, runs: Sequence[Path], orders: int, policies: Sequence[str]) -> dict[str, Any]:
    """Measure what OUT.json lacks, and return its contents. Raises InputError if it holds other
    states of the runs."""
    found = read_json(out) if out.is_file() else {"states": {}}
    found |= {"command": command_line(), "versions": versions()}
    for run in runs:
        bench = Bench(run)
        names = [bench.dataset.frames[i].name for i in bench.left]
        known = {"model": bench.model, "metric": bench.metric, "candidates": names}
        empty = {"images": len(bench.state.taken), "scores": {}, "psnr": {}}
        record = found["states"].setdefault(str(run), known | empty)
        if any(record[key] != value for key, value in known.items()):
            raise InputError(f"{out}: holds another state of {run}; write to a new file")
        if missing := [name for name in policies if name not in record["scores"]]:
            record["scores"] |= bench.scores(missing)
            write_json(out, found)
        psnr = record["psnr"]
        if "start" not in psnr:
            psnr["start"] = bench.measured(None, 0)
        for order in range(orders):
            for candidate, name in zip(bench.left, names, strict=True):
                values = psnr.setdefault(name, [])
                if len(values) > order:
                    continue
                values.append(bench.measured(candidate, order))
                write_json(out, found)
                gain = values[-1] - psnr["start"]
                print(f"{run}: {name}, order {order + 1}: {gain:+.3f} dB", flush=True)
        record["result"] = compare(record, orders)
        write_json(out, found)
    return found


def compare(record: dict[str, Any], orders: int) -> dict[str, Any]:
    """Compare scores with gains in one state, by its first so many orders.

    gains: of each candidate, mean over the orders, dB. spearman, regret: of each policy; None for
    scores that are all equal. agreement, ceiling: see the module; only with several orders.
    """
    psnr = np.array([record["psnr"][name][:orders] for name in record["candidates"]])
    gains = psnr - record["psnr"]["start"]
    mean = gains.mean(axis=1)
    result: dict[str, Any] = {"gains": mean.tolist(), "spearman": {}, "regret": {}}
    distance = record["scores"]["(farthest)"]
    for name, scores in record["scores"].items():
        if name == "(farthest)":
            continue
        result["spearman"][name] = spearman(scores, mean)
        chosen = max(range(len(mean)), key=lambda k: (scores[k], distance[k]))
        result["regret"][name] = float(mean.max() - mean[chosen])
    pairs = [spearman(gains[:, a], gains[:, b]) or 0.0 for a, b in combinations(range(orders), 2)]
    if pairs:
        r = float(np.mean(pairs))
        result["agreement"] = r
        result["ceiling"] = float(np.sqrt(orders * r / (1 + (orders - 1) * r))) if r > 0 else 0.0
    return result


def spearman(a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray) -> float | None:
    """Rank correlation; None if all values of one are equal."""
    return None if np.ptp(a) == 0 or np.ptp(b) == 0 else float(spearmanr(a, b).statistic)


def table(found: dict[str, Any], runs: Sequence[Path]) -> str:
    """Format a line for each policy: Spearman's correlation in each state, mean, mean regret."""
    results = [found["states"][str(run)]["result"] for run in runs]
    rows: dict[str, list[float | None]] = {
        name: [result["spearman"].get(name) for result in results]
        for name in results[0]["spearman"]
    }
    if all("ceiling" in result for result in results):
        rows["(ceiling)"] = [result["ceiling"] for result in results]
    heads = "".join(f"{run.name[:12]:>14}" for run in runs)
    lines = [f"{'':16}{heads}{'mean':>10}{'regret, dB':>12}"]
    for name, values in rows.items():
        cells = "".join(f"{'–' if value is None else f'{value:.2f}':>14}" for value in values)
        known = [value for value in values if value is not None]
        mean = f"{np.mean(known):.2f}" if known else "–"
        regrets = [result["regret"][name] for result in results if name in result["regret"]]
        regret = f"{np.mean(regrets):.3f}" if regrets else ""
        lines.append(f"{Path(name).name:16}{cells}{mean:>10}{regret:>12}")
    return "\n".join(lines)


def main() -> None:
    """Measure, write, print the table."""
    parser = argparse.ArgumentParser(description="How well scores predict the gain of a view.")
    parser.add_argument("out", type=Path, metavar="OUT.json")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--orders", type=int, default=1, help="fits of each candidate")
    parser.add_argument("--policy", action="append", default=[], help="beside all named policies")
    given = parser.parse_args()
    runtime.start()
    try:
        found = study(given.out, given.runs, given.orders, [*policy_names(), *given.policy])
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
    print(table(found, given.runs))


if __name__ == "__main__":
    main()
