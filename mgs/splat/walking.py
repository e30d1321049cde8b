"""What all kernels share: how one SIMD lane draws the splats of its block of pixels, and how sums
reach the splats.

The image is cut into blocks of BLOCK_X x BLOCK_Y pixels. Each block has one lane of a SIMD register
to itself; it reads the block's list of splats front to back and draws every one on all pixels of
the block. A splat is so read once for 32 pixels,
and their contributions to it are added up before they are stored once: on a CPU splatting spends
its time on reads and writes at scattered addresses, not on arithmetic.

The Python loops over a block's pixels run while Dr.Jit traces the kernel, so they become straight
code; no Python runs over Gaussians or over the image. Symbols are those of docs/notation.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mgs.splat.blocks import BLOCK_X, BLOCK_Y, BlockLists
from mgs.splat.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from mgs.splat.projection import Splats

PIXELS = BLOCK_X * BLOCK_Y
"""Pixels of a block."""

DENORMAL = 1e-24
"""Sums smaller than this become 0: threads differ in how they flush denormals, and nothing else
would differ between reruns. It lies so far above the smallest normal float (1e-38) that a denormal
product can change no sum that is kept."""


def without_denormals(x: Any) -> Any:
    """x, or 0 where its size is at most DENORMAL."""
    return dr.select(dr.abs(x) > DENORMAL, x, 0)


def recorded_sizes(lists: BlockLists, *others: Any) -> tuple[int, ...]:
    """What a recorded kernel holds as constants (see `frozen`): the lengths of its lists, and its
    arguments that are flags or plain numbers."""
    return (
        len(lists.splat),
        len(lists.slot_start),
        len(lists.block),
        *(x for x in others if isinstance(x, int)),
    )


def pack(s: Splats, place: Any) -> Any:
    """The numbers of each splat side by side in memory, at the splat's `place` (UInt32 [N], see
    `BlockLists.place`).

    The splats must be detached. Splats from `project` become Float [16 N], so one splat fills one
    cache line: (mean_x, mean_y, shear, white_x), (white_y, log2_opacity, mean_x_rest, mean_y_rest),
    (red, green, blue, shear_rest), (depth, 0, 0, 0). What only some kernels need comes last, alone,
    as packets of which nothing is used are not read. Splats from `project64` become Float64 [12 N]:
    the same without the rests, and depth behind the opacity.
    """
    parts = [[s.mean_x, s.mean_y, s.shear, s.white_x]]
    if s.mean_x_rest is None:
        parts += [[s.white_y, s.log2_opacity, s.depth, 0], [*s.colour, 0]]
    else:
        parts += [
            [s.white_y, s.log2_opacity, s.mean_x_rest, s.mean_y_rest],
            [*s.colour, s.shear_rest],
            [s.depth, 0, 0, 0],
        ]
    return pack_parts(parts, place)


def pack_parts(parts: list[list[Any]], place: Any) -> Any:
    """Write lists of four arrays [N] each to one evaluated array: the numbers at `place` lie side
    by side, part after part."""
    real, vector = (
        (mi.Float, mi.Vector4f) if type(parts[0][0]) is mi.Float else (mi.Float64, mi.Vector4d)
    )
    packed = dr.empty(real, 4 * len(parts) * len(place))
    for i, part in enumerate(parts):
        dr.scatter(packed, vector(*part), place * len(parts) + i, mode=dr.ReduceMode.NoConflicts)
    dr.eval(packed)
    return packed


def unpack(packed: Any, place: Any) -> Splats:
    """The splats that `pack` put at the places (UInt32). mean_x, mean_y, shear are Float64, rests
    added; others as packed."""
    if type(packed) is mi.Float64:
        (mean_x, mean_y, shear, white_x), (white_y, log2_opacity, depth, _), (*colour, _) = (
            dr.gather(mi.Vector4d, packed, place * 3 + i) for i in range(3)
        )
    else:
        (
            (mean_x, mean_y, shear, white_x),
            (white_y, log2_opacity, x_rest, y_rest),
            (*colour, shear_rest),
            (depth, *_),
        ) = (dr.gather(mi.Vector4f, packed, place * 4 + i) for i in range(4))
        mean_x, mean_y = (
            mi.Float64(mean_x) + mi.Float64(x_rest),
            mi.Float64(mean_y) + mi.Float64(y_rest),
        )
        shear = mi.Float64(shear) + mi.Float64(shear_rest)
    return Splats(mean_x, mean_y, shear, white_x, white_y, log2_opacity, depth, *colour)


@dataclass
class Lane:
    """What a lane works on. left, top: centre of its block's first pixel, px, Float [L]; start,
    end: UInt32 [L], the range of its pairs in `BlockLists.splat`."""

    left: Any
    top: Any
    start: Any
    end: Any


def lanes(lists: BlockLists) -> tuple[Lane, list[Any]]:
    """The lanes, and the transmittance with which each of their 32 pixels starts: 1, or 0
    (finished) outside the image."""
    x, y = (lists.block % lists.blocks_x) * BLOCK_X, (lists.block // lists.blocks_x) * BLOCK_Y
    T = [
        dr.select((x + i < lists.width) & (y + j < lists.height), mi.Float(1), mi.Float(0))
        for j in range(BLOCK_Y)
        for i in range(BLOCK_X)
    ]
    return Lane(mi.Float(x) + 0.5, mi.Float(y) + 0.5, lists.start, lists.end), T


@dataclass
class Row:
    """One row of a block's pixels under one splat. eta of the row; xi and raw_alpha, before any
    threshold, of each pixel."""

    eta: Any
    xi: list[Any]
    raw_alpha: list[Any]


EXP2 = (
    1.0,
    0.69314720574,
    0.24022646891,
    0.05550328776,
    0.00961848896,
    0.00133999314,
    0.00015345812,
)
"""Coefficients of a polynomial for 2^x on [-1/2, 1/2], x^0 first; relative error 3e-9, and 0 at x =
0 (Remez exchange)."""


def exp2(x: Any) -> Any:
    """2^x of a Float or Float64 up to 120, and 2^-120 for every x below -120. Relative error 3e-9,
    of a Float 8e-8.

    It takes half the instructions of dr.exp2, which also handles infinity and zero. Nothing here
    needs these: an alpha of 2^-120 is not drawn, and nor is a smaller one.
    """
    integer, bits = (mi.Int64, 52) if type(x) is mi.Float64 else (mi.Int32, 23)
    x = dr.select(x > -120, x, -120)
    shifted = (
        x + 1.5 * 2.0**bits
    )  # so large that its last bit is worth 1: x rounded to a whole number is in the last bits
    part = x - (shifted - 1.5 * 2.0**bits)
    value = type(x)(EXP2[-1])
    for coefficient in EXP2[-2::-1]:
        value = dr.fma(value, part, coefficient)
    exponent = dr.reinterpret_array(integer, shifted) << bits
    return dr.reinterpret_array(type(x), dr.reinterpret_array(integer, value) + exponent)


CENTRE, MIDDLE = BLOCK_X // 2, BLOCK_Y // 2
"""Column and row of a block from which `block_rows` goes on to its other pixels."""


def block_rows(lane: Lane, s: Splats) -> list[Row]:
    """xi, eta and alpha = 2^(log2_opacity - xi^2 - eta^2) of one splat on all pixels of a lane's
    block.

    The exponent is quadratic in x and y. So along a row the ratio of neighbouring alphas changes by
    a constant factor from pixel to pixel, and from row to row these ratios change by a constant
    factor, too. Alphas follow from one another by
    multiplication: nine exp2 for 32 pixels, for rounding errors up to ten times as large.

    Nothing underflows that is drawn. Every splat in a block's list reaches the rectangle of the
    block's pixel centres: there the exponent is somewhere at least -log2(255) (`Footprints`). From
    a pixel to the next (xi, eta) moves by at most 1.56, because EPS2D widens every footprint, and
    the centre of a row is at most 5 pixels from any point of the rectangle. So the exponent at the
    centre of a row is at least -(2.83 + 5 * 1.56)^2 = -113, and no ratio is beyond 2^(+-36).
    Between a centre and a pixel that is drawn the exponent is nowhere below the lower of the two,
    as it is concave. Lists are made in single
    precision: a splat with its centre millions of pixels away may miss the block, and where an
    exponent says so, nothing of it is drawn in that row.

    The offset of the block's first pixel from the splat is computed in double: far along a slanted
    needle, xi is a small difference of large numbers.
    """
    real = type(s.white_x)
    dx, dy = mi.Float64(lane.left) - s.mean_x, mi.Float64(lane.top) - s.mean_y
    corner, down = real(mi.Float64(s.white_x) * (dx - s.shear * dy)), real(dy)
    slant, bend = (
        s.white_x * real(s.shear),
        exp2(-2 * s.white_x * s.white_x),
    )  # bend: the constant factor of the ratios
    middle = [
        dr.fma(s.white_x, real(CENTRE), dr.fma(-slant, real(j), corner)) for j in range(BLOCK_Y)
    ]
    ratios = {}  # of the alphas beside the centre of each row to the one at the centre, to the right (-1) and to the left (1)
    for side in (-1, 1):
        ratio = [exp2(s.white_x * dr.fma(real(2 * side), middle[MIDDLE], -s.white_x))] * BLOCK_Y
        for way, rows in ((-1, range(MIDDLE + 1, BLOCK_Y)), (1, range(MIDDLE - 1, -1, -1))):
            turn = exp2(2 * side * way * s.white_x * slant)  # the constant factor from row to row
            for j in rows:
                ratio[j] = ratio[j + way] * turn
        ratios[side] = ratio
    made = []
    for j in range(BLOCK_Y):
        eta = s.white_y * (down + j)
        first = dr.fma(-slant, real(j), corner)
        xi = [dr.fma(s.white_x, real(i), first) for i in range(BLOCK_X)]
        power = dr.fma(-xi[CENTRE], xi[CENTRE], dr.fma(-eta, eta, s.log2_opacity))
        raw = [dr.select(power > -120, exp2(power), 0)] * BLOCK_X
        for side, columns in ((-1, range(CENTRE + 1, BLOCK_X)), (1, range(CENTRE - 1, -1, -1))):
            ratio = ratios[side][j]
            for i in columns:
                raw[i] = raw[i + side] * ratio
                ratio = ratio * bend
        made.append(Row(eta, xi, raw))
    return made


def blend(raw: Any, T: Any) -> tuple[Any, Any, Any, Any]:
    """Draw one splat on one pixel. raw: its alpha before thresholds; T: the transmittance in front
    of it.

    Returns alpha (0 below ALPHA_MIN; of a finished pixel it means nothing), the weight w = alpha T
    (0 where the splat is not drawn), the transmittance behind the splat, and the mask of pixels
    that are not finished. A finished pixel keeps its
    transmittance with a minus sign: every later splat then leaves less than TRANSMITTANCE_MIN, so
    none is drawn, and the pixel's alpha is still known.

    Thresholds are comparisons and selects. dr.minimum and dr.maximum must propagate NaN, which
    takes five instructions.
    """
    alpha = dr.select(raw >= ALPHA_MIN, dr.select(raw < ALPHA_MAX, raw, ALPHA_MAX), 0)
    after = dr.fma(-alpha, T, T)
    room = after > TRANSMITTANCE_MIN
    return alpha, dr.select(room, alpha * T, 0), dr.select(room, after, -dr.abs(T)), room


def computed_after(x: Any, before: list[Any]) -> Any:
    """x, a Float or Float64, unchanged; the compiler computes what follows from it after the Floats
    in `before`.

    A kernel's operations are compiled in the order in which its results need them (see
    `mgs.runtime`). In a loop these are
    first the state of all 32 pixels, and at the end what is summed over them: what lies between
    would leave the registers for the stack. If each pixel depends on the sums over the pixels
    before it, these are finished first. The dependence costs
    nothing: what is added to x is a bit that is always zero. Dr.Jit does not see that, and so keeps
    the order; LLVM does, and leaves the addition out.
    """
    if not before:
        return x
    bits = mi.UInt32(0)
    for value in before:
        bits |= dr.reinterpret_array(mi.UInt32, value)
    integer = mi.UInt64 if type(x) is mi.Float64 else mi.UInt32
    return dr.reinterpret_array(
        type(x), dr.reinterpret_array(integer, x) | integer((bits & 1) >> 1)
    )


TOGETHER = 2
"""How many splats `walk` draws in one iteration. The state of the pixels does not fit into the
registers, and so is read and written once an iteration instead of once a splat."""


def walk(
    lists: BlockLists,
    packed: Any,
    lane: Lane,
    pixels: list[list[Any]],
    draw: Callable[..., Any],
    start: Any,
) -> Any:
    """Go through each lane's list front to back, until it ends or all pixels of the block are
    finished.

    pixels: what each of the 32 pixels carries along, in lists, T of `blend` first. start(pair,
    splat) is called once for each pair (UInt32, its number in the lists) and its splat;
    draw(started, raw, xi, eta, pixel) -> pixel draws the splat on one pixel, given what `start`
    returned, and raw alpha, xi and eta of the pixel. Returns the pixels' state at the end.

    The numbers of one pixel stay together in the list, since the compiler keeps that order: it
    finishes each pixel before the next one needs registers.
    """

    def visit(i: Any, drawn: list[tuple[Any, Splats, list[Row]]], pixels: Any) -> Any:
        started = [(start(pair, splat), rows) for pair, splat, rows in drawn]
        new: list[list[Any]] = []
        most: Any = (
            None  # the largest transmittance of the pixels so far; of a finished one it is negative
        )
        for number, pixel in enumerate(pixels):
            for of_splat, rows in started:
                row, x = rows[number // BLOCK_X], number % BLOCK_X
                raw = computed_after(row.raw_alpha[x], [] if most is None else [mi.Float(most)])
                pixel = draw(of_splat, raw, row.xi[x], row.eta, pixel)
            new.append(pixel)
            most = pixel[0] if most is None else dr.select(most > pixel[0], most, pixel[0])
        return new, most > 0

    return _walk_until_done(lists, packed, lane, pixels, visit, TOGETHER)[1]


def walk_and_store(
    lists: BlockLists,
    packed: Any,
    lane: Lane,
    pixels: list[list[Any]],
    visit: Callable[..., Any],
    count: int,
) -> Any:
    """Go through each lane's list as `walk` does, and store sums over the pixels of each pair.

    visit(splat, rows, pixels) -> (pixels, alive, sums) draws one splat; alive: mask of lanes with a
    pixel that is not finished;
    sums: `count` numbers, Float. Returns the sums of all pairs, in the order of the lists, each
    pair's rounded up to whole packets of four; they are 0 for pairs that no lane visited, because
    their block's pixels were all finished.

    A lane writes to its own list's pairs, one after the other, so no atomic operations are needed,
    and a line of the cache is full before it is left.
    """
    packets = packet_count(count)
    stored = dr.empty(mi.Float, len(lists.splat) * 4 * packets)

    def store(pair: Any, sums: list[Any]) -> None:
        padded = sums + [mi.Float(0)] * (-len(sums) % 4)
        for i in range(packets):
            dr.scatter(
                stored,
                mi.Vector4f(*padded[4 * i : 4 * i + 4]),
                pair * packets + i,
                mode=dr.ReduceMode.NoConflicts,
            )

    def visit_and_store(
        pair: Any, drawn: list[tuple[Any, Splats, list[Row]]], pixels: Any
    ) -> tuple[Any, Any]:
        ((_, splat, rows),) = drawn
        pixels, alive, sums = visit(splat, rows, pixels)
        store(pair, sums)
        return pixels, alive

    def store_zeros(pair: Any) -> tuple[Any]:
        store(pair, [mi.Float(0)] * count)
        return (pair + 1,)

    left, _ = _walk_until_done(lists, packed, lane, pixels, visit_and_store, 1)
    dr.while_loop((left,), lambda pair: pair < lane.end, store_zeros)
    return stored


def pair_at(
    lists: BlockLists, packed: Any, lane: Lane, first: Any, k: int
) -> tuple[Any, Splats, list[Row]]:
    """The k-th pair after the first, its splat, and the rows of the lane's block under it. After a
    lane's last pair comes the first one again, as a splat that draws nothing."""
    if k == 0:
        pair, splat = first, unpack(packed, dr.gather(mi.UInt32, lists.splat, first))
    else:
        there = first + k < lane.end
        pair = dr.select(there, first + k, first)
        splat = unpack(packed, dr.gather(mi.UInt32, lists.splat, pair))
        nothing = {
            "white_x": 0,
            "white_y": 0,
            "log2_opacity": -200,
        }  # an alpha far below ALPHA_MIN in every pixel
        splat = replace(
            splat,
            **{
                name: dr.select(there, getattr(splat, name), value)
                for name, value in nothing.items()
            },
        )
    return pair, splat, block_rows(lane, splat)


