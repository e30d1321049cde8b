"""Compare variants of fits or of whole runs on the test views.

    python benchmarks/sweep.py OUT.json WORK TABLE DATASET... [--only VARIANT]...

TABLE is `fits` (one fit to 12 views spread evenly in azimuth) or `runs` (4 seeds and 8 chosen
views). To try something new, add a row. Each run is made by `mgs.run_nbv`, so a row can change any
of its settings, and those of the prior. Prints mean metrics over the datasets; OUT.json has one
record for each dataset and variant. WORK keeps the runs: the same command continues where it was
interrupted.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs import runtime
from mgs.files import write_json
from mgs.provenance import command_line, versions

SHOWN = ("psnr", "psnr_mask", "psnr_inside", "too_deep_3", "see_through")
"""Metrics that are printed, of `mgs.metrics`: dB, and shares of pixels."""


@dataclass(frozen=True)
class Variant:
    """Changes of the settings of `mgs.run_nbv` and of `mgs.PriorSettings`."""

    settings: dict[str, Any] = field(default_factory=dict)
    prior: dict[str, Any] = field(default_factory=dict)

    @staticmethod
    def train(**settings: Any) -> Variant:
        """Change settings of the fit."""
        return Variant({"train": settings})


FITS = {
    "default": Variant(),
    "colours alone": Variant.train(alpha_weight=0.0),
    "alpha weight 1": Variant.train(alpha_weight=1.0),
    "no backing": Variant(prior={"backing": 0.0}),
    "5,000 Gaussians": Variant(prior={"gaussians": 5_000}),
    "20,000 Gaussians": Variant(prior={"gaussians": 20_000}),
    "means along normals": Variant.train(means="normal"),
    "means free": Variant.train(means="free"),
    "Adam": Variant.train(optimiser="adam", passes=100),
    "100 passes": Variant.train(passes=100, tolerance=0.0),
    "noise of a pixel x 2": Variant({"pixel_noise": 0.04}),
}

POLICIES = ("d-optimal", "directional-i", "uniform", "random")
SETTINGS = {
    "": {},
    ", colours alone": {"train": {"alpha_weight": 0.0}},
    ", five nearest": {"nearest": 5},
    ", means free": {"train": {"means": "free"}},
}
RUNS = {
    f"{policy}{name}": Variant({"policy": policy, **settings})
    for policy in POLICIES
    for name, settings in SETTINGS.items()
}

TABLES = {
    "fits": (FITS, {"seeds": 12, "budget": 0}),
    "runs": (RUNS, {"seeds": 4, "budget": 8}),
}
"""Variants of each table, and the settings that they share."""

GAUSSIANS = 10_000


def prior_of(dataset: Path, work: Path, changes: dict[str, Any]) -> Path:
    """Build the prior of a variant, or find the one that is there."""
    changes = {"gaussians": GAUSSIANS, **changes}
    folder = work / "priors" / "-".join(f"{key}{value}" for key, value in sorted(changes.items()))
    if not folder.is_dir():
        prior, _ = mgs.build_prior(mgs.load_dataset(dataset), mgs.PriorSettings(**changes))
        mgs.save_prior(folder, prior)
    return folder


def measure(dataset: Path, work: Path, name: str, variant: Variant, shared: dict[str, Any]) -> dict:
    """Make or continue the run of a variant; its metrics over the test views."""
    run = work / "".join(letter if letter.isalnum() else "-" for letter in name)
    if (run / "config.json").is_file():
        mgs.resume_nbv(run)
    else:
        prior = prior_of(dataset, work, variant.prior)
        mgs.run_nbv(dataset, run, prior=prior, **shared | variant.settings)
    found = mgs.evaluate_run(run, pictures=False)
    return {"dataset": str(dataset), "variant": name, **found["test"]}


def main() -> None:
    """Measure, write, print the means."""
    parser = argparse.ArgumentParser(description="Compare variants of fits or of whole runs.")
    parser.add_argument("out", type=Path, metavar="OUT.json")
    parser.add_argument("work", type=Path)
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("datasets", type=Path, nargs="+", metavar="DATASET")
    parser.add_argument("--only", action="append", help="a variant; may be repeated")
    given = parser.parse_args()
    variants, shared = TABLES[given.table]
    chosen = given.only or list(variants)
    if unknown := set(chosen) - set(variants):
        parser.error(f"--only {min(unknown)!r}: choose from {', '.join(map(repr, variants))}")
    runtime.start()
    records: list[dict[str, Any]] = []
    for dataset in given.datasets:
        work = given.work / given.table / dataset.resolve().as_posix().strip("/").replace("/", "-")
        for name in chosen:
            records.append(measure(dataset, work, name, variants[name], shared))
            print(json.dumps(records[-1]), flush=True)
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(given.out, made | {"records": records})
    print(f"{'mean over datasets':32}" + "".join(f"{key:>13}" for key in SHOWN))
    for name in chosen:
        rows = [row for row in records if row["variant"] == name]
        means = [np.mean([row.get(key, np.nan) for row in rows]) for key in SHOWN]
        print(f"{name:32}" + "".join(f"{value:13.4g}" for value in means))


if __name__ == "__main__":
    main()
