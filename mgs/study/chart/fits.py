"""Speed against accuracy of fits and of whole runs.

A point is one `mgs nbv`: its time, and its quality on the test views. A *fit* takes all its images
at once, evenly spaced in azimuth; a *run* starts from the seeds and chooses the other images one by
one. Factors are varied one at a time around the default; those that matter most are crossed.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mgs.data.dataset import load_dataset
from mgs.fit.settings import COLOURS_ALONE, PASSES, RATES, WARM_PASSES
from mgs.run.folder import State
from mgs.run.nbv import run_nbv
from mgs.run.settings import PRESETS
from mgs.study.case import Case, Scene, Size, judge
from mgs.study.chart.timing import span, timed, with_seconds
from mgs.study.output import Content
from mgs.study.statistics import pareto_front
from mgs.study.sweep import Cell, Results
from mgs.study.verdict import Claim, Row

DENSITY = 1 / 8
"""Density of the default prior (`PriorSettings`): about that of `mgs demo`."""

SCENE = "boulder"
"""Scene of the charts."""

QUALITIES = ("psnr", "ssim", "psnr_mask", "ssim_mask")
"""Metrics of the test views in rows."""

LEARNED = ("colour", "colour+opacity", "colour+opacity+scale", "all")
"""Kinds of parameters that are learned; the others have rate 0."""

LATER_PASSES = {2: 2, 5: 3, 10: 5, 20: 10, 40: 20}
"""Passes of later fits of a run, by passes of the first."""

EQUAL_TIME, LOSS = 1.05, 0.1
"""Factor up to which times count as equal, and loss in dB up to which a preset is as good as the
best run of equal time."""


@dataclass(frozen=True)
class ChartSize:
    """Size of the charts. images: of the dataset. count: images fitted, of which `seeds` are evenly
    spaced. repeats: default number of timings. run_passes: of the first fit of runs. The other
    fields are values of factors."""

    images: Size
    repeats: int
    densities: tuple[float, ...]
    passes: tuple[int, ...]
    run_passes: tuple[int, ...]
    image_counts: tuple[int, ...]
    policies: tuple[str, ...]
    probes: tuple[int, ...]
    count: int
    seeds: int = 4


SIZES = {
    "quick": ChartSize(
        images=Size(192, 144, 24, 8),
        repeats=2,
        densities=(1 / 8, 1 / 4, 1 / 2, 3 / 4),
        passes=(5, 10, 20),
        run_passes=(5, 10),
        image_counts=(4, 12),
        policies=("directional-i", "random"),
        probes=(1, 4),
        count=8,
    ),
    "full": ChartSize(
        images=Size(320, 240, 32, 12),
        repeats=3,
        densities=(1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4),
        passes=(2, 5, 10, 20, 40),
        run_passes=(5, 10, 20),
        image_counts=(4, 6, 8, 16, 24),
        policies=(
            "directional-i", "directional-d", "fisherrf", "uniform", "farthest", "random", "paper"
        ),
        probes=(1, 2, 4, 8, 16, 32, 64),
        count=12,
    ),
}  # fmt: skip
"""`quick` takes about ten minutes on two quiet cores, `full` hours."""


@dataclass(frozen=True)
class Data:
    """What the charts measure on: the rendered scene, or a dataset that exists already."""

    size: ChartSize
    given: Path | None = None

    def case(self, density: float = DENSITY, half: bool = False) -> Case:
        """Case with a prior of this density. half: images of half the width and height."""
        images = self.size.images
        if half:
            images = Size(images.width // 2, images.height // 2, images.frames, 0)
        label = self.given.name if self.given else ""
        return Case(Scene(SCENE, label=label), images, {"density": density}, self.given)


@dataclass(frozen=True)
class Point:
    """Settings of one `mgs nbv`. policy: empty for a fit of all images at once. half: trained on
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
        """Name of its cell."""
        passes = f"{self.passes}-{self.warm_passes}" if self.policy else str(self.passes)
        parts = [f"d{1 / self.density:g}", f"i{self.images}", f"p{passes}", self.optimiser]
        parts += [self.learned.replace("+", "-")]
        parts += [self.policy, self.estimator] if self.policy else ["fit"]
        return f"fit/{'-'.join([*parts, *(['half'] if self.half else [])])}"

    def settings(self, seeds: int) -> dict[str, Any]:
        """Settings of `mgs nbv`, without COLOURS_ALONE."""
        seeds = seeds if self.policy else self.images
        kinds = RATES if self.learned == "all" else self.learned.split("+")
        rates = {kind: 0.0 for kind in RATES if kind not in kinds}
        return {
            "policy": self.policy or "uniform",
            "estimator": self.estimator,
            "warm_passes": self.warm_passes,
            "seeds": seeds,
            "budget": self.images - seeds,
            "train": {"passes": self.passes, "optimiser": self.optimiser, "rates": rates},
        }

    def command(self, dataset: str, prior: str, seeds: int) -> str:
        """Command line that makes this model."""
        given = self.settings(seeds)
        train = given.pop("train")
        rates = train.pop("rates")
        words = ["mgs", "nbv", dataset, "--prior", prior, "--out", "RUN"]
        for name, value in (given | train | {"alpha_weight": 0}).items():
            words += [f"--{name.replace('_', '-')}", str(value)]
        for kind, rate in rates.items():
            words += ["--rate", f"{kind}={rate:g}"]
        return shlex.join(words)

    def text(self, gaussians: int) -> str:
        """What differs from the default, for tables."""
        passes = f"{self.passes} passes" + (f", then {self.warm_passes}" if self.policy else "")
        parts = [f"{gaussians:,} Gaussians", passes]
        usual = Point(self.images)
        for key in ("policy", "optimiser", "learned", "estimator"):
            if getattr(self, key) != getattr(usual, key):
                parts.append(f"{key} {getattr(self, key)}")
        return ", ".join([*parts, *(["half the size"] if self.half else [])])


