"""How much the order of memory is worth: time of the kernels against the size of the tiles they are
walked in.

    python benchmarks/tiles.py docs/benchmarks/tiles [GAUSSIANS]

Writes PREFIX.png and PREFIX.json. The scene of `mgs bench splat`, 100,000 Gaussians at 640x480,
warm lists. One tile for the whole image is walking by length of the lists alone; "splats anywhere"
is that with the splats where the user had them in memory. Medians of rounds in which every setting
takes its turn.
"""

import sys
import time
from dataclasses import replace

import matplotlib
import numpy as np
from rich.progress import track

from mgs import runtime

runtime.start()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from mgs.bench.core import WARM_UP, surface_camera, surface_gaussians  # noqa: E402
from mgs.files import write_json  # noqa: E402
from mgs.plotting import STYLE, new_figure, save_figure  # noqa: E402
from mgs.provenance import command_line, versions  # noqa: E402
from mgs.splat import as_drjit, blocks, kernels  # noqa: E402
from mgs.splat.projection import camera_array, project  # noqa: E402
from mgs.splat.rendering import as_colour  # noqa: E402
from mgs.splat.walking import pack  # noqa: E402

TILES = (1, 2, 4, 8, 16, 32, 64, 128)
"""Blocks across and down; 128 is the whole image."""

ROUNDS = 15


def anywhere(lists: blocks.BlockLists) -> blocks.BlockLists:
    """The same lists with every splat, and its slots, at its index."""
    place = np.asarray(lists.place)
    start, end = (np.asarray(a).astype(np.int64)[place] for a in (lists.slot_start, lists.slot_end))
    moved_end = np.cumsum(end - start)
    moved_start, pair = moved_end - (end - start), np.asarray(lists.pair).copy()
    pair[: moved_end[-1]] = pair[
        np.repeat(start - moved_start, end - start) + np.arange(moved_end[-1])
    ]
    splat = np.argsort(place)[np.asarray(lists.splat)]
    arrays = {
        "place": np.arange(len(place)),
        "splat": splat,
        "pair": pair,
        "slot_start": moved_start,
        "slot_end": moved_end,
    }
    return replace(lists, **{name: mi.UInt32(values) for name, values in arrays.items()})


def main(prefix: str, n: int = 100_000) -> None:
    gaussians = surface_gaussians(n)
    camera = surface_camera(gaussians, 640, 480)
    splats = project(as_drjit(gaussians), camera_array(camera))
    dr.eval(splats)
    black, chosen, settings = as_colour(0.0), blocks.TILE, {}
    for blocks.TILE in TILES:
        settings[blocks.TILE] = blocks.build(splats, camera.width, camera.height)
    blocks.TILE = chosen
    settings["splats anywhere"] = anywhere(settings[TILES[-1]])
    prepared = {}
    for name, lists in settings.items():
        packed = pack(splats, lists.place)
        prepared[name] = lists, packed, kernels.forward(lists, packed, True)
    operations = {
        "forward": lambda lists, packed, out: kernels.forward(lists, packed, True),
        "adjoint": lambda lists, packed, out: kernels.adjoint(lists, packed, out, out, False, 5),
        "exact Fisher": lambda lists, packed, out: kernels.fisher(lists, packed, black, False),
    }
    seconds = {name: {setting: [] for setting in settings} for name in operations}
    for i in track(range(ROUNDS + WARM_UP), "rounds"):
        for setting, arguments in prepared.items():
            for name, call in operations.items():
                start = time.perf_counter()
                dr.eval(call(*arguments))
                dr.sync_thread()
                if i >= WARM_UP:
                    seconds[name][setting].append(time.perf_counter() - start)
    median = {
        name: {str(k): float(np.median(v)) for k, v in row.items()} for name, row in seconds.items()
    }
    relative = {
        name: {k: v / row[str(chosen)] for k, v in row.items()} for name, row in median.items()
    }
    for name, row in relative.items():
        print(f"{name:14}", "  ".join(f"{k}: {v:.2f}" for k, v in row.items()))
    found = {
        "command": command_line(),
        "gaussians": n,
        "seconds": median,
        "relative_to_chosen": relative,
        "machine": runtime.processor(),
        "versions": versions(),
    }
    write_json(f"{prefix}.json", found)
    with matplotlib.rc_context(STYLE):
        figure = new_figure(4.6, 3.4)
        axis = figure.subplots()
        for (name, row), colour in zip(
            relative.items(), ("#0072b2", "#d55e00", "#009e73"), strict=True
        ):
            axis.semilogx(
                TILES, [row[str(t)] for t in TILES], "o-", base=2, color=colour, label=name
            )
            axis.axhline(row["splats anywhere"], color=colour, ls=":")
        axis.plot([], [], ":", color="#444444", label="splats anywhere in memory")
        axis.set(
            xlabel="blocks across a tile (128: the whole image)",
            ylabel=f"time, relative to {chosen}",
            ylim=(0.9, 2.15),
        )
        axis.set_xticks(TILES, [str(t) for t in TILES])
        axis.legend(fontsize=8)
        save_figure(figure, f"{prefix}.png")


if __name__ == "__main__":
    main(sys.argv[1], *(int(n) for n in sys.argv[2:]))
