"""Speed against accuracy of scoring: how well cheaper scores agree with the exact ones, and what
they save.

A *state* is a model fitted to some images, from which the next view is chosen. A *choice* computes
the information of the views taken and scores every candidate. The reference is the choice of
`mgs nbv --policy d-optimal`: exact diagonal, whole images, all Gaussians.
"""

from __future__ import annotations

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
from mgs.metrics import agreement
from mgs.policy.criteria import block_log_determinant, d_optimal
from mgs.policy.registry import policy_named
from mgs.prior.build import load_prior
from mgs.run.folder import State as RunState
from mgs.run.folder import read_checkpoint, read_settings, write_checkpoint
from mgs.run.nbv import run_nbv
from mgs.run.operations import operations_of
from mgs.run.problem import Problem
from mgs.splat import ListCache, fisher
from mgs.study.chart.fits import Data
from mgs.study.chart.timing import span, timed, with_seconds
from mgs.study.output import Content
from mgs.study.sweep import Cell, Results, cell_folder
from mgs.study.verdict import Row

STATES = (4, 8)
"""Steps of a d-optimal run after which a choice is studied."""

Scores = NDArray[np.float64]


class State:
    """A run after some steps: model, indices of the views taken and left, all cameras, lambda."""

    def __init__(self, root: Path, dataset: str, prior: str, states: Path, step: int) -> None:
        data, settings = load_dataset(root / dataset), read_settings(states / "run")
        now = read_checkpoint(states / str(step))
        if now is None:
            raise InputError(
                f"{states}: states are missing; delete that folder and give the command again"
            )
        self.run, self.model, self.taken = now, now.gaussians, now.taken
        self.cameras, self.cache = [frame.camera for frame in data.frames], ListCache()
        self.left = [i for i in range(len(data)) if i not in self.taken]
        operations = operations_of(data, load_prior(root / prior), settings)
        self.problem = Problem(data, settings, operations)
        self.lam = self.problem.lam

    def information(
        self, view: int, estimator: str = "exact", shrink: int = 1, **options: Any
    ) -> Any:
        """Information of a view [N,P]; shrink: from an image of so many times less width and
        height, multiplied by the ratio of the numbers of pixels."""
        camera = self.cameras[view]
        small = camera if shrink == 1 else camera.resized(camera.width // shrink)
        F = fisher(self.model, small, estimator, cache=self.cache, **options)
        return F * np.float32(camera.width * camera.height / (small.width * small.height))

    def summed(self, **how: Any) -> Any:
        """Information of the views taken together."""
        return np.sum([self.information(i, **how) for i in self.taken], axis=0, dtype=np.float64)


def by_information(state: State, **how: Any) -> Scores:
    """D-optimal scores with information measured in some way (`State.information`)."""
    H = state.summed(**how)
    return np.array([d_optimal(state.information(i, **how), H, state.lam) for i in state.left])


def by_blocks(state: State) -> Scores:
    """Scores of the policy `block-d`."""
    H, lam = state.summed(estimator="block"), state.lam
    blocks = (state.information(i, estimator="block") for i in state.left)
    return np.array([block_log_determinant(H + F, lam) for F in blocks])


def by_policy(state: State, name: str) -> Scores:
    """Scores of a policy that looks at poses and the prior's surface, as for the first choice."""
    state.problem.__dict__.pop("visibility", None)
    return np.asarray(policy_named(name)(state.problem.context(state.run, state.left)), np.float64)


Way = tuple[str, Callable[[State], Scores]]
"""Family and function of a way to score."""

WAYS: dict[str, Way] = {
    "exact": ("reference", by_information),
    "block": ("estimator", by_blocks),
    "loss-gradient": ("estimator", partial(by_information, estimator="loss-gradient")),
    **{
        f"size 1/{shrink}": ("resolution", partial(by_information, shrink=shrink))
        for shrink in (2, 4, 8)
    },
    **{
        name: ("surface", partial(by_policy, name=name))
        for name in ("coverage", "directional-d", "directional-i")
    },
    **{name: ("poses", partial(by_policy, name=name)) for name in ("uniform", "farthest")},
}


def way(name: str) -> Way:
    """A row of WAYS, or "hutchinson PROBES"."""
    if name in WAYS:
        return WAYS[name]
    probes = int(name.rpartition(" ")[2])
    return "estimator", partial(by_information, estimator="hutchinson", probes=probes)


def _names(data: Data) -> list[str]:
    return [*WAYS, *(f"hutchinson {k}" for k in data.size.probes)]


def _cell_name(name: str) -> str:
    return f"scoring/{name.replace(' ', '-').replace('/', '-')}"


def cells(data: Data, repeats: int) -> list[Cell]:
    """The states, and a cell for each way to score them."""
    case, task = data.case(), f"{__name__}:make_states"
    made = case.cells()
    needs = tuple(cell.name for cell in made)
    given = {**case.folders, "seeds": data.size.seeds, "steps": list(STATES)}
    states = Cell("scoring/states", task, given, needs)
    where = {**case.folders, "states": states.name, "steps": list(STATES), "repeats": repeats}
    return [*made, states] + [
        Cell(_cell_name(n), f"{__name__}:measure", where | {"name": n}, (states.name,), alone=True)
        for n in _names(data)
    ]


def make_states(
    root: Path, out: Path, dataset: str, prior: str, seeds: int, steps: list[int]
) -> dict[str, Any]:
    """Task: run d-optimal once, and keep its state after some steps in folders of their numbers."""
    for folder in out.iterdir():  # of an interrupted call
        shutil.rmtree(folder)

    def keep(state: RunState) -> None:
        if len(state.steps) - 1 in steps:
            write_checkpoint(out / str(len(state.steps) - 1), state)

    given: dict[str, Any] = {"seeds": seeds, "budget": max(steps), "train": COLOURS_ALONE}
    state = run_nbv(root / dataset, out / "run", prior=root / prior, on_step=keep, **given)
    return {"taken": state.taken}


def measure(
    root: Path,
    out: Path,
    dataset: str,
    prior: str,
    states: str,
    steps: list[int],
    name: str,
    repeats: int,
) -> dict[str, Any]:
    """Task: time a way to score over all states. Returns times (`timed`) of one candidate, and the
    scores in each state."""
    _, score = way(name)
    there = [State(root, dataset, prior, cell_folder(root, states), step) for step in steps]
    scores, times = timed(lambda: [score(state) for state in there], repeats)
    count = sum(len(state.left) for state in there)
    times = {k: v if k == "reference" else v / count for k, v in times.items()}
    return times | {"scores": [values.tolist() for values in scores]}


def rows(data: Data, root: Path, found: Results, unit: float) -> list[Row]:
    """A row for each way to score: its time over that of the exact scores, and its agreement with
    them, mean over the states."""
    exact, made = found[_cell_name("exact")], list[Row]()
    for name in _names(data):
        result = dict(found[_cell_name(name)])
        pairs = zip(result.pop("scores"), exact["scores"], strict=True)
        agree = [agreement(np.array(mine), np.array(reference)) for mine, reference in pairs]
        row = {"variant": name, "family": way(name)[0], **result}
        row |= {"over_exact": row["ratio"] / exact["ratio"]}
        made.append(row | {k: float(np.mean([one[k] for one in agree])) for k in ("tau", "regret")})
    return with_seconds(made, unit)


COLUMNS: dict[str, Content] = {
    "scores": "variant",
    "ms a candidate": lambda row: span(row, 1e3),
    "over exact": "over_exact:.2f",
    "Kendall's tau": "tau:.2f",
    "regret": "regret:.1%",
}
