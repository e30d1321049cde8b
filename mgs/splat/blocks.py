"""Block lists: for every block of pixels, the splats that touch it, front to back.

A block is a rectangle of BLOCK_X x BLOCK_Y pixels; the kernels give each block to one lane of a
SIMD register (see `mgs.splat.walking`). A splat that touches five blocks is in five lists: it makes
five (splat, block) *pairs*.

Lists serve as long as no footprint changes (`changes`). Where the means stay, so does the depth
order of the splats in each camera, and new lists of a camera take it over from the old ones.

Splats of neighbouring blocks should lie near one another in memory. So blocks are grouped into
square *tiles*, and the splats are stored tile by tile; where a splat lies is called its *place*.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mgs.errors import InputError
from mgs.memory import check_room
from mgs.splat.projection import Splats

BLOCK_X, BLOCK_Y = 8, 4
"""Width and height of a block, pixels. With AVX-512, 8x2 and 4x4 drew no faster, and took longer
for gradients, as they make more pairs whose sums must be stored."""

TILE = 16
"""Blocks across and down a tile. Lanes work through one tile before the next, so that its splats
(64 bytes each) and their sums stay in a core's cache; `benchmarks/tiles.py` measures what that is
worth, and this size was the best."""

LOG2_INV_ALPHA_MIN = 7.994353436858858
"""log2(255), that is -log2(ALPHA_MIN): a footprint ends where xi^2 + eta^2 = log2_opacity +
log2(255)."""

SLACK = 1e-2
"""Added to the level of a footprint that is listed (see `Footprints`), so that rounding never drops
a pixel at its rim."""

MAX_PAIRS = 1 << 26
"""Most (splat, block) pairs of a view, and most (splat, row of blocks) pairs, which are made on the
way to them. With it every index into the kernels' buffers, with 24 sums per pair, is below 2^31: it
may be lowered, but not raised. Fisher information with means has up to 36 and checks its own."""

PAIR_BYTES = 128
"""Peak memory of a view for each of its pairs: measured 28 for an image, 58 for exact Fisher
information, 123 for blocks. With means their sums take 32 and 48 more (exact information with means
and an SH degree above 0 has as many sums as blocks)."""


@dataclass
class Footprints:
    """The ellipses for which lists were built, Float [N] each. Fields as in `Splats`.

    level: the value of xi^2 + eta^2 at the rim of the ellipse, SLACK included; not positive where
    the splat is in no list.
    """

    mean_x: Any
    mean_y: Any
    depth: Any
    shear: Any
    white_x: Any
    white_y: Any
    level: Any


@dataclass
class BlockLists:
    """The lists of all blocks, as M (splat, block) pairs sorted by block, tile by tile, and within
    a block by depth.

    Each splat has a place, its position in memory: splats are stored by the tile of their centre,
    then block, then depth (in lists that took their places over from older ones, as it was for
    these). Kernels store their sums pair by pair. To add
    those of one splat, each pair also has a slot: slots go front to back, so those of one splat
    follow one another.

    order: UInt32 [N], the Gaussians front to back; place: UInt32 [N], the place of each Gaussian's
    splat.
    splat: UInt32 [M], the place of the pair's splat; pair: UInt32 [M], the pair at each slot. The
    last of both are unused (see `_room`).
    slot_start, slot_end: UInt32 [N], the range of slots of the splat at each place.
    block: UInt32 [L], the block of each lane, counted row by row through the image. Lanes go tile
    by tile, and in a tile the
    block with the longest list comes first. start, end: UInt32 [L], the range of the lane's pairs.
    width, height: pixels, and blocks_x: blocks across the image; UInt32 [1].
    footprints: what the lists were built for.
    """

    order: Any
    place: Any
    splat: Any
    pair: Any
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
        return 4 * (2 * len(self.splat) + 11 * len(self.slot_start) + 3 * len(self.block))


def footprints(splats: Splats) -> Footprints:
    """The splats' footprints: each ends where alpha = ALPHA_MIN."""
    level = splats.log2_opacity + LOG2_INV_ALPHA_MIN
    drawn = splats.visible & (level > 0)
    shape = splats.mean_x, splats.mean_y, splats.depth, splats.shear, splats.white_x, splats.white_y
    return Footprints(*shape, level=dr.select(drawn, level + SLACK, -1))


RESHAPED, REORDERED = 1, 2
"""What `changes` finds."""


