"""Variants of the core that were tried, those that lost too: speed against accuracy. `python
benchmarks/variants.py PREFIX`

Writes PREFIX.json and PREFIX.png. Every variant replaces constants or functions of `mgs.splat` in a
process of its own. Timed are an image of a view never seen before and of one seen before, an image
with its gradient, the exact Fisher information and its blocks, of 100,000 Gaussians at 640x480, in
rounds in which each variant has its turn. A ratio is the fastest of the variant's rounds over the
fastest of the core as it is: on a host that others use, too, these were disturbed least; spread is
the slowest round of the core as it is over its fastest. Errors are the largest over all entries,
relative to the largest entry of the float64 oracle (`mgs.splat.reference`), of the worst kind of
parameter (`mgs.study.chart.core.error`), on SMALL. Whether the order of instructions matters to
Mitsuba's own kernels is told by the peer of `mgs bench splat`. Let nothing else run.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from unseen import UNSEEN

from mgs import runtime
from mgs.bench.core import in_new_process, time_core, time_volprim
from mgs.files import write_json
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.provenance import command_line, versions
from mgs.splat import reference  # imported before any constant is replaced
from mgs.study.chart.core import Call, Scene, error, gradient, image, information, oracle, scene
from mgs.study.chart.drawing import COLOURS

SMALL = 150, (96, 72)
"""Number of Gaussians, and size of the image, of the scene on which errors are measured."""

ROUNDS, REPEATS = 4, 9

TIMED = {"image": "forward_warm", "gradient": "gradient_warm", "diagonal": "fisher_exact"}
"""What is timed, by what errors are measured of."""
OPERATIONS = ("forward_cold", "forward_warm", "gradient_warm", "fisher_exact", "fisher_block")
"""All that is timed (`mgs.bench.core.time_core`)."""


def put(**values: Any) -> None:
    """Replace names of `mgs.splat` in every module that has them, but not in the oracle. Before the
    first kernel. Raises
    ValueError where no module has a name: what was meant would stay as it is."""
    missing = set(values)
    for name, module in list(sys.modules.items()):
        if name.startswith(("mgs.splat", "mgs.bench")) and module is not reference:
            for key in values.keys() & vars(module).keys():
                setattr(module, key, values[key])
                missing.discard(key)
    if missing:
        raise ValueError(f"no module has {', '.join(sorted(missing))}")


def block_size(width: int, height: int) -> None:
    """Blocks of other pixels. Beyond 8x4 alphas cannot be carried from a block's centre to its
    corners."""
    put(BLOCK_X=width, BLOCK_Y=height, PIXELS=width * height, CENTRE=width // 2, MIDDLE=height // 2)
    if width > 8:
        each_pixel_alone()


def rows_of_alphas(position: str, each_pixel: bool, one_by_one: bool = False) -> Callable[..., Any]:
    """`mgs.splat.walking.block_rows` with the offset of a block in another precision ("Float",
    "Float64"), with an exp2 at every pixel or three in every row, or with each row made when it is
    asked for."""
    import mitsuba as mi

    from mgs.splat import walking

    wide, size, middle = getattr(mi, position), walking.BLOCK_X, walking.CENTRE

    def rows(lane: Any, s: Any) -> Any:
        real = type(s.white_x)
        dx, dy = wide(lane.left) - wide(s.mean_x), wide(lane.top) - wide(s.mean_y)
        corner, down, slant = (
            real(wide(s.white_x) * (dx - wide(s.shear) * dy)),
            real(dy),
            s.white_x * real(s.shear),
        )
        bend = walking.exp2(-2 * s.white_x * s.white_x)

        def made(j: int) -> Any:
            eta, first = s.white_y * (down + j), dr.fma(-slant, real(j), corner)
            xi = [dr.fma(s.white_x, real(i), first) for i in range(size)]
            row = dr.fma(-eta, eta, s.log2_opacity)
            raw = [
                walking.exp2(dr.fma(-x, x, row))
                for x in (xi if each_pixel else xi[middle : middle + 1])
            ]
            if not each_pixel:
                raw = raw * size
                for columns, sign in (
                    (range(middle + 1, size), -1),
                    (range(middle - 1, -1, -1), 1),
                ):
                    step = s.white_x * dr.fma(real(2 * sign), xi[middle], -s.white_x)
                    ratio = walking.exp2(
                        dr.select(dr.fma(-xi[middle], xi[middle], row) > -120, step, -120)
                    )
                    for i in columns:
                        raw[i], ratio = raw[i + sign] * ratio, ratio * bend
            return walking.Row(eta, xi, raw)

        return (
            Lazily(made, walking.BLOCK_Y)
            if one_by_one
            else [made(j) for j in range(walking.BLOCK_Y)]
        )

    return rows


class Lazily:
    """A list whose entries are made when they are first asked for."""

    def __init__(self, make: Callable[[int], Any], length: int) -> None:
        self.make, self.length, self.made = make, length, dict[int, Any]()

    def __getitem__(self, index: int) -> Any:
        if index >= self.length:
            raise IndexError(index)
        if index not in self.made:
            self.made[index] = self.make(index)
        return self.made[index]


def each_pixel_alone() -> None:
    """An exp2 at every pixel."""
    put(block_rows=rows_of_alphas("Float64", each_pixel=True))


def row_by_row() -> None:
    """Three exp2 in every row: ratios of alphas are not carried from row to row."""
    put(block_rows=rows_of_alphas("Float64", each_pixel=False))


def rows_one_by_one() -> None:
    """Each row of a block made just before it is drawn."""
    put(block_rows=rows_of_alphas("Float64", each_pixel=False, one_by_one=True))


def by_minimum() -> None:
    """Dr.Jit's minimum in place of a select for the largest alpha."""
    from mgs.splat import constants

    def blend(raw: Any, T: Any) -> tuple[Any, Any, Any, Any]:
        alpha = dr.select(raw >= constants.ALPHA_MIN, dr.minimum(raw, constants.ALPHA_MAX), 0)
        after = dr.fma(-alpha, T, T)
        room = after > constants.TRANSMITTANCE_MIN
        return alpha, dr.select(room, alpha * T, 0), dr.select(room, after, -dr.abs(T)), room

    put(blend=blend)


