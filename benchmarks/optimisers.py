"""How fast optimisers lower the objective: `python benchmarks/optimisers.py DATASET PREFIX` writes PREFIX.json and PREFIX.png.

Fits 10,000 Gaussians to 12 views spread evenly in azimuth, from the prior (cold), and goes on from such a fit with one more
view (warm). Every point is a fit of its own, since rates fall over the length of a fit. Compared are the rows of
`mgs.active.optimisers.OPTIMISERS` and Levenberg-Marquardt steps, solved by conjugate gradients with exact curvature products,
which are made here only. Measured are the objective, PSNR inside the rock over the views that were not fitted, and work in
passes: one is a render with gradients of every view. Seconds are given beside them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs import runtime
from mgs.active.criteria import regularisation
from mgs.active.fitting import fit
from mgs.active.loop import target_of
from mgs.active.objective import Objective, dot, objective, plus
from mgs.active.optimisers import INFORMATION_PASSES, OPTIMISERS
from mgs.active.pose_policies import seed_views
from mgs.active.settings import RATES, TrainSettings
from mgs.data.dataset import load_dataset
from mgs.files import write_json
from mgs.gaussians import LEARNED, Gaussians
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.splat import ListCache, as_drjit, groups

GAUSSIANS, VIEWS = 10_000, 12
FIRST_RATES = {"colour": 0.02, "scale": 0.02, "rotation": 0.01, "opacity": 0.05}
"""Rates of the first version of mgs, whose optimiser was Adam."""
FAST_RATES = {kind: 2 * rate for kind, rate in RATES.items()}
"""The best that were found for Adam: at twice these it ends lower on the images fitted and worse on the others."""
ROWS = {
    "Adam, first version's rates": ("adam", FIRST_RATES, (5, 10, 20, 40, 80)),
    "Adam, rates chosen for it": ("adam", FAST_RATES, (5, 10, 20, 40, 80)),
    "natural gradient": ("natural", RATES, (5, 10, 20, 40, 80)),
}
LM_STEPS, LM_CG, LM_DAMPING = 5, 8, 300.0
"""Levenberg-Marquardt: steps, iterations of conjugate gradients in each, and first damping, a factor of the prior's lam."""
CURVATURE_COST = 1.5
"""Passes that a product with the curvature costs: one derivative in forward mode and one in reverse mode for each view, where a
gradient takes one in reverse mode and the render."""


class _Case:
    """A dataset with the views to fit to, and those to judge by."""

    def __init__(self, root: Path) -> None:
        self.dataset, self.cache = load_dataset(root), ListCache()
        prior, _ = build_prior(self.dataset, PriorSettings(gaussians=GAUSSIANS))
        positions = np.array([frame.camera.position for frame in self.dataset.frames])
        self.taken = seed_views(positions, prior.points.mean(0), VIEWS)
        self.added = [*self.taken, next(i for i in range(len(positions)) if i not in self.taken)]
        self.start = initial_gaussians(prior, [self.dataset.frames[i] for i in self.taken])[0]
        lam = regularisation(groups(0))
        self.lam = {kind: float(lam[c][0]) for kind, c in groups(0).items()}

    def images(self, views: list[int]) -> tuple[list[Any], list[np.ndarray]]:
        """Cameras and targets."""
        frames = [self.dataset.frames[i] for i in views]
        return [frame.camera for frame in frames], [target_of(frame) for frame in frames]

    def objective(self, views: list[int]) -> Objective:
        """What a fit to these views lowers."""
        return objective(self.start, *self.images(views), self.start, self.lam, self.cache)

    def fitted(self, model: Gaussians, views: list[int], optimiser: str, rates: dict[str, float], passes: int) -> Gaussians:
        """A fit of exactly so many passes."""
        train = TrainSettings(optimiser=optimiser, passes=passes, tolerance=0.0, rates=rates)
        return fit(model, *self.images(views), train, cache=self.cache, start=self.start, lam=self.lam).gaussians

    def psnr(self, model: Gaussians) -> float:
        """PSNR inside the rock over the views never fitted in any case, dB."""
        names = [self.dataset.frames[i].name for i in self.added]
        found: float = evaluate(model, self.dataset.frames, names)["held_out"]["psnr_inside"]
        return found