def changes(built: Footprints, splats: Splats) -> Any:
    """UInt32 [N]: how each splat differs from those for which lists were built. 0: not at all, or
    it is drawn in neither;
    RESHAPED: its footprint is another, so that the lists no longer serve; REORDERED: nor does their
    depth order.
    """
    now = footprints(splats)
    other = (built.mean_x != now.mean_x) | (built.mean_y != now.mean_y) | (built.shear != now.shear)
    other |= (
        (built.white_x != now.white_x) | (built.white_y != now.white_y) | (built.level != now.level)
    )
    reshaped = other & ((built.level > 0) | (now.level > 0))
    return dr.select(
        built.depth == now.depth, mi.UInt32(dr.select(reshaped, RESHAPED, 0)), REORDERED
    )


def depth_order(depth: Any) -> Any:
    """UInt32 [N]: indices of the splats front to back, equal depths by index; depth: Float [N],
    positive.

    A stable radix sort of the bits of the floats, which for positive numbers have the same order as
    their values.
    """
    bits = dr.reinterpret_array(mi.UInt32, depth)
    order = dr.detail.block_mkperm(bits & 0xFFFF, len(depth), 1 << 16)
    return _sorted(order, dr.gather(mi.UInt32, bits, order) >> 16, 1 << 16)


