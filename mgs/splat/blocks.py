"""Block lists: for every block of pixels, the splats that touch it, front to back.

A block is what one SIMD lane owns. Lists are built with a margin around every footprint and stay valid while each footprint
stays inside its margin (`outgrown`), as neighbour lists with a skin do in molecular dynamics. That works because the means,
and with them centres and depth order, are frozen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mgs.errors import InputError
from mgs.splat.projection import Splats

BLOCK_X, BLOCK_Y = 8, 4
"""Pixels of one lane. With AVX-512, 8x2 and 4x4 were no faster forward, and slower for gradients: more pairs to store."""

TILE = 16
"""Blocks across and down a tile, which is walked before the next, so that its splats (64 bytes each) and their sums stay in a
core's cache; `benchmarks/tiles.py` chose it."""

LOG2_INV_ALPHA_MIN = 7.994353436858858
"""log2(255): a footprint ends where xi^2 + eta^2 = log2_opacity + log2(255)."""

SLACK = 1e-2
"""Bits added to a footprint's level so that rounding never drops a pixel at its rim."""

MAX_PAIRS = 1 << 26
"""Most (splat, block) pairs of a view, and most rows of blocks in the lists' making. With it, every place in the kernels'
buffers, the 24 sums of a pair too, is below 2^31; so it may be lowered, but not raised."""

PAIR_BYTES = 128
"""Peak memory of a view for each of its pairs: measured 28 for an image, 58 for exact Fisher information, 123 for blocks."""


@dataclass
class Footprints:
    """Centres and depths of the splats as the lists were built, whitening and level q of their footprints (inflated; q <= 0:
    not drawn). Float [N] each."""

    u: Any
    v: Any
    z: Any
    k: Any
    p: Any
    e: Any
    q: Any


@dataclass
class BlockLists:
    """Pairs (splat, block), sorted by block (tile by tile), in each block by depth; M counts some unused room at the end.

    Splats lie in memory by tile, block, depth, and are known by that place: place: UInt32 [N] is where each one lies.
    splat, slot: UInt32 [M]; a pair's slot is its place in the order where the pairs of one splat are contiguous, and
    slot_start, slot_end: UInt32 [N] are the slots of the splat at each place. block: UInt32 [L] of each lane, by tile, in it
    the longest list first, and start, end: UInt32 [L] its range of pairs. width, height: UInt32, pixels; blocks_x: UInt32.
    """

    place: Any
    splat: Any
    slot: Any
    slot_start: Any
    slot_end: Any
    block: Any
    start: Any
    end: Any
    width: Any
    height: Any
    blocks_x: Any
    footprints: Footprints

    @property
    def nbytes(self) -> int:
        """Memory held, bytes."""
        return 4 * (2 * len(self.splat) + 10 * len(self.slot_start) + 3 * len(self.block))


def level(splats: Splats) -> Any:
    """q [N]: the value of xi^2 + eta^2 at the rim where alpha = ALPHA_MIN; not positive where nothing is drawn."""
    return dr.select(splats.visible, splats.log2_opacity + LOG2_INV_ALPHA_MIN, -1)


def inflate(splats: Splats, margin: float) -> Footprints:
    """Footprints grown by `margin` (a share of their size; 0: exact)."""
    q = level(splats)
    growth = 1 / (1 + margin)
    return Footprints(
        splats.u,
        splats.v,
        splats.z,
        splats.k,
        splats.p * growth,
        splats.e * growth,
        dr.select(q > -margin, q + margin + SLACK, -1),
    )


def outgrown(built: Footprints, splats: Splats) -> Any:
    """Mask [N]: the splat moved (or left the view), or its footprint is not wholly inside the one its lists were built with.

    In the whitened coordinates of the built ellipse, the present one is {x: x^T S^T S x <= 1}; it is inside the unit disc
    exactly where the smaller eigenvalue of S^T S is at least 1.
    """
    q = level(splats)
    ratio = dr.sqrt(dr.maximum(built.q, 0) / dr.maximum(q, 1e-6))
    s00 = ratio * splats.p / built.p
    s01 = ratio * splats.p * (built.k - splats.k) / built.e
    s11 = ratio * splats.e / built.e
    a, b, c = s00 * s00, s00 * s01, s01 * s01 + s11 * s11
    half = 0.5 * (a + c)
    spread = dr.sqrt(0.25 * (a - c) * (a - c) + b * b)
    smallest = s00 * s00 * (s11 * s11) / (half + spread)
    moved = (built.u != splats.u) | (built.v != splats.v) | (built.z != splats.z)
    return (moved & ((q > 0) | (built.q > 0))) | ((q > 0) & ~(smallest >= 1))