def local_arrays() -> None:
    """What a lane's pixels carry along in arrays of its own, in memory, instead of in variables of
    the loop."""
    import mitsuba as mi

    from mgs.splat import walking

    def walk(
        lists: Any, packed: Any, lane: Any, pixels: Any, visit: Any, together: int
    ) -> tuple[Any, Any]:
        width, state = len(pixels[0]), dr.alloc_local(mi.Float, len(pixels) * len(pixels[0]))

        def read(state: Any) -> list[list[Any]]:
            return [[state[width * k + i] for i in range(width)] for k in range(len(pixels))]

        def write(state: Any, values: Any) -> None:
            for k, value in enumerate(value for pixel in values for value in pixel):
                state[k] = value

        def body(i: Any, state: Any, alive: Any) -> Any:
            pairs = [walking.pair_at(lists, packed, lane, i, k) for k in range(together)]
            values, alive = visit(i, pairs, read(state))
            write(state, values)
            return i + together, state, (i + together < lane.end) & alive

        write(state, pixels)
        start = mi.UInt32(lane.start)
        pair, state, _ = dr.while_loop(
            (start, state, start < lane.end), lambda i, state, alive: alive, body
        )
        return pair, read(state)

    put(_walk_until_done=walk)


def single_positions() -> None:
    """The centre of a splat, and its distance to a block, in single precision."""
    import mitsuba as mi

    from mgs.splat import walking

    exact = walking.unpack

    def unpack(packed: Any, place: Any) -> Any:
        if type(packed) is mi.Float64:  # blocks: packed in double
            return exact(packed, place)
        (mean_x, mean_y, shear, white_x), (white_y, log2_opacity, *_), (*colour, _), (depth, *_) = (
            dr.gather(mi.Vector4f, packed, place * 4 + i) for i in range(4)
        )
        return walking.Splats(mean_x, mean_y, shear, white_x, white_y, log2_opacity, depth, *colour)

    put(unpack=unpack, block_rows=rows_of_alphas("Float", each_pixel=False))


