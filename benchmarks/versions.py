"""Two versions of mgs on one machine, in turn. `python benchmarks/versions.py OUT.json OLD NEW`

OLD, NEW: folders of two checkouts (`git worktree add`), with the packages of this environment. Each round starts a process for
either version, which times the operations of `mgs.bench.core.time_core` on the same 100,000 Gaussians in 640x480, and draws
1,000 of them in 64x48; the medians of the rounds are compared, and the ratio to what was asked for. What leaving out the hidden
Gaussians would be worth: the new version also gets only those that the view sees, by its information about their colours, with
the difference that this makes to the image. Let nothing else run.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.files import write_json
from mgs.provenance import command_line, versions

ROUNDS = 8

TARGETS = {"forward_warm": 0.6, "forward_cold": 0.5, "gradient_warm": 0.6, "fisher_exact": 0.6, "tiny": 1.0}
CULLED_TARGETS = {"forward_warm": 0.35, "forward_cold": 0.4, "gradient_warm": 0.35, "fisher_exact": 0.35}
"""Time over that of commit 55789c2 that this project asks of itself, with all Gaussians and without the hidden ones."""

SEEN = 1e-6
"""Least information about the colour of a Gaussian that a view sees, summed over the channels (pixel value / coefficient)^2."""

WORKER = """
import json, sys
import numpy as np
from mgs import runtime
runtime.start()
try:
    from mgs.bench import core
except ImportError:  # before mgs.bench was a folder
    from mgs import bench as core

def seconds(path, repeats):
    held = np.load(path)
    model = core.Gaussians(**{name: held[name] for name in ("means", "log_scales", "quats", "logit_opacities", "sh")})
    camera = core.Camera(held["K"], int(held["width"]), int(held["height"]), held["world_to_camera"])
    return core.time_core(model, camera, repeats)

found = seconds(sys.argv[1], 9) | {"tiny": seconds(sys.argv[2], 50)["forward_warm"]}
if len(sys.argv) > 3:
    found |= {f"culled {key}": value for key, value in seconds(sys.argv[3], 9).items()}
print(json.dumps({key: found[key] for key in found if not key.endswith(("pairs", "list_bytes"))}))
"""


def scenes(folder: Path) -> tuple[list[Path], dict[str, float]]:
    """Write the scenes: arrays of the Gaussians and of a camera. Also what the hidden Gaussians are to the first image."""
    from mgs.bench.core import surface_camera, surface_gaussians
    from mgs.splat import as_drjit, fisher, groups, render

    large, small = surface_gaussians(100_000), surface_gaussians(1_000)
    camera = surface_camera(large, 640, 480)
    culled = large[fisher(large, camera)[:, groups(0)["colour"]].sum(axis=1) > SEEN]
    images = [np.asarray(render(as_drjit(model), camera).rgb) for model in (large, culled)]
    paths = []
    for model, view in ((large, camera), (small, surface_camera(small, 64, 48)), (culled, camera)):
        paths.append(folder / f"{len(paths)}.npz")
        arrays = {"K": view.K, "width": view.width, "height": view.height, "world_to_camera": view.world_to_camera}
        np.savez(paths[-1], **asdict(model), **arrays)
    return paths, {"gaussians": len(culled), "psnr": float(-10 * np.log10(np.mean((images[0] - images[1]) ** 2)))}


def measure(checkout: Path, paths: list[Path]) -> dict[str, float]:
    """Seconds by operation, of one process of the version in a checkout."""
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve())}
    arguments = [sys.executable, "-c", WORKER, *map(str, paths)]
    done = subprocess.run(arguments, cwd=checkout, env=environment, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def commit(checkout: Path) -> str:
    """The commit that is checked out."""
    asked = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()


def main(out: Path, old: Path, new: Path) -> None:
    """Measure and write."""
    runtime.start()
    runs: dict[str, list[dict[str, float]]] = {"old": [], "new": []}
    with tempfile.TemporaryDirectory() as folder:
        paths, culled = scenes(Path(folder))
        for _ in range(ROUNDS):
            for name, checkout in (("old", old), ("new", new)):
                runs[name].append(measure(checkout, paths if name == "new" else paths[:2]))
                print(name, runs[name][-1], flush=True)
    medians = {name: {key: float(np.median([run[key] for run in found])) for key in found[0]} for name, found in runs.items()}
    made: dict[str, Any] = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    made |= {"old": commit(old), "rounds": ROUNDS, "seconds": medians, "culled": culled}
    made |= {"targets": TARGETS | {f"culled {key}": value for key, value in CULLED_TARGETS.items()}, "ratios": {}}
    for key in medians["new"]:
        ratios = [b[key] / a[key.removeprefix("culled ")] for a, b in zip(runs["old"], runs["new"], strict=True)]
        made["ratios"][key] = [min(ratios), float(np.median(ratios)), max(ratios)]
    write_json(out, made)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