def build(splats: Splats, width: int, height: int, older: BlockLists | None = None) -> BlockLists:
    """Block lists of detached splats; width, height: pixels; older: lists of the same camera whose
    depth order and places are taken over, where no splat was REORDERED since.

    Pairs are made splat by splat, front to back, and then sorted by block; as the sort is stable,
    each block's list is front to back too. Whether a splat touches a block is decided by its
    ellipse, not by a bounding box. Raises InputError for more than MAX_PAIRS pairs, and where there
    is no room for them, before memory is taken for them.
    """
    blocks_x, blocks_y = -(-width // BLOCK_X), -(-height // BLOCK_Y)
    foot = footprints(splats)
    order, place = (older.order, older.place) if older else _orders(splats, blocks_x, blocks_y)
    numbers = _tile_number(dr.arange(mi.UInt32, blocks_x * blocks_y), blocks_x)
    owner, number, slot_start, slot_end = _pairs(foot, order, place, blocks_x, blocks_y)
    splat, pair, start, end = _by_block(owner, number, _tile_numbers(blocks_x, blocks_y))
    start, end = dr.gather(mi.UInt32, start, numbers), dr.gather(mi.UInt32, end, numbers)
    lane = _lanes_by_tile(end - start, numbers, _tile_numbers(blocks_x, blocks_y))
    lists = BlockLists(
        order=order,
        place=place,
        splat=splat,
        pair=pair,
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


def _tile_number(block: Any, blocks_x: int) -> Any:
    """UInt32: the number of a block when blocks are counted tile by tile, from its number when they
    are counted row by row.

    A tile at the edge of the image is counted as if it were whole, TILE x TILE blocks, so some
    numbers belong to no block.
    """
    bx, by = block % blocks_x, block // blocks_x
    tile = (by // TILE) * -(-blocks_x // TILE) + bx // TILE
    return (tile * TILE + by % TILE) * TILE + bx % TILE


def _tile_numbers(blocks_x: int, blocks_y: int) -> int:
    """How many numbers there are in the count of `_tile_number`."""
    return -(-blocks_x // TILE) * -(-blocks_y // TILE) * TILE * TILE


def _sorted(values: Any, keys: Any, count: int) -> Any:
    """UInt32 values, stably sorted by their keys, which are below `count`; evaluated.

    Evaluated, since the values serve as addresses next: within one kernel a read at a random
    address that must wait for another such read takes longer than two kernels do.
    """
    values = dr.gather(mi.UInt32, values, dr.detail.block_mkperm(keys, len(values), count))
    dr.eval(values)
    return values


def _orders(splats: Splats, blocks_x: int, blocks_y: int) -> tuple[Any, Any]:
    """The Gaussians front to back, and the place of each Gaussian's splat, UInt32 [N].

    They are stored by the tile of their centre, then its block, then depth. A centre outside the
    image counts to the nearest block.
    """

    def block(pixel: Any, size: int, count: int) -> Any:
        return mi.UInt32(dr.select(splats.visible, dr.clip(pixel / size, 0, count - 1), 0))

    number = _tile_number(
        block(splats.mean_y, BLOCK_Y, blocks_y) * blocks_x
        + block(splats.mean_x, BLOCK_X, blocks_x),
        blocks_x,
    )
    order = depth_order(splats.depth)
    dr.eval(number)
    at = _sorted(order, dr.gather(mi.UInt32, number, order), _tile_numbers(blocks_x, blocks_y))
    place = dr.empty(mi.UInt32, len(at))
    dr.scatter(place, dr.arange(mi.UInt32, len(at)), at, mode=dr.ReduceMode.NoConflicts)
    dr.eval(place)
    return order, place


def _lanes_by_tile(length: Any, number: Any, numbers: int) -> Any:
    """UInt32 [L]: the blocks in the order of lanes, tile by tile, and in a tile the longest list
    first.

    The lanes of one SIMD register then have lists of similar lengths and end together. length: of
    each block's list; number: `_tile_number` of each block; numbers: how many of these there are.
    """
    longest = _sorted(dr.arange(mi.UInt32, len(length)), 4095 - dr.minimum(length, 4095), 4096)
    return _sorted(
        longest, dr.gather(mi.UInt32, number, longest) // (TILE * TILE), numbers // (TILE * TILE)
    )


def _pairs(
    foot: Footprints, order: Any, place: Any, blocks_x: int, blocks_y: int
) -> tuple[Any, ...]:
    """All (splat, block) pairs, in the order of their slots: front to back, and for one splat block
    by block, row by row.

    Returns the place of each pair's splat [M], the `_tile_number` of its block [M], and the first
    slot and the end of the slots of the splat at each place [N], UInt32. The first two are empty
    where no splat is drawn.

    First come the (splat, row of blocks) pairs, then the blocks of each row. So the work grows with
    the pairs that are kept; a bounding box around a slanted needle would first list a whole square
    of blocks.
    """
    n = len(order)
    dr.eval(foot)
    u, v, k, p, e, q = (
        dr.gather(mi.Float, part, order)
        for part in (foot.mean_x, foot.mean_y, foot.shear, foot.white_x, foot.white_y, foot.level)
    )
    half = dr.sqrt(dr.maximum(q, 0)) * dr.rcp(e)
    low = dr.clip(dr.ceil((v - half + 0.5) / BLOCK_Y) - 1, 0, blocks_y)
    high = dr.clip(dr.floor((v + half - 0.5) / BLOCK_Y) + 1, 0, blocks_y)
    rows, shapes = (
        mi.UInt32(dr.select(q > 0, dr.maximum(high - low, 0), 0)),
        dr.empty(mi.Float, 8 * n),
    )
    for i, part in enumerate((mi.Vector4f(u, v, k, p), mi.Vector4f(e, q, low, 0))):
        dr.scatter(shapes, part, 2 * dr.arange(mi.UInt32, n) + i, mode=dr.ReduceMode.NoConflicts)
    nearest = dr.gather(mi.UInt32, place, order)
    dr.eval(shapes, rows, nearest)

    first_row = dr.prefix_sum(rows)
    rank = _run_numbers(first_row, rows, _total(rows, blocks_y, "rows of blocks"))
    owner, block, columns = mi.UInt32(), mi.UInt32(), mi.UInt32()
    if len(rank) > 0:
        owner = dr.gather(mi.UInt32, nearest, rank)
        offset = dr.arange(mi.UInt32, len(rank)) - dr.gather(mi.UInt32, first_row, rank)
        block, columns = _blocks_of_row(shapes, rank, offset, blocks_x)
        dr.eval(owner, block, columns)
    count = _total(columns, blocks_x, "blocks")
    if count == 0:
        return mi.UInt32(), mi.UInt32(), dr.zeros(mi.UInt32, n), dr.zeros(mi.UInt32, n)
    first = dr.prefix_sum(columns)
    row, slots = _run_numbers(first, columns, count), [dr.empty(mi.UInt32, n) for _ in range(2)]
    number = _tile_number(
        dr.gather(mi.UInt32, block - first, row) + dr.arange(mi.UInt32, count), blocks_x
    )
    start = dr.gather(mi.UInt32, first, first_row, rows > 0)
    end = dr.gather(mi.UInt32, first + columns, first_row + rows - 1, rows > 0)
    for array, value in zip(slots, (start, end), strict=True):
        dr.scatter(array, value, nearest, mode=dr.ReduceMode.NoConflicts)
    pairs = dr.gather(mi.UInt32, owner, row), number, *slots
    dr.eval(pairs)
    return pairs


def _total(counts: Any, most: int, what: str) -> int:
    """Sum of UInt32 counts, each at most `most`; in 64 bits where 32 might not hold it. Raises
    InputError beyond MAX_PAIRS, and as `check_room`."""
    if len(counts) == 0:
        return 0
    total = int(dr.sum(counts if len(counts) * most < 1 << 32 else mi.UInt64(counts))[0])
    if total > MAX_PAIRS:
        raise InputError(
            f"view: {total:,} pairs of a Gaussian and one of its {what} ({BLOCK_X}x{BLOCK_Y} pixels) may take "
            f"{total * PAIR_BYTES / 2**30:,.1f} GiB, and {MAX_PAIRS:,} are the most; draw fewer or smaller Gaussians, "
            "or a smaller image"
        )
    what = f"view: {total:,} pairs of a Gaussian and one of its {what} ({BLOCK_X}x{BLOCK_Y} pixels)"
    check_room(total * PAIR_BYTES, what, "draw fewer or smaller Gaussians, or a smaller image")
    return total


def _run_numbers(start: Any, length: Any, count: int) -> Any:
    """UInt32 [count]: for each of `count` numbers cut into runs, which run it belongs to.

    start, length: UInt32, where each run begins, and how many numbers it has (0 for an empty one).
    """
    if count == 0:
        return mi.UInt32()
    begun = dr.zeros(mi.UInt32, count)
    dr.scatter(
        begun, dr.arange(mi.UInt32, len(start)), start, length > 0, mode=dr.ReduceMode.NoConflicts
    )
    return dr.block_prefix_reduce(dr.ReduceOp.Max, begun, count, exclusive=False)


def _blocks_of_row(shapes: Any, splat: Any, offset: Any, blocks_x: int) -> tuple[Any, Any]:
    """The blocks that a footprint's ellipse reaches in one row of blocks: number of the first (row
    by row), and how many.

    shapes: two packets for each splat, front to back: (mean_x, mean_y, shear, white_x) and
    (white_y, level, first row, unused);
    splat: UInt32, its number in them; offset: UInt32, the row counted from the splat's first row.

    The ellipse counts between the centres of the row's first and last pixels. At height y from the
    splat's centre its right rim is x = k y + sqrt(q - e^2 y^2) / p, with the letters of
    docs/notation.md. That is concave in y, so in this band it is largest at its own maximum, or at
    the end of the band nearest to that. The left rim is its mirror image.
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


def _by_block(owner: Any, number: Any, numbers: int) -> tuple[Any, Any, Any, Any]:
    """Sort pairs by block. owner, number: UInt32 [M], the place of each pair's splat, and its
    block, one of `numbers`.

    Returns the place of the splat of each sorted pair, and the sorted pair at each slot, UInt32
    [_room(M)], then where the pairs of each block begin and end, UInt32 [numbers] (0 and 0 where
    there are none).
    """
    count = len(number)
    pair, start, end = (
        dr.zeros(mi.UInt32, _room(count)),
        dr.zeros(mi.UInt32, numbers),
        dr.zeros(mi.UInt32, numbers),
    )
    if count == 0:  # Dr.Jit has no operations on arrays of length 0
        return dr.zeros(mi.UInt32, _room(count)), pair, start, end
    slot, at = dr.detail.block_mkperm(number, count, numbers), dr.arange(mi.UInt32, _room(count))
    used, last = at < dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, count - 1)
    slot = dr.gather(mi.UInt32, slot, at, used)
    dr.scatter(pair, at, slot, used, mode=dr.ReduceMode.NoConflicts)
    dr.eval(
        pair
    )  # each alone: one kernel with all three at random addresses takes half as long again
    splat = dr.gather(mi.UInt32, owner, slot, used)
    dr.eval(splat)
    number = dr.gather(mi.UInt32, number, slot, used)
    dr.eval(number)
    previous = dr.gather(mi.UInt32, number, dr.maximum(at, 1) - 1)
    following = dr.gather(mi.UInt32, number, dr.minimum(at + 1, last))
    dr.scatter(
        start, at, number, used & ((at == 0) | (previous != number)), mode=dr.ReduceMode.NoConflicts
    )
    dr.scatter(
        end,
        at + 1,
        number,
        used & ((at == last) | (following != number)),
        mode=dr.ReduceMode.NoConflicts,
    )
    return splat, pair, start, end


def _room(pairs: int) -> int:
    """Length of the lists of this many pairs, rounded up by at most an eighth, so that few lengths
    occur: a kernel is recorded anew for each."""
    step = max(1024, 1 << max(pairs.bit_length() - 4, 0))
    return -(-max(pairs, 1) // step) * step