def levenberg_marquardt(goal: Objective, model: Gaussians) -> Iterator[tuple[float, Gaussians]]:
    """Steps (J^T J + (1 + mu) lam)^-1 g, kept where they lower the objective; mu falls after good steps and rises after bad
    ones. Gives the work so far, passes, and the model."""
    work, mu, phi = 1.0, LM_DAMPING, goal.phi(model)
    for _ in range(LM_STEPS):
        gradient, lams = goal.gradient(model), list(goal.prior.lam.values())
        damped = [mi.TensorXf(d.array + mu * lam, d.shape) for d, lam in zip(goal.diagonal(model), lams, strict=True)]
        x, residual = [dr.zeros(mi.TensorXf, g.shape) for g in gradient], [-g for g in gradient]
        z = [r / d for r, d in zip(residual, damped, strict=True)]
        direction, rz = z, dot(residual, z)
        for _ in range(LM_CG):
            product = goal.curvature_times(model, direction)
            product = [p + mi.TensorXf(mu * lam * v.array, v.shape) for p, v, lam in zip(product, direction, lams, strict=True)]
            step = rz / dot(direction, product)
            x, residual = plus(x, step, direction), plus(residual, -step, product)
            z = [r / d for r, d in zip(residual, damped, strict=True)]
            before, rz = rz, dot(residual, z)
            direction = plus(z, rz / before, direction)
            dr.eval(x, residual, direction)
        expected = 0.5 * (dot(residual, x) - dot(gradient, x))
        values = plus([getattr(model, name) for name in LEARNED], 1.0, x)
        moved = Gaussians(model.means, **dict(zip(LEARNED, values, strict=True)))
        work += 2 + 0.4 + CURVATURE_COST * LM_CG  # gradient, diagonal, objective
        found = goal.phi(moved)
        gain = (phi - found) / expected
        if gain > 0.05:
            model, phi = moved, found
        mu *= 1 / 3 if gain > 0.75 else 3 if gain < 0.4 else 1
        yield work, model


def study(case: _Case) -> list[dict[str, Any]]:
    """One record per fit: whether warm, which row, passes of work, seconds, objective, PSNR."""
    records = []

    def record(begin: str, row: str, work: float, seconds: float, goal: Objective, model: Gaussians) -> None:
        phi, decibels = goal.phi(as_drjit(model)), case.psnr(model)
        records.append({"start": begin, "row": row, "passes": work, "seconds": seconds, "phi": phi, "psnr_inside": decibels})
        print(records[-1], flush=True)

    before = case.fitted(case.start, case.taken, "natural", RATES, TrainSettings().passes)
    for begin, model, views in (("cold", case.start, case.taken), ("warm", before, case.added)):
        goal = case.objective(views)
        for row, (optimiser, rates, lengths) in ROWS.items():
            for passes in lengths:
                began = time.perf_counter()
                found = case.fitted(model, views, optimiser, rates, passes)
                seconds = time.perf_counter() - began
                extra = -(-passes // INFORMATION_PASSES) if OPTIMISERS[optimiser].uses_information else 0
                record(begin, row, passes + extra, seconds, goal, found)
        began = time.perf_counter()
        for work, moved in levenberg_marquardt(goal, as_drjit(model)):
            numpy = Gaussians(*(np.asarray(getattr(moved, f.name)) for f in fields(moved)))
            record(begin, "Levenberg-Marquardt, CG", work, time.perf_counter() - began, goal, numpy)
    return records


def draw(path: Path, records: list[dict[str, Any]]) -> None:
    """Objective and PSNR against work, cold above, warm below."""
    import matplotlib

    colours = ("#D55E00", "#E69F00", "#0072B2", "#009E73")
    with matplotlib.rc_context(STYLE):
        figure = new_figure(7.2, 5.6)
        axes = figure.subplots(2, 2, sharex=True)
        for line, begin in zip(axes, ("cold", "warm"), strict=True):
            rows = list(dict.fromkeys(r["row"] for r in records))
            for row, colour in zip(rows, colours, strict=True):
                shown = [r for r in records if (r["start"], r["row"]) == (begin, row)]
                for axis, key in zip(line, ("phi", "psnr_inside"), strict=True):
                    axis.plot(
                        [r["passes"] for r in shown], [r[key] for r in shown], "o-", color=colour, markersize=3, label=row
                    )
            line[0].set(xscale="log", yscale="log", ylabel=f"objective, {begin} start")
            line[1].set(ylabel="PSNR inside, held out (dB)")
        for axis in axes[1]:
            axis.set(xlabel="work (passes)")
            axis.xaxis.set_major_formatter("{x:.0f}")
        for axis in axes[:, 0]:
            axis.yaxis.set_major_formatter("{x:.0f}")
            axis.yaxis.set_minor_formatter("{x:.0f}")
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        save_figure(figure, path)


def main(root: Path, prefix: Path) -> None:
    """Measure, write, draw."""
    runtime.start()
    records = study(_Case(root))
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(prefix.with_suffix(".json"), made | {"records": records})
    draw(prefix.with_suffix(".png"), records)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
