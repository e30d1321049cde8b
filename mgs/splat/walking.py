"""Shared parts of the kernels: how a lane draws the splats of its block, and how sums reach the
splats (docs/splatting.md, Walk).

A lane draws a block's pixels, so that a splat is read once for 32 of them and their contributions
are added before they are stored: scattered addresses, not arithmetic, limit a CPU. On a GPU a lane
draws one pixel (`lane_size`). Loops over a block's pixels are unrolled. Symbols: docs/notation.md.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mgs.splat.blocks import BLOCK_X, BLOCK_Y, BlockLists, on_cpu
from mgs.splat.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from mgs.splat.projection import Splats

PIXELS = BLOCK_X * BLOCK_Y  # pixels of a block
# Smaller sums become 0, because threads flush denormals differently. It is so far above the
# smallest normal float (1e-38) that denormal products change no sum that is kept.
DENORMAL = 1e-24


def without_denormals(x: Any) -> Any:
    """x, or 0 where |x| is at most DENORMAL."""
    return dr.select(dr.abs(x) > DENORMAL, x, 0)


def recorded_sizes(lists: BlockLists, *others: Any) -> tuple[int, ...]:
    """Constants of a recorded kernel (`frozen`): lengths of its lists, flags and plain numbers, and
    its `lane_size`."""
    numbers = (x for x in others if isinstance(x, int))
    return len(lists.splat), len(lists.slot_start), len(lists.block), *lane_size(), *numbers


def pack(s: Splats, place: Any) -> Any:
    """Pack the numbers of each detached splat at its `place` (UInt32 [N], `BlockLists.place`).

    Splats from `project` become Float [16 N], one cache line each: (mean_x, mean_y, shear,
    white_x), (white_y, log2_opacity, mean_x_rest, mean_y_rest), (red, green, blue, shear_rest),
    (depth, 0, 0, 0). Depth comes last, in a packet of its own that most kernels need not read.
    Splats from `project64` become Float64 [12 N]: the same without rests, depth after opacity."""
    # Four numbers at a time: a lane reads a splat in as few packets as possible.
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
    """Write lists of four arrays [N] to one evaluated array: for each `place`, part after part."""
    single = type(parts[0][0]) is mi.Float
    real, vector = (mi.Float, mi.Vector4f) if single else (mi.Float64, mi.Vector4d)
    packed = dr.empty(real, 4 * len(parts) * len(place))
    for i, part in enumerate(parts):
        dr.scatter(packed, vector(*part), place * len(parts) + i, mode=dr.ReduceMode.NoConflicts)
    dr.eval(packed)
    return packed


def unpack(packed: Any, place: Any) -> Splats:
    """The splats at these places (UInt32) of `pack`. mean_x, mean_y and shear are Float64, with
    rests added."""
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
        # Rounded part plus rounding error: 48 bits of the double.
        mean_x = mi.Float64(mean_x) + mi.Float64(x_rest)
        mean_y = mi.Float64(mean_y) + mi.Float64(y_rest)
        shear = mi.Float64(shear) + mi.Float64(shear_rest)
    return Splats(mean_x, mean_y, shear, white_x, white_y, log2_opacity, depth, *colour)


def lane_size() -> tuple[int, int]:
    """Width and height of a lane's part of its block, pixels: the whole block on a CPU, one pixel
    on a GPU, where a block is a warp of 32 lanes."""
    return (BLOCK_X, BLOCK_Y) if on_cpu() else (1, 1)


@dataclass
class Lane:
    """Work of each lane."""

    columns: int  # `lane_size`
    rows: int
    left: Any  # centre of its first pixel, px, Float [L]
    top: Any
    start: Any  # range of its pairs in `BlockLists.splat`, UInt32 [L]
    end: Any
    first: Any  # place of its first pixel in the output of kernels, UInt32 [L]


def lanes(lists: BlockLists) -> tuple[Lane, list[Any]]:
    """The lanes, and the initial transmittance of each of their pixels: 1, or 0 (finished) outside
    the image."""
    columns, rows = lane_size()
    block, start, end, first = lists.block, lists.start, lists.end, lists.block * PIXELS
    # On a GPU each lane is one pixel of its block, and the 32 lanes of a block are a warp.
    across, down = mi.UInt32(0), mi.UInt32(0)  # from the block's first pixel to the lane's
    if (per_block := PIXELS // (columns * rows)) > 1:
        lane = dr.arange(mi.UInt32, len(lists.block) * per_block)
        block, start, end = (
            dr.gather(mi.UInt32, x, lane // per_block) for x in (block, start, end)
        )
        across = lane % per_block % BLOCK_X
        down = lane % per_block // BLOCK_X
        first = block * PIXELS + lane % per_block
    # Film coordinates of the lane's first pixel: its block, and its place in that.
    x = (lists.left // BLOCK_X + block % lists.blocks_x) * BLOCK_X + across
    y = (lists.top // BLOCK_Y + block // lists.blocks_x) * BLOCK_Y + down

    def inside(x: Any, y: Any) -> Any:
        across = (x >= lists.left) & (x < lists.right)
        return across & (y >= lists.top) & (y < lists.bottom)

    T = [
        dr.select(inside(x + i, y + j), mi.Float(1), mi.Float(0))
        for j in range(rows)
        for i in range(columns)
    ]
    return Lane(columns, rows, mi.Float(x) + 0.5, mi.Float(y) + 0.5, start, end, first), T


@dataclass
class PixelRow:
    """One row of a lane's pixels under one splat."""

    eta: Any
    xi: list[Any]  # of each pixel
    raw_alpha: list[Any]  # of each pixel, before thresholds


