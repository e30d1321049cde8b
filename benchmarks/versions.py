"""Two versions of mgs on one machine, in turn. `python benchmarks/versions.py OUT.json OLD NEW DATASET`

OLD, NEW: folders of two checkouts (`git worktree add`), with the packages of this environment. DATASET: one whose orbit and
prior (DATASET/../prior) a fit is timed with. Each round starts a process for either version; the medians of the rounds are
compared. Seconds of: drawing a view never seen before and one seen before, image and gradient, exact and block Fisher
information (`mgs.bench.core.time_core`, 100,000 Gaussians, 640x480), and a fit of 12 views in 5 passes. Let nothing else run.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.files import write_json
from mgs.provenance import command_line, versions

ROUNDS = 8

WORKER = """
import json, sys, time
from mgs import runtime
runtime.start()
from mgs.active.loop import target_of
from mgs.active.settings import NbvSettings
from mgs.active.stations import real_stations
from mgs.bench.core import surface_camera, surface_gaussians, time_core
from mgs.data.dataset import load_dataset
from mgs.prior.build import load_prior

model = surface_gaussians(100_000)
seconds = time_core(model, surface_camera(model, 640, 480), 9)
root, prior = sys.argv[1:]
dataset, settings = load_dataset(root), NbvSettings(dataset=root, prior=prior)
stations = real_stations(dataset, load_prior(prior), settings)
frames = dataset.frames[:: max(len(dataset.frames) // 12, 1)][:12]
start, targets = stations.initial(frames), [target_of(frame) for frame in frames]
times = []
for _ in range(4):  # kernels are compiled in the first
    began = time.perf_counter()
    stations.fit(start, start, [f.camera for f in frames], targets, settings.train_at(1), lambda done, most: None)
    times.append(time.perf_counter() - began)
seconds["fit"] = sorted(times[1:])[1]
del seconds["pairs"], seconds["list_bytes"]
print(json.dumps(seconds))
"""


def measure(checkout: Path, dataset: Path) -> dict[str, float]:
    """Seconds by operation, of one process of the version in a checkout."""
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve())}
    arguments = [sys.executable, "-c", WORKER, str(dataset.resolve()), str(dataset.resolve().parent / "prior")]
    done = subprocess.run(arguments, cwd=checkout, env=environment, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def commit(checkout: Path) -> str:
    """The commit that is checked out."""
    asked = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()


def main(out: Path, old: Path, new: Path, dataset: Path) -> None:
    """Measure and write."""
    runtime.start()
    runs: dict[str, list[dict[str, float]]] = {"old": [], "new": []}
    for _ in range(ROUNDS):
        for name, checkout in (("old", old), ("new", new)):
            runs[name].append(measure(checkout, dataset))
            print(name, runs[name][-1], flush=True)
    medians = {name: {key: float(np.median([run[key] for run in found])) for key in found[0]} for name, found in runs.items()}
    made: dict[str, Any] = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    made |= {"old": commit(old), "rounds": ROUNDS, "seconds": medians}
    ratios = [[b[key] / a[key] for a, b in zip(runs["old"], runs["new"], strict=True)] for key in medians["old"]]
    made["ratios"] = {key: [min(r), float(np.median(r)), max(r)] for key, r in zip(medians["old"], ratios, strict=True)}
    write_json(out, made)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
