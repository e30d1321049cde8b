"""`mgs demo`: the other commands in a row, on a small rock."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Iterator
from concurrent.futures import wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Annotated

from mgs import runtime
from mgs.cli.options import Seed, argument
from mgs.cli.progress import progress_bar
from mgs.cli.terminal import Terminal
from mgs.errors import InputError
from mgs.files import check_new_folder, check_writable, read_json

POLICIES = ("directional-i", "paper", "d-optimal", "cover", "random")

TEST_VIEWS = 12

ORBIT = f"--size 160x120 --orbit hemisphere --distances 1,1.5,2 --test-views {TEST_VIEWS}"
"""Options of `mgs synth-orbit`. On a ring at one distance even spacing is as good as any choice."""

GAUSSIANS = "auto"
"""Number of Gaussians. With fewer than the images resolve, policies differ less."""

BUDGET = 8
"""Views beyond the four seeds, the same for every policy."""

Words = list[str]
"""Words of a command line after `mgs`."""


def demo(
    out: Annotated[
        Path, argument("Folder for everything; the same command again continues or shows it.")
    ] = Path("demo"),
    seed: Seed = 0,
) -> None:
    """Run all steps in a minute: render a rock orbit, build the prior, choose views by five
    policies, compare, draw. Every command is shown as it is run."""
    runtime.start()
    console, started = Terminal(), time.monotonic()
    dataset, prior, report = out / "dataset", out / "prior", out / "report"
    runs = [out / policy for policy in POLICIES]
    check_writable(out)
    check_seed(dataset, runs, seed)
    if not dataset.exists():
        check_new_folder(out)

    def heading(text: str) -> None:
        console.rule(f"{text}   {time.monotonic() - started:.0f} s", align="left")

    def run(*words: str | Path) -> None:
        called = [str(word) for word in words]
        console.print(f"$ mgs {shlex.join(called)}", soft_wrap=True)
        _call(called)

    heading(f"1/4 a photoreal orbit: 32 frames with depth and masks, and {TEST_VIEWS} test views")
    if not (dataset / "transforms.json").is_file():
        run("synth-orbit", dataset, *ORBIT.split(), "--seed", str(seed))
    heading("2/4 the prior: Gaussians on the rock's mesh, as many as the images resolve")
    if not (prior / "prior.json").is_file():
        run("prior", dataset, "--out", prior, "--gaussians", GAUSSIANS, "--seed", str(seed))
    heading(f"3/4 next best views by {len(runs)} policies, 4 seeds and {BUDGET} views each")
    settings = ["--budget", str(BUDGET), "--seed", str(seed), "--set", "evaluate_every=1"]
    begin = ["nbv", str(dataset), "--prior", str(prior), *settings]
    jobs = [
        ["nbv", "--resume", str(folder)]
        if (folder / "config.json").is_file()
        else [*begin, "--policy", policy, "--out", str(folder)]
        for policy, folder in zip(POLICIES, runs, strict=True)
    ]
    for k, printed in enumerate(in_processes(jobs, runs, console)):  # the next runs go on
        console.print(f"$ mgs {shlex.join(jobs[k])}\n{printed}", soft_wrap=True)
        console.print(f"$ mgs eval {runs[k]}", soft_wrap=True)
    run("diagnose", runs[0], "--force")
    heading("4/4 the report")
    run("report", *runs, "--out", report, "--force")
    pictures = [dataset / "contact_sheet.png", prior / "prior.png"]
    console.print(f"done in {time.monotonic() - started:.0f} s; look at these pictures, too:")
    for picture in pictures:
        console.print(f"  {picture}", soft_wrap=True)


def in_processes(jobs: list[Words], runs: list[Path], console: Terminal) -> Iterator[str]:
    """Call `mgs nbv` and `mgs eval` for several runs, as many at once as there are cores, each in a
    process; yield what `nbv` printed, in order.

    The last ones, fewer than the cores, have several threads each: a run's kernels are small, so
    many threads mostly wait. Raises InputError as the command, and if a process is killed.
    """
    cores = len(os.sched_getaffinity(0))
    count = min(len(jobs), cores)
    last = len(jobs) % count or count
    with runtime.processes(count) as pool, progress_bar("steps", console) as progress:
        threads = [cores // (count if k < len(jobs) - last else last) for k in range(len(jobs))]
        calls = [pool.submit(nbv_and_eval, *job) for job in zip(jobs, runs, threads, strict=True)]
        try:
            for call in calls:
                while not wait([call], 1).done:
                    progress("steps", sum(map(steps_done, runs)), len(runs) * (1 + BUDGET))
                yield call.result()
        except BrokenProcessPool:
            raise InputError(
                "demo: a process was killed (is there too little memory?); give the command again"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def nbv_and_eval(words: Words, run: Path, threads: int) -> str:
    """Call `mgs nbv` with these words, and draw the run's pictures; return what `nbv` printed.
    threads: of Dr.Jit."""
    runtime.start()
    import drjit as dr

    dr.set_thread_count(threads)
    with redirect_stdout(StringIO()) as printed:
        _call(words)
    with redirect_stdout(StringIO()):
        _call(["eval", str(run)])
    return printed.getvalue().rstrip()


def _call(words: Words) -> None:
    """Run a command in this process. Raises InputError as it does."""
    from mgs.cli.app import app

    app(words, prog_name="mgs", standalone_mode=False)


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
    for folder, other in recorded.items():
        if other != seed:
            raise InputError(
                f"{folder}: was made with `seed` {other}, not {seed}; "
                "give that seed, or another folder"
            )
