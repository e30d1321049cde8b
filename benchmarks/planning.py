"""Seconds to plan a flight by the directional criteria. `python benchmarks/planning.py OUT.json
BUDGET DATASET:PRIOR...`

A plan is BUDGET views beyond four seeds, chosen one after another by `directional-i` or
`directional-d`; it needs poses and a prior, no image. It is made by gains that are brought up to
date with every view (`mgs.policy.pool_gains`), as `mgs nbv` does it; by gains that are computed
anew for every choice (`mgs.policy.directional.gains`); and anew for every k-th Gaussian alone. Are
the choices the same, and what does the whole plan bring? Seconds are those of the choices, after
one pass over the poses has measured what they see, and without a first plan of one view, in which
kernels are compiled; the shortest, gains brought up to date, are timed three times, and the median
counts. Let nothing else run.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mgs import runtime
from mgs.data.dataset import load_dataset
from mgs.files import write_json
from mgs.policy import directional
from mgs.policy.criteria import regularisation
from mgs.policy.directional import Views
from mgs.policy.poses import seed_views
from mgs.policy.visibility import Visibility
from mgs.prior.build import load_prior
from mgs.provenance import command_line, versions
from mgs.run.settings import NbvSettings

CRITERIA = {"directional-i": (3, 0.1), "directional-d": (2, 0.3)}
"""Degree and tau of `mgs.policy.registry`."""

COUNTS = (1024, 4096, 16384)
"""About so many Gaussians, where there are more."""

SEEDS = 4


REPEATS = 3


class Pool(NamedTuple):
    """Points [N,3], all poses, a dome, lam of colours, seeds."""

    points: np.ndarray
    poses: Views
    dome: Views
    lam: float
    seeds: list[int]

    def some(self, count: int) -> Pool:
        """With about that many of the Gaussians, every k-th."""
        rows = np.arange(0, len(self.points), -(-len(self.points) // count))
        cut = [Views(views.positions, views.seen[:, rows]) for views in (self.poses, self.dome)]
        return self._replace(points=self.points[rows], poses=cut[0], dome=cut[1])


def pool_of(dataset: Path, prior_folder: Path) -> Pool:
    """What all poses of a dataset see of a prior's Gaussians before training."""
    from mgs.prior.initial import initial_gaussians
    from mgs.splat import ListCache, fisher, groups

    prior, frames = load_prior(prior_folder), load_dataset(dataset).frames
    unseen = np.zeros(len(prior.points), bool), np.zeros((0, 3))
    start = initial_gaussians(prior, frames, colours=lambda frame: unseen)[0]
    cameras, cache, n = [frame.camera for frame in frames], ListCache(), len(prior.points)
    centre, points = prior.points.mean(axis=0), np.asarray(start.means[:n])
    settings = NbvSettings(dataset=dataset, prior=prior_folder)
    lam = float(regularisation(groups(0), settings.pixel_noise, settings.prior_std)[0])
    sight = Visibility(
        cameras, lambda camera: fisher(start, camera, cache=cache)[:n], points, centre, lam
    )
    return Pool(points, sight.pool(), sight.dome(), lam, seed_views(sight.positions, centre, SEEDS))


def anew(pool: Pool, criterion: str) -> Callable[[list[int], list[int]], np.ndarray]:
    """The function (views taken, candidates) -> gains, computed anew at every call."""
    degree, tau = CRITERIA[criterion]
    dome = pool.dome if criterion == "directional-i" else None

    def gains(taken: list[int], left: list[int]) -> np.ndarray:
        views = [Views(pool.poses.positions[some], pool.poses.seen[some]) for some in (taken, left)]
        return directional.gains(pool.points, pool.lam, degree, tau, *views, dome)

    return gains


def updated(pool: Pool, criterion: str) -> Callable[[list[int], list[int]], np.ndarray]:
    """The same, brought up to date."""
    from mgs.policy.pool_gains import pool_gains

    degree, tau = CRITERIA[criterion]
    gains = pool_gains(pool.points, pool.lam, lambda: pool.poses, lambda: pool.dome)
    return lambda taken, left: gains(taken, left, degree, tau, criterion == "directional-i")