# Polynomial for 2^x on [-1/2, 1/2], x^0 first: relative error 3e-9, exact at x = 0 (Remez).
EXP2 = (
    1.0, 0.69314720574, 0.24022646891, 0.05550328776, 0.00961848896, 0.00133999314, 0.00015345812
)  # fmt: skip


def exp2(x: Any) -> Any:
    """2^x of a Float or Float64 up to 120, and 2^-120 below -120. Relative error 3e-9, of a Float
    8e-8. Half the instructions of dr.exp2, which also handles infinity and zero: an alpha of 2^-120
    is not drawn."""
    # x = n + f with n an integer and |f| <= 1/2: 2^f by the polynomial (Horner), times 2^n by
    # adding n to the bits of the exponent.
    integer, bits = (mi.Int64, 52) if type(x) is mi.Float64 else (mi.Int32, 23)
    x = dr.select(x > -120, x, -120)
    shifted = x + 1.5 * 2.0**bits  # its last bit is worth 1, so x is rounded to an integer
    part = x - (shifted - 1.5 * 2.0**bits)
    value = type(x)(EXP2[-1])
    for coefficient in EXP2[-2::-1]:
        value = dr.fma(value, part, coefficient)
    exponent = dr.reinterpret_array(integer, shifted) << bits
    return dr.reinterpret_array(type(x), dr.reinterpret_array(integer, value) + exponent)


