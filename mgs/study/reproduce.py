"""`mgs reproduce`: the paper's Table I and what it leaves open, each result with its runs.

A result is a row of RESULTS; its cells are datasets, priors and runs. Cells that several results
need are done once.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mgs.data.dataset import TEST_FOLDER, load_dataset, write_transforms
from mgs.errors import InputError, flag
from mgs.files import atomic_folder
from mgs.policy import from_file as policy_file
from mgs.policy.registry import policy_named
from mgs.run.inputs import file_digest, policy_record
from mgs.study.case import Case, Scene, Size
from mgs.study.statistics import MOST_ROCKS
from mgs.study.sweep import CELLS, Cell, names_of

SCENES = ("boulder", "contact-binary", "low-sun", "pebbles", "strata")

DEVELOPED_ON = ("boulder", "contact-binary")
"""Scenes whose rocks of seed 0 were used to choose settings of policies."""

SEEDS = 4
"""Seed views of a run, as in the paper."""

POLICIES = (
    "paper", "d-optimal", "directional-i", "directional-d", "fisherrf", "cover", "coverage",
    "completeness", "farthest", "uniform", "random",
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
"""Pairs of policies whose difference is tested, named before they were measured over rocks. The
paper compares `paper`, `d-optimal` and `coverage`; COVER's authors compare it with FisherRF."""

LEADER = "directional-i"
"""Policy whose difference from every other is reported for each pool."""

DRAWS = 3
"""Runs of the policy `random` for one row of a table."""

TABLE_POLICIES = (
    "paper", "d-optimal", "coverage", "uniform", "directional-i", "fisherrf", "farthest", "random",
    "directional-d",
)  # fmt: skip
"""Policies of Table I; those of the paper first, because the table grows as its runs are done."""

SLOW_POLICIES = ("block-d",)
"""Last policies of Table I: a choice by 11x11 blocks takes 20 seconds at the paper's size."""

ALL_VIEWS, FEWER, AS_3DGS = "all views", "coverage, fewer images", "all views, as 3DGS"
"""Rows of Table I that are no policies: `uniform` until no frame is left; coverage with
FEWER_IMAGES fewer images, as the paper counts; and a fit that is not held to a surface."""

FEWER_IMAGES = 4

POOLS: dict[str, dict[str, Any]] = {
    "ring": {"kind": "circle"},
    "hemisphere": {"kind": "hemisphere"},
    "rings": {"kind": "rings"},
    "biased arc": {"kind": "circle", "every": 6},
    "five nearest": {"kind": "circle", "nearest": 5},
    "mixed distances": {"kind": "hemisphere", "distances": [1, 2, 3]},
}
"""Pools of candidates. kind, distances: as in `mgs.synth.scene_file.Orbit`; every: all frames of
half a ring and one in so many of its other half, from a ring of 3/2 as many frames; nearest: the
setting of `mgs nbv`."""

SEED_COUNTS = (1, 2, 3, 4, 6, 8)
SEED_POLICIES = ("d-optimal", "paper")

ORACLE, FREE_FIT = "oracle", "free-fit"
OTHER_TASKS = {ORACLE: "mgs.study.oracle:run_oracle", FREE_FIT: "mgs.study.free_fit:time_free_fit"}
"""Tasks of runs that have no policy of `mgs nbv`."""

MESH_SCENE = "boulder"
"""Scene whose ground, light and orbits a mesh gets."""

MOST_POOL_ROCKS = 10
"""Two rocks of each scene. The twelfth is larger than the images of its hemisphere."""

FIGURE_POLICIES = ("paper", "d-optimal", "coverage", "uniform")
"""Runs of Table I that the figures show."""


@dataclass(frozen=True)
class RunSize:
    """Images of the dataset, Gaussians of the prior, views chosen beyond the seeds, and how many of
    these are chosen before the model is fitted again."""

    images: Size
    gaussians: int
    budget: int
    batch: int = 1


@dataclass(frozen=True)
class Rock:
    """A scene and the seed of its rock, or a mesh file and its hash in MESH_SCENE. index: place
    among the rocks, and seed of the runs."""

    scene: str
    seed: int
    index: int = 0
    mesh: Path | None = None
    digest: str = ""

    @property
    def name(self) -> str:
        """Folder name."""
        return f"{self.scene}-{self.digest[:8] if self.mesh else self.seed}"

    def at(self, orbit: dict[str, Any]) -> Scene:
        """Scene of the rock with values of the orbit's section."""
        scene = MESH_SCENE if self.mesh else self.scene
        mesh = str(self.mesh) if self.mesh else None
        kind = "-".join([orbit["kind"], *map(str, orbit.get("distances", ()))])
        return Scene(scene, self.seed, {"orbit": orbit}, mesh, f"{self.name}/{kind}")


