"""How many Gaussians the directional criteria need. `python benchmarks/directional_sample.py OUT.json BUDGET DATASET:PRIOR...`

A plan is BUDGET views beyond four seeds, chosen one after another by `directional-i` or `directional-d`; it needs poses and a
prior, no image. With some of the prior's Gaussians instead of all: the same choices? What would all say of the choices that
some make, and what does the whole plan bring? Seconds are those of the choices, after one pass over the poses has measured what
they see; let nothing else run.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import kendalltau

from mgs import runtime
from mgs.active import directional
from mgs.active.criteria import regularisation
from mgs.active.directional import Views
from mgs.active.pose_policies import seed_views
from mgs.active.settings import NbvSettings
from mgs.camera import Camera
from mgs.data.dataset import load_dataset
from mgs.files import write_json
from mgs.prior.build import load_prior
from mgs.provenance import command_line, versions

CRITERIA = {"directional-i": (3, 0.1), "directional-d": (2, 0.3)}
"""Degree and tau of `mgs.active.policies`."""

COUNTS = (512, 1024, 2048, 4096, 8192, 16384)
SEEDS = 4


class Pool(NamedTuple):
    """Points [N,3], all poses, a dome, lam of colours, seeds."""

    points: np.ndarray
    poses: Views
    dome: Views
    lam: float
    seeds: list[int]

    def some(self, count: int) -> Pool:
        """With that many of the Gaussians."""
        rows = directional.spread(len(self.points), count)
        cut = [Views(views.positions, views.seen[:, rows]) for views in (self.poses, self.dome)]
        return self._replace(points=self.points[rows], poses=cut[0], dome=cut[1])

    def gains(self, criterion: str, taken: list[int]) -> np.ndarray:
        """Of all poses; those taken have -inf."""
        degree, tau = CRITERIA[criterion]
        left = [i for i in range(len(self.poses.positions)) if i not in taken]
        views = [Views(self.poses.positions[some], self.poses.seen[some]) for some in (taken, left)]
        dome = self.dome if criterion == "directional-i" else None
        found = np.full(len(self.poses.positions), -np.inf)
        found[left] = directional.gains(self.points, self.lam, degree, tau, *views, dome)
        return found


def pool_of(dataset: Path, prior_folder: Path) -> Pool:
    """What all poses of a dataset see of a prior's Gaussians before training."""
    from mgs.prior.initial import initial_gaussians
    from mgs.splat import ListCache, fisher, groups

    prior, frames = load_prior(prior_folder), load_dataset(dataset).frames
    unseen = np.zeros(len(prior.points), bool), np.zeros((0, 3))
    start = initial_gaussians(prior, frames, colours=lambda frame: unseen)[0]
    cameras, cache = [frame.camera for frame in frames], ListCache()
    positions, centre = np.array([camera.position for camera in cameras]), prior.points.mean(axis=0)

    def views(those: list[Camera]) -> Views:
        seen = [directional.squared_weights(fisher(start, camera, cache=cache)[: len(prior.points)]) for camera in those]
        return Views(np.array([camera.position for camera in those]), np.stack(seen))

    settings = NbvSettings(dataset=dataset, prior=prior_folder)
    lam = float(regularisation(groups(0), settings.pixel_noise, settings.prior_std)[0])
    dome = views(directional.dome_cameras(cameras[0], positions, centre))
    return Pool(np.asarray(start.means[: len(prior.points)]), views(cameras), dome, lam, seed_views(positions, centre, SEEDS))


def planned(pool: Pool, criterion: str, budget: int) -> tuple[list[int], float, list[np.ndarray]]:
    """The views, with the seeds; the seconds of their choice; the gains of all poses before each choice."""
    taken, gains = list(pool.seeds), []
    began = time.perf_counter()
    for _ in range(budget):
        gains.append(pool.gains(criterion, taken))
        taken.append(int(gains[-1].argmax()))
    return taken, time.perf_counter() - began, gains


def compared(pool: Pool, criterion: str, budget: int) -> list[dict[str, Any]]:
    """A record for each number of Gaussians, the last of which is all of them."""
    every, seconds, truth = planned(pool, criterion, budget)
    whole = worth(pool, criterion, every)
    rows = []
    for count in [count for count in COUNTS if count < len(pool.points)]:
        part = pool.some(count)
        plan, took, _ = planned(part, criterion, budget)
        regret, tau = [], []
        for k, exact in enumerate(truth):  # the states of the plan of all Gaussians
            found, left = part.gains(criterion, every[: SEEDS + k]), np.isfinite(exact)
            regret.append(float(1 - exact[found.argmax()] / exact.max()))
            tau.append(float(kendalltau(found[left], exact[left]).statistic) if left.sum() > 1 else 1.0)
        rows.append({
            "gaussians": len(part.points), "seconds": took, "kept": len(set(plan) & set(every)) - SEEDS,
            "largest_regret": max(regret), "mean_regret": float(np.mean(regret)), "tau": float(np.mean(tau)),
            "worth": worth(pool, criterion, plan) / whole,
        })  # fmt: skip
        print(criterion, rows[-1], flush=True)
    rows.append({"gaussians": len(pool.points), "seconds": seconds})
    print(criterion, rows[-1], flush=True)
    return rows


def worth(pool: Pool, criterion: str, taken: list[int]) -> float:
    """What the chosen views of a plan bring by the criterion, all Gaussians counted: the sum of the gains of one after another."""
    degree, tau = CRITERIA[criterion]
    prior = np.diag(directional.precision(degree, tau, pool.lam))
    total = 0.0
    for first in range(0, len(pool.points), directional.CHUNK):
        some = slice(first, first + directional.CHUNK)
        seeds, plan = (
            prior + directional.information(pool.points[some], Views(pool.poses.positions[v], pool.poses.seen[v][:, some]), degree)
            for v in (pool.seeds, taken)
        )
        if criterion == "directional-d":
            total += 1.5 * (np.linalg.slogdet(plan)[1] - np.linalg.slogdet(seeds)[1]).sum()
        else:
            M = directional.information(pool.points[some], Views(pool.dome.positions, pool.dome.seen[:, some]), degree)
            total += np.einsum("nkl,nkl->", M, np.linalg.inv(seeds) - np.linalg.inv(plan))
    return float(total)


def main(out: Path, budget: int, cases: list[str]) -> None:
    """Measure, write after each case."""
    runtime.start()
    rows = []
    for case in cases:
        dataset, prior = case.split(":")
        pool = pool_of(Path(dataset), Path(prior))
        for criterion in CRITERIA:
            found = compared(pool, criterion, budget)
            rows += [{"dataset": dataset, "criterion": criterion, "poses": len(pool.poses.positions), **row} for row in found]
            write_json(out, {"command": command_line(), "budget": budget, "rows": rows, "versions": versions()})


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
