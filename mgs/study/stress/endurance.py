"""A long run in one process: whether memory, block lists and recordings stay bounded."""

from __future__ import annotations

import gc
import itertools
import resource
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.camera import Camera
from mgs.files import read_json, write_json
from mgs.study.stress.experiment import Experiment, Panel, rock_cell
from mgs.study.stress.lab import Lab, Preset, open_lab
from mgs.study.stress.verdict import Claim, Row
from mgs.study.sweep import Cell

BLOCKS = 8
"""Parts into which the second half of the steps is cut; memory of a part is the median over its
steps. The first half warms
up: recordings and block lists are kept up to a limit, which must be reached before the slope means
anything."""

LISTS = 1 << 22
"""Budget of the block lists in this test, bytes: so small that it is used up soon."""


def endurance(root: Path, out: Path, scene: str, steps: int) -> dict[str, Any]:
    """Steps as those of `mgs nbv`, in a process of its own, so that nothing done before counts. It
    runs this module: workers may not start processes of `multiprocessing`."""
    rows = out / "rows.json"
    subprocess.run([sys.executable, "-m", __name__, root, scene, str(steps), rows], check=True)
    return {"rows": read_json(rows)}


def _steps(root: Path, scene: str, steps: int) -> list[Row]:
    """Fit to three views that were never seen before and measure the information of a fourth, again
    and again."""
    from mgs.splat import ListCache

    lab = replace(open_lab(root, scene), cache=ListCache(LISTS))
    rng, model = np.random.default_rng(0), lab.start(lab.even(4))
    found = np.ones(
        (steps, 2)
    )  # written to before the first step, so that keeping the results takes no memory later
    for step in range(steps):
        views = [int(i) for i in rng.choice(len(lab.frames), 4, replace=False)]
        moved = _moved(lab, views, rng)
        model = moved.fit(range(3), 1, model=model, start=model).gaussians
        moved.information(model, [3])
        gc.collect()
        found[step] = _resident() / 2**20, lab.cache.builds
    return [
        {"run": "one process", "step": step, "megabytes": float(megabytes), "lists": int(lists)}
        for step, (megabytes, lists) in enumerate(found)
    ]


def _moved(lab: Lab, views: Sequence[int], rng: np.random.Generator) -> Lab:
    """Some frames with cameras that were moved by a millimetre or so: new cameras for every
    cache."""
    frames = []
    for i in views:
        pose = lab.cameras[i].world_to_camera.copy()
        pose[:3, 3] += rng.normal(0, 1e-3, 3)
        camera = Camera(lab.cameras[i].K, lab.cameras[i].width, lab.cameras[i].height, pose)
        frames.append(replace(lab.frames[i], camera=camera))
    return replace(lab, frames=tuple(frames))


def _resident() -> int:
    """Memory that this process holds now, bytes."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize()


def slopes(rows: Sequence[Row]) -> list[float]:
    """Growth of memory from each part of the second half to the next, megabytes per step."""
    if len(rows) < 2 * BLOCKS:
        return []
    memory = np.array([row["megabytes"] for row in sorted(rows, key=lambda row: row["step"])])
    parts = np.array_split(memory[len(memory) // 2 :], BLOCKS)
    middles = [float(np.median(part)) for part in parts]
    length = len(memory) / 2 / BLOCKS
    return [(after - before) / length for before, after in itertools.pairwise(middles)]


def _cells(preset: Preset) -> list[Cell]:
    return [
        rock_cell(
            "endurance", f"{__name__}:endurance", preset, *preset.rocks[0], steps=preset.steps
        )
    ]


ENDURANCE = Experiment(
    "Does memory stay bounded over many steps in one process?",
    _cells,
    (
        Claim("After a warm-up of half the steps, memory grows by at most 0.05 MB a step: 50 MB in a thousand steps.", slopes,
              "MB per step", "below", 0.05, "part of the second half of the steps"),
    ),
    (Panel("step", "megabytes", "step", "resident memory (MB)"),),
)  # fmt: skip

if __name__ == "__main__":
    runtime.start()
    write_json(Path(sys.argv[4]), _steps(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])))
