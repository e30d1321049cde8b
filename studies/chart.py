"""Speed against accuracy of fits and of whole runs.

A point is one `mgs nbv`: its time, and its quality on the test views. A *fit* takes all its images
at once, evenly spaced in azimuth; a *run* starts from the seeds and chooses the other images one by
one. Factors are varied one at a time around the default; those that matter most are crossed. Each
point is compared with the base of its kind on the same rock; intervals are over scenes.

Points are timed one by one: let nothing else run meanwhile.
"""

import shlex
import shutil
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.fit.settings import PASSES, WARM_PASSES, WARM_RATE
from studies.chart_points import draw, points_over_rocks, tables
from studies.frame.case import ROCKS, Case, Rock, Size, judge, rocks_of, test_views_of
from studies.frame.output import write_table
from studies.frame.program import Study, Work, at_least, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell, Results
from studies.frame.timing import REFERENCE, timed

KINDS = ("fit", "run")

ROCK_COUNT = 8

BASE = "d-optimal"
"""Policy of runs in which other settings vary."""

DENSITY = 1 / 8
"""Density of the base: a tenth of the automatic one, for short times."""

QUALITIES = ("psnr", "ssim", "psnr_mask", "ssim_mask")
"""Metrics of the test views in rows."""

LATER_PASSES = {2: 2, 5: 3, 10: 5, 20: 10, 40: 20}
"""Passes of later fits of a run, by passes of the first."""

PRESETS: dict[str, dict[str, Any]] = {
    "fast": {"passes": 5, "warm_passes": 3, "density": 1 / 4},
    "balanced": {"passes": PASSES, "warm_passes": WARM_PASSES, "density": 1 / 2},
    "accurate": {"passes": PASSES, "warm_passes": WARM_PASSES, "density": 5 / 4},
}
"""Fields of a `Point` by name: settings that docs/speed-accuracy.md recommends."""


@dataclass(frozen=True)
class ChartSize:
    """Size of the charts.

    images: of the dataset. count: images fitted, of which `seeds` are evenly spaced. repeats:
    timings of each point. run_passes: of the first fit of runs. reference: of `timed`. kinds: of
    KINDS. rocks: set by the options. given: a dataset in place of the rocks'. The other fields are
    values of factors.
    """

    images: Size
    count: int
    repeats: int
    densities: tuple[float, ...]
    passes: tuple[int, ...]
    run_passes: tuple[int, ...]
    image_counts: tuple[int, ...]
    policies: tuple[str, ...]
    estimators: tuple[str, ...] = ("loss-gradient",)
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: PRESETS)
    seeds: int = 4
    reference: tuple[int, int, int] = REFERENCE
    kinds: tuple[str, ...] = KINDS
    rocks: tuple[Rock, ...] = ()
    given: Path | None = None

    def case(self, rock: Rock, density: float) -> Case:
        """Case with a prior of this density."""
        label = self.given.name if self.given else ""
        return Case(rock, self.images, {"density": density}, self.given, label=label)


