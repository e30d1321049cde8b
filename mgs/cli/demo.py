"""`mgs demo`: the other commands in a row, on a small rock."""

import shlex
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from mgs import runtime
from mgs.cli.options import Seed
from mgs.cli.terminal import Terminal
from mgs.errors import InputError
from mgs.files import check_new_folder, check_writable, read_json

POLICIES = ("directional-i", "paper", "random")

TEST_VIEWS = 12

ORBIT = f"--size 160x120 --orbit hemisphere --distances 1,1.5,2 --test-views {TEST_VIEWS}"
"""Options of `mgs synth-orbit`. On a ring at one distance even spacing is as good as any choice."""

GAUSSIANS = "auto"  # number of Gaussians. With fewer than the images resolve, policies differ less
BUDGET = 8  # views beyond the four seeds, the same for every policy


def demo(out: Annotated[Path, typer.Argument()] = Path("demo"), seed: Seed = 0) -> None:
    """Run all steps in a minute or two: render a rock orbit, build the prior, choose views by three
    policies, compare, draw. Every command is shown as it is run.

    - out: Folder for everything; the same command again continues or shows it."""
    from mgs.cli.nbv import resume_and_print, start_and_print
    from mgs.run.folder import open_run
    from mgs.run.nbv import scene_of

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

    def show(*words: object) -> None:
        console.print(f"$ mgs {shlex.join(map(str, words))}", soft_wrap=True)

    def run(*words: object) -> None:
        from mgs.cli.app import app

        show(*words)
        app([str(word) for word in words], prog_name="mgs", standalone_mode=False)

    heading(f"1/4 a photoreal orbit: 32 frames with depth and masks, and {TEST_VIEWS} test views")
    if not (dataset / "transforms.json").is_file():
        run("synth-orbit", dataset, *ORBIT.split(), "--seed", seed)
    heading("2/4 the prior: Gaussians on the rock's mesh, as many as the images resolve")
    if not (prior / "prior.json").is_file():
        run("prior", dataset, "--out", prior, "--gaussians", GAUSSIANS, "--seed", seed)
    heading(f"3/4 next best views by {len(runs)} policies, 4 seeds and {BUDGET} views each")
    options = ["--budget", BUDGET, "--seed", seed, "--set", "evaluate_every=1"]
    settings: dict[str, Any] = {"prior": prior, "budget": BUDGET, "seed": seed, "evaluate_every": 1}
    scene = None  # of all runs, so that the fit to the seeds is made once
    for policy, folder in zip(POLICIES, runs, strict=True):
        if (folder / "config.json").is_file():
            show("nbv", "--resume", folder)
            this = open_run(folder)
        else:
            show("nbv", dataset, "--prior", prior, *options, "--policy", policy, "--out", folder)
            this = start_and_print(dataset, folder, console, policy=policy, **settings)
        scene = scene_of(this, like=scene)
        resume_and_print(this, console, like=scene)
    run("eval", runs[0])
    run("diagnose", runs[0], "--force")
    heading("4/4 the report")
    run("report", *runs, "--out", report, "--force")
    console.print(f"done in {time.monotonic() - started:.0f} s; look at these pictures, too:")
    for picture in (dataset / "contact_sheet.png", prior / "prior.png"):
        console.print(f"  {picture}", soft_wrap=True)


def check_seed(dataset: Path, runs: list[Path], seed: int) -> None:
    from mgs.run.folder import open_run

    recorded = {run: open_run(run).settings.seed for run in runs if (run / "config.json").is_file()}
    if (dataset / "config.json").is_file():
        config = read_json(dataset / "config.json")
        recorded[dataset] = config.get("seed", seed) if isinstance(config, dict) else seed
    for folder, other in recorded.items():
        if other != seed:
            was = f"was made with `seed` {other}, not {seed}"
            raise InputError(f"{folder}: {was}; give that seed, or another folder")
