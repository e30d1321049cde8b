"""Does a converged model choose better? Scores of models after 1 to 100 passes against real gains.

`python benchmarks/convergence_gain.py OUT [ROCKS]`: hemispheres of `mgs reproduce --only setups`,
with the four seeds and with six random views. Every candidate is added to the model of 10 passes
and fitted; its gain is the PSNR on the test views. After 10 passes all policies are compared.
"""

import sys
from pathlib import Path

import numpy as np

from mgs import runtime

runtime.start()

from mgs.data.dataset import load_dataset  # noqa: E402
from mgs.prior.build import load_prior  # noqa: E402
from mgs.run.loop import fit_views, information, learn  # noqa: E402
from mgs.run.operations import operations_of, psnr_measure  # noqa: E402
from mgs.run.planning import surface_information  # noqa: E402
from mgs.run.problem import Problem  # noqa: E402
from mgs.run.settings import NbvSettings, with_defaults  # noqa: E402
from mgs.run.state import Fitted  # noqa: E402
from mgs.seeds import generator  # noqa: E402
from mgs.splat import ListCache  # noqa: E402
from mgs.study.case import test_views_of  # noqa: E402
from mgs.study.oracle import foretold  # noqa: E402
from mgs.study.reproduce import SIZES  # noqa: E402
from mgs.study.rocks import FRESH  # noqa: E402
from mgs.study.setups import SCORED, SETUPS, case_of  # noqa: E402
from mgs.study.sweep import run_cells  # noqa: E402

PASSES = (1, 3, 10, 30, 100)
POLICIES = ("d-optimal", "paper")
"""Policies whose scores depend on how far the model is fitted."""

USUAL = 10
"""Passes after which the scores of all policies are compared."""


def main(out: Path, rocks: int) -> None:
    """Print for each policy and number of passes the mean Spearman and regret over states."""
    found: dict[tuple[str, int], list[list[float]]] = {}
    for rock in FRESH[:rocks]:
        case = case_of(rock, SETUPS["hemisphere"], SIZES["quick"].setups)
        run_cells(out, case.cells(), lambda cell, done, total: print(cell, flush=True))
        data, prior = load_dataset(out / case.dataset), load_prior(out / case.prior)
        given = {"dataset": out / case.dataset, "prior": out / case.prior, "budget": 8}
        settings = NbvSettings(**with_defaults({**given, "policy": "d-optimal", "seeds": 4}))
        problem = Problem(data, settings, operations_of(data, prior, settings))
        measure = psnr_measure(test_views_of(data), ListCache())
        drawn = generator(rock.index, "convergence").choice(len(data), 6, replace=False).tolist()
        for taken in (problem.seeds, drawn):
            state = learn(problem, taken)
            left = [i for i in range(len(data)) if i not in taken]
            fits = (fit_views(problem, [*taken, frame], state) for frame in left)
            gains = [measure(fit.gaussians, [])["psnr"] for fit in fits]
            for passes in PASSES:
                train = settings.train.model_copy(update={"passes": passes, "tolerance": 0})
                model = fit_views(problem.with_settings(train=train), taken).gaussians
                H = information(problem, model, taken)
                fitted = Fitted(model, H, surface_information(problem, taken), taken)
                policies = (*SCORED, "fisherrf") if passes == USUAL else POLICIES
                told = foretold(policies, problem, fitted, left, gains)
                for policy, one in told.items():
                    found.setdefault((policy, passes), []).append(list(one.values()))
        print(rock.name, flush=True)
        for (policy, passes), numbers in found.items():
            mean = " | ".join(f"{x:.2f}" for x in np.mean(numbers, 0))
            print(f"| {policy} | {passes} | {mean} | {len(numbers)}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 8)
