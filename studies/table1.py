"""The paper's Table I: policies at equal numbers of images, with times, and 3DGS of all views.

3DGS is Kerbl et al. 2023, a model that no surface holds. As in the authors' program: round, nearly
transparent Gaussians at points, L1 and D-SSIM of sRGB values, Adam with their learning rates,
adaptive density, and a degree of the spherical harmonics more every 1,000 steps. The points are
those of the prior, or random inside the masks. Different: density changes at the ends of passes. In
fits of less than 30,000 steps it changes during the first half of the steps.

Runs are timed one by one: let nothing else run meanwhile.
"""

import os
import shutil
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

import mgs
from mgs.camera import extent_of
from mgs.data.dataset import target_of
from mgs.fit.fitting import fit_gaussians
from mgs.fit.settings import as_3dgs
from mgs.memory import IMAGE_BYTES, Deferred, kept_within
from mgs.prior.initial import round_gaussians
from mgs.prior.points import scattered
from mgs.run import policy_file
from mgs.run.inputs import policy_record
from studies.frame.case import Case, Rock, Size, test_views_of
from studies.frame.output import table, write_table
from studies.frame.program import Study, Work, at_least, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell, cell_folder
from studies.frame.timing import peak_megabytes
from studies.setups import RANDOM, RING

SEEDS = 4
"""Seed views of a run, as in the paper."""

POLICIES = (
    "paper", "d-optimal", "coverage", "uniform", "directional-i", "fisherrf", "farthest", RANDOM,
    "directional-d",
)  # fmt: skip
"""Policies of Table I; those of the paper first, because the table grows as its runs are done."""

HERE = Path(__file__).parent
SLOW = {"block-d": f"{HERE}/policies.py:block_d"}
"""Last row of Table I: a choice by 11x11 blocks takes 20 seconds at the paper's size."""

ALL_VIEWS, FEWER = "all views", "coverage, fewer images"
"""Rows of Table I that are no policies: `uniform` until no frame is left; and coverage with
`fewer` fewer images, as the paper counts."""

ALL_3DGS: dict[str, dict[str, Any]] = {
    "3DGS": {},
    "3DGS, random points": {"random": True},
    "3DGS, random points, twice the steps": {"random": True, "times": 2},
}
"""Rows of Table I for 3DGS, which sees all views: settings of `time_3dgs`."""

FIGURE_POLICIES = ("paper", "d-optimal", "coverage", "uniform")
"""Runs of Table I that the figures show."""

DEGREE_3DGS = 3
"""Degree of the spherical harmonics of 3DGS."""


@dataclass(frozen=True)
class TableSize:
    """Images of the dataset, Gaussians of the prior, and views chosen beyond the seeds.

    batch: how many of these are chosen before the model is fitted again. policies: first rows;
    slow: last ones, by label. draws: runs of `random`. rows_3dgs, passes_3dgs: number of rows for
    3DGS, and passes of its fits (15,000 steps for the 100 images of the paper).
    """

    images: Size
    gaussians: int
    budget: int
    batch: int = 1
    policies: tuple[str, ...] = POLICIES
    slow: Mapping[str, str] = field(default_factory=lambda: SLOW)
    draws: int = 5
    fewer: int = 4
    rows_3dgs: int = 2
    passes_3dgs: int = 150


ROCK = Rock("boulder", 0)
"""Rock of Table I."""

SIZES = {
    "quick": TableSize(Size(320, 240, 32, 12), 10_000, 8),
    "paper": TableSize(Size(640, 480, 100, 24, spp=12), 100_000, 50, rows_3dgs=3),
}


@dataclass(frozen=True)
class TableRun:
    """A run of a policy on the views of a rock. It runs alone, for its seconds and memory, and is
    measured on all views. budget: by default that of the size."""

    rock: Rock
    size: TableSize
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
        task = "time_3dgs" if self.policy in ALL_3DGS else "time_policy"
        return self.case.with_task(
            self.name, f"{__name__}:{task}", alone=True, settings=self.settings()
        )

    @property
    def name(self) -> str:
        images, settings = self.size.images, self.settings()
        shape = f"{images.frames}x{images.width}x{images.height}-{self.size.gaussians}"
        views = f"{self.seeds}+{settings['budget']}-{settings['seed']}"
        views += f"-by{settings['batch']}" if "batch" in settings else ""
        version = "".join(f"-{digest[:8]}" for digest in policy_record(self.policy).values())
        label = policy_file.label(self.policy).replace(", ", "-").replace(" ", "-")
        return f"timed/{self.rock.name}/ring-{shape}/{label}{version}-{views}"

    def settings(self) -> dict[str, Any]:
        """Settings of `mgs nbv`, or of 3DGS."""
        if self.policy in ALL_3DGS:
            settings = ALL_3DGS[self.policy] | {"passes": self.size.passes_3dgs}
        else:
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
        options = " ".join(f"--set {key}={value}" for key, value in self.settings().items())
        where = f"{folders['dataset']} --prior {folders['prior']} --out RUN"
        line = f"mgs nbv {where} {options}"
        return line.replace(f"{HERE.parent}/", "")  # names no folder of this machine