TABLE_ROCK = Rock("boulder", 0)
"""Rock of Table I."""


@dataclass(frozen=True)
class ReproduceSize:
    """Size of a reproduction: of the runs of Table I, of the runs over many rocks, and how many
    rocks these results have.

    own_policies: policies that curves and pools compare, too. meshes: rocks in place of the
    procedural ones.
    """

    table: RunSize
    rocks: RunSize
    curve_rocks: int = 12
    seed_rocks: int = 5
    pool_rocks: int = 3
    own_policies: tuple[str, ...] = ()
    meshes: tuple[Rock, ...] = ()

    @property
    def policies(self) -> tuple[str, ...]:
        """Policies that curves and pools compare."""
        return (*POLICIES, *self.own_policies)

    def some_rocks(self, count: int) -> list[Rock]:
        """The first rocks: meshes, or the scenes in turn with seeds from 1 on. On rocks of seed 0
        the policies were developed."""
        if self.meshes:
            return list(self.meshes[:count])
        return [Rock(SCENES[k % len(SCENES)], 1 + k // len(SCENES), k) for k in range(count)]


SIZES = {
    "quick": ReproduceSize(
        RunSize(Size(320, 240, 32, 12), 10_000, 8), RunSize(Size(240, 180, 32, 12), 5_000, 8)
    ),
    "paper": ReproduceSize(
        RunSize(Size(640, 480, 100, 24, spp=16), 100_000, 50),
        RunSize(Size(320, 240, 48, 24), 10_000, 20),
        pool_rocks=5,
    ),
}


@dataclass(frozen=True)
class Run:
    """A run of a policy on the views of a rock. budget: by default that of the size. timed: it runs
    alone, for its seconds and memory, and is measured on all views."""

    rock: Rock
    size: RunSize
    policy: str
    seeds: int = SEEDS
    budget: int | None = None
    draw: int = 0
    pool: str = "ring"
    timed: bool = False

    @property
    def case(self) -> Case:
        """Case of the dataset and the prior; the prior is of the whole flight."""
        pool, images = POOLS[self.pool], self.size.images
        if "every" in pool:
            images = replace(images, frames=images.frames * 3 // 2)
        orbit = {"distances": [1]} | {k: pool[k] for k in ("kind", "distances") if k in pool}
        settings = {"gaussians": self.size.gaussians, "seed": 0}
        return Case(self.rock.at(orbit), images, settings)

    def cells(self) -> list[Cell]:
        """Cells of the run; the last is the run itself."""
        case, pool = self.case, POOLS[self.pool]
        cells, folders = case.cells(), case.folders
        if "every" in pool:
            arguments = {"ring": case.dataset, "every": pool["every"]}
            arc = Cell(f"arc/{case.name}", f"{__name__}:make_arc", arguments, (cells[0].name,))
            cells.append(arc)
            folders["dataset"] = f"{CELLS}/{arc.name}/dataset"
        usual = "time_policy" if self.timed else "run_policy"
        task = OTHER_TASKS.get(self.policy, f"mgs.study.case:{usual}")
        needs = tuple(cell.name for cell in cells)
        arguments = {**folders, "settings": self.settings()}
        return [*cells, Cell(self.name, task, arguments, needs, alone=self.timed)]

    @property
    def name(self) -> str:
        """Name of its cell."""
        images, settings = self.size.images, self.settings()
        kind = "timed" if self.timed else "run"
        shape = f"{images.frames}x{images.width}x{images.height}-{self.size.gaussians}"
        views = f"{self.seeds}+{settings['budget']}-{settings['seed']}"
        views += f"-by{settings['batch']}" if "batch" in settings else ""
        version = "".join(f"-{digest[:8]}" for digest in policy_record(self.policy).values())
        where = f"{kind}/{self.rock.name}/{self.pool.replace(' ', '-')}-{shape}"
        return f"{where}/{self.label}{version}-{views}"

    @property
    def label(self) -> str:
        """Name of the policy in tables."""
        return policy_file.label(self.policy)

    def settings(self) -> dict[str, Any]:
        """Settings of `mgs nbv`; without a policy for OTHER_TASKS."""
        settings: dict[str, Any] = {}
        if self.policy not in OTHER_TASKS:
            batch = {"batch": self.size.batch} if self.size.batch > 1 else {}
            settings = {"policy": self.policy, **batch}
        budget = self.size.budget if self.budget is None else self.budget
        settings |= {"seeds": self.seeds, "budget": budget}
        settings |= {"seed": self.rock.index + 1000 * self.draw}
        nearest = POOLS[self.pool].get("nearest")
        return settings | ({"nearest": nearest} if nearest else {})

    def command(self) -> str:
        """The `mgs nbv` that does the same in the study's folder; empty for OTHER_TASKS."""
        if self.policy in OTHER_TASKS:
            return ""
        folders = self.cells()[-1].arguments
        options = " ".join(f"{flag(key)} {value}" for key, value in self.settings().items())
        where = f"{folders['dataset']} --prior {folders['prior']} --out RUN"
        return f"mgs nbv {where} --alpha-weight 0 {options}"


def make_arc(root: Path, out: Path, ring: str, every: int) -> dict[str, Any]:
    """Task: a dataset of all frames of the first half of a ring, and one in so many of the second
    half, into OUT/dataset."""
    source, folder = load_dataset(root / ring), out / "dataset"
    half = len(source) // 2
    kept = [frame for i, frame in enumerate(source.frames) if i < half or (i - half) % every == 0]
    if not folder.is_dir():
        with atomic_folder(folder) as unfinished:
            copies = []
            for frame in kept:
                paths: dict[str, Any] = {}
                for key, path in asdict(frame).items():
                    if isinstance(path, Path):
                        paths[key] = unfinished / path.relative_to(source.root)
                        paths[key].parent.mkdir(parents=True, exist_ok=True)
                        shutil.copyfile(path, paths[key])
                copies.append(replace(frame, **paths))
            shutil.copytree(source.root / TEST_FOLDER, unfinished / TEST_FOLDER)
            write_transforms(unfinished, copies, source.up, source.unit)
    return {"frames": len(kept)}


def table_runs(size: ReproduceSize) -> dict[str, Run]:
    """Runs of Table I by the label of their row."""
    one, runs = size.table, dict[str, Run]()
    for policy in TABLE_POLICIES:
        draws = DRAWS if policy == "random" else 1
        for draw in range(draws):
            label = policy if draws == 1 else f"{policy}, draw {draw + 1}"
            runs[label] = Run(TABLE_ROCK, one, policy, draw=draw, timed=True)
    runs[FEWER] = Run(TABLE_ROCK, one, "coverage", budget=one.budget - FEWER_IMAGES, timed=True)
    runs[ALL_VIEWS] = Run(TABLE_ROCK, one, "uniform", budget=one.images.frames - SEEDS, timed=True)
    runs |= {policy: Run(TABLE_ROCK, one, policy, timed=True) for policy in SLOW_POLICIES}
    runs[AS_3DGS] = Run(TABLE_ROCK, one, FREE_FIT, seeds=one.images.frames, budget=0, timed=True)
    return runs


def curve_runs(size: ReproduceSize, count: int) -> list[Run]:
    """Every policy on every rock."""
    rocks = size.some_rocks(count)
    return [Run(rock, size.rocks, policy) for rock in rocks for policy in size.policies]


def seed_runs(size: ReproduceSize, count: int) -> list[Run]:
    """Numbers of seeds, at equal numbers of images."""
    total = SEEDS + size.rocks.budget
    return [
        Run(rock, size.rocks, policy, seeds=seeds, budget=total - seeds)
        for rock in size.some_rocks(count)
        for policy in SEED_POLICIES
        for seeds in SEED_COUNTS
    ]


def pool_runs(size: ReproduceSize, count: int) -> list[Run]:
    """Every policy on every pool; several draws of `random`."""
    return [
        Run(rock, size.rocks, policy, draw=draw, pool=pool)
        for pool in POOLS
        for rock in size.some_rocks(count)
        for policy in size.policies
        for draw in range(DRAWS if policy == "random" else 1)
    ]


def oracle_runs(size: ReproduceSize, count: int) -> list[Run]:
    """The oracle on every pool."""
    rocks = size.some_rocks(count)
    return [Run(rock, size.rocks, ORACLE, pool=pool) for pool in POOLS for rock in rocks]


@dataclass(frozen=True)
class Result:
    """A result that --only can name.

    runs(size, rocks): the runs that it needs. rocks: attribute of the size with its default number
    of rocks; None: it has one. optional: only done if asked for. most: most rocks.
    """

    runs: Callable[[ReproduceSize, int], list[Run]]
    rocks: str | None = None
    optional: bool = False
    most: int = MOST_ROCKS

    def count(self, size: ReproduceSize) -> int:
        """Default number of rocks."""
        return getattr(size, self.rocks) if self.rocks else 1

    def cells(self, size: ReproduceSize, count: int) -> list[Cell]:
        """Cells over so many rocks."""
        return [cell for run in self.runs(size, count) for cell in run.cells()]


RESULTS = {
    "table1": Result(lambda size, _: list(table_runs(size).values())),
    "figures": Result(lambda size, _: [table_runs(size)[policy] for policy in FIGURE_POLICIES]),
    "curves": Result(curve_runs, "curve_rocks"),
    "seeds": Result(seed_runs, "seed_rocks"),
    "pools": Result(pool_runs, "pool_rocks", most=MOST_POOL_ROCKS),
    "oracle": Result(
        lambda size, count: pool_runs(size, count) + oracle_runs(size, count),
        "pool_rocks",
        optional=True,
        most=MOST_POOL_ROCKS,
    ),
}
"""Every result by name, in the order in which they are made."""


def pairs_of(policies: Iterable[str]) -> tuple[tuple[str, str], ...]:
    """Pairs of policies whose difference is tested: PAIRS, and the user's own policies with two
    baselines."""
    own = [policy for policy in policies if policy not in POLICIES]
    return (*PAIRS, *((policy, other) for policy in own for other in ("uniform", "farthest")))


def results_of(only: str | None) -> list[str]:
    """Names of the results of an option --only; all that are not optional if None."""
    if only is None:
        return [name for name, result in RESULTS.items() if not result.optional]
    return names_of(only, RESULTS)


def rocks_of(name: str, size: ReproduceSize, asked: int | None) -> int:
    """Number of rocks of a result. asked: of the option --rocks. Raises InputError if out of
    range."""
    result = RESULTS[name]
    if asked is None or result.rocks is None:
        return result.count(size)
    most = len(size.meshes) or result.most
    if not 1 <= asked <= most:
        raise InputError(f"--rocks {asked}: {name} can have 1 to {most}")
    return asked


NAMESAKE = "there is one of this name already; leave it out, or rename its file"


def with_options(
    size: ReproduceSize,
    names: Sequence[str],
    policies: Sequence[str],
    meshes: Sequence[Path],
    batch: int,
) -> ReproduceSize:
    """Size with the options --policy, --mesh and --batch. names: the results to make.

    Raises InputError if an option is for none of these results, a policy is unknown or already
    compared, two policies or meshes have the same name, or a mesh cannot be read or is one too
    many.
    """
    labels = list(POLICIES)
    for policy in policies:
        _check_used(f"--policy {policy}", names, "curves", "pools")
        if policy in POLICIES:
            raise InputError(f"--policy {policy}: is compared anyway")
        if policy_file.label(policy) in labels:
            raise InputError(f"--policy {policy}: {NAMESAKE}")
        labels.append(policy_file.label(policy))
        policy_named(policy)
    size = replace(size, own_policies=tuple(policy_file.absolute(policy) for policy in policies))
    if batch > 1:
        _check_used(f"--batch {batch}", names, "table1", "figures")
        size = replace(size, table=replace(size.table, batch=batch))
    return _with_meshes(size, names, meshes) if meshes else size


def _check_used(option: str, names: Sequence[str], *results: str) -> None:
    """Raise InputError if an option is for none of the results to make."""
    if not set(results) & set(names):
        raise InputError(f"{option}: is for {' and '.join(results)}, and --only leaves both out")


def _with_meshes(
    size: ReproduceSize, names: Sequence[str], meshes: Sequence[Path]
) -> ReproduceSize:
    if len(meshes) > MOST_ROCKS:
        raise InputError(
            f"--mesh: {len(meshes)} files; differences are tested over {MOST_ROCKS} rocks at most, "
            "leave some out"
        )
    if all(RESULTS[name].rocks is None for name in names):
        raise InputError(
            f"--mesh {meshes[0]}: is for results over many rocks, and --only leaves them out"
        )
    rocks: list[Rock] = []
    for k, mesh in enumerate(meshes):
        if mesh.stem in [rock.scene for rock in rocks]:
            raise InputError(f"--mesh {mesh}: {NAMESAKE}")
        rocks.append(Rock(mesh.stem, 0, k, mesh.resolve(), file_digest(mesh)))
    count = len(rocks)
    return replace(size, meshes=tuple(rocks), curve_rocks=count, seed_rocks=count, pool_rocks=count)
