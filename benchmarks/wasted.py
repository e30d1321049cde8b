"""What the walks do in vain, and what could be saved of it: `python benchmarks/wasted.py OUT.json`.

A register draws the lists of as many blocks as it has lanes, the k-th pair of each at the same
time. Counted on the scene of `mgs bench splat`, with nothing timed: pixels that a pair evaluates
and does not draw (alpha below 1/255); rows of a block that a splat does not reach, and those that
none of the splats reaches which the register draws at that time, so that it could leave them out;
pairs whose splat another lane draws at that time, so that their sums could be merged before they
are stored; and lanes that wait for the longest list of their register. That pixels are finished
early is left out.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mgs import runtime
from mgs.bench.core import surface_camera, surface_gaussians
from mgs.files import write_json
from mgs.provenance import command_line, versions
from mgs.splat import ListCache, as_drjit
from mgs.splat.blocks import BLOCK_X, BLOCK_Y, BlockLists
from mgs.splat.constants import ALPHA_MIN
from mgs.splat.projection import Splats, camera_array, project

GAUSSIANS, WIDTH, HEIGHT = 100_000, 640, 480
LANES = (16, 8)


def drawn_pixels(
    splats: Splats, lists: BlockLists, lane: np.ndarray, pair: np.ndarray
) -> np.ndarray:
    """[M, BLOCK_Y, BLOCK_X] which pixels of its block each pair draws. lane: [M] whose list it is
    in; pair: [M] its number."""
    gaussian = np.argsort(np.asarray(lists.place))[np.asarray(lists.splat)[pair]]
    block, across = (
        np.asarray(lists.block).astype(np.int64)[lane],
        int(np.asarray(lists.blocks_x)[0]),
    )
    mean_x, mean_y, shear, white_x, white_y, log2_opacity = (
        np.asarray(getattr(splats, name), np.float64)[gaussian]
        for name in ("mean_x", "mean_y", "shear", "white_x", "white_y", "log2_opacity")
    )
    drawn = np.empty((len(pair), BLOCK_Y, BLOCK_X), bool)
    for j in range(BLOCK_Y):
        dy = block // across * BLOCK_Y + j + 0.5 - mean_y
        for i in range(BLOCK_X):
            xi = white_x * (block % across * BLOCK_X + i + 0.5 - mean_x - shear * dy)
            drawn[:, j, i] = log2_opacity - xi**2 - (white_y * dy) ** 2 >= np.log2(ALPHA_MIN)
    return drawn


def counted(
    lists: BlockLists, rows: np.ndarray, lane: np.ndarray, pair: np.ndarray, lanes: int
) -> dict[str, float]:
    """What registers of so many lanes could leave out. rows: [M, BLOCK_Y] which rows each pair
    reaches."""
    start, end = (np.asarray(a).astype(np.int64) for a in (lists.start, lists.end))
    register, turn = lane // lanes, pair - start[lane]
    padded = np.pad(end - start, (0, -len(start) % lanes)).reshape(-1, lanes)
    longest = padded.max(axis=1)
    first = np.concatenate([[0], np.cumsum(longest)])
    at = first[register] + turn  # a number for each register and turn
    reached = np.zeros((first[-1], BLOCK_Y), bool)
    np.logical_or.at(reached, at, rows)
    _, times = np.unique(at * len(lists.place) + np.asarray(lists.splat)[pair], return_counts=True)
    return {
        "rows_no_lane_reaches": float(1 - reached.mean()),
        "pairs_merged": float(1 - len(times) / len(pair)),
        "lanes_waiting": float(1 - padded.sum() / (lanes * longest.sum())),
    }


def main(out: Path) -> None:
    """Count and write."""
    runtime.start()
    gaussians = surface_gaussians(GAUSSIANS)
    camera = surface_camera(gaussians, WIDTH, HEIGHT)
    splats = project(as_drjit(gaussians), camera_array(camera))
    lists = ListCache().get(camera, splats)[0]
    dr.eval(splats)
    start, end = (np.asarray(a).astype(np.int64) for a in (lists.start, lists.end))
    lane = np.repeat(np.arange(len(start)), end - start)
    pair = np.concatenate([np.arange(a, b) for a, b in zip(start, end, strict=True)])
    drawn = drawn_pixels(splats, lists, lane, pair)
    rows = drawn.any(axis=2)
    found: dict[str, Any] = {
        "pairs": len(pair),
        "pixels_not_drawn": float(1 - drawn.mean()),
        "rows_not_reached": float(1 - rows.mean()),
    }
    found["lanes"] = {str(lanes): counted(lists, rows, lane, pair, lanes) for lanes in LANES}
    print(found)
    write_json(out, {"command": command_line(), "versions": versions()} | found)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
