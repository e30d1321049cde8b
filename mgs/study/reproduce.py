"""The paper's results, and what it leaves open, each with the cells of work that it is made of: one
table, RESULTS.

A cell is a dataset, a prior or a run; cells that several results need are done once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mgs.policy import from_file as policy_file
from mgs.run.inputs import policy_record
from mgs.study.statistics import MOST_ROCKS
from mgs.study.sweep import Cell

SCENES = ("boulder", "contact-binary", "low-sun", "pebbles", "strata")

DEVELOPED_ON = ("boulder", "contact-binary")
"""Scenes on whose rocks of seed 0 the settings of policies were chosen; the other scenes had no
part in that choice."""

SEEDS = 4
"""Seed views of a run, as in the paper."""

POLICIES = (
    "paper", "d-optimal", "directional-i", "directional-d", "fisherrf", "cover", "coverage", "completeness", "farthest",
    "uniform", "random",
)  # fmt: skip
"""Policies that are compared over rocks."""

PAIRS = (
    ("d-optimal", "uniform"),
    ("d-optimal", "farthest"),
    ("directional-i", "uniform"),
    ("directional-i", "farthest"),
    ("paper", "coverage"),
    ("d-optimal", "coverage"),
    ("cover", "fisherrf"),
)
"""Pairs of policies, named before they were measured over rocks, whose difference is tested.
`paper`, `d-optimal` and `coverage` are what the paper compares, and COVER's authors compare it with
FisherRF."""

LEADER = "directional-i"
"""The policy whose difference from every other is told for each pool."""

DRAWS = 3
"""Runs of the policy `random` for one row of a table."""

TABLE_POLICIES = (
    "paper", "d-optimal", "coverage", "uniform", "directional-i", "fisherrf", "farthest", "random", "directional-d",
)  # fmt: skip
"""Rows of Table I; what the paper compares comes first, because the table is written as its rows
are done."""

SLOW_POLICIES = ("block-d",)
"""Further rows, which take longest: at the paper's size a choice by 11x11 blocks takes a third of a
minute."""

ALL_VIEWS, FEWER, AS_3DGS = "all views", "coverage, fewer images", "all views, as 3DGS"
"""Rows of Table I that are no policies: `uniform` until no frame is left; as the paper counts, 54
images against 50; and a fit that is not held to a surface (`mgs.study.free_fit`)."""

FEWER_IMAGES = 4
"""By how many images coverage has fewer there."""

POOLS: dict[str, dict[str, Any]] = {
    "ring": {"orbit": "circle"},
    "hemisphere": {"orbit": "hemisphere"},
    "rings": {"orbit": "rings"},
    "biased arc": {"orbit": "circle", "every": 6},
    "five nearest": {"orbit": "circle", "nearest": 5},
    "mixed distances": {"orbit": "hemisphere", "distances": (1, 2, 3)},
}
"""Candidates to choose from. orbit, distances: as in `mgs.synth.scene_file.Orbit`; every: half of a
ring of 3/2 as many frames, and of its other half one frame of so many; nearest: the setting of `mgs
nbv`."""

SEED_COUNTS = (1, 2, 3, 4, 6, 8)
SEED_POLICIES = ("d-optimal", "paper")


@dataclass(frozen=True)
class Size:
    """Images, in pixels; numbers of frames, samples per pixel, test views, Gaussians, views chosen
    beyond the seeds, and of these, how many are chosen before the model is fitted again."""

    width: int
    height: int
    frames: int
    spp: int
    test_views: int
    gaussians: int
    budget: int
    batch: int = 1


@dataclass(frozen=True)
class Mesh:
    """A file with a rock, and its hash when the study began (`mgs.run.inputs.file_digest`)."""

    file: Path
    digest: str


@dataclass(frozen=True)
class Preset:
    """How large a reproduction is. table: of Table I. rocks: of the results over many rocks. How
    many rocks the curves, the study of seeds and that of pools have."""

    table: Size
    rocks: Size
    curve_rocks: int = 12
    seed_rocks: int = 5
    pool_rocks: int = 3
    own_policies: tuple[str, ...] = ()
    """Policies of the user's own that the curves and the pools compare, too
    (`mgs.study.reproduce_asked`)."""
    meshes: tuple[Mesh, ...] = ()
    """Rocks of the user's own, which then take the place of the procedural ones
    (`mgs.study.reproduce_asked`)."""

    @property
    def policies(self) -> tuple[str, ...]:
        """All that the curves and the pools compare."""
        return (*POLICIES, *self.own_policies)


PRESETS = {
    "quick": Preset(Size(320, 240, 32, 8, 12, 10_000, 8), Size(240, 180, 32, 8, 12, 5_000, 8)),
    "paper": Preset(
        Size(640, 480, 100, 16, 24, 100_000, 50),
        Size(320, 240, 48, 8, 24, 10_000, 20),
        pool_rocks=5,
    ),
}


@dataclass(frozen=True)
class Rock:
    """A scene, and the seed of the rock in it; or a mesh, called by its file's name, in MESH_SCENE.
    index: its place among the rocks, also the seed of the runs on it."""

    scene: str
    seed: int
    index: int = 0
    mesh: Mesh | None = None

    @property
    def name(self) -> str:
        """As it is called in folders."""
        return f"{self.scene}-{self.seed if self.mesh is None else self.mesh.digest[:8]}"

    def made_of(self) -> dict[str, Any]:
        """What the task that renders is told of it."""
        if self.mesh is None:
            return {"scene": self.scene, "seed": self.seed}
        return {"scene": MESH_SCENE, "seed": self.seed, "mesh": str(self.mesh.file)}


MESH_SCENE = "boulder"
"""The scene whose ground, light and orbits a mesh is given."""


TABLE_ROCK = Rock("boulder", 0)
"""The rock of Table I."""


def rocks(preset: Preset, count: int) -> list[Rock]:
    """The first so many rocks: the scenes in turn, with seeds from 1 on. On those of seed 0 the
    policies were developed. Where the preset has meshes, these instead."""
    if preset.meshes:
        return [Rock(mesh.file.stem, 0, k, mesh) for k, mesh in enumerate(preset.meshes[:count])]
    return [Rock(SCENES[k % len(SCENES)], 1 + k // len(SCENES), k) for k in range(count)]


@dataclass(frozen=True)
class Run:
    """A run of a policy on the views of a rock: all that decides which cells it is made of."""

    rock: Rock
    size: Size
    policy: str
    seeds: int = SEEDS
    budget: int | None = None
    """None: that of the size."""
    draw: int = 0
    pool: str = "ring"
    timed: bool = False
    """Whether it is done alone, for its seconds and memory, and measured on all views."""

    def cells(self) -> list[Cell]:
        """Its cells; the last is the run itself."""
        size, pool = self.size, POOLS[self.pool]
        frames = size.frames * 3 // 2 if "every" in pool else size.frames
        distances = pool.get("distances", ())
        shape = "-".join(
            [pool["orbit"], *map(str, distances), f"{frames}x{size.width}x{size.height}"]
        )
        views = {"test_views": size.test_views}
        preset = {"width": size.width, "height": size.height, "frames": frames, "spp": size.spp}
        where = self.rock.made_of() | {"orbit": pool["orbit"]}
        where |= {"distances": list(distances)} if distances else {}
        cells = [
            Cell(
                f"dataset/{self.rock.name}/{shape}",
                "mgs.study.tasks:make_dataset",
                where | views | {"preset": preset},
            )
        ]
        survey = cells[0].name  # the prior is of the whole flight
        prior = {"dataset": survey, "gaussians": size.gaussians, "seed": 0}
        cells.append(
            Cell(
                f"prior/{self.rock.name}/{shape}-{size.gaussians}",
                "mgs.study.tasks:make_prior",
                prior,
                (survey,),
            )
        )
        if "every" in pool:
            arc = {"ring": survey, "every": pool["every"]}
            cells.append(
                Cell(
                    f"dataset/{self.rock.name}/arc-{shape}",
                    "mgs.study.tasks:make_arc",
                    arc,
                    (survey,),
                )
            )
        dataset, prior_name = cells[-1 if "every" in pool else 0].name, cells[1].name
        task = OTHER_TASKS.get(
            self.policy,
            "mgs.study.tasks:time_policy" if self.timed else "mgs.study.tasks:run_policy",
        )
        return [
            *cells,
            Cell(
                self.name,
                task,
                {"dataset": dataset, "prior": prior_name, "settings": self.settings()},
                tuple(cell.name for cell in cells),
                alone=self.timed,
            ),
        ]

    @property
    def name(self) -> str:
        """Of its cell."""
        size, settings = self.size, self.settings()
        kind = "timed" if self.timed else "run"
        shape = f"{size.frames}x{size.width}x{size.height}-{size.gaussians}"
        views = f"{self.seeds}+{settings['budget']}-{settings['seed']}"
        views += f"-by{settings['batch']}" if "batch" in settings else ""
        version = "".join(
            f"-{digest[:8]}" for digest in policy_record(self.policy).values()
        )  # of a policy's file
        return f"{kind}/{self.rock.name}/{self.pool.replace(' ', '-')}-{shape}/{self.label}{version}-{views}"

    @property
    def label(self) -> str:
        """The policy as it is called in tables."""
        return policy_file.label(self.policy)

    def settings(self) -> dict[str, Any]:
        """Of `mgs nbv`; those of OTHER_TASKS name no policy."""
        budget = self.size.budget if self.budget is None else self.budget
        policy: dict[str, Any] = {} if self.policy in OTHER_TASKS else {"policy": self.policy}
        if policy and self.size.batch > 1:
            policy["batch"] = self.size.batch
        nearest = {"nearest": POOLS[self.pool]["nearest"]} if "nearest" in POOLS[self.pool] else {}
        seed = self.rock.index + 1000 * self.draw
        return {**policy, "seeds": self.seeds, "budget": budget, "seed": seed, **nearest}

    def command(self) -> str:
        """The `mgs nbv` that does the same, in the study's folder. Those of OTHER_TASKS have
        none."""
        if self.policy in OTHER_TASKS:
            return ""
        *_, cell = self.cells()
        options = " ".join(f"--{key} {value}" for key, value in self.settings().items())
        dataset, prior = (
            f"cells/{cell.arguments['dataset']}/dataset",
            f"cells/{cell.arguments['prior']}/prior",
        )
        return f"mgs nbv {dataset} --prior {prior} --out RUN --alpha-weight 0 {options}"


ORACLE, FREE_FIT = "oracle", "free-fit"
"""The policy that looks at the truth, `mgs.study.oracle`, and a fit to all views,
`mgs.study.free_fit`."""

OTHER_TASKS = {ORACLE: "mgs.study.oracle:run_oracle", FREE_FIT: "mgs.study.free_fit:time_free_fit"}
"""What does the cell of these, which are no policies of `mgs nbv`."""


def table_runs(preset: Preset) -> dict[str, Run]:
    """Table I: a run for each row, by its label."""
    size = preset.table
    runs: dict[str, Run] = {}
    for policy in TABLE_POLICIES:
        draws = DRAWS if policy == "random" else 1
        for draw in range(draws):
            label = policy if draws == 1 else f"{policy}, draw {draw + 1}"
            runs[label] = Run(TABLE_ROCK, size, policy, draw=draw, timed=True)
    runs[FEWER] = Run(TABLE_ROCK, size, "coverage", budget=size.budget - FEWER_IMAGES, timed=True)
    runs[ALL_VIEWS] = Run(TABLE_ROCK, size, "uniform", budget=size.frames - SEEDS, timed=True)
    runs |= {policy: Run(TABLE_ROCK, size, policy, timed=True) for policy in SLOW_POLICIES}
    runs[AS_3DGS] = Run(TABLE_ROCK, size, FREE_FIT, seeds=size.frames, budget=0, timed=True)
    return runs


def curve_runs(preset: Preset, count: int) -> list[Run]:
    """PSNR(images): every policy on every rock."""
    return [
        Run(rock, preset.rocks, policy)
        for rock in rocks(preset, count)
        for policy in preset.policies
    ]


def seed_runs(preset: Preset, count: int) -> list[Run]:
    """Numbers of seeds, at equal numbers of images in all, on so many rocks."""
    total = SEEDS + preset.rocks.budget
    return [
        Run(rock, preset.rocks, policy, seeds=seeds, budget=total - seeds)
        for rock in rocks(preset, count)
        for policy in SEED_POLICIES
        for seeds in SEED_COUNTS
    ]


def pool_runs(preset: Preset, count: int) -> list[Run]:
    """Every policy on every pool of so many rocks; of `random` several draws."""
    return [
        Run(rock, preset.rocks, policy, draw=draw, pool=pool)
        for pool in POOLS
        for rock in rocks(preset, count)
        for policy in preset.policies
        for draw in range(DRAWS if policy == "random" else 1)
    ]


def oracle_runs(preset: Preset, count: int) -> list[Run]:
    """The oracle on every pool of so many rocks."""
    return [
        Run(rock, preset.rocks, ORACLE, pool=pool)
        for pool in POOLS
        for rock in rocks(preset, count)
    ]


MOST_POOL_ROCKS = 10
"""Two rocks of each scene. The twelfth is larger than the images of its hemisphere."""

FIGURE_POLICIES = ("paper", "d-optimal", "coverage", "uniform")
"""Runs of Table I that the figures show."""


@dataclass(frozen=True)
class Result:
    """What one name of --only stands for."""

    runs: Callable[[Preset, int], list[Run]]
    """(preset, number of rocks) -> the runs that it needs."""
    rocks: Callable[[Preset], int]
    """How many rocks it has by default."""
    optional: bool = False
    """Done only if it is asked for."""
    most: int = MOST_ROCKS
    """Most rocks that can be asked for."""
    grows: bool = False
    """Written anew after every cell, of the runs that are done by then."""


RESULTS = {
    "table1": Result(
        lambda preset, _: list(table_runs(preset).values()), lambda preset: 1, grows=True
    ),
    "figures": Result(
        lambda preset, _: [table_runs(preset)[policy] for policy in FIGURE_POLICIES],
        lambda preset: 1,
    ),
    "curves": Result(curve_runs, lambda preset: preset.curve_rocks),
    "seeds": Result(seed_runs, lambda preset: preset.seed_rocks),
    "pools": Result(pool_runs, lambda preset: preset.pool_rocks, most=MOST_POOL_ROCKS),
    "oracle": Result(
        lambda preset, count: pool_runs(preset, count) + oracle_runs(preset, count),
        lambda preset: preset.pool_rocks,
        optional=True,
        most=MOST_POOL_ROCKS,
    ),
}
"""Every result by its name, in the order in which they are made."""


def cells_of(name: str, preset: Preset, count: int) -> list[Cell]:
    """The cells of a result over so many rocks, each once."""
    return list(
        {
            cell.name: cell for run in RESULTS[name].runs(preset, count) for cell in run.cells()
        }.values()
    )


def pairs_of(policies: Iterable[str]) -> tuple[tuple[str, str], ...]:
    """The pairs of policies whose difference is tested: PAIRS, and those of the user's own policies
    with the same two."""
    own = [policy for policy in policies if policy not in POLICIES]
    return (*PAIRS, *((policy, other) for policy in own for other in ("uniform", "farthest")))
