"""Large models and images: `python benchmarks/sizes.py OUT.json`. Let nothing else run.

Seconds of each operation of the core and the most memory that Dr.Jit holds
(`mgs.bench.core.scaling_point`), for each of SIZES in a process of its own.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import drjit as dr

from mgs import runtime
from mgs.bench.core import in_new_process, scaling_point
from mgs.files import write_json
from mgs.provenance import command_line, versions

SIZES = ((1_000_000, 1920, 1080), (1_000_000, 3840, 2160), (10_000_000, 1280, 960))
"""Numbers of Gaussians, and width and height of the image."""

REPEATS = 3


def main(out: Path) -> None:
    """Measure and write."""
    runtime.start()
    made: dict[str, Any] = {
        "command": command_line(),
        "machine": runtime.processor(),
        "versions": versions(),
        "sizes": [],
    }
    for n, width, height in SIZES:
        found = in_new_process(scaling_point, n, width, height, dr.thread_count(), REPEATS, True)
        made["sizes"].append({"n": n, "width": width, "height": height} | found)
        print(made["sizes"][-1], flush=True)
    write_json(out, made)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