def table_runs(size: TableSize) -> dict[str, TableRun]:
    """Runs of Table I by the label of their row."""
    runs = dict[str, TableRun]()
    for policy in size.policies:
        draws = size.draws if policy == RANDOM else 1
        for draw in range(draws):
            label = policy if draws == 1 else f"{policy}, draw {draw + 1}"
            runs[label] = TableRun(ROCK, size, policy, draw=draw)
    runs[FEWER] = TableRun(ROCK, size, "coverage", budget=size.budget - size.fewer)
    runs[ALL_VIEWS] = TableRun(ROCK, size, "uniform", budget=size.images.frames - SEEDS)
    runs |= {label: TableRun(ROCK, size, policy) for label, policy in size.slow.items()}
    for row in list(ALL_3DGS)[: size.rows_3dgs]:
        runs[row] = TableRun(ROCK, size, row, seeds=size.images.frames, budget=0)
    return runs


def begun_run(root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]) -> mgs.Run:
    """The run in OUT/run, which is started if it is not there. settings: of `mgs nbv`."""
    for leftover in out.glob(".run.*.part"):  # of a process killed before the run began
        shutil.rmtree(leftover)
    run = out / "run"
    if (run / "config.json").is_file():
        return mgs.open_run(run)
    return mgs.start_run(root / dataset, run, prior=root / prior, **settings)