def single_projection() -> None:
    """Projection, and the way from sums to entries, in single precision."""
    from mgs.splat import derivatives, information, projection

    names = {f"{kind}64": kind for kind in ("Float", "Int", "UInt")} | {
        f"Vector{k}d": f"Vector{k}f" for k in (2, 3, 4)
    }
    projection.mi = derivatives.mi = information.mi = Renamed(**names)


class Renamed:
    """Mitsuba's module, some of its names standing for others."""

    def __init__(self, **names: str) -> None:
        self.names = names

    def __getattr__(self, name: str) -> Any:
        import mitsuba as mi

        return getattr(mi, self.names.get(name, name))


def llvms_order() -> None:
    """Start with instructions in the order that LLVM's machine scheduler gives them."""
    runtime._keep_order = lambda: None
    runtime.start()


def in_llvms_order(call: Callable[..., Any], *arguments: Any) -> Any:
    """As `in_new_process`, in LLVM's order of instructions. Kernels that Dr.Jit keeps on the disk
    may be in either order, so this process has a folder of its own for them."""
    with tempfile.TemporaryDirectory() as folder:
        before = os.environ.get(KERNELS)
        os.environ[KERNELS] = folder
        try:
            return in_new_process(call, *arguments, initializer=llvms_order)
        finally:
            os.environ.pop(KERNELS)
            os.environ |= {} if before is None else {KERNELS: before}


KERNELS = "DRJIT_CACHE_DIR"
"""Environment variable that names the folder in which Dr.Jit keeps compiled kernels."""


def least_alpha(value: float) -> None:
    """A footprint that ends where alpha falls below another value."""
    put(ALPHA_MIN=value, LOG2_INV_ALPHA_MIN=-np.log2(value))


LLVMS_ORDER = "instructions in LLVM's order"

VARIANTS: dict[str, tuple[Callable[[], None], float | None]] = {
    "as it is": (lambda: None, None),
    "an exp2 at every pixel": (each_pixel_alone, None),
    "Dr.Jit's exp2": (partial(put, exp2=dr.exp2), None),
    "three exp2 in every row": (row_by_row, None),
    "rows one by one": (rows_one_by_one, None),
    "one splat at a time": (partial(put, TOGETHER=1), None),
    "three splats at a time": (partial(put, TOGETHER=3), None),
    "pixels mixed by the compiler": (partial(put, computed_after=lambda x, before: x), None),
    LLVMS_ORDER: (lambda: None, None),
    "pixels in local arrays": (local_arrays, None),
    "Dr.Jit's minimum": (by_minimum, None),
    "positions in single precision": (single_positions, None),
    "projection in single precision": (single_projection, None),
    "blocks of 8x2": (partial(block_size, 8, 2), None),
    "blocks of 4x4": (partial(block_size, 4, 4), None),
    "blocks of 16x2": (partial(block_size, 16, 2), None),
    "one tile": (partial(put, TILE=256), None),
    "one pair read at a time": (partial(put, AT_ONCE=1), None),
    "pixels end at 1e-3": (partial(put, TRANSMITTANCE_MIN=1e-3), None),
    "pixels end at 1e-2": (partial(put, TRANSMITTANCE_MIN=1e-2), None),
    "footprints end at 2/255": (partial(least_alpha, 2 / 255), None),
    "without what is not seen": (lambda: None, UNSEEN),
    "without what is hardly seen": (lambda: None, 1e-3),
}
"""By name: what is replaced, and where Gaussians are left out, the information (`unseen.UNSEEN`)
below which they are."""