def block_rows(lane: Lane, s: Splats) -> list[PixelRow]:
    """xi, eta and alpha = 2^(log2_opacity - xi^2 - eta^2) of one splat on all pixels of a lane.

    The exponent is quadratic in x and y. So along a row the ratio of neighbouring alphas changes by
    a constant factor, and from row to row these ratios do, too. Alphas follow from one another by
    multiplication, from the central row and column on: nine exp2 for 32 pixels, with rounding
    errors up to ten times as large.

    Nothing that is drawn underflows. A splat in a block's list reaches the rectangle of the block's
    pixel centres, where its exponent is somewhere at least -log2(255) (`Footprints`). From a pixel
    to the next, (xi, eta) moves by at most 1.56, because EPS2D widens every footprint, and the
    centre of a row is at most 5 pixels from any point of the rectangle. So the exponent at the
    centre of a row is at least -(2.83 + 5 * 1.56)^2 = -113, and no ratio is beyond 2^(+-36).
    Between a centre and a drawn pixel the exponent, which is concave, is not below the lower of
    both. Lists are made in single precision: a splat with its centre millions of pixels away may
    miss the block; then nothing of it is drawn in rows whose exponent is too small.

    The offset of the lane's first pixel from the splat is computed in double: far along a slanted
    needle, xi is a small difference of large numbers."""
    # (dx, dy): the lane's first pixel minus the splat's centre; corner: xi there.
    real, centre_column, centre_row = type(s.white_x), lane.columns // 2, lane.rows // 2
    dx, dy = mi.Float64(lane.left) - s.mean_x, mi.Float64(lane.top) - s.mean_y
    corner, down = real(mi.Float64(s.white_x) * (dx - s.shear * dy)), real(dy)
    # xi at column i, row j: corner + white_x i - slant j. With h the step of xi from pixel to
    # pixel, -(xi + h)^2 + xi^2 = -2 h xi - h^2: the log2 of the ratio of neighbouring alphas.
    slant = s.white_x * real(s.shear)
    bend = exp2(-2 * s.white_x * s.white_x)  # factor of the ratios from pixel to pixel
    middle = [
        dr.fma(s.white_x, real(centre_column), dr.fma(-slant, real(j), corner))
        for j in range(lane.rows)
    ]
    ratios = {}  # of the alpha beside the centre of each row to that at the centre
    for side in (-1, 1):
        # side: -1 to the right, 1 to the left.
        # 2^(side 2 white_x xi - white_x^2): ratio in the central row.
        beside = exp2(s.white_x * dr.fma(real(2 * side), middle[centre_row], -s.white_x))
        # From row to row xi at the centre falls by slant, so ratios turn by 2^(2 side way h slant).
        ratio = [beside] * lane.rows
        above, below = range(centre_row - 1, -1, -1), range(centre_row + 1, lane.rows)
        for way, rows in ((-1, below), (1, above)):
            turn = exp2(2 * side * way * s.white_x * slant)  # factor from row to row
            for j in rows:
                ratio[j] = ratio[j + way] * turn
        ratios[side] = ratio
    block = []
    left, right = range(centre_column - 1, -1, -1), range(centre_column + 1, lane.columns)
    for j in range(lane.rows):
        # Central pixel of the row: log2 alpha = log2 o - eta^2 - xi^2.
        eta = s.white_y * (down + j)
        first = dr.fma(-slant, real(j), corner)
        xi = [dr.fma(s.white_x, real(i), first) for i in range(lane.columns)]
        centre = xi[centre_column]
        power = dr.fma(-centre, centre, dr.fma(-eta, eta, s.log2_opacity))
        # Its neighbours by multiplication, to the right and to the left; each ratio bends by -2
        # h^2.
        raw = [dr.select(power > -120, exp2(power), 0)] * lane.columns
        for side, columns in ((-1, right), (1, left)):
            ratio = ratios[side][j]
            for i in columns:
                raw[i] = raw[i + side] * ratio
                ratio = ratio * bend
        block.append(PixelRow(eta, xi, raw))
    return block


def blend(raw: Any, T: Any) -> tuple[Any, Any, Any, Any]:
    """Draw one splat on one pixel. raw: alpha before thresholds. T: transmittance in front of it.

    Returns alpha (0 below ALPHA_MIN; meaningless for a finished pixel), the weight w = alpha T (0
    where not drawn), the transmittance behind the splat, and the mask of pixels that are not
    finished. A finished pixel keeps its transmittance with a minus sign: every later splat then
    leaves less than TRANSMITTANCE_MIN, so none is drawn, and the pixel's alpha is still known.

    Thresholds are comparisons and selects, because dr.minimum and dr.maximum take five
    instructions to propagate NaN."""
    # after = T (1 - alpha); the splat is drawn if that leaves more than TRANSMITTANCE_MIN.
    alpha = dr.select(raw >= ALPHA_MIN, dr.select(raw < ALPHA_MAX, raw, ALPHA_MAX), 0)
    after = dr.fma(-alpha, T, T)
    room = after > TRANSMITTANCE_MIN
    return alpha, dr.select(room, alpha * T, 0), dr.select(room, after, -dr.abs(T)), room