def depth_order(depth: Any) -> Any:
    """UInt32 [N]: indices front to back, ties by index (a radix sort of the float bits; depths are positive)."""
    bits = dr.reinterpret_array(mi.UInt32, depth)
    order = dr.detail.block_mkperm(bits & 0xFFFF, len(depth), 1 << 16)
    return _sorted(order, dr.gather(mi.UInt32, bits, order) >> 16, 1 << 16)


def build(splats: Splats, order: Any, width: int, height: int, margin: float) -> BlockLists:
    """Block lists of detached splats, given their depth order. Exact ellipse-block overlap, not bounding boxes.

    Raises InputError for more than MAX_PAIRS pairs, before memory is taken for them.
    """
    blocks_x, blocks_y = -(-width // BLOCK_X), -(-height // BLOCK_Y)
    foot, place = inflate(splats, margin), _places(splats, order, blocks_x, blocks_y)
    splat, number, slot_start, slot_end = _pairs(splats, foot, place, blocks_x, blocks_y)
    numbers = _by_tile(dr.arange(mi.UInt32, blocks_x * blocks_y), blocks_x)
    if len(splat) == 0:  # Dr.Jit has no operations on arrays of length 0
        slot, start, end = mi.UInt32(), dr.zeros(mi.UInt32, len(numbers)), dr.zeros(mi.UInt32, len(numbers))
    else:
        slot = _front_to_back(slot_start, slot_end, dr.gather(mi.UInt32, place, order), len(splat))
        slot = _sorted(slot, dr.gather(mi.UInt32, number, slot), _numbers(blocks_x, blocks_y))
        splat, number = dr.gather(mi.UInt32, splat, slot), dr.gather(mi.UInt32, number, slot)
        dr.eval(splat, number)
        start, end = (dr.gather(mi.UInt32, a, numbers) for a in _ranges(number, _numbers(blocks_x, blocks_y)))
    room = _rounded(len(splat))
    lane = _lane_order(end - start, numbers, _numbers(blocks_x, blocks_y))
    lists = BlockLists(
        place=place,
        splat=_padded(splat, room),
        slot=_padded(slot, room),
        slot_start=slot_start,
        slot_end=slot_end,
        block=lane,
        start=dr.gather(mi.UInt32, start, lane),
        end=dr.gather(mi.UInt32, end, lane),
        width=dr.opaque(mi.UInt32, width),
        height=dr.opaque(mi.UInt32, height),
        blocks_x=dr.opaque(mi.UInt32, blocks_x),
        footprints=foot,
    )
    dr.eval(lists)
    return lists


def _by_tile(block: Any, blocks_x: int) -> Any:
    """UInt32: the number of a block (UInt32, row by row) when they are counted tile by tile, each of TILE x TILE blocks."""
    bx, by = block % blocks_x, block // blocks_x
    tile = (by // TILE) * -(-blocks_x // TILE) + bx // TILE
    return (tile * TILE + by % TILE) * TILE + bx % TILE


def _numbers(blocks_x: int, blocks_y: int) -> int:
    """How many numbers `_by_tile` gives; tiles are counted whole."""
    return -(-blocks_x // TILE) * -(-blocks_y // TILE) * TILE * TILE


def _sorted(values: Any, keys: Any, count: int) -> Any:
    """UInt32 values, stably sorted by keys below `count`. Evaluated, as all that are read next in a random order: a random read
    whose place awaits another one stalls, and takes longer than two kernels."""
    values = dr.gather(mi.UInt32, values, dr.detail.block_mkperm(keys, len(values), count))
    dr.eval(values)
    return values


def _places(splats: Splats, order: Any, blocks_x: int, blocks_y: int) -> Any:
    """UInt32 [N]: where each splat lies: by the tile of its centre (the nearest, outside the image), then block, then depth."""

    def block(pixel: Any, size: int, count: int) -> Any:
        return mi.UInt32(dr.select(splats.visible, dr.clip(pixel / size, 0, count - 1), 0))

    number = _by_tile(block(splats.v, BLOCK_Y, blocks_y) * blocks_x + block(splats.u, BLOCK_X, blocks_x), blocks_x)
    dr.eval(number)
    at = _sorted(order, dr.gather(mi.UInt32, number, order), _numbers(blocks_x, blocks_y))
    place = dr.empty(mi.UInt32, len(at))
    dr.scatter(place, dr.arange(mi.UInt32, len(at)), at, mode=dr.ReduceMode.NoConflicts)
    dr.eval(place)
    return place


def _lane_order(length: Any, number: Any, numbers: int) -> Any:
    """UInt32 [L]: blocks by tile, in it the longest list first, so that the lanes of one SIMD packet end together, given the
    length of each block's list and its number by tile."""
    longest = _sorted(dr.arange(mi.UInt32, len(length)), 4095 - dr.minimum(length, 4095), 4096)
    return _sorted(longest, dr.gather(mi.UInt32, number, longest) // (TILE * TILE), numbers // (TILE * TILE))


def _pairs(splats: Splats, foot: Footprints, place: Any, blocks_x: int, blocks_y: int) -> tuple[Any, ...]:
    """Place of the splat, and number by tile of the block, of every pair, in the order of slots: splats as they lie in memory,
    the blocks of each row by row; first and end of the slots of the splat at each place [N]. Empty where no splat is drawn.

    First the rows of blocks that a footprint reaches, then the blocks of each row: work grows with the pairs that are kept,
    where a bounding box would list the whole square around a slanted needle.
    """
    n = len(splats.u)
    half = dr.sqrt(dr.maximum(foot.q, 0)) * dr.rcp(foot.e)
    low = dr.clip(dr.ceil((splats.v - half + 0.5) / BLOCK_Y) - 1, 0, blocks_y)
    high = dr.clip(dr.floor((splats.v + half - 0.5) / BLOCK_Y) + 1, 0, blocks_y)
    rows, shapes = dr.select(foot.q > 0, dr.maximum(high - low, 0), 0), dr.empty(mi.Float, 8 * n)
    dr.scatter(shapes, mi.Vector4f(splats.u, splats.v, foot.k, foot.p), 2 * place, mode=dr.ReduceMode.NoConflicts)
    dr.scatter(shapes, mi.Vector4f(foot.e, foot.q, low, rows), 2 * place + 1, mode=dr.ReduceMode.NoConflicts)
    dr.eval(foot, shapes)

    rows = mi.UInt32(dr.gather(mi.Float, shapes, 8 * dr.arange(mi.UInt32, n) + 7))
    first_row = dr.prefix_sum(rows)
    row_splat = _runs(first_row, _total(rows, blocks_y, "rows of blocks"))
    block, columns = mi.UInt32(), mi.UInt32()
    if len(row_splat) > 0:
        offset = dr.arange(mi.UInt32, len(row_splat)) - dr.gather(mi.UInt32, first_row, row_splat)
        block, columns = _columns(shapes, row_splat, offset, blocks_x)
        dr.eval(row_splat, block, columns)
    count = _total(columns, blocks_x, "blocks")
    if count == 0:
        return mi.UInt32(), mi.UInt32(), dr.zeros(mi.UInt32, n), dr.zeros(mi.UInt32, n)
    first = dr.prefix_sum(columns)
    row, end = _runs(first, count), first + columns
    number = _by_tile(dr.gather(mi.UInt32, block - first, row) + dr.arange(mi.UInt32, count), blocks_x)
    slot_start = dr.gather(mi.UInt32, first, first_row, rows > 0)
    slot_end = dr.gather(mi.UInt32, end, first_row + rows - 1, rows > 0)
    pairs = dr.gather(mi.UInt32, row_splat, row), number, slot_start, slot_end
    dr.eval(pairs)
    return pairs


def _total(counts: Any, most: int, what: str) -> int:
    """Sum of UInt32 counts of at most `most` each, in 64 bits where 32 might wrap. Raises InputError beyond MAX_PAIRS."""
    if len(counts) == 0:
        return 0
    total = int(dr.sum(counts if len(counts) * most < 1 << 32 else mi.UInt64(counts))[0])
    if total > MAX_PAIRS:
        raise InputError(
            f"view: {total:,} pairs of a Gaussian and one of its {what} ({BLOCK_X}x{BLOCK_Y} pixels) may take "
            f"{total * PAIR_BYTES / 2**30:,.1f} GiB, and {MAX_PAIRS:,} are the most; draw fewer or smaller Gaussians, "
            "or a smaller image"
        )
    return total


def _front_to_back(slot_start: Any, slot_end: Any, by_depth: Any, count: int) -> Any:
    """UInt32 [count]: the slots of the splat at each of these places, in their order."""
    dr.eval(by_depth)
    start, end = dr.gather(mi.UInt32, slot_start, by_depth), dr.gather(mi.UInt32, slot_end, by_depth)
    dr.eval(start, end)
    first = dr.prefix_sum(end - start)
    rank = _runs(first, count)
    slots = dr.gather(mi.UInt32, start - first, rank) + dr.arange(mi.UInt32, count)
    dr.eval(slots)
    return slots


def _runs(start: Any, count: int) -> Any:
    """UInt32 [count]: the run that each place belongs to, given the first places of runs (UInt32, growing; some are empty)."""
    if count == 0:
        return mi.UInt32()
    begun, inside = dr.zeros(mi.UInt32, count), start < dr.opaque(mi.UInt32, count)  # a literal would compile anew
    dr.scatter_add(begun, mi.UInt32(1), start, inside, mode=dr.ReduceMode.Direct)
    return dr.cumsum(begun) - 1


def _columns(shapes: Any, splat: Any, offset: Any, blocks_x: int) -> tuple[Any, Any]:
    """The blocks of one row that a footprint's ellipse reaches within the row's pixel centres: the first, and how many.

    The right rim x = k y + sqrt(q - e^2 y^2) / p is concave in y, so over the row's band it is largest at its own maximum,
    clipped to the band; likewise the left rim. shapes: (u, v, k, p), (e, q, low, rows) of each splat, where low is its first
    row; the row is low + offset.
    """
    u, v, k, p = dr.gather(mi.Vector4f, shapes, 2 * splat)
    e, q, first_row, _ = dr.gather(mi.Vector4f, shapes, 2 * splat + 1)
    by, half = mi.UInt32(first_row) + offset, dr.sqrt(q) * dr.rcp(e)
    top = mi.Float(by * BLOCK_Y) + 0.5 - v
    low, high = dr.maximum(top, -half), dr.minimum(top + (BLOCK_Y - 1), half)
    slant = k * p
    summit = slant * half * dr.rsqrt(e * e + slant * slant)

    def rim(side: float) -> Any:
        y = dr.clip(side * summit, low, high)
        return u + k * y + side * dr.sqrt(dr.maximum(dr.fma(-e * y, e * y, q), 0)) / p

    first = dr.clip(dr.ceil((rim(-1) + 0.5) / BLOCK_X) - 1, 0, blocks_x)
    last = dr.clip(dr.floor((rim(1) - 0.5) / BLOCK_X) + 1, 0, blocks_x)
    columns = mi.UInt32(dr.select(low <= high, dr.maximum(last - first, 0), 0))
    return by * blocks_x + mi.UInt32(first), columns


def _padded(values: Any, size: int) -> Any:
    """UInt32 values, then zeros up to `size` (dr.concat refuses arrays of length 0)."""
    padded = dr.zeros(mi.UInt32, size)
    dr.scatter(padded, values, dr.arange(mi.UInt32, len(values)), mode=dr.ReduceMode.NoConflicts)
    return padded


def _rounded(pairs: int) -> int:
    """Room for this many pairs, rounded up by at most an eighth: few distinct sizes, so recorded kernels are reused."""
    step = max(1024, 1 << max(pairs.bit_length() - 4, 0))
    return -(-max(pairs, 1) // step) * step


def _ranges(key: Any, buckets: int) -> tuple[Any, Any]:
    """(start, end) [buckets] of each bucket in the sorted keys."""
    start, end = dr.zeros(mi.UInt32, buckets), dr.zeros(mi.UInt32, buckets)
    m = len(key)
    place, last = dr.arange(mi.UInt32, m), dr.opaque(mi.UInt32, m - 1)
    previous = dr.gather(mi.UInt32, key, dr.maximum(place, 1) - 1)
    following = dr.gather(mi.UInt32, key, dr.minimum(place + 1, last))
    dr.scatter(start, place, key, (place == 0) | (previous != key), mode=dr.ReduceMode.NoConflicts)
    dr.scatter(end, place + 1, key, (place == last) | (following != key), mode=dr.ReduceMode.NoConflicts)
    return start, end