def factors(data: Data) -> dict[str, list[Point]]:
    """Points by factor; a point may be in several."""
    size = data.size
    fit, run = Point(size.count), Point(size.count, policy="d-optimal")
    found = {
        "density": [replace(fit, density=d) for d in size.densities],
        "passes": [replace(fit, passes=p) for p in size.passes],
        "optimiser": [replace(fit, optimiser="adam")],
        "learned": [replace(fit, learned=kinds) for kinds in LEARNED],
        "images": [replace(fit, images=n) for n in size.image_counts],
        "crossed": [replace(fit, density=d, passes=p) for d in size.densities for p in size.passes],
        "policy, run": [replace(run, policy=name) for name in ("d-optimal", *size.policies)],
        "estimator, run": [replace(run, estimator=e) for e in ("hutchinson", "loss-gradient")],
        "crossed, run": [
            *(
                replace(run, density=d, passes=p, warm_passes=LATER_PASSES[p])
                for d in size.densities[-3:]
                for p in size.run_passes
            ),
            *preset_points(size).values(),
        ],
    }
    if not data.given:
        halves = [replace(fit, half=True, density=d) for d in size.densities[:-1]]
        found["half the size"] = halves
    return found


def preset_points(size: ChartSize) -> dict[str, Point]:
    """Runs of `mgs nbv --preset`."""
    run = Point(size.count, policy="d-optimal")
    return {name: replace(run, **asdict(row)) for name, row in PRESETS.items()}


def points_of(data: Data) -> list[Point]:
    """All points, each once."""
    return list(dict.fromkeys(point for points in factors(data).values() for point in points))