def computed_after(x: Any, before: list[Any]) -> Any:
    """x unchanged, a Float or Float64, but compiled after the Floats in `before`.

    Operations are compiled in the order in which the results need them (`mgs.runtime`). In a loop,
    these are first the state of all 32 pixels and then the sums over them, and everything between
    would leave the registers for the stack. A dependence of each pixel on the sums over the pixels
    before it finishes those first. It costs nothing: what is added to x is a bit that is always
    zero, which LLVM removes, but Dr.Jit does not."""
    if not before:
        return x
    # (bits & 1) >> 1 is 0: x | 0 = x, but computed after `before`.
    bits = mi.UInt32(0)
    for value in before:
        bits |= dr.reinterpret_array(mi.UInt32, value)
    integer = mi.UInt64 if type(x) is mi.Float64 else mi.UInt32
    same = dr.reinterpret_array(integer, x) | integer((bits & 1) >> 1)
    return dr.reinterpret_array(type(x), same)


TOGETHER = 2  # splats drawn in an iteration: the pixels' state does not fit the registers


def walk(
    lists: BlockLists,
    packed: Any,
    lane: Lane,
    pixels: list[list[Any]],
    draw: Callable[..., Any],
    start: Any,
) -> Any:
    """Draw each lane's list front to back, until it ends or all pixels of the block are finished.

    pixels: state of each of a lane's pixels, lists with T of `blend` first.
    start(pair, splat): called once per pair (UInt32, index in the lists).
    draw(of_splat, raw, xi, eta, pixel) -> pixel: draws the splat on one pixel, given the result of
        `start`.

    Returns the final state. The numbers of a pixel stay together in the list, because the compiler
    keeps that order and finishes each pixel before the next one needs registers."""

    def visit(i: Any, pairs: list[tuple[Any, Splats, list[PixelRow]]], pixels: Any) -> Any:
        # Pixel by pixel, all splats of this iteration, so that a pixel's state is read once.
        splats = [(start(pair, splat), rows) for pair, splat, rows in pairs]
        new: list[list[Any]] = []
        most: Any = None  # largest transmittance so far; that of a finished pixel is negative
        for number, pixel in enumerate(pixels):
            for of_splat, rows in splats:
                row, x = rows[number // lane.columns], number % lane.columns
                # Compiled after the pixels before it (`computed_after`).
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
    """Draw each lane's list as `walk` does, and store sums over the pixels of each pair.

    visit(pair, splat, rows, pixels) -> (pixels, alive, sums): draws one splat. alive: mask of lanes
        with an unfinished pixel. sums: `count` Floats.

    Returns the sums of all pairs in the order of the lists, padded to packets of four; 0 for pairs
    that were not visited because all pixels of their block were finished. A lane that draws a whole
    block writes to its own list's pairs in order, so no atomic operations are needed, and cache
    lines are filled at once. Lanes that share a block are a warp: it adds up their sums in a fixed
    order and makes one addition to zeros."""
    packets, whole = packet_count(count), lane.columns * lane.rows == PIXELS
    by_pair = (dr.empty if whole else dr.zeros)(mi.Float, len(lists.splat) * 4 * packets)

    def store(pair: Any, sums: list[Any]) -> None:
        values = sums + [mi.Float(0)] * (-len(sums) % 4)
        for i in range(packets):
            packet, at = mi.Vector4f(*values[4 * i : 4 * i + 4]), pair * packets + i
            if whole:
                dr.scatter(by_pair, packet, at, mode=dr.ReduceMode.NoConflicts)
            else:
                dr.scatter_reduce(dr.ReduceOp.Add, by_pair, packet, at, mode=dr.ReduceMode.Local)

    def visit_and_store(
        pair: Any, pairs: list[tuple[Any, Splats, list[PixelRow]]], pixels: Any
    ) -> tuple[Any, Any]:
        ((_, splat, rows),) = pairs
        pixels, alive, sums = visit(pair, splat, rows, pixels)
        store(pair, sums)
        return pixels, alive

    # The sums are not cleared before: pairs behind finished pixels get their zeros here.
    def store_zeros(pair: Any) -> tuple[Any]:
        store(pair, [mi.Float(0)] * count)
        return (pair + 1,)

    rest, _ = _walk_until_done(lists, packed, lane, pixels, visit_and_store, 1)
    if whole:
        dr.while_loop((rest,), lambda pair: pair < lane.end, store_zeros)
    return by_pair


def pair_at(
    lists: BlockLists, packed: Any, lane: Lane, first: Any, k: int
) -> tuple[Any, Splats, list[PixelRow]]:
    """The k-th pair after the first, its splat, and the lane's rows under it. After a lane's last
    pair, the first one again as a splat that draws nothing."""
    if k == 0:
        pair, splat = first, unpack(packed, dr.gather(mi.UInt32, lists.splat, first))
    else:
        # Beyond the list's end: the first pair once more, with an alpha of 2^-200.
        there = first + k < lane.end
        pair = dr.select(there, first + k, first)
        splat = unpack(packed, dr.gather(mi.UInt32, lists.splat, pair))
        nothing = {"white_x": 0, "white_y": 0, "log2_opacity": -200}  # alpha far below ALPHA_MIN
        masked = {n: dr.select(there, getattr(splat, n), value) for n, value in nothing.items()}
        splat = replace(splat, **masked)
    return pair, splat, block_rows(lane, splat)


def _walk_until_done(
    lists: BlockLists,
    packed: Any,
    lane: Lane,
    pixels: list[list[Any]],
    visit: Callable[..., Any],
    together: int,
) -> tuple[Any, list[list[Any]]]:
    """The loop of `walk`. Returns the pair after the last visited one, and the pixels' state.
    visit(pair, pairs, pixels) -> (pixels, alive), with `pairs` the results of `pair_at` for
    `together` pairs from that one on."""

    def body(i: Any, pixels: Any, alive: Any) -> Any:
        # A lane ends with its list, or with its last unfinished pixel.
        pairs = [pair_at(lists, packed, lane, i, k) for k in range(together)]
        pixels, alive = visit(i, pairs, pixels)
        return i + together, pixels, (i + together < lane.end) & alive

    start = mi.UInt32(lane.start)
    state = start, pixels, start < lane.end
    pair, pixels, _ = dr.while_loop(state, lambda i, pixels, alive: alive, body)
    return pair, pixels


def packet_count(count: int) -> int:
    """Number of packets of four for `count` numbers."""
    return -(-count // 4)


AT_ONCE = 4  # pairs read in an iteration: reads at scattered addresses are slow, but overlap


def sums_by_place(lists: BlockLists, by_pair: Any, count: int, real: Any) -> Any:
    """Add the results of `walk_and_store` for the pairs of each splat, in the order of their slots
    and in double, so reruns are bitwise equal. Returns [N * packets * 4] of type `real` (Float or
    Float64), by place."""
    dr.eval(by_pair)
    # Slots of one splat are consecutive, so a lane adds those of one splat, in their order.
    packets, place = packet_count(count), lists.summed
    start, end = (dr.gather(mi.UInt32, part, place) for part in (lists.slot_start, lists.slot_end))

    def body(first: Any, totals: list[Any]) -> Any:
        # Reads of slots beyond the end are masked to 0.
        for slot in (first + k for k in range(AT_ONCE)):
            pair = dr.gather(mi.UInt32, lists.pair, slot, slot < end) * packets
            parts = [dr.gather(mi.Vector4f, by_pair, pair + i, slot < end) for i in range(packets)]
            totals = [total + mi.Vector4d(part) for total, part in zip(totals, parts, strict=True)]
        return first + AT_ONCE, totals

    state = start, [mi.Vector4d(0)] * packets
    _, totals = dr.while_loop(state, lambda first, totals: first < end, body)
    sums = dr.empty(real, len(lists.place) * 4 * packets)
    vector = mi.Vector4f if real is mi.Float else mi.Vector4d
    for i, total in enumerate(totals):
        # Sums in double, rounded once.
        single = vector(*(without_denormals(x) for x in total))
        dr.scatter(sums, single, place * packets + i, mode=dr.ReduceMode.NoConflicts)
    return sums


def sums_by_splat(lists: BlockLists, totals: Any, count: int) -> list[Any]:
    """Result of `sums_totals` as `count` arrays [N], in the order of the Gaussians. Evaluated,
    because two kernels are faster than one that waits for these random reads."""
    packets, vector = packet_count(count), mi.Vector4f if type(totals) is mi.Float else mi.Vector4d
    sums = [
        x for i in range(packets) for x in dr.gather(vector, totals, lists.place * packets + i)
    ][:count]
    dr.eval(sums)
    return sums
