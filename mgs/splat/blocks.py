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

from mgs.splat.project import Splats

BLOCK_X, BLOCK_Y = 8, 4
"""Pixels of one lane. With AVX-512, 8x2 and 4x4 were no faster forward, and slower for gradients: more pairs to store."""

TILE = 16
"""Blocks across and down a tile, which is walked before the next, so that its splats (64 bytes each) and their sums stay in a
core's cache; `benchmarks/tiles.py` chose it."""

LOG2_INV_ALPHA_MIN = 7.994353436858858
"""log2(255): a footprint ends where xi^2 + eta^2 = log2_opacity + log2(255)."""

SLACK = 1e-2
"""Bits added to a footprint's level so that rounding never drops a pixel at its rim."""


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
    """Pairs (splat, block), sorted by block, in each block by depth; M counts some unused room at the end.

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
    n = len(depth)
    order = dr.detail.block_mkperm(bits & 0xFFFF, n, 1 << 16)
    high = dr.gather(mi.UInt32, bits, order) >> 16
    return dr.gather(mi.UInt32, order, dr.detail.block_mkperm(high, n, 1 << 16))


def build(splats: Splats, order: Any, width: int, height: int, margin: float) -> BlockLists:
    """Block lists of detached splats, given their depth order. Exact ellipse-block overlap, not bounding boxes."""
    blocks_x, blocks_y = -(-width // BLOCK_X), -(-height // BLOCK_Y)
    n, lanes = len(splats.u), blocks_x * blocks_y
    foot = inflate(splats, margin)
    place = _places(splats, order, blocks_x, blocks_y)
    splat, slot, block, slot_start, slot_end = _pairs(splats, foot, order, place, blocks_x, blocks_y)
    if len(splat) == 0:  # Dr.Jit has no operations on arrays of length 0
        slot_start = slot_end = dr.zeros(mi.UInt32, n)
        start = end = dr.zeros(mi.UInt32, lanes)
    else:
        start, end, by_block = _group(block, lanes)
        splat, slot = dr.gather(mi.UInt32, splat, by_block), dr.gather(mi.UInt32, slot, by_block)
    room = _rounded(len(splat))
    lane = _lane_order(start, end, blocks_x, blocks_y)
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


def _tile(bx: Any, by: Any, blocks_x: int) -> Any:
    """The tile, row by row, of the blocks in column bx and row by (UInt32)."""
    return (by // TILE) * (-(-blocks_x // TILE)) + bx // TILE


def _tiles(blocks_x: int, blocks_y: int) -> int:
    return -(-blocks_x // TILE) * -(-blocks_y // TILE)


def _places(splats: Splats, order: Any, blocks_x: int, blocks_y: int) -> Any:
    """UInt32 [N]: where each splat lies: by the tile of its centre (the nearest, outside the image), then block, then depth."""

    def block(pixel: Any, size: int, count: int) -> Any:
        return mi.UInt32(dr.select(splats.visible, dr.clip(pixel / size, 0, count - 1), 0))

    n, tiles = len(splats.u), _tiles(blocks_x, blocks_y)
    bx, by = block(splats.u, BLOCK_X, blocks_x), block(splats.v, BLOCK_Y, blocks_y)
    key = (_tile(bx, by, blocks_x) * TILE + by % TILE) * TILE + bx % TILE
    dr.eval(key)
    at = dr.gather(mi.UInt32, order, dr.detail.block_mkperm(dr.gather(mi.UInt32, key, order), n, tiles * TILE * TILE))
    place = dr.empty(mi.UInt32, n)
    dr.scatter(place, dr.arange(mi.UInt32, n), at, mode=dr.ReduceMode.NoConflicts)
    return place


def _lane_order(start: Any, end: Any, blocks_x: int, blocks_y: int) -> Any:
    """UInt32 [L]: blocks by tile, in it the longest list first, so that the lanes of one SIMD packet end together."""
    lanes = len(start)
    longest = dr.detail.block_mkperm(4095 - dr.minimum(end - start, 4095), lanes, 4096)
    tile = _tile(longest % blocks_x, longest // blocks_x, blocks_x)
    return dr.gather(mi.UInt32, longest, dr.detail.block_mkperm(tile, lanes, _tiles(blocks_x, blocks_y)))


def _pairs(splats: Splats, foot: Footprints, order: Any, place: Any, blocks_x: int, blocks_y: int) -> tuple[Any, ...]:
    """(place of the splat, slot, block) of every pair, splats in depth order; first and end of the slots of the splat at each
    place [N]. Empty arrays where no splat touches a block.

    First the rows of blocks that a footprint reaches, then the blocks of each row: work grows with the pairs that are kept,
    where a bounding box would list the whole square around a slanted needle.
    """
    half = dr.sqrt(dr.maximum(foot.q, 0)) * dr.rcp(foot.e)
    low = dr.clip(dr.ceil((splats.v - half + 0.5) / BLOCK_Y) - 1, 0, blocks_y)
    high = dr.clip(dr.floor((splats.v + half - 0.5) / BLOCK_Y) + 1, 0, blocks_y)
    rows = dr.select(foot.q > 0, mi.UInt32(dr.maximum(high - low, 0)), 0)
    n, nothing = len(splats.u), (mi.UInt32(),) * 5
    shapes, index = dr.empty(mi.Float, 8 * n), dr.arange(mi.UInt32, n) * 2
    dr.scatter(shapes, mi.Vector4f(splats.u, splats.v, foot.k, foot.p), index, mode=dr.ReduceMode.NoConflicts)
    dr.scatter(shapes, mi.Vector4f(foot.e, foot.q, half, low), index + 1, mode=dr.ReduceMode.NoConflicts)
    dr.eval(foot, rows, shapes)

    ranked = dr.gather(mi.UInt32, rows, order)
    first_row = dr.prefix_sum(ranked)
    rank = _runs(first_row, int(dr.sum(rows)[0]))
    if len(rank) == 0:
        return nothing
    row_splat = dr.gather(mi.UInt32, order, rank)
    offset = dr.arange(mi.UInt32, len(rank)) - dr.gather(mi.UInt32, first_row, rank)
    block, columns = _columns(shapes, row_splat, offset, blocks_x)
    dr.eval(rank, row_splat, block, columns)
    before = dr.prefix_sum(columns)
    row = _runs(before, int(dr.sum(columns)[0]))
    if len(row) == 0:
        return nothing
    first = dr.gather(mi.UInt32, before, first_row, ranked > 0)
    row_place, count = dr.gather(mi.UInt32, place, row_splat), dr.empty(mi.UInt32, n)
    last = dr.gather(mi.UInt32, before + columns, first_row + ranked - 1, ranked > 0)
    dr.scatter(count, last - first, dr.gather(mi.UInt32, place, order), mode=dr.ReduceMode.NoConflicts)
    slot_start = dr.prefix_sum(count)
    to_slot = dr.gather(mi.UInt32, slot_start, row_place) - dr.gather(mi.UInt32, first, rank)
    dr.eval(row, row_place, to_slot)
    pair = dr.arange(mi.UInt32, len(row))
    splat, to_slot, block, before = (dr.gather(mi.UInt32, a, row) for a in (row_place, to_slot, block, before))
    return splat, pair + to_slot, pair - before + block, slot_start, slot_start + count


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
    clipped to the band; likewise the left rim. shapes: (u, v, k, p), (e, q, half, low) of each splat, where half is the
    ellipse's half height and low its first row; the row is low + offset.
    """
    u, v, k, p = dr.gather(mi.Vector4f, shapes, 2 * splat)
    e, q, half, first_row = dr.gather(mi.Vector4f, shapes, 2 * splat + 1)
    by = mi.UInt32(first_row) + offset
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


def _group(key: Any, buckets: int) -> tuple[Any, Any, Any]:
    """(start, end) [buckets] of each bucket in the stably sorted keys, and the sorting permutation."""
    start, end = dr.zeros(mi.UInt32, buckets), dr.zeros(mi.UInt32, buckets)
    m = len(key)
    slot = dr.detail.block_mkperm(key, m, buckets)
    place, last = dr.arange(mi.UInt32, m), dr.opaque(mi.UInt32, m - 1)
    sorted_key = dr.gather(mi.UInt32, key, slot)
    dr.eval(sorted_key)
    previous = dr.gather(mi.UInt32, sorted_key, dr.maximum(place, 1) - 1)
    following = dr.gather(mi.UInt32, sorted_key, dr.minimum(place + 1, last))
    dr.scatter(start, place, sorted_key, (place == 0) | (previous != sorted_key), mode=dr.ReduceMode.NoConflicts)
    dr.scatter(end, place + 1, sorted_key, (place == last) | (following != sorted_key), mode=dr.ReduceMode.NoConflicts)
    return start, end, slot
