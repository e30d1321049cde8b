"""Two versions of mgs on one machine, in turn. `python benchmarks/versions.py OUT.json OLD NEW RUN`

OLD, NEW: folders of two checkouts (`git worktree add`), with the packages of this environment. Each
round starts a process for either version, which times the operations of `mgs.bench.core.time_core`
on the same 100,000 Gaussians in 640x480, and draws 1,000 of them in 64x48. Compared are the medians
of the rounds, and the fastest of either version: on a host that others use, too, rounds differ by
more than the versions do, and the fastest are those that were disturbed least. What it is worth to
leave out what an image does not see (`benchmarks/unseen.py`): RUN is the folder of a run. The old
version draws its model whole in the first view of its dataset, and the new one without what that
view does not see; told is the difference that this makes to the image. Let nothing else run.
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
from unseen import UNSEEN

from mgs import runtime
from mgs.files import write_json
from mgs.provenance import command_line, versions

ROUNDS = 16

TARGETS = {
    "forward_warm": 0.6,
    "forward_cold": 0.5,
    "gradient_warm": 0.6,
    "fisher_exact": 0.6,
    "tiny": 1.0,
}
CULLED_TARGETS = {
    "forward_warm": 0.35,
    "forward_cold": 0.4,
    "gradient_warm": 0.35,
    "fisher_exact": 0.35,
}
"""Time over that of commit 55789c2 that this project asks of itself, with all Gaussians and without
those not seen."""

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
found |= {f"culled {key}": value for key, value in seconds(sys.argv[3], 9).items()}
print(json.dumps({key: found[key] for key in found if not key.endswith(("pairs", "list_bytes"))}))
"""


def scenes(folder: Path, run: Path) -> tuple[list[Path], dict[str, float]]:
    """Write the scenes: arrays of the Gaussians and of a camera; the model of a run comes last,
    whole and without what is not seen. Also how many are seen, and what the others are to the
    image, dB."""
    from mgs.bench.core import surface_camera, surface_gaussians
    from mgs.data.dataset import load_dataset
    from mgs.run.folder import read_settings
    from mgs.splat import as_drjit, fisher, render
    from mgs.splat_ply import read_ply

    large, small, whole = (
        surface_gaussians(100_000),
        surface_gaussians(1_000),
        read_ply(run / "gaussians.ply"),
    )
    first = load_dataset(read_settings(run).dataset).frames[0].camera
    seen = whole[(fisher(whole, first) > UNSEEN).any(axis=1)]
    images = [np.asarray(render(as_drjit(model), first).rgb) for model in (whole, seen)]
    cameras, paths = (
        [surface_camera(large, 640, 480), surface_camera(small, 64, 48), first, first],
        [],
    )
    for model, view in zip((large, small, whole, seen), cameras, strict=True):
        paths.append(folder / f"{len(paths)}.npz")
        arrays = {
            "K": view.K,
            "width": view.width,
            "height": view.height,
            "world_to_camera": view.world_to_camera,
        }
        np.savez(paths[-1], **asdict(model), **arrays)
    psnr = float(-10 * np.log10(np.mean((images[0] - images[1]) ** 2)))
    return paths, {"gaussians": len(whole), "seen": len(seen), "psnr": psnr}


def measure(checkout: Path, paths: list[Path]) -> dict[str, float]:
    """Seconds by operation, of one process of the version in a checkout."""
    kernels = (
        paths[0].parent / checkout.name
    )  # the same code, compiled by the two versions, may differ
    environment = os.environ | {
        "PYTHONPATH": str(checkout.resolve()),
        "DRJIT_CACHE_DIR": str(kernels),
    }
    arguments = [sys.executable, "-c", WORKER, *map(str, paths)]
    done = subprocess.run(
        arguments, cwd=checkout, env=environment, capture_output=True, text=True, check=True
    )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def commit(checkout: Path) -> str:
    """The commit that is checked out."""
    asked = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()


def main(out: Path, old: Path, new: Path, run: Path) -> None:
    """Measure and write."""
    runtime.start()
    runs: dict[str, list[dict[str, float]]] = {"old": [], "new": []}
    with tempfile.TemporaryDirectory() as folder:
        (large, small, whole, seen), culled = scenes(Path(folder), run)
        for _ in range(ROUNDS):
            for name, checkout, model in (("old", old, whole), ("new", new, seen)):
                runs[name].append(measure(checkout, [large, small, model]))
                print(name, runs[name][-1], flush=True)
    medians = {
        name: {key: float(np.median([run[key] for run in found])) for key in found[0]}
        for name, found in runs.items()
    }
    made: dict[str, Any] = {
        "command": command_line(),
        "machine": runtime.processor(),
        "versions": versions(),
    }
    made |= {
        "old": commit(old),
        "new": commit(new),
        "rounds": ROUNDS,
        "seconds": medians,
        "culled": culled,
    }
    made |= {
        "targets": TARGETS | {f"culled {key}": value for key, value in CULLED_TARGETS.items()},
        "ratios": {},
        "fastest": {},
    }
    for key in medians["new"]:
        ratios = [b[key] / a[key] for a, b in zip(runs["old"], runs["new"], strict=True)]
        made["ratios"][key] = [min(ratios), float(np.median(ratios)), max(ratios)]
        made["fastest"][key] = {
            name: min(run[key] for run in found) for name, found in runs.items()
        }
    write_json(out, made)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