def cells(data: Data, repeats: int) -> list[Cell]:
    """Cells of all points, and those they need."""
    found: dict[str, Cell] = {}
    for point in points_of(data):
        case = data.case(point.density)
        trained = data.case(half=True) if point.half else case
        made = [*case.cells(), *trained.cells()[: 1 if point.half else None]]
        arguments: dict[str, Any] = {"dataset": trained.dataset, "judged": case.dataset}
        arguments |= {
            "prior": case.prior,
            "settings": point.settings(data.size.seeds),
            "repeats": repeats,
        }
        needs = tuple(dict.fromkeys(cell.name for cell in made))
        cell = Cell(point.name, f"{__name__}:measure", arguments, needs, alone=True)
        found |= {one.name: one for one in (*made, cell)}
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
    """Task: time a run, files included, and judge its model by the test views of the dataset
    `judged`. Returns times (`timed`), qualities, and passes of all fits together."""
    given = settings | {"train": settings["train"] | COLOURS_ALONE}

    def run() -> State:
        shutil.rmtree(out / "run", ignore_errors=True)
        return run_nbv(root / dataset, out / "run", prior=root / prior, **given)

    state, times = timed(run, repeats)
    shutil.rmtree(out / "run")
    metrics = judge(state.gaussians, load_dataset(root / judged))
    return {
        **times,
        **{name: metrics[name] for name in QUALITIES},
        "total_passes": sum(step["iterations"] // step["images"] for step in state.steps),
        "image_passes": sum(step["iterations"] for step in state.steps),
    }


def rows(data: Data, root: Path, found: Results, unit: float) -> list[Row]:
    """A row for each point: factors, settings, results, command, and whether it is on the front of
    seconds against PSNR and SSIM among fits, or runs, of as many images."""
    by_factor = factors(data)
    presets = {point: name for name, point in preset_points(data.size).items()}
    made = []
    for point in points_of(data):
        case = data.case(point.density)
        trained = data.case(half=True) if point.half else case
        where = str(root / trained.dataset), str(root / case.prior)
        gaussians = found[case.prior_name]["gaussians"]
        row = {"factors": "; ".join(name for name in by_factor if point in by_factor[name])}
        row |= {"preset": presets.get(point, ""), "gaussians": gaussians, **asdict(point)}
        row |= {"text": point.text(gaussians), **found[point.name]}
        made.append(row | {"command": point.command(*where, data.size.seeds)})
    return _with_fronts(with_seconds(made, unit))


def _with_fronts(rows: Sequence[Row]) -> list[Row]:
    """Rows with `front` and `front_ssim`."""
    groups: dict[tuple[bool, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((bool(row["policy"]), row["images"]), []).append(row)
    for alike in groups.values():
        seconds = [row["seconds"] for row in alike]
        for column, metric in (("front", "psnr"), ("front_ssim", "ssim")):
            front = pareto_front(seconds, [row[metric] for row in alike])
            for row, on in zip(alike, front, strict=True):
                row[column] = bool(on)
    return list(rows)


def preset_losses(rows: Sequence[Row]) -> list[float]:
    """Effects: PSNR that each preset loses against the best run of equal time, dB."""
    runs = [row for row in rows if "crossed, run" in row["factors"].split("; ")]
    losses = []
    for row in runs:
        if row["preset"]:
            equal = [one for one in runs if one["seconds"] <= EQUAL_TIME * row["seconds"]]
            losses.append(max(one["psnr"] for one in equal) - row["psnr"])
    return losses


CLAIMS = (
    Claim(
        "A preset of `mgs nbv` loses at most 0.1 dB against the best run of equal time.",
        preset_losses, "dB", "below", LOSS, "preset",
    ),
)  # fmt: skip

COLUMNS: dict[str, Content] = {
    "fit or run": lambda row: (f"**{row['preset']}**: " if row["preset"] else "") + row["text"],
    "seconds": span,
    "PSNR (dB)": "psnr:.2f",
    "SSIM": "ssim:.4f",
    "PSNR, rock (dB)": "psnr_mask:.2f",
}


def shown(rows: Sequence[Row]) -> list[Row]:
    """Rows of the table: fits and runs on the front, and presets, by seconds."""
    kept = [row for row in rows if row["front"] or row["preset"]]
    return sorted(kept, key=lambda row: (bool(row["policy"]), row["images"], row["seconds"]))