def _walk_until_done(
    lists: BlockLists,
    packed: Any,
    lane: Lane,
    pixels: list[list[Any]],
    visit: Callable[..., Any],
    together: int,
) -> tuple[Any, list[list[Any]]]:
    """The loop of `walk`. Returns the pair after the last one that was visited, and the pixels'
    state.

    visit(pair, drawn, pixels) -> (pixels, alive); drawn: what `pair_at` returns, of so
    many pairs from that one on.
    """

    def body(i: Any, pixels: Any, alive: Any) -> Any:
        pixels, alive = visit(
            i, [pair_at(lists, packed, lane, i, k) for k in range(together)], pixels
        )
        return i + together, pixels, (i + together < lane.end) & alive

    start = mi.UInt32(lane.start)
    pair, pixels, _ = dr.while_loop(
        (start, pixels, start < lane.end), lambda i, pixels, alive: alive, body
    )
    return pair, pixels


def packet_count(count: int) -> int:
    """How many packets of four hold `count` numbers."""
    return -(-count // 4)


AT_ONCE = 4
"""How many pairs of a splat `sums_by_place` reads in one iteration of its loop. Their addresses are
scattered, so each read takes long, but several can be under way at once."""


def sums_by_place(lists: BlockLists, stored: Any, count: int, real: Any) -> Any:
    """Add what `walk_and_store` stored for the pairs of each splat, in the order of their slots and
    in double: so reruns are bitwise equal.

    Returns [N * packets * 4] of the type `real` (Float or Float64), by the splats' places in
    memory.
    """
    dr.eval(stored)
    packets, end = packet_count(count), lists.slot_end

    def body(first: Any, totals: list[Any]) -> Any:
        for slot in (first + k for k in range(AT_ONCE)):
            pair = dr.gather(mi.UInt32, lists.pair, slot, slot < end) * packets
            parts = [dr.gather(mi.Vector4f, stored, pair + i, slot < end) for i in range(packets)]
            totals = [total + mi.Vector4d(part) for total, part in zip(totals, parts, strict=True)]
        return first + AT_ONCE, totals

    start = (mi.UInt32(lists.slot_start), [mi.Vector4d(0)] * packets)
    _, totals = dr.while_loop(start, lambda first, totals: first < end, body)
    place, summed = (
        dr.arange(mi.UInt32, len(lists.place)),
        dr.empty(real, len(lists.place) * 4 * packets),
    )
    for i, total in enumerate(totals):
        vector = (mi.Vector4f if real is mi.Float else mi.Vector4d)(
            *(without_denormals(x) for x in total)
        )
        dr.scatter(summed, vector, place * packets + i, mode=dr.ReduceMode.NoConflicts)
    return summed


def sums_by_splat(lists: BlockLists, placed: Any, count: int) -> list[Any]:
    """The result of `sums_by_place` as `count` arrays [N], in the order of the Gaussians.

    They are evaluated here, because what follows would otherwise wait for these reads at random
    addresses within one kernel; two kernels take less time.
    """
    packets, vector = packet_count(count), mi.Vector4f if type(placed) is mi.Float else mi.Vector4d
    sums = [
        x for i in range(packets) for x in dr.gather(vector, placed, lists.place * packets + i)
    ][:count]
    dr.eval(sums)
    return sums
