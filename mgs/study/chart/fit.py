"""Speed against accuracy of fits and of whole runs. A point is one `mgs nbv`: its time, and its
quality on the test views.

There are two kinds of points. A *fit* takes all its images at once, spread evenly in azimuth, and
chooses nothing; a *run* starts from the seeds and chooses the other images one by one, with a fit
after each. Factors are varied one at a time around the default, and those that decide most are
crossed.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mgs.data.dataset import load_dataset
from mgs.fit.settings import COLOURS_ALONE, PASSES, RATES, WARM_PASSES
from mgs.run.settings import PRESETS
from mgs.study.chart.pareto import pareto_front
from mgs.study.chart.plan import DENSITY, SCENE, Data, Plan, synthetic
from mgs.study.chart.subject import quality
from mgs.study.chart.timing import timed
from mgs.study.sweep import Cell, cell_folder

LEARNED = ("colour", "colour+opacity", "colour+opacity+scale", "all")
"""Kinds of parameters that are learned; the others have a rate of 0."""

LATER_PASSES = {2: 2, 5: 3, 10: 5, 20: 10, 40: 20}
"""Passes of the fits after the first in runs, for each number of passes of the first."""


@dataclass(frozen=True)
class Point:
    """Settings of one `mgs nbv`. policy: "" for a fit of all images at once. half: trained on
    images of half the size."""

    images: int
    density: float = DENSITY
    passes: int = PASSES
    warm_passes: int = WARM_PASSES
    optimiser: str = "natural"
    learned: str = "all"
    policy: str = ""
    estimator: str = "exact"
    half: bool = False

    @property
    def name(self) -> str:
        """A name for its cell, which tells all settings."""
        passes = f"{self.passes}-{self.warm_passes}" if self.policy else str(self.passes)
        parts = [
            f"d{1 / self.density:g}",
            f"i{self.images}",
            f"p{passes}",
            self.optimiser,
            self.learned.replace("+", "-"),
        ]
        parts += [self.policy, self.estimator] if self.policy else ["fit"]
        return "-".join([*parts, *(["half"] if self.half else [])])

    def settings(self, seeds: int) -> dict[str, Any]:
        """The arguments of `mgs.run.nbv.run_nbv`, but for COLOURS_ALONE."""
        seeds = seeds if self.policy else self.images
        rates = (
            {}
            if self.learned == "all"
            else {kind: 0.0 for kind in RATES if kind not in self.learned.split("+")}
        )
        train = {"passes": self.passes, "optimiser": self.optimiser, "rates": rates}
        chosen = {
            "policy": self.policy or "uniform",
            "estimator": self.estimator,
            "warm_passes": self.warm_passes,
        }
        return {**chosen, "seeds": seeds, "budget": self.images - seeds, "train": train}

    def command(self, dataset: str, prior: str, seeds: int) -> str:
        """The command line that makes this model again."""
        given = self.settings(seeds)
        train = given.pop("train")
        options = {
            **given,
            "passes": train["passes"],
            "optimiser": train["optimiser"],
            "alpha_weight": 0,
        }
        words = ["mgs", "nbv", dataset, "--prior", prior, "--out", "RUN"]
        for name, value in options.items():
            words += [f"--{name.replace('_', '-')}", str(value)]
        for kind, rate in train["rates"].items():
            words += ["--rate", f"{kind}={rate:g}"]
        return shlex.join(words)


def factors(plan: Plan, halves: bool) -> dict[str, list[Point]]:
    """The points by factor; "crossed" and "crossed, run" span the front. Points may occur in
    several. halves: whether there is data of half the size."""
    fit, run = Point(plan.images), Point(plan.images, policy="d-optimal")
    known = {
        "density": [replace(fit, density=d) for d in plan.densities],
        "passes": [replace(fit, passes=p) for p in plan.passes],
        "optimiser": [replace(fit, optimiser="adam")],
        "learned": [replace(fit, learned=kinds) for kinds in LEARNED],
        "images": [replace(fit, images=n) for n in plan.image_counts],
        "crossed": [replace(fit, density=d, passes=p) for d in plan.densities for p in plan.passes],
        "policy, run": [replace(run, policy=name) for name in ("d-optimal", *plan.policies)],
        "estimator, run": [
            replace(run, estimator=name) for name in ("hutchinson", "loss-gradient")
        ],
        "crossed, run": crossed_runs(plan),
    }
    if halves:
        known["half the size"] = [replace(fit, half=True, density=d) for d in plan.densities[:-1]]
    return known


def crossed_runs(plan: Plan) -> list[Point]:
    """Runs of the default policy over the settings that presets are made of."""
    run = Point(plan.images, policy="d-optimal")
    grid = [
        replace(run, density=d, passes=p, warm_passes=LATER_PASSES[p])
        for d in plan.densities[-3:]
        for p in plan.run_passes
    ]
    return list(dict.fromkeys([*grid, *preset_points(plan).values()]))


def preset_points(plan: Plan) -> dict[str, Point]:
    """The runs that `mgs nbv --preset` stands for."""
    run = Point(plan.images, policy="d-optimal")
    return {name: replace(run, **asdict(row)) for name, row in PRESETS.items()}


def cells(
    plan: Plan, data: Data, points: Iterable[Point], repeats: int, half: Data | None = None
) -> list[Cell]:
    """The cells of some points, and those that they need."""
    found: dict[str, Cell] = {
        cell.name: cell for cell in (*data.cells, *(half.cells if half else ()))
    }
    for point in points:
        prior, trained = data.prior(point.density), half if point.half and half else data
        found[prior.name] = prior
        arguments = {
            "dataset": trained.folder, "judged": data.folder, "prior": f"cells/{prior.name}/prior",
            "settings": point.settings(plan.seeds), "repeats": repeats,
        }  # fmt: skip
        name = f"fit/{data.label}/{point.name}"
        found[name] = Cell(
            name, "mgs.study.chart.fit:measure", arguments, (prior.name, *trained.needs), alone=True
        )
    return list(found.values())


def measure(
    root: Path,
    out: Path,
    dataset: str,
    judged: str,
    prior: str,
    settings: dict[str, Any],
    repeats: int,
) -> dict[str, Any]:
    """Time a run with these settings, files included, and judge its model by the test views of the
    dataset `judged`.

    The model is the same in every repeat. Returns times (`timed`), qualities, and passes: of all
    fits together.
    """
    from mgs.run.folder import State
    from mgs.run.nbv import run_nbv

    given = settings | {"train": settings["train"] | COLOURS_ALONE}

    def run() -> State:
        shutil.rmtree(out / "run", ignore_errors=True)
        return run_nbv(root / dataset, out / "run", prior=root / prior, **given)

    state, times = timed(run, repeats)
    shutil.rmtree(out / "run")
    passes = sum(step["iterations"] // step["images"] for step in state.steps)
    steps = sum(step["iterations"] for step in state.steps)
    return {
        **times,
        **quality(state.gaussians, load_dataset(root / judged)),
        "passes": passes,
        "image_passes": steps,
    }


def rows(
    plan: Plan, data: Data, root: Path, found: dict[str, Any], halves: bool
) -> list[dict[str, Any]]:
    """A row for each point: the factors it belongs to, its settings, what was found, and the
    command that makes it again."""
    by_factor, presets = (
        factors(plan, halves),
        {point: name for name, point in preset_points(plan).items()},
    )
    half = synthetic(plan, SCENE, half=True)
    made = []
    for point in dict.fromkeys(point for points in by_factor.values() for point in points):
        prior, trained = data.prior(point.density), half if point.half else data
        result = found[f"fit/{data.label}/{point.name}"]
        command = point.command(
            str(root / trained.folder), str(cell_folder(root, prior.name) / "prior"), plan.seeds
        )
        made.append({
            "factors": "; ".join(name for name, points in by_factor.items() if point in points),
            "preset": presets.get(point, ""), "gaussians": found[prior.name]["gaussians"], **asdict(point),
            "total_passes": result["passes"], **{key: value for key, value in result.items() if key != "passes"},
            "command": command,
        })  # fmt: skip
    return made


def with_fronts(made: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with `front` and `front_ssim`: whether they lie on the front of seconds against PSNR and
    SSIM, among fits or runs of as many images."""
    for row in made:
        alike = [
            other
            for other in made
            if (bool(other["policy"]), other["images"]) == (bool(row["policy"]), row["images"])
        ]
        seconds, own = (
            [other["seconds"] for other in alike],
            next(i for i, other in enumerate(alike) if other is row),
        )
        for column, metric in (("front", "psnr"), ("front_ssim", "ssim")):
            row[column] = bool(pareto_front(seconds, [other[metric] for other in alike])[own])
    return made