def time_policy(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """Run a policy in a new process, and measure its last model on all views.

    Returns "images"; "test", "all" and "held_out" of `evaluate`; "seconds" of all steps without
    evaluation; "choice_seconds", the mean of one choice (None without any); "peak_megabytes" of the
    process at the end of the run.
    """
    return in_new_process(_timed, out, root, out, dataset, prior, settings)


def _timed(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    run = begun_run(root, out, dataset, prior, settings)
    steps = mgs.resume_nbv(run, policy=settings.get("policy")).state.steps
    peak = peak_megabytes()
    metrics = mgs.evaluate_run(run.folder, pictures=False)
    seconds = [step["seconds"] for step in steps]
    choices = [one["score"] for one in seconds[1:]]
    return {key: metrics[key] for key in ("images", "test", "all", "held_out")} | {
        "seconds": sum(one[stage] for one in seconds for stage in one if stage != "evaluate"),
        "choice_seconds": sum(choices) / len(choices) if choices else None,
        "peak_megabytes": peak,
    }


def in_new_process(
    task: Callable[..., dict[str, Any]], out: Path, *arguments: Any
) -> dict[str, Any]:
    """Result of a function called in a new process, whose memory is its own. out: for messages.

    Raises InputError if that process is killed, and what the function raises.
    """
    with ProcessPoolExecutor(1, get_context("spawn"), initializer=_begin) as pool:
        try:
            return pool.submit(task, *arguments).result()
        except BrokenProcessPool:
            raise mgs.InputError(
                f"{out}: its process was killed (is there too little memory?); "
                "give the command again"
            ) from None


def _begin() -> None:
    """Begin a process that ends silently at Ctrl-C, and with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent = parent_process()
    assert parent

    def wait() -> None:
        parent.join()
        os._exit(1)

    Thread(target=wait, daemon=True).start()


def time_3dgs(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """Fit to all images from the prior's points, in a new process; returns as `time_policy`,
    without a choice. settings: "seed"; "passes" and a factor on them, "times"; "random": whether as
    many random points take the place of the prior's."""
    return in_new_process(_fit, out, root / dataset, root / prior, settings)


def _fit(dataset: Path, prior: Path, settings: dict[str, Any]) -> dict[str, Any]:
    data, seed = mgs.load_dataset(dataset), settings["seed"]
    frames, points = list(data.frames), mgs.load_prior(prior).points
    if settings.get("random"):
        points = scattered(data, mgs.PriorSettings(gaussians=len(points), seed=seed))[1]
    began = time.perf_counter()
    cameras = [frame.camera for frame in frames]
    passes = settings.get("times", 1) * settings["passes"]
    train = mgs.TrainSettings(**as_3dgs(extent_of(cameras)), passes=passes, seed=seed)
    start = round_gaussians(points, frames, linear=False)[0].with_degree(DEGREE_3DGS)
    start = replace(start, antialiased=train.antialiased)
    kept = kept_within(IMAGE_BYTES, lambda i: target_of(frames[i]), lambda target: target.nbytes)
    targets = Deferred(range(len(frames)), kept)
    model = fit_gaussians(start, cameras, targets, train).gaussians
    seconds, peak = time.perf_counter() - began, peak_megabytes()
    tests = test_views_of(data).frames
    metrics = mgs.evaluate_model(model, frames, [frame.name for frame in frames], test_frames=tests)
    found = {key: metrics[key] for key in ("images", "test", "all", "held_out")}
    more = {"seconds": seconds, "choice_seconds": None, "peak_megabytes": peak}
    return found | more | {"gaussians": len(model)}


PAPER_TABLE = (("D-Optimal NBV", 54, 25.97, 0.9654), ("Coverage-Greedy", 50, 26.06, 0.9648))
"""Table I of the paper, on its own rock: method, images, PSNR in dB, SSIM."""

TABLE_COLUMNS = {
    "policy": "row",
    "images": "images",
    "test views (dB)": "test.psnr:.2f",
    "rock (dB)": "test.psnr_mask:.2f",
    "all views (dB)": "all.psnr:.2f",
    "SSIM": "all.ssim:.4f",
    "a choice (s)": "choice_seconds:.2f",
}


def table_rows(work: Work) -> list[Row]:
    """Table I: a row for each run that is done."""
    rows = []
    for label, run in table_runs(work.size).items():
        if run.name not in work.results:
            continue
        numbers = work.results[run.name]
        row: Row = {"row": label, "images": numbers["images"]}
        for views in ("test", "all", "held_out"):
            for metric in ("psnr", "ssim", "psnr_mask", "ssim_mask"):
                row[f"{views}.{metric}"] = numbers[views][metric]
        row |= {key: numbers[key] for key in ("choice_seconds", "seconds", "peak_megabytes")}
        rows.append(row | {"command": run.command()})
    return rows


def tables(rows: Sequence[Row], left: Sequence[str] = ()) -> str:
    """Table I with the paper's rows, and the mean of the draws of `random`. left: rows to come."""
    shown: list[Row] = [
        {"row": f"the paper's {name}, on its rock", "images": n, "all.psnr": psnr, "all.ssim": ssim}
        for name, n, psnr, ssim in PAPER_TABLE
    ]
    draws = [row for row in rows if row["row"].startswith("random,")]
    for row in rows:
        if row not in draws:
            shown.append(row)
        elif row is draws[0]:
            numbers = [key for key, value in row.items() if isinstance(value, float)]
            mean = {key: float(np.mean([draw[key] for draw in draws])) for key in numbers}
            shown.append(row | mean | {"row": f"random, mean of {len(draws)}"})
    to_come = f"\nNot done yet: {'; '.join(left)}.\n" if left else ""
    return table(TABLE_COLUMNS, shown) + to_come


def write(work: Work) -> list[Path]:
    """Write table1.csv, .json and .md of the runs that are done; where all are, the figures too."""
    rows = table_rows(work)
    done = {row["row"] for row in rows}
    left = [label for label in table_runs(work.size) if label not in done]
    paths = write_table(work, "table1", rows, tables(rows, left), left=left)
    runs = table_runs(work.size)
    shown = [cell_folder(work.out, runs[p].name) / "run" for p in FIGURE_POLICIES if p in runs]
    if left or not shown:
        return paths
    for run in shown:
        mgs.evaluate_run(run)  # draws; the metrics are there already
    return [*paths, *mgs.report(shown, work.out / "figures")]


STUDY = Study(
    "table1",
    __doc__,
    write,
    SIZES,
    lambda size: [cell for run in table_runs(size).values() for cell in run.cells()],
    {"--batch": {"type": at_least(1), "default": 1, "help": "Views chosen before the next fit."}},
    lambda size, options: replace(size, batch=options.batch),
    growing=True,
)

if __name__ == "__main__":
    study_of("table1")()
