"""SH degree, tau and criterion of the planned directional policies, on rocks that judge nothing.

python benchmarks/directional_models.py OUT [ROCKS]

Prints for each set-up and model the mean difference to D-optimality of degree 1 with tau 0.3, in dB
on test views, inside the rock and on the candidates not taken. Data are kept in OUT. An hour for
seven rocks on two quiet cores. With `five nearest` the plan is a path.
"""

import sys
from pathlib import Path

import numpy as np

from mgs import runtime
from mgs.policy.pool_gains import PoolGains, planned_views
from mgs.run.loop import fit_views
from mgs.study.rocks import Rock
from mgs.study.setups import JUDGE_PASSES, SETUPS, SetupSize, case_of, shared_problem
from mgs.study.sweep import run_cells

SEEDS = "boulder 1, strata 1, contact-binary 2, low-sun 1, contact-binary 1, pebbles 1, boulder 2"
ROCKS = [
    Rock(one.split()[0], int(one.split()[1]), index) for index, one in enumerate(SEEDS.split(", "))
]
MODELS = {
    f"{'I' if over_dome else 'D'}, degree {degree}, tau {tau}": (degree, tau, over_dome)
    for degree, tau, over_dome in [
        (1, 0.3, False), (2, 0.3, False), (2, 1.0, False), (1, 0.3, True), (2, 0.1, True),
        (2, 0.2, True), (2, 0.3, True), (3, 0.1, True), (3, 0.3, True),
    ]
}  # fmt: skip


def main(root: Path, count: int) -> None:
    found: dict[tuple[str, str], list[list[float]]] = {}
    for rock in ROCKS[:count]:
        for name in SETUPS:
            for model, row in judged(root, rock, name).items():
                found.setdefault((name, model), []).append(row)
            print(rock.name, name, flush=True)
    first = next(iter(MODELS))
    for (name, model), rows in found.items():
        means = np.mean(np.array(rows) - found[name, first], 0)
        print(f"{name:16s} {model:22s}", " ".join(f"{mean:+.3f}" for mean in means))


def judged(root: Path, rock: Rock, name: str) -> dict[str, list[float]]:
    """PSNR on test views, inside the rock, on the candidates not taken, by model."""
    setup, size = SETUPS[name], SetupSize()
    case = case_of(rock, setup, size)
    run_cells(root, case.cells(), lambda *_: None)
    budget, data = size.images - setup.seeds, root / case.dataset
    problem, tests, pool, _ = shared_problem(
        data, root / case.prior, data, setup.every, setup.seeds, budget
    )
    known: dict[tuple[int, ...], list[float]] = {}

    def measured(taken: tuple[int, ...]) -> list[float]:
        train = problem.settings.train.model_copy(update={"passes": JUDGE_PASSES})
        model = fit_views(problem.with_settings(train=train), list(taken)).gaussians
        on, left = tests(model), [i for i in range(len(problem.frames)) if i not in taken]
        psnr = on["psnr"].mean(), on["psnr_mask"].mean(), pool(model, left)["psnr"].mean()
        return [float(value) for value in psnr]

    rows = {}
    for model, (degree, tau, over_dome) in MODELS.items():
        seen, seeds = problem.visibility, list(problem.seeds)
        free = problem.reachable(seeds)
        if near := setup.settings.get("nearest"):
            views = seen.path(tuple(seeds), tuple(free), budget, near, (degree, tau, over_dome))
        else:
            dome = seen.dome() if over_dome else None
            gains = PoolGains(seen.points, seen.pool(), seen.lam, degree, tau, dome)
            gains.take(seeds)
            views = planned_views(gains, free, budget)
        taken = (*seeds, *sorted(views))
        known[taken] = known.get(taken) or measured(taken)
        rows[model] = known[taken]
    return rows


if __name__ == "__main__":
    runtime.start()
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else len(ROCKS))
