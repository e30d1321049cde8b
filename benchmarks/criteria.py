"""Which score predicts what a view is really worth?

    python benchmarks/criteria.py OUT.json RUN... [--orders N] [--policy P]... [--gains OLD.json]

The last state of each run is a state to choose from: `mgs nbv --budget 0` leaves that of the seeds
alone, `--policy random
--budget 4` another. Every candidate is really taken: the model is fitted on with its image, and the
gain is the rise of the mean PSNR inside the rock over the dataset's test views (over all views
where it has none). For each policy, of the same state: Spearman's rank correlation of its scores
with the gains, and the regret, which is the best gain minus that of the view that it chooses, dB.

A fit depends on the order in which it takes the images. With `--orders N` each candidate is fitted
N times, in other orders, and the mean counts. The agreement r of the gains of single orders (mean
Spearman) then gives the ceiling, the correlation that
the true gains would have with the measured ones: sqrt(N r / (1 + (N - 1) r)), after Spearman and
Brown. It is approximate, since they speak of Pearson's correlation.

OUT.json is written after each fit. The same command goes on where it was interrupted; with more
runs, orders or policies it adds what is missing.

With `--gains OLD.json` the gains are those of an earlier file, which a version or a processor
measured whose last digits were
others, and only the scores are made anew, all of them. So that the states are the same ones is
checked: they must have the same candidates, and the model as it is, and after a fit with the first
candidate and with the last, must come out within SAME.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import spearmanr

from mgs import runtime
from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.files import read_json, write_json
from mgs.policy.poses import farthest_pose
from mgs.policy.registry import policy_named, policy_names
from mgs.run import folder as run_folder
from mgs.run.inputs import array_digest

if TYPE_CHECKING:
    from mgs.run.loop import Loop

METRIC = "psnr_mask"

SAME = 0.02
"""By how much PSNR measured anew may differ from that of an earlier file, dB. Fits in other orders
differ by more."""


def silent(stage: str, done: int, total: int) -> None:
    """No progress bar."""


class Bench:
    """The last state of a run, whose candidates can be scored and fitted."""

    def __init__(self, run: Path) -> None:
        from mgs.prior.build import load_prior

        self.run, self.settings = run, run_folder.read_settings(run)
        state = run_folder.read_checkpoint(run)
        if state is None:
            raise InputError(
                f"{run}: has no finished step yet; continue it with `mgs nbv --resume {run}`"
            )
        self.state, self.dataset, self.prior = (
            state,
            load_dataset(self.settings.dataset),
            load_prior(self.settings.prior),
        )
        run_folder.check_same_frames(run, self.dataset)
        self.metric = f"test_{METRIC}" if self.dataset.test_views() else METRIC
        self.left = [i for i in range(len(self.dataset)) if i not in state.taken]
        self.model = array_digest(asdict(state.gaussians).values())
        from mgs.run.operations import operations_of

        self.stations = operations_of(self.dataset, self.prior, self.settings)

    def loop(self, order: int) -> Loop:
        """The loop of the run; fits take the images in another order for each number."""
        from mgs.run.loop import Loop

        train = self.settings.train.model_copy(update={"seed": self.settings.train.seed + order})
        settings = self.settings.model_copy(update={"train": train})
        return Loop(self.run, settings, self.dataset, self.stations, silent)

    def scores(self, policies: Sequence[str]) -> dict[str, list[float]]:
        """The scores of the candidates, by policy, and how far they are from the views taken, by
        which ties are decided."""
        loop, found = self.loop(0), {}
        for name in policies:
            context = loop.context(self.state, self.left)  # with draws of its own
            found[name] = np.asarray(policy_named(name)(context), np.float64).tolist()
        farthest = farthest_pose(context.candidates, context.taken, context.centre, context.rng)
        return found | {"(farthest)": farthest.tolist()}

    def measured(self, candidate: int | None, order: int) -> float:
        """PSNR of the model after a fit with the candidate's image too, in this order; None: of the
        model as it is."""
        if candidate is None:
            return float(self.stations.measure(self.state.gaussians, self.state.taken)[self.metric])
        loop, taken = self.loop(order), [*self.state.taken, candidate]
        fit = loop.fit(
            self.state, taken, loop.targets(taken), len(self.state.steps), lambda done, most: None
        )
        return float(self.stations.measure(fit.gaussians, taken)[self.metric])


def earlier(bench: Bench, record: dict[str, Any], old: dict[str, Any]) -> dict[str, Any]:
    """The entries of a state whose gains are those of an earlier record: `psnr`, and what was
    `measured_anew` to check them.

    Raises InputError where that is of another state.
    """
    names = record["candidates"]
    anew = {"start": bench.measured(None, 0)} | {
        names[k]: bench.measured(bench.left[k], 0) for k in (0, -1)
    }
    before = {
        name: old["psnr"][name] if name == "start" else old["psnr"][name][0]
        for name in anew
        if name in old["psnr"]
    }
    apart = max(abs(anew[name] - before.get(name, np.inf)) for name in anew)
    for key in ("metric", "candidates", "images"):
        if old[key] != record[key]:
            raise InputError(
                f"--gains: are of another state of {bench.run} ({key} differ); leave them out"
            )
    if apart > SAME:
        raise InputError(
            f"--gains: are of another state of {bench.run} (PSNR differs by {apart:.3f} dB); leave them out"
        )
    return {"psnr": old["psnr"], "measured_anew": anew, "largest_difference": apart}


def study(
    out: Path, runs: Sequence[Path], orders: int, policies: Sequence[str], gains: Path | None = None
) -> dict[str, Any]:
    """Measure what OUT.json does not hold yet; returns its contents. gains: an earlier file, see
    the module. Raises InputError if either is of other states of the runs."""
    from mgs.provenance import command_line, versions

    found = read_json(out) if out.is_file() else {"states": {}}
    if gains is not None:
        old = read_json(gains)
        found["gains_of"] = {key: old[key] for key in ("command", "versions")}
    found |= {"command": command_line(), "versions": versions()}
    for run in runs:
        bench = Bench(run)
        names = [bench.dataset.frames[i].name for i in bench.left]
        known = {"model": bench.model, "metric": bench.metric, "candidates": names}
        record = found["states"].setdefault(
            str(run), known | {"images": len(bench.state.taken), "scores": {}, "psnr": {}}
        )
        if any(record[key] != value for key, value in known.items()):
            raise InputError(
                f"{out}: holds another state of {run} than its last one; write to a new file"
            )
        missing = [name for name in policies if name not in record["scores"]]
        if missing:
            record["scores"] |= bench.scores(missing)
            write_json(out, found)
        if gains is not None and not record["psnr"] and str(run) in old["states"]:
            record |= earlier(bench, record, old["states"][str(run)])
            print(
                f"{run}: PSNR measured anew differs by {record['largest_difference']:.4f} dB at most",
                flush=True,
            )
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
                print(
                    f"{run}: {name}, order {order + 1}: {values[-1] - psnr['start']:+.3f} dB",
                    flush=True,
                )
        record["result"] = compare(record, orders)
        write_json(out, found)
    return found


def compare(record: dict[str, Any], orders: int) -> dict[str, Any]:
    """What one state says, by its first so many orders.

    gains: of each candidate, mean over the orders, dB. spearman, regret: of each policy; None for
    scores that are all equal.
    agreement, ceiling: see the module; only of several orders.
    """
    gains = (
        np.array([record["psnr"][name][:orders] for name in record["candidates"]])
        - record["psnr"]["start"]
    )
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
    """Rank correlation, None where all values of one are equal."""
    return None if np.ptp(a) == 0 or np.ptp(b) == 0 else float(spearmanr(a, b).statistic)


def table(found: dict[str, Any], runs: Sequence[Path]) -> str:
    """A line for each policy: its Spearman correlation in each state, their mean, and the mean
    regret."""
    results = [found["states"][str(run)]["result"] for run in runs]
    lines = [
        f"{'':16}"
        + "".join(f"{run.name[:12]:>14}" for run in runs)
        + f"{'mean':>10}{'regret, dB':>12}"
    ]
    for name in results[0]["spearman"]:
        values = [result["spearman"].get(name) for result in results]
        known = [value for value in values if value is not None]
        mean = f"{np.mean(known):.2f}" if known else "–"
        regret = np.mean([result["regret"][name] for result in results if name in result["regret"]])
        cells = "".join(f"{'–' if value is None else f'{value:.2f}':>14}" for value in values)
        lines.append(f"{Path(name).name:16}{cells}{mean:>10}{regret:>12.3f}")
    ceilings = [result.get("ceiling") for result in results]
    if all(value is not None for value in ceilings):
        lines.append(
            f"{'(ceiling)':16}"
            + "".join(f"{value:14.2f}" for value in ceilings)
            + f"{np.mean(ceilings):10.2f}"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, write, print the table."""
    parser = argparse.ArgumentParser(description="How well scores predict the gain of a view.")
    parser.add_argument("out", type=Path, metavar="OUT.json")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument(
        "--orders",
        type=int,
        default=1,
        help="fits of each candidate, in different orders of the images",
    )
    parser.add_argument("--policy", action="append", help="FILE.py:FUNCTION, beside all names")
    parser.add_argument(
        "--gains",
        type=Path,
        metavar="OLD.json",
        help="an earlier file, from which the gains are taken",
    )
    given = parser.parse_args(arguments)
    runtime.start()
    try:
        found = study(
            given.out,
            given.runs,
            given.orders,
            [*policy_names(), *(given.policy or [])],
            given.gains,
        )
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
    print(table(found, given.runs))


if __name__ == "__main__":
    main()
