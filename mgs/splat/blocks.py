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

    splat, slot: UInt32 [M]; a pair's slot is its place in the order where the pairs of one splat are contiguous, and
    slot_start, slot_end: UInt32 [N] are the slots of each splat. block: UInt32 [L] of each lane, longest list first, and
    start, end: UInt32 [L] its range of pairs. width, height: UInt32, pixels; blocks_x: UInt32.
    """

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
        return 4 * (2 * len(self.splat) + 9 * len(self.slot_start) + 3 * len(self.block))


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
    splat, block, slot_start, slot_end = _pairs(splats, foot, order, blocks_x, blocks_y)
    if len(splat) == 0:  # Dr.Jit has no operations on arrays of length 0
        slot_start = slot_end = dr.zeros(mi.UInt32, n)
        start = end = dr.zeros(mi.UInt32, lanes)
        slot, longest_first = splat, dr.arange(mi.UInt32, lanes)
    else:
        start, end, slot = _group(block, lanes)
        splat = dr.gather(mi.UInt32, splat, slot)
        longest_first = dr.detail.block_mkperm(4095 - dr.minimum(end - start, 4095), lanes, 4096)
    room = _rounded(len(splat))
    lists = BlockLists(
        splat=_padded(splat, room),
        slot=_padded(slot, room),
        slot_start=slot_start,
        slot_end=slot_end,
        block=longest_first,
        start=dr.gather(mi.UInt32, start, longest_first),
        end=dr.gather(mi.UInt32, end, longest_first),
        width=dr.opaque(mi.UInt32, width),
        height=dr.opaque(mi.UInt32, height),
        blocks_x=dr.opaque(mi.UInt32, blocks_x),
        footprints=foot,
    )
    dr.eval(lists)
    return lists


def _pairs(splats: Splats, foot: Footprints, order: Any, blocks_x: int, blocks_y: int) -> tuple[Any, Any, Any, Any]:
    """(splat, block) of every pair, splats in depth order and the pairs of one splat contiguous; first and end of each
    splat's pairs [N]. Empty arrays where no splat touches a block.

    First the rows of blocks that a footprint reaches, then the blocks of each row: work grows with the pairs that are kept,
    where a bounding box would list the whole square around a slanted needle.
    """
    half = dr.sqrt(dr.maximum(foot.q, 0)) * dr.rcp(foot.e)
    low = dr.clip(dr.ceil((splats.v - half + 0.5) / BLOCK_Y) - 1, 0, blocks_y)
    high = dr.clip(dr.floor((splats.v + half - 0.5) / BLOCK_Y) + 1, 0, blocks_y)
    rows = dr.select(foot.q > 0, mi.UInt32(dr.maximum(high - low, 0)), 0)
    dr.eval(foot, half, low, rows)

    n, none = len(splats.u), mi.UInt32()
    ranked = dr.gather(mi.UInt32, rows, order)
    first_row = dr.prefix_sum(ranked)
    rank = dr.repeat(dr.arange(mi.UInt32, n), ranked)
    if len(rank) == 0:
        return none, none, none, none
    row_splat = dr.gather(mi.UInt32, order, rank)
    offset = dr.arange(mi.UInt32, len(rank)) - dr.gather(mi.UInt32, first_row, rank)
    by = mi.UInt32(dr.gather(mi.Float, low, row_splat)) + offset
    left, columns = _columns(splats, foot, half, row_splat, by, blocks_x)
    columns = _padded(columns, _rounded(len(rank) + 1))  # dr.repeat compiles anew for every length
    before = dr.prefix_sum(columns)
    row = dr.repeat(dr.arange(mi.UInt32, len(columns)), columns)
    if len(row) == 0:
        return none, none, none, none
    slot_start, slot_end = dr.empty(mi.UInt32, n), dr.empty(mi.UInt32, n)
    dr.scatter(slot_start, dr.gather(mi.UInt32, before, first_row), order, mode=dr.ReduceMode.NoConflicts)
    dr.scatter(slot_end, dr.gather(mi.UInt32, before, first_row + ranked), order, mode=dr.ReduceMode.NoConflicts)
    offset = dr.arange(mi.UInt32, len(row)) - dr.gather(mi.UInt32, before, row)
    block = dr.gather(mi.UInt32, by * blocks_x + left, row) + offset
    return dr.gather(mi.UInt32, row_splat, row), block, slot_start, slot_end


def _columns(splats: Splats, foot: Footprints, half: Any, splat: Any, by: Any, blocks_x: int) -> tuple[Any, Any]:
    """The blocks of row `by` that a footprint's ellipse reaches within the row's pixel centres: the first, and how many.

    The right rim x = k y + sqrt(q - e^2 y^2) / p is concave in y, so over the row's band it is largest at its own maximum,
    clipped to the band; likewise the left rim. half: the ellipse's half height [N].
    """
    gathered = (splats.u, splats.v, foot.k, foot.p, foot.e, foot.q, half)
    u, v, k, p, e, q, half = (dr.gather(mi.Float, a, splat) for a in gathered)
    top = mi.Float(by * BLOCK_Y) + 0.5 - v
    low, high = dr.maximum(top, -half), dr.minimum(top + (BLOCK_Y - 1), half)
    slant = k * p
    summit = slant * half * dr.rsqrt(e * e + slant * slant)

    def rim(side: float) -> Any:
        y = dr.clip(side * summit, low, high)
        return u + k * y + side * dr.sqrt(dr.maximum(dr.fma(-e * y, e * y, q), 0)) / p

    first = dr.clip(dr.ceil((rim(-1) + 0.5) / BLOCK_X) - 1, 0, blocks_x)
    last = dr.clip(dr.floor((rim(1) - 0.5) / BLOCK_X) + 1, 0, blocks_x)
    return mi.UInt32(first), mi.UInt32(dr.select(low <= high, dr.maximum(last - first, 0), 0))


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
