"""Sizes of the studies of `studies.results`, and the runs of the paper's Table I."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mgs.run import policy_file
from mgs.run.inputs import policy_record
from studies.case import Case, Rock, Size
from studies.setups import DRAWS, POLICIES, RING, SetupSize
from studies.sweep import Cell

SEEDS = 4
"""Seed views of a run, as in the paper."""

TABLE_POLICIES = (
    "paper", "d-optimal", "coverage", "uniform", "directional-i", "fisherrf", "farthest", "random",
    "directional-d",
)  # fmt: skip
"""Policies of Table I; those of the paper first, because the table grows as its runs are done."""

SLOW_POLICIES = ("block-d",)
"""Last policies of Table I: a choice by 11x11 blocks takes 20 seconds at the paper's size."""

ALL_VIEWS, FEWER = "all views", "coverage, fewer images"
"""Rows of Table I that are no policies: `uniform` until no frame is left; and coverage with
FEWER_IMAGES fewer images, as the paper counts."""

FEWER_IMAGES = 4

ALL_3DGS: dict[str, dict[str, Any]] = {
    "3DGS": {},
    "3DGS, random points": {"random": True},
    "3DGS, random points, twice the steps": {"random": True, "passes": 2},
}
"""Rows of Table I for 3DGS, which sees all views: settings of `studies.free_fit.time_3dgs`."""

FIGURE_POLICIES = ("paper", "d-optimal", "coverage", "uniform")
"""Runs of Table I that the figures show."""


@dataclass(frozen=True)
class RunSize:
    """Images of the dataset, Gaussians of the prior, views chosen beyond the seeds, how many of
    these are chosen before the model is fitted again, and number of rows for 3DGS."""

    images: Size
    gaussians: int
    budget: int
    batch: int = 1
    rows_3dgs: int = 2


TABLE_ROCK = Rock("boulder", 0)
"""Rock of Table I."""

_SEEDS = {
    "boulder": (11, 12),
    "contact-binary": (12, 14),
    "low-sun": (11, 12),
    "pebbles": (11, 12),
    "strata": (12,),
    "horseshoe": (11,),
    "obsidian": (12,),
    "half-banded": (11,),
}

FRESH = tuple(
    Rock(scene, seed, index)
    for index, (scene, seed) in enumerate(
        (scene, seeds[k]) for k in range(2) for scene, seeds in _SEEDS.items() if k < len(seeds)
    )
)
"""Rocks that chose no setting: of each scene the first seeds from 11 on with which the rock is
wholly in every view, one of each scene first. Three scenes are new with them."""


@dataclass(frozen=True)
class ReproduceSize:
    """Size of a reproduction: of the runs of Table I, set-ups and flights, and numbers of rocks.

    own_policies: policies that the set-ups compare, too. meshes: rocks in place of FRESH.
    """

    table: RunSize
    setups: SetupSize
    flights: SetupSize
    setup_rocks: int = len(FRESH)
    oracle_rocks: int = 2
    own_policies: tuple[str, ...] = ()
    meshes: tuple[Rock, ...] = ()

    @property
    def policies(self) -> tuple[str, ...]:
        """Policies that the set-ups compare."""
        return (*POLICIES, *self.own_policies)

    def some_rocks(self, count: int) -> list[Rock]:
        """The first of the meshes, or of FRESH."""
        return list((self.meshes or FRESH)[:count])


SIZES = {
    "quick": ReproduceSize(
        RunSize(Size(320, 240, 32, 12), 10_000, 8), SetupSize(), SetupSize(gaussians=6000)
    ),
    "paper": ReproduceSize(
        RunSize(Size(640, 480, 100, 24, spp=12), 100_000, 50, rows_3dgs=3),
        SetupSize(320, 240, 24, 16),
        SetupSize(320, 240, 24, 16),
    ),
}


@dataclass(frozen=True)
class Run:
    """A run of a policy on the views of a rock. It runs alone, for its seconds and memory, and is
    measured on all views. budget: by default that of the size."""

    rock: Rock
    size: RunSize
    policy: str
    seeds: int = SEEDS
    budget: int | None = None
    draw: int = 0

    @property
    def case(self) -> Case:
        """Case of the dataset and the prior; the prior is of the whole flight."""
        settings = {"gaussians": self.size.gaussians, "seed": 0}
        return Case(self.rock, self.size.images, settings).on_orbit(RING)

    def cells(self) -> list[Cell]:
        """Cells of the run; the last is the run itself."""
        is_3dgs = self.policy in ALL_3DGS
        task = "studies.free_fit:time_3dgs" if is_3dgs else "studies.case:time_policy"
        return self.case.with_task(self.name, task, alone=True, settings=self.settings())

    @property
    def name(self) -> str:
        """Name of its cell."""
        images, settings = self.size.images, self.settings()
        shape = f"{images.frames}x{images.width}x{images.height}-{self.size.gaussians}"
        views = f"{self.seeds}+{settings['budget']}-{settings['seed']}"
        views += f"-by{settings['batch']}" if "batch" in settings else ""
        version = "".join(f"-{digest[:8]}" for digest in policy_record(self.policy).values())
        where = f"timed/{self.rock.name}/ring-{shape}"
        label = self.label.replace(", ", "-").replace(" ", "-")
        return f"{where}/{label}{version}-{views}"

    @property
    def label(self) -> str:
        """Name of the policy in tables."""
        return policy_file.label(self.policy)

    def settings(self) -> dict[str, Any]:
        """Settings of `mgs nbv`, or of 3DGS."""
        settings = ALL_3DGS.get(self.policy, {})
        if self.policy not in ALL_3DGS:
            batch = {"batch": self.size.batch} if self.size.batch > 1 else {}
            settings = {"policy": self.policy, **batch}
        budget = self.size.budget if self.budget is None else self.budget
        views = {"seeds": self.seeds, "budget": budget}
        return settings | views | {"seed": self.rock.index + 1000 * self.draw}

    def command(self) -> str:
        """The `mgs nbv` that does the same in the study's folder; empty for 3DGS."""
        if self.policy in ALL_3DGS:
            return ""
        folders = self.cells()[-1].arguments
        options = " ".join(
            f"{'--' + key.replace('_', '-')} {value}" for key, value in self.settings().items()
        )
        where = f"{folders['dataset']} --prior {folders['prior']} --out RUN"
        return f"mgs nbv {where} --set train.alpha_weight=0 {options}"


def table_runs(size: ReproduceSize) -> dict[str, Run]:
    """Runs of Table I by the label of their row."""
    one, runs = size.table, dict[str, Run]()
    for policy in TABLE_POLICIES:
        draws = DRAWS if policy == "random" else 1
        for draw in range(draws):
            label = policy if draws == 1 else f"{policy}, draw {draw + 1}"
            runs[label] = Run(TABLE_ROCK, one, policy, draw=draw)
    runs[FEWER] = Run(TABLE_ROCK, one, "coverage", budget=one.budget - FEWER_IMAGES)
    runs[ALL_VIEWS] = Run(TABLE_ROCK, one, "uniform", budget=one.images.frames - SEEDS)
    runs |= {policy: Run(TABLE_ROCK, one, policy) for policy in SLOW_POLICIES}
    for row in list(ALL_3DGS)[: one.rows_3dgs]:
        runs[row] = Run(TABLE_ROCK, one, row, seeds=one.images.frames, budget=0)
    return runs


def figure_runs(size: ReproduceSize) -> list[Run]:
    """Runs of Table I that the figures show."""
    return [table_runs(size)[policy] for policy in FIGURE_POLICIES]


if __name__ == "__main__":
    from studies.commands import start

    start("table1")
