"""Speed against accuracy of scoring: how well cheaper scores agree with the exact ones, and what
they save.

A *state* is a model fitted to some images, from which the next view is to be chosen. A *choice*
computes the information of the views taken and scores every candidate. The reference is the choice
of `mgs nbv --policy d-optimal`: exact diagonal, whole images, all Gaussians, information of the
views taken measured anew at the model of the state.
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.fit.settings import COLOURS_ALONE
from mgs.gaussians import Gaussians
from mgs.metrics import agreement
from mgs.policy.criteria import d_optimal
from mgs.run.folder import read_checkpoint
from mgs.seeds import generator
from mgs.study.chart.plan import DENSITY, PLANS, Data, Plan
from mgs.study.chart.timing import timed
from mgs.study.sweep import Cell, cell_folder

AGES = (2, 4)
"""How many steps ago the model was fitted at which old information, or old scores, were
measured."""

STATES = (4, 8)
"""Steps of a d-optimal run after which a choice is studied."""


class State:
    """The state of a run after some steps, and after `age` steps less.

    state: as the loop has it; model, old: Gaussians then and before; taken, taken_before: indices
    of frames; cameras: of all frames; left: the candidates; lam: [P].
    """

    def __init__(
        self, root: Path, dataset: str, prior: str, runs: Path, step: int, age: int
    ) -> None:
        from mgs.prior.build import load_prior
        from mgs.run.folder import read_settings
        from mgs.run.operations import operations_of
        from mgs.run.problem import Problem
        from mgs.splat import ListCache

        data, settings = load_dataset(root / dataset), read_settings(runs / "run")
        now, before = (read_checkpoint(runs / str(k)) for k in (step, step - age))
        if now is None or before is None:
            raise InputError(
                f"{runs}: states are missing; delete that folder and give the command again"
            )
        self.state, self.model, self.old, self.taken, self.taken_before = (
            now,
            now.gaussians,
            before.gaussians,
            now.taken,
            before.taken,
        )
        self.cameras, self.cache = [frame.camera for frame in data.frames], ListCache()
        self.left = [i for i in range(len(data)) if i not in self.taken]
        self.folders = [runs / str(k) for k in range(step + 1)]
        stations = operations_of(data, load_prior(root / prior), settings)
        self.problem = Problem(data, settings, stations)
        self.lam = settings.regularisation(stations.groups)

    @functools.cached_property
    def old_information(self) -> NDArray[np.float64]:
        """Information of the views taken by now, measured at the older model."""
        return self.summed(self.taken, model=self.old)

    @functools.cached_property
    def first_information(self) -> NDArray[np.float64]:
        """Information of the views taken by now, that of each as it was measured at the first model
        that was fitted to it."""
        parts, known = [], 0
        for folder in self.folders:
            then = read_checkpoint(folder)
            assert then is not None
            parts.append(self.summed(then.taken[known:], model=then.gaussians))
            known = len(then.taken)
        return np.sum(parts, axis=0)

    @functools.cached_property
    def old_scores(self) -> NDArray[np.float64]:
        """Scores of the candidates as they were then."""
        H = self.summed(self.taken_before, model=self.old)
        return np.array(
            [d_optimal(self.information(i, model=self.old), H, self.lam) for i in self.left]
        )

    def information(
        self,
        view: int,
        model: Gaussians | None = None,
        estimator: str = "exact",
        shrink: int = 1,
        **options: Any,
    ) -> NDArray[np.float64]:
        """What one view says, [N,P]; shrink: from an image of so many times less width and height,
        whose information is multiplied by how many pixels fewer it has."""
        from mgs.splat import fisher

        camera = self.cameras[view]
        small = camera if shrink == 1 else camera.resized(camera.width // shrink)
        F = fisher(
            self.model if model is None else model, small, estimator, cache=self.cache, **options
        )
        return F * np.float32(camera.width * camera.height / (small.width * small.height))

    def summed(self, views: list[int], **how: Any) -> NDArray[np.float64]:
        """Information of some views together."""
        return np.sum([self.information(i, **how) for i in views], axis=0, dtype=np.float64)


Score = Callable[[State], NDArray[np.float64]]
"""(state) -> scores of its candidates, by their order in `left`."""


def scored(state: State, columns: slice = slice(None), **how: Any) -> NDArray[np.float64]:
    """D-optimal scores with information measured in some way (`State.information`), by some
    columns."""
    H, lam = state.summed(state.taken, **how), state.lam[columns]
    return np.array(
        [d_optimal(state.information(i, **how)[:, columns], H[:, columns], lam) for i in state.left]
    )


def of_subset(state: State, share: float) -> NDArray[np.float64]:
    """Scores of a model of only a random share of the Gaussians, which is also what hides the
    others."""
    n = len(state.model)
    kept = np.sort(generator(0, "chart/subset").choice(n, max(1, round(share * n)), replace=False))
    return scored(state, model=state.model[kept])


def stale(state: State) -> NDArray[np.float64]:
    """Scores beside old information of the views taken, which is there already; that of the
    candidates is new."""
    return np.array(
        [d_optimal(state.information(i), state.old_information, state.lam) for i in state.left]
    )


def incremental(state: State) -> NDArray[np.float64]:
    """Scores where information of each view taken is measured once, when it is taken; that of the
    candidates is new."""
    return np.array(
        [d_optimal(state.information(i), state.first_information, state.lam) for i in state.left]
    )


def lazy(state: State) -> NDArray[np.float64]:
    """Candidates in the order of their old scores, scored anew until the best new score is above
    the next old one.

    Gains fall as views are taken if the model stays as it is, so that an old score is an upper
    bound (Minoux 1978). Here the model is fitted in between, and it is none. The old scores are
    there already, and no part of the time.
    """
    H, scores, best = state.summed(state.taken), state.old_scores.copy(), -np.inf
    for k in np.argsort(-state.old_scores, kind="stable"):
        if best > state.old_scores[k]:
            break
        scores[k] = d_optimal(state.information(state.left[k]), H, state.lam)
        best = max(best, float(scores[k]))
    return scores


def by_policy(state: State, name: str) -> NDArray[np.float64]:
    """Scores by a policy that looks at poses and the prior's surface, all computed anew, as for the
    first choice."""
    from mgs.policy.registry import policy_named

    problem = state.problem
    problem.__dict__.pop("visibility", None)
    fisher = problem.view_information(state.model)
    context = problem.context(state.state, state.left, fisher)
    return np.asarray(policy_named(name)(context), np.float64)


def block_scores(state: State) -> NDArray[np.float64]:
    """Scores by the exact blocks (`mgs.policy.registry.block_d`)."""
    from mgs.policy.criteria import block_log_determinant

    H = state.summed(state.taken, estimator="block")
    return np.array(
        [
            block_log_determinant(H + state.information(i, estimator="block"), state.lam)
            for i in state.left
        ]
    )


def variants(plan: Plan) -> dict[str, tuple[str, Score]]:
    """The ways to score: {name: (family, function)}. A number at the end of `stale` and `lazy` is
    the age of what is old."""
    found: dict[str, tuple[str, Score]] = {
        "exact": ("reference", scored),
        "block": ("estimator", block_scores),
    }
    for k in plan.probes:
        found[f"hutchinson {k}"] = ("estimator", partial(scored, estimator="hutchinson", probes=k))
    found["loss-gradient"] = ("estimator", partial(scored, estimator="loss-gradient"))
    for shrink in (2, 4, 8):
        found[f"size 1/{shrink}"] = ("resolution", partial(scored, shrink=shrink))
    for part in (2, 4, 10):
        found[f"1/{part} of Gaussians"] = ("subset", partial(of_subset, share=1 / part))
    found["colour only"] = ("columns", partial(scored, columns=slice(0, 3)))
    found["incremental"] = ("stale", incremental)
    for age in AGES:
        found[f"stale {age}"], found[f"lazy {age}"] = ("stale", stale), ("lazy", lazy)
    for name in ("coverage", "directional-d", "directional-i"):
        found[name] = ("surface", partial(by_policy, name=name))
    for name in ("uniform", "farthest"):
        found[name] = ("poses", partial(by_policy, name=name))
    return found


def cells(plan: Plan, data: Data, repeats: int, preset: str) -> list[Cell]:
    """The states, and a cell for each way to score them. preset: the name of the plan."""
    prior = data.prior(DENSITY)
    where = {"dataset": data.folder, "prior": f"cells/{prior.name}/prior"}
    states = Cell(
        f"scoring/{data.label}/states",
        "mgs.study.chart.scoring:make_states",
        {**where, "seeds": plan.seeds},
        (prior.name,),
    )
    found = [*data.cells, prior, states]
    for name in variants(plan):
        arguments = {
            **where,
            "states": states.name,
            "variant": name,
            "preset": preset,
            "repeats": repeats,
        }
        found.append(
            Cell(
                cell_name(data, name),
                "mgs.study.chart.scoring:measure",
                arguments,
                (states.name,),
                alone=True,
            )
        )
    return found


def cell_name(data: Data, variant: str) -> str:
    """The name of the cell of a way to score."""
    return f"scoring/{data.label}/{variant.replace(' ', '-').replace('/', '-')}"


def make_states(root: Path, out: Path, dataset: str, prior: str, seeds: int) -> dict[str, Any]:
    """Run d-optimal once, and keep its state after every step in a folder of the step's number."""
    from mgs.run.folder import State as Kept
    from mgs.run.folder import write_checkpoint
    from mgs.run.nbv import run_nbv

    def keep(state: Kept) -> None:
        write_checkpoint(out / str(len(state.steps) - 1), state)

    for folder in out.iterdir():  # what an interrupted call left
        shutil.rmtree(folder)
    given: dict[str, Any] = {"seeds": seeds, "budget": max(STATES), "train": COLOURS_ALONE}
    state = run_nbv(root / dataset, out / "run", prior=root / prior, on_step=keep, **given)
    return {"taken": state.taken}


