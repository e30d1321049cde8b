"""Whole runs of two versions of mgs, stage by stage. `python benchmarks/whole_runs.py OUT.json WORK
OLD NEW DATASET:N:BUDGET`

OLD, NEW: folders of two checkouts (`git worktree add`), with the packages of this environment. For
every dataset, each version builds its own prior of N Gaussians, then runs choose BUDGET views
beyond four seeds. The runs are kept in WORK, below the name of the folder that the dataset lies in;
one that has ended is not made again. Seconds of a stage are summed over all steps; measuring the
model is not counted. All models are measured on the test views, by the version that runs this
program. Let nothing else run.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from versions import commit

from mgs import runtime
from mgs.data.dataset import load_dataset
from mgs.files import write_json
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.splat_ply import read_ply

PROGRAM = """
try:
    from mgs.cli.app import main
except ImportError:  # before the commands had a folder
    from mgs.cli import main
main()
"""
EVALUATE = "evaluate"
"""The stage that only measures the model."""

COLOURS = ["--alpha-weight", "0"]
"""So that the new version fits what the old one does."""

RUNS = {
    "old, d-optimal": ("old", ["--policy", "d-optimal"]),
    "d-optimal": ("new", [*COLOURS, "--policy", "d-optimal"]),
    "d-optimal, 5 at a time": ("new", [*COLOURS, "--policy", "d-optimal", "--batch", "5"]),
    "coverage, 5 at a time": ("new", [*COLOURS, "--policy", "coverage", "--batch", "5"]),
    "uniform, 5 at a time": ("new", [*COLOURS, "--policy", "uniform", "--batch", "5"]),
    "directional-i, all at once": (
        "new",
        [*COLOURS, "--policy", "directional-i", "--batch", "BUDGET"],
    ),
}
"""Runs by name: which version, and its options."""


def mgs(checkout: Path, *arguments: Any) -> float:
    """Run a command of the version in a checkout; returns its seconds."""
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve())}
    began = time.perf_counter()
    command = [sys.executable, "-P", "-c", PROGRAM, *map(str, arguments)]
    subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - began


def record(run: Path, dataset: Path) -> dict[str, Any]:
    """Seconds by stage of a run that has ended, its fits' passes, and what its model is like on the
    test views."""
    steps = [json.loads(line) for line in (run / "steps.jsonl").read_text().splitlines()]
    stages: dict[str, float] = {}
    for step in steps:
        for stage, seconds in step["seconds"].items():
            stages[stage] = stages.get(stage, 0) + seconds
    stages.pop(EVALUATE, None)
    fits = [step for step in steps if "iterations" in step]
    passes = sum(step["iterations"] / step["images"] for step in fits)
    tests = load_dataset(dataset).test_views().frames
    measured = evaluate(read_ply(run / "gaussians.ply"), [], [], test_frames=tests)["test"]
    quality = {key: measured[key] for key in ("psnr", "psnr_mask", "ssim")}
    return {
        "images": steps[-1]["images"],
        "fits": len(fits),
        "passes": passes,
        "seconds": stages,
        **quality,
    }


def study(
    work: Path, checkouts: dict[str, Path], dataset: Path, gaussians: str, budget: str
) -> list[dict[str, Any]]:
    """A record for each of RUNS."""
    records = []
    for name, (version, options) in RUNS.items():
        folder, prior = work / name.replace(", ", "-").replace(" ", "-"), work / f"prior-{version}"
        if not prior.is_dir():
            mgs(checkouts[version], "prior", dataset, "--gaussians", gaussians, "--out", prior)
        if not (folder / "gaussians.ply").is_file():
            given = [budget if option == "BUDGET" else option for option in options]
            mgs(
                checkouts[version],
                "nbv",
                dataset,
                "--prior",
                prior,
                "--budget",
                budget,
                *given,
                "--out",
                folder,
            )
        found = {"gaussians": int(gaussians), "run": name, **record(folder, dataset)}
        total = sum(found["seconds"].values())
        print(f"{dataset} {name}: {total:.0f} s, {found['psnr']:.2f} dB", flush=True)
        records.append(found)
    return records


def main(out: Path, work: Path, old: Path, new: Path, datasets: list[str]) -> None:
    """Run, measure and write."""
    runtime.start()
    records = []
    for dataset, gaussians, budget in (given.rsplit(":", 2) for given in datasets):
        records += study(
            work / Path(dataset).parent.name,
            {"old": old, "new": new},
            Path(dataset),
            gaussians,
            budget,
        )
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(out, made | {"old": commit(old), "new": commit(new), "records": records})


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:5]), sys.argv[5:])
