"""`mgs demo`: all steps on a small rock."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from concurrent.futures import wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mgs import runtime
from mgs.cli.models import diagnose
from mgs.cli.nbv import resume_and_print, start_and_print
from mgs.cli.options import Seed, argument
from mgs.cli.printing import print_quality
from mgs.cli.prior import prior
from mgs.cli.progress import progress_bar
from mgs.cli.synth_orbit import synth_orbit
from mgs.cli.terminal import Terminal
from mgs.errors import InputError
from mgs.files import check_new_folder, check_writable, read_json

if TYPE_CHECKING:
    from mgs.run.folder import Run
    from mgs.run.state import Checkpoint

POLICIES = ("directional-i", "paper", "d-optimal", "cover", "random")

ORBIT, DISTANCES = "hemisphere", "1,1.5,2"
"""Options of the orbit. On a ring at one distance even spacing is as good as any choice."""

SIZE = "160x120"
"""Size of the images: so small that all steps take a minute."""

GAUSSIANS = "auto"
"""Number of Gaussians. With fewer than the images resolve, policies differ less."""

TEST_VIEWS = 12
"""Test views on a dome around the rock."""

BUDGET = 8
"""Views beyond the four seeds, the same for every policy."""


def demo(
    out: Annotated[
        Path, argument("Folder for everything; the same command again continues or shows it.")
    ] = Path("demo"),
    seed: Seed = 0,
) -> None:
    """Run all steps in minutes: render a rock orbit, build the prior, choose views by five
    policies, compare, draw."""
    from mgs.report.runs import compare_runs
    from mgs.report.tables import comparison_rows
    from mgs.report.writing import write_report
    from mgs.run.folder import open_run

    runtime.start()
    console, started = Terminal(), time.monotonic()
    dataset, folder, report = out / "dataset", out / "prior", out / "report"
    runs = [out / policy for policy in POLICIES]
    check_writable(out)
    check_seed(dataset, runs, seed)
    if not dataset.exists():
        check_new_folder(out)

    def heading(text: str) -> None:
        console.rule(f"{text}   [dim]{time.monotonic() - started:.0f} s", align="left")

    heading(f"1/4 a photoreal orbit: 32 frames with depth and masks, and {TEST_VIEWS} test views")
    if not (dataset / "transforms.json").is_file():
        views: dict[str, Any] = {"orbit": ORBIT, "distances": DISTANCES, "test_views": TEST_VIEWS}
        synth_orbit(dataset, size=SIZE, seed=seed, **views)
    heading("2/4 the prior: Gaussians on the rock's mesh, as many as the images resolve")
    if not (folder / "prior.json").is_file():
        prior(dataset, out=folder, gaussians=GAUSSIANS, seed=seed)
    opened: list[Run] = []
    for policy, run in zip(POLICIES, runs, strict=True):
        if (run / "config.json").is_file():
            opened.append(open_run(run))
            continue
        settings: Any = {"policy": policy, "budget": BUDGET, "seed": seed, "evaluate_every": 1}
        opened.append(start_and_print(dataset, run, console, prior=folder, **settings))
    heading(f"3/4 next best views by {len(runs)} policies, 4 seeds and {BUDGET} views each")
    for done in completed(opened, console):  # meanwhile the next runs go on
        heading(f"3/4 {done.label}")
        resume_and_print(done, console, pictures=True)
        if done is opened[0]:
            console.print("what its views say about each Gaussian:")
            diagnose(runs[:1], force=True)
    heading("4/4 the report")
    compared = compare_runs(runs)
    written = write_report(report, list(compared.values()))
    print_quality(console, comparison_rows(compared))
    console.print(f"done in {time.monotonic() - started:.0f} s; look at:")
    for picture in (dataset / "contact_sheet.png", folder / "prior.png", *written):
        console.print(f"  {picture}", soft_wrap=True)


def completed(runs: list[Run], console: Terminal) -> Iterator[Run]:
    """Complete runs, as many at once as there are cores, each in a process; yield them in order.

    The last ones, fewer than the cores, have several threads each. Raises InputError as
    `resume_nbv`, and if a process is killed.
    """
    left = [run.folder for run in runs if not (run.folder / "metrics.json").is_file()]
    cores = len(os.sched_getaffinity(0))
    count = max(1, min(len(left), cores))
    last = len(left) % count or count
    working = {}
    with runtime.processes(count) as pool:
        for k, folder in enumerate(left):
            together = count if k < len(left) - last else last
            working[folder] = pool.submit(complete, folder, left[count:], cores // together)
        try:
            for run in runs:
                with progress_bar("steps", console) as progress:
                    while run.folder in working and not wait([working[run.folder]], 1).done:
                        progress("steps", sum(map(steps_done, left)), len(left) * (1 + BUDGET))
                if run.folder in working:
                    working[run.folder].result()
                yield run
        except BrokenProcessPool:
            raise InputError(
                "demo: a process was killed (is there too little memory?); give the command again"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def complete(run: Path, others: list[Path], threads: int) -> None:
    """Run or resume a run. others: get the fit to the seeds, the same for every policy, if they
    have none yet. threads: of Dr.Jit. A run's kernels are small, so many threads mostly wait."""
    runtime.start()
    import drjit as dr

    from mgs.run.folder import write_checkpoint
    from mgs.run.nbv import resume_nbv

    def share(state: Checkpoint) -> None:
        for other in others:
            if len(state.steps) == 1 and not (other / "checkpoint.npz").is_file():
                write_checkpoint(other, state)

    dr.set_thread_count(threads)
    resume_nbv(run, share)


def steps_done(run: Path) -> int:
    """Number of finished steps of a run."""
    lines = run / "steps.jsonl"
    return len(lines.read_bytes().splitlines()) if lines.is_file() else 0


def check_seed(dataset: Path, runs: list[Path], seed: int) -> None:
    """Raises InputError if the dataset or a run exists with another seed."""
    from mgs.run.folder import open_run

    recorded = {run: open_run(run).settings.seed for run in runs if (run / "config.json").is_file()}
    if (dataset / "config.json").is_file():
        config = read_json(dataset / "config.json")
        recorded[dataset] = config.get("seed", seed) if isinstance(config, dict) else seed
    for folder, found in recorded.items():
        if found != seed:
            raise InputError(
                f"{folder}: was made with `seed` {found}, not {seed}; "
                "give that seed, or another folder"
            )