def measure(
    root: Path,
    out: Path,
    dataset: str,
    prior: str,
    states: str,
    variant: str,
    preset: str,
    repeats: int,
) -> dict[str, Any]:
    """Time a way to score over all states. Returns times (`timed`) of one candidate, and the scores
    in each state."""
    _, score = variants(PLANS[preset])[variant]
    last = variant.rpartition(" ")[2]
    age = int(last) if variant.startswith(("stale", "lazy")) else min(AGES)
    there = [State(root, dataset, prior, cell_folder(root, states), step, age) for step in STATES]
    scores, times = timed(lambda: [score(state) for state in there], repeats)
    candidates = sum(len(state.left) for state in there)
    return {
        name: value if name == "reference" else value / candidates for name, value in times.items()
    } | {"scores": [values.tolist() for values in scores]}


def rows(plan: Plan, data: Data, found: dict[str, Any], command: str) -> list[dict[str, Any]]:
    """A row for each way to score: its time, and its agreement with the exact scores, mean over the
    states."""
    exact, made = found[cell_name(data, "exact")]["scores"], []
    for name, (family, _) in variants(plan).items():
        result = found[cell_name(data, name)]
        agree = [
            agreement(*map(np.array, pair)) for pair in zip(result["scores"], exact, strict=True)
        ]
        tau, regret = (float(np.mean([one[key] for one in agree])) for key in ("tau", "regret"))
        times = {key: value for key, value in result.items() if key != "scores"}
        made.append(
            {
                "variant": name,
                "family": family,
                **times,
                "tau": tau,
                "regret": regret,
                "command": command,
            }
        )
    return made