Gains = Callable[[Pool, str], Callable[[list[int], list[int]], np.ndarray]]


def planned(
    pool: Pool, criterion: str, budget: int, method: Gains
) -> tuple[list[int], float, list[np.ndarray]]:
    """The views, with the seeds; the seconds of their choice; the gains of the candidates before
    each choice."""
    taken, found = list(pool.seeds), []
    began = time.perf_counter()
    gains = method(pool, criterion)
    for _ in range(budget):
        left = [i for i in range(len(pool.poses.positions)) if i not in taken]
        found.append(gains(taken, left))
        taken.append(left[int(found[-1].argmax())])
    return taken, time.perf_counter() - began, found


def compared(pool: Pool, criterion: str, budget: int) -> list[dict[str, Any]]:
    """A record for each way to plan; the first is the reference."""
    reference, seconds, truth = planned(pool, criterion, budget, anew)
    whole = worth(pool, criterion, reference)
    planned(pool, criterion, 1, updated)
    ways = [
        ("updated", pool, updated),
        *((f"{count}", pool.some(count), anew) for count in COUNTS if count < len(pool.points)),
    ]
    rows = [{"way": "anew", "gaussians": len(pool.points), "seconds": seconds}]
    for way, part, method in ways:
        plans = [
            planned(part, criterion, budget, method)
            for _ in range(REPEATS if way == "updated" else 1)
        ]
        plan, took, found = sorted(plans, key=lambda plan: plan[1])[len(plans) // 2]
        row = {
            "way": way,
            "gaussians": len(part.points),
            "seconds": took,
            "worth": worth(pool, criterion, plan) / whole,
        }
        row |= {"kept": len(set(plan) & set(reference)) - SEEDS, "same": plan == reference}
        if way == "updated" and plan == reference:  # gains of a part of the Gaussians are smaller
            row["largest_difference"] = max(
                float(np.abs(a / b - 1).max()) for a, b in zip(found, truth, strict=True)
            )
        rows.append(row)
    for row in rows:
        print(criterion, row, flush=True)
    return rows


def worth(pool: Pool, criterion: str, taken: list[int]) -> float:
    """What the chosen views of a plan bring by the criterion, all Gaussians counted: the sum of
    their gains."""
    degree, tau = CRITERIA[criterion]
    prior, dome = np.diag(directional.precision(degree, tau, pool.lam)), pool.dome

    def part(some: slice) -> float:
        points = pool.points[some]
        seeds, plan = (
            prior
            + directional.information(
                points, Views(pool.poses.positions[v], pool.poses.seen[v][:, some]), degree
            )
            for v in (pool.seeds, taken)
        )
        if criterion == "directional-d":
            return float(1.5 * (np.linalg.slogdet(plan)[1] - np.linalg.slogdet(seeds)[1]).sum())
        M = directional.information(points, Views(dome.positions, dome.seen[:, some]), degree)
        return float(np.einsum("nkl,nkl->", M, np.linalg.inv(seeds) - np.linalg.inv(plan)))

    return sum(directional.in_parts(len(pool.points), part))


def main(out: Path, budget: int, cases: list[str]) -> None:
    """Measure, write after each case."""
    runtime.start()
    rows, made = [], {"machine": runtime.processor(), "versions": versions()}
    for case in cases:
        dataset, prior = case.split(":")
        began = time.perf_counter()
        pool = pool_of(Path(dataset), Path(prior))
        looking = time.perf_counter() - began
        for criterion in CRITERIA:
            found = compared(pool, criterion, budget)
            rows += [
                {
                    "dataset": dataset,
                    "criterion": criterion,
                    "poses": len(pool.poses.positions),
                    "looking": looking,
                    **row,
                }
                for row in found
            ]
            write_json(out, {"command": command_line(), "budget": budget, "rows": rows, **made})


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