SIZES = {
    "quick": ChartSize(
        images=Size(192, 144, 24, 8),
        count=8,
        repeats=1,
        densities=(1 / 8, 1 / 4, 1 / 2, 3 / 4),
        passes=(5, 10, 20),
        run_passes=(5, 10),
        image_counts=(4, 12),
        policies=("directional-i", "random"),
    ),
    "full": ChartSize(
        images=Size(320, 240, 32, 12),
        count=12,
        repeats=3,
        densities=(1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4),
        passes=(2, 5, 10, 20, 40),
        run_passes=(5, 10, 20),
        image_counts=(4, 6, 8, 16, 24),
        policies=(
            "directional-i", "directional-d", "fisherrf", "uniform", "farthest", "random", "paper"
        ),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Point:
    """Settings of one `mgs nbv`. policy: empty for a fit of all images at once."""

    images: int
    density: float = DENSITY
    passes: int = PASSES
    warm_passes: int = WARM_PASSES
    warm_rate: float = WARM_RATE
    policy: str = ""
    estimator: str = "exact"

    @property
    def kind(self) -> str:
        """One of KINDS."""
        return "run" if self.policy else "fit"

    @property
    def name(self) -> str:
        parts = [f"d{1 / self.density:g}", f"i{self.images}", f"p{self.passes}"]
        later = f"{self.warm_passes}x{self.warm_rate:g}"
        parts += [later, self.policy, self.estimator] if self.policy else []
        return f"{self.kind}/{'-'.join(parts)}"

    def settings(self, seeds: int) -> dict[str, Any]:
        """Settings of `mgs nbv`."""
        seeds = seeds if self.policy else self.images
        return {
            "policy": self.policy or "uniform",
            "estimator": self.estimator,
            "warm_passes": self.warm_passes,
            "warm_rate": self.warm_rate,
            "seeds": seeds,
            "budget": self.images - seeds,
            "train": {"passes": self.passes},
        }

    def command(self, dataset: Path, prior: Path, seeds: int) -> str:
        """Command line that makes this model."""
        given = self.settings(seeds)
        passes = given.pop("train")["passes"]
        given |= {"train.passes": passes}
        words = ["mgs", "nbv", str(dataset), "--prior", str(prior), "--out", "RUN"]
        for key, value in given.items():
            words += ["--set", f"{key}={value}"]
        return shlex.join(words)


def points_of(size: ChartSize, kind: str) -> list[Point]:
    """Points of a kind, each once; the base first."""
    if kind == "fit":
        base = Point(size.count)
        points = [replace(base, images=n) for n in size.image_counts]
        points += [replace(base, density=d, passes=p) for d in size.densities for p in size.passes]
    else:
        base = Point(size.count, policy=BASE)
        points = [replace(base, policy=name) for name in size.policies]
        points += [replace(run, warm_rate=1.0) for run in (base, *preset_points(size).values())]
        points += [replace(base, estimator=name) for name in size.estimators]
        points += [
            replace(base, density=d, passes=p, warm_passes=LATER_PASSES[p])
            for d in size.densities[-3:]
            for p in size.run_passes
        ]
        points += preset_points(size).values()
    return list(dict.fromkeys([base, *points]))


def preset_points(size: ChartSize) -> dict[str, Point]:
    """Runs with PRESETS."""
    run = Point(size.count, policy=BASE)
    return {name: replace(run, **row) for name, row in size.presets.items()}


def name_of(rock: Rock, point: Point) -> str:
    return f"{point.name}/{rock.name}"


def cells_of(size: ChartSize) -> list[Cell]:
    """Cells of all points on every rock, and those they need."""
    cells: list[Cell] = []
    points = [point for kind in size.kinds for point in points_of(size, kind)]
    for rock, point in product(size.rocks, points):
        how: dict[str, Any] = {"repeats": size.repeats, "settings": point.settings(size.seeds)}
        how["reference"] = list(size.reference)
        case, task = size.case(rock, point.density), f"{__name__}:measure"
        cells += case.with_task(name_of(rock, point), task, alone=True, **how)
    return cells


def rows_of(size: ChartSize, kind: str, results: Results, unit: float) -> list[Row]:
    """A row for each point of a kind on every rock: settings, results, command. unit: seconds of
    the reference."""
    rows = list[Row]()
    presets = {point: name for name, point in preset_points(size).items()}
    for point, rock in product(points_of(size, kind), size.rocks):
        case = size.case(rock, point.density)
        row: Row = {"kind": kind, "rock": rock.name, "scene": rock.scene}
        row |= {"preset": presets.get(point, "")}
        row |= {"base": point == Point(size.count, policy=point.policy and BASE)}
        row |= asdict(point) | results[name_of(rock, point)]
        row |= {"gaussians": results[case.prior_name]["gaussians"]}
        where = Path(case.dataset), Path(case.prior)  # below the study's folder
        row |= {"seconds": row["ratio"] * unit}
        rows.append(row | {"command": point.command(*where, size.seeds)})
    return rows


def measure(
    root: Path,
    out: Path,
    dataset: str,
    prior: str,
    settings: dict[str, Any],
    repeats: int,
    reference: Sequence[int] = REFERENCE,
) -> dict[str, Any]:
    """Task: time a run, files included, and judge its model. Returns times (`timed`), qualities,
    and passes of all fits together."""

    def run() -> mgs.Checkpoint:
        shutil.rmtree(out / "run", ignore_errors=True)
        return mgs.run_nbv(root / dataset, out / "run", prior=root / prior, **settings).state

    state, times = timed(run, repeats, tuple(reference))
    shutil.rmtree(out / "run")
    metrics = judge(state.gaussians, mgs.load_dataset(root / dataset))
    return {
        **times,
        **{name: metrics[name] for name in QUALITIES},
        "total_passes": sum(step["iterations"] // step["images"] for step in state.steps),
    }


def check_dataset(dataset: Path) -> None:
    """Raises InputError for a dataset that cannot be read or has no test views."""
    test_views_of(mgs.load_dataset(dataset))


def sized(size: ChartSize, options: Namespace) -> ChartSize:
    """Size with the options. Raises InputError as `rocks_of` and `check_dataset`, and for rocks
    beside a dataset."""
    given: Path | None = options.dataset and options.dataset.resolve()
    rocks = rocks_of(options, ROCK_COUNT)
    if given:
        check_dataset(given)
        if options.rocks or options.training or options.mesh or options.scene:
            raise mgs.InputError("--dataset: takes the place of rocks; leave out one of the two")
        rocks = (Rock(given.name),)
    kinds = (options.only,) if options.only else KINDS
    repeats = options.repeats or size.repeats
    return replace(size, rocks=rocks, given=given, kinds=kinds, repeats=repeats)


def write(work: Work) -> list[Path]:
    """Write chart.csv, .json, .md and .png."""
    size, results = work.size, work.results
    unit = float(np.median([one["reference"] for one in results.values() if "reference" in one]))
    rows = [row for kind in size.kinds for row in rows_of(size, kind, results, unit)]
    text = tables(rows)
    draw(work.out / "chart.png", points_over_rocks(rows))
    more = {"repeats": size.repeats, "reference_seconds": unit}
    return [*write_table(work, "chart", rows, text, **more), work.out / "chart.png"]


STUDY = Study(
    "chart",
    __doc__,
    write,
    SIZES,
    cells_of,
    {
        **ROCKS,
        "--dataset": {"type": Path, "help": "A dataset with test views, in place of rocks."},
        "--only": {"choices": KINDS, "help": "Default: both."},
        "--repeats": {
            "type": at_least(1),
            "help": "Timings of each point; the median counts. Default: quick 1, full 3.",
        },
    },
    sized,
)

if __name__ == "__main__":
    study_of("chart")()