def measure(name: str, with_errors: bool) -> dict[str, float]:
    """Seconds of a variant, and if asked its errors."""
    change, least = VARIANTS[name]
    change()
    where, small = scene(100_000, (640, 480)), scene(*SMALL)
    found = time_core(where.gaussians[seen(where, least)], where.camera, REPEATS)
    if with_errors and name in ("as it is", LLVMS_ORDER):
        found |= time_volprim(where.gaussians, where.camera, 3)
    if with_errors:
        for what in TIMED:
            found[f"error_{what}"] = error(in_full(small, least, what), oracle(what, small), what)
    return found


def seen(where: Scene, least: float | None) -> np.ndarray:
    """Mask [N] of the Gaussians that are drawn."""
    if least is None:
        return np.ones(len(where.gaussians), bool)
    return np.asarray((information(where, "exact")() > least).any(axis=1))


def in_full(where: Scene, least: float | None, what: str) -> np.ndarray:
    """An image, a gradient or information of the Gaussians that are drawn; zeros for the others."""
    calls: dict[str, Callable[[Scene], Call]]
    calls = {
        "image": image,
        "gradient": gradient,
        "diagonal": partial(information, estimator="exact"),
    }
    drawn = seen(where, least)
    found = calls[what](replace(where, gaussians=where.gaussians[drawn]))()
    if what == "image":
        return found
    whole = np.zeros((len(drawn), found.shape[1]), found.dtype)
    whole[drawn] = found
    return whole


def chart(path: Path, rows: list[dict[str, Any]]) -> None:
    """Times over that of the core as it is, against errors."""
    import matplotlib

    titles = {
        "image": "image",
        "gradient": "image and gradient",
        "diagonal": "exact Fisher information",
    }
    with matplotlib.rc_context(STYLE):
        figure = new_figure(11, 4.6)
        axes = figure.subplots(1, 3, sharey=True)
        for ax, (what, title) in zip(axes, titles.items(), strict=True):
            for number, row in enumerate(rows):
                style = {
                    "marker": "ov^<>sDPX*"[number % 10],
                    "color": COLOURS[number % 7],
                    "label": row["name"],
                }
                ax.plot(
                    row["ratios"][TIMED[what]],
                    row["errors"][what],
                    linestyle="none",
                    markersize=6,
                    **style,
                )
            ax.axvline(1, color="0.8", linewidth=0.8, zorder=0)
            ax.set(yscale="log", title=title, xlabel="time over that of the core as it is")
        axes[0].set_ylabel("largest error over largest entry")
        figure.legend(
            *axes[0].get_legend_handles_labels(),
            loc="outside right center",
            fontsize=9,
            frameon=False,
        )
        save_figure(figure, path)


def main(prefix: str) -> None:
    """Measure, write and draw."""
    runtime.start()
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in VARIANTS}
    for turn in range(ROUNDS):
        for name in VARIANTS:
            process = in_llvms_order if name == LLVMS_ORDER else in_new_process
            runs[name].append(process(measure, name, turn == 0))
            print(name, runs[name][-1], flush=True)
    rows = []
    for name, found in runs.items():
        ratios = {
            key: min(run[key] for run in found) / min(run[key] for run in runs["as it is"])
            for key in OPERATIONS
        }
        rows.append(
            {
                "name": name,
                "ratios": ratios,
                "errors": {what: found[0][f"error_{what}"] for what in TIMED},
            }
        )
    spread = {
        key: max(run[key] for run in base) / min(run[key] for run in base)
        for key in OPERATIONS
        for base in [runs["as it is"]]
    }
    made = {
        "command": command_line(),
        "machine": runtime.processor(),
        "versions": versions(),
        "rounds": ROUNDS,
    }
    peer = {
        name: {k: v for k, v in runs[name][0].items() if k.startswith("volprim")}
        for name in ("as it is", LLVMS_ORDER)
    }
    made |= {"spread": spread, "rows": rows, "peer": peer}
    write_json(Path(f"{prefix}.json"), made)
    chart(Path(f"{prefix}.png"), rows)


if __name__ == "__main__":
    main(sys.argv[1])
