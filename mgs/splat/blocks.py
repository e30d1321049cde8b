"""Block lists: for every block of BLOCK_X x BLOCK_Y pixels, the splats that touch it, front to
back.

A splat that touches five blocks makes five (splat, block) *pairs*. Blocks are grouped into square
*tiles*; splats are stored tile by tile, and the position of one is its *place*. Lists stay valid
while no footprint changes (`changes`), and their depth order while the means stay."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.memory import check_room
from mgs.splat.projection import Splats

# Width and height of a block, pixels. With AVX-512, 8x2 and 4x4 drew no faster, and gradients took
# longer because there are more pairs. Its 32 pixels are a warp of a GPU.
BLOCK_X, BLOCK_Y = 8, 4
# Lanes work tile by tile, so that splats (64 bytes) and sums stay in a core's cache.
TILE = 16  # width and height of a tile, blocks: the fastest measured


def on_cpu() -> bool:
    """Whether the variant computes on the processor; else on a GPU."""
    return bool(dr.backend_v(mi.Float) == dr.JitBackend.LLVM)


LOG2_INV_ALPHA_MIN = 7.994353436858858  # at the rim xi^2 + eta^2 = log2_opacity + this
SLACK = 1e-2  # added to `Footprints.level`, so that rounding never drops a pixel at the rim
# Most (splat, block) pairs of a view, and most (splat, row of blocks) pairs. Indices into buffers
# of 24 sums per pair then stay below 2^31, so it must not be raised. Fisher information with means
# has up to 36 sums and its own check.
MAX_PAIRS = 1 << 26
# Measured: 28 for an image, 58 for exact information, 123 for blocks; means add 32 and 48.
PAIR_BYTES = 128  # peak memory per pair, bytes


@dataclass
class Footprints:
    """Ellipses for which lists were built, Float [N] each. Fields as in `Splats`."""

    mean_x: Any
    mean_y: Any
    depth: Any
    shear: Any
    white_x: Any
    white_y: Any
    level: Any  # xi^2 + eta^2 at the rim, plus SLACK; not positive: in no list


@dataclass
class BlockLists:
    """Lists of all blocks: M (splat, block) pairs, sorted by block, tile by tile, then by depth.
    Splats have places by the tile of their centre, then block, then depth. Pairs have slots, front
    to back, so that those of one splat are consecutive and kernels can add up its sums."""

    order: Any  # Gaussians front to back, UInt32 [N]
    place: Any  # place of each Gaussian's splat, UInt32 [N]
    splat: Any  # place of each pair's splat, UInt32 [M], padded (`_room`)
    pair: Any  # pair at each slot, UInt32 [M], padded
    slot_start: Any  # range of slots of the splat at each place, UInt32 [N]
    slot_end: Any
    summed: Any  # places by their number of slots, the largest first, UInt32 [N]
    block: Any  # of each lane, counted row by row, UInt32 [L]; in a tile the longest list first
    start: Any  # range of each lane's pairs, UInt32 [L]
    end: Any
    left: Any  # the image on its film, pixels, UInt32 [1]
    top: Any
    right: Any
    bottom: Any
    blocks_x: Any  # blocks per row, UInt32 [1]
    footprints: Footprints  # for which the lists were built

    @cached_property
    def nbytes(self) -> int:
        """Memory held, bytes."""
        return 4 * (2 * len(self.splat) + 12 * len(self.slot_start) + 3 * len(self.block))


def footprints(splats: Splats) -> Footprints:
    """Footprints of splats. Each ends where alpha = ALPHA_MIN."""
    # alpha >= ALPHA_MIN where xi^2 + eta^2 <= log2 o - log2 ALPHA_MIN = q.
    level = splats.log2_opacity + LOG2_INV_ALPHA_MIN
    visible = splats.visible & (level > 0)
    shape = splats.mean_x, splats.mean_y, splats.depth, splats.shear, splats.white_x, splats.white_y
    return Footprints(*shape, level=dr.select(visible, level + SLACK, -1))


RESHAPED, REORDERED = 1, 2  # results of `changes`


def changes(old: Footprints, splats: Splats) -> Any:
    """Compare splats with those for which lists were built, UInt32 [N]. 0: the footprint is the
    same, or drawn in neither. RESHAPED: the footprint changed, so lists must be rebuilt. REORDERED:
    the depth changed, so the order must be, too."""
    now = footprints(splats)
    # Any number of a drawn footprint differs, bit for bit.
    other = (old.mean_x != now.mean_x) | (old.mean_y != now.mean_y) | (old.shear != now.shear)
    other |= (old.white_x != now.white_x) | (old.white_y != now.white_y)
    other |= old.level != now.level
    other &= (old.level > 0) | (now.level > 0)
    reshaped = mi.UInt32(dr.select(other, RESHAPED, 0))
    return dr.select(old.depth == now.depth, reshaped, REORDERED)


def depth_order(depth: Any) -> Any:
    """Indices of splats front to back, equal depths by index, UInt32 [N]. The bits of positive
    floats have the order of the values. depth: Float [N], positive."""
    index = dr.arange(mi.UInt32, len(depth))
    return _sorted(index, dr.reinterpret_array(mi.UInt32, depth), 1 << 32)


def build(splats: Splats, camera: Camera, older: BlockLists | None = None) -> BlockLists:
    """Build the block lists of detached splats.

    Blocks are those of the camera's whole film: a crop window has the ones that it touches.
    older: lists of the same camera whose depth order and places are reused. No splat may be
    REORDERED since.

    Pairs are made front to back and then sorted by block. The sort is stable, so each block's list
    is front to back, too. A splat touches a block if its ellipse does, not its bounding box. Raises
    InputError for more than MAX_PAIRS pairs, or too many for the memory, before taking memory."""
    # First block (column, row) on the film, and number of blocks that the window touches.
    left, top = camera.corner
    right, bottom = left + camera.width, top + camera.height
    column, row = left // BLOCK_X, top // BLOCK_Y
    blocks_x, blocks_y = -(-right // BLOCK_X) - column, -(-bottom // BLOCK_Y) - row
    first = dr.opaque(mi.UInt32, column), dr.opaque(mi.UInt32, row)
    foot = footprints(splats)
    if older:
        order, place = older.order, older.place
    else:
        order, place = _orders(splats, first, blocks_x, blocks_y)
    # Pairs are sorted by block counted tile by tile; lists are stored by block row by row.
    numbers = _tile_number(dr.arange(mi.UInt32, blocks_x * blocks_y), blocks_x)
    owner, number, slot_start, slot_end = _pairs(foot, order, place, first, blocks_x, blocks_y)
    splat, pair, start, end = _by_block(owner, number, _tile_numbers(blocks_x, blocks_y))
    start, end = dr.gather(mi.UInt32, start, numbers), dr.gather(mi.UInt32, end, numbers)
    lane = _lanes_by_tile(end - start, numbers, _tile_numbers(blocks_x, blocks_y))
    ranges = (dr.gather(mi.UInt32, part, lane) for part in (start, end))
    edges = (dr.opaque(mi.UInt32, side) for side in (left, top, right, bottom, blocks_x))
    slots = splat, pair, slot_start, slot_end, _longest_first(slot_end - slot_start)
    lists = BlockLists(*(order, place, *slots, lane, *ranges, *edges, foot))
    dr.eval(lists)
    return lists


def _tile_number(block: Any, blocks_x: int) -> Any:
    """Number of a block counted tile by tile, from its number counted row by row, UInt32. Tiles at
    the edge of the image count as whole, so some numbers belong to no block."""
    # Block (bx, by) is number (by mod TILE) TILE + bx mod TILE of its tile.
    bx, by = block % blocks_x, block // blocks_x
    tile = (by // TILE) * -(-blocks_x // TILE) + bx // TILE
    return (tile * TILE + by % TILE) * TILE + bx % TILE


def _tile_numbers(blocks_x: int, blocks_y: int) -> int:
    return -(-blocks_x // TILE) * -(-blocks_y // TILE) * TILE * TILE


def _sorted(values: Any, keys: Any, count: int) -> Any:
    """UInt32 values, stably sorted by their keys, which are below `count`. Evaluated, because the
    values serve as addresses next: two kernels are faster than one in which a random read waits for
    another."""
    values = dr.gather(mi.UInt32, values, _permutation(keys, count))
    dr.eval(values)
    return values


# Most bits of a key by which `_permutation` sorts at once. On a GPU Dr.Jit's permutations are
# stable for up to 512 values (with 64 KB of shared memory), and not above.
DIGIT_BITS = {"cpu": 20, "gpu": 8}


def _permutation(keys: Any, count: int) -> Any:
    """Indices that sort UInt32 keys below `count` stably, by a radix sort of even digits."""
    # Digits of equal length, at most `most` bits: one counting sort for each, lowest first.
    bits, most = max(count - 1, 1).bit_length(), DIGIT_BITS["cpu" if on_cpu() else "gpu"]
    digit = -(-bits // -(-bits // most))
    if digit == bits:
        return dr.detail.block_mkperm(keys, len(keys), count)
    order = dr.detail.block_mkperm(keys & ((1 << digit) - 1), len(keys), 1 << digit)
    for shift in range(digit, bits, digit):
        rest = (dr.gather(mi.UInt32, keys, order) >> shift) & ((1 << digit) - 1)
        order = dr.gather(mi.UInt32, order, dr.detail.block_mkperm(rest, len(keys), 1 << digit))
    return order


def _orders(
    splats: Splats, first: tuple[Any, Any], blocks_x: int, blocks_y: int
) -> tuple[Any, Any]:
    """Order and place of `BlockLists`. A centre outside the image counts to the nearest block.
    first: column and row of the first block on the film, UInt32 [1]."""

    def block(pixel: Any, size: int, first: Any, count: int) -> Any:
        number = dr.clip(pixel / size - mi.Float(first), 0, count - 1)
        return mi.UInt32(dr.select(splats.visible, number, 0))

    # Block of each centre, clipped to the image; then by tile, in it front to back.
    column = block(splats.mean_x, BLOCK_X, first[0], blocks_x)
    row = block(splats.mean_y, BLOCK_Y, first[1], blocks_y)
    number = _tile_number(row * blocks_x + column, blocks_x)
    order = depth_order(splats.depth)
    dr.eval(number)
    at = _sorted(order, dr.gather(mi.UInt32, number, order), _tile_numbers(blocks_x, blocks_y))
    place = dr.empty(mi.UInt32, len(at))
    dr.scatter(place, dr.arange(mi.UInt32, len(at)), at, mode=dr.ReduceMode.NoConflicts)
    dr.eval(place)
    return order, place


def _lanes_by_tile(length: Any, number: Any, numbers: int) -> Any:
    """Blocks in the order of lanes, UInt32 [L]: tile by tile, in a tile the longest list first, so
    that the lanes of a SIMD register have lists of similar lengths. length: of each block's list.
    number: `_tile_number` of each block. numbers: `_tile_numbers`."""
    longest = _longest_first(length)  # then stably by tile
    tile = dr.gather(mi.UInt32, number, longest) // (TILE * TILE)
    return _sorted(longest, tile, numbers // (TILE * TILE))


def _longest_first(length: Any) -> Any:
    """Indices of UInt32 lengths, the longest first, those of 4095 and more as if equal. Lanes of a
    SIMD register wait for the one that loops longest."""
    return _sorted(dr.arange(mi.UInt32, len(length)), 4095 - dr.minimum(length, 4095), 4096)


def _pairs(
    foot: Footprints,
    order: Any,
    place: Any,
    first_block: tuple[Any, Any],
    blocks_x: int,
    blocks_y: int,
) -> tuple[Any, ...]:
    """All (splat, block) pairs in the order of their slots: front to back, and for one splat row
    by row. first_block: as `first` in `_orders`.

    Returns, as UInt32: the place of each pair's splat [M], the `_tile_number` of its block [M], and
    the range of slots of the splat at each place [N], [N]. The first two are empty if no splat is
    drawn.

    It first makes (splat, row of blocks) pairs, then the blocks of each row, so the work grows with
    the pairs that are kept. The bounding box of a slanted needle would contain many more blocks."""
    n = len(order)
    dr.eval(foot)
    u, v, k, p, e, q = (
        dr.gather(mi.Float, part, order)
        for part in (foot.mean_x, foot.mean_y, foot.shear, foot.white_x, foot.white_y, foot.level)
    )
    # |eta| <= sqrt(q), so |dy| <= sqrt(q) / e: first and last row of blocks, by pixel centres.
    half = dr.sqrt(dr.maximum(q, 0)) * dr.rcp(e)
    row = mi.Float(first_block[1])
    low = dr.clip(dr.ceil((v - half + 0.5) / BLOCK_Y) - 1 - row, 0, blocks_y)
    high = dr.clip(dr.floor((v + half - 0.5) / BLOCK_Y) + 1 - row, 0, blocks_y)
    rows = mi.UInt32(dr.select(q > 0, dr.maximum(high - low, 0), 0))
    # Ellipses front to back, in two packets each (`_blocks_of_row`).
    shapes = dr.empty(mi.Float, 8 * n)
    for i, part in enumerate((mi.Vector4f(u, v, k, p), mi.Vector4f(e, q, low, 0))):
        dr.scatter(shapes, part, 2 * dr.arange(mi.UInt32, n) + i, mode=dr.ReduceMode.NoConflicts)
    nearest = dr.gather(mi.UInt32, place, order)
    dr.eval(shapes, rows, nearest)

    # One entry for each (splat, row of blocks): its splat, and its offset from the first row.
    # first_row: entry of a splat's first row; rank: splat of each entry, counted from the front.
    first_row = dr.prefix_sum(rows)
    rank = _run_numbers(first_row, rows, _total(rows, blocks_y, "rows of blocks"))
    owner, block, columns = mi.UInt32(), mi.UInt32(), mi.UInt32()
    if len(rank) > 0:
        owner = dr.gather(mi.UInt32, nearest, rank)
        offset = dr.arange(mi.UInt32, len(rank)) - dr.gather(mi.UInt32, first_row, rank)
        block, columns = _blocks_of_row(shapes, rank, offset, first_block, blocks_x)
        dr.eval(owner, block, columns)
    count = _total(columns, blocks_x, "blocks")
    if count == 0:
        return mi.UInt32(), mi.UInt32(), dr.zeros(mi.UInt32, n), dr.zeros(mi.UInt32, n)
    # One entry for each pair; the blocks of a row are consecutive.
    first = dr.prefix_sum(columns)
    row, slots = _run_numbers(first, columns, count), [dr.empty(mi.UInt32, n) for _ in range(2)]
    block_of_pair = dr.gather(mi.UInt32, block - first, row) + dr.arange(mi.UInt32, count)
    number = _tile_number(block_of_pair, blocks_x)
    # Slots of a splat: from the first pair of its first row to the last of its last.
    start = dr.gather(mi.UInt32, first, first_row, rows > 0)
    end = dr.gather(mi.UInt32, first + columns, first_row + rows - 1, rows > 0)
    for array, value in zip(slots, (start, end), strict=True):
        dr.scatter(array, value, nearest, mode=dr.ReduceMode.NoConflicts)
    pairs = dr.gather(mi.UInt32, owner, row), number, *slots
    dr.eval(pairs)
    return pairs


def _total(counts: Any, most: int, what: str) -> int:
    """Sum of UInt32 counts, each at most `most`, in 64 bits if needed."""
    if len(counts) == 0:
        return 0
    total = int(dr.sum(counts if len(counts) * most < 1 << 32 else mi.UInt64(counts))[0])
    what = f"view: {total:,} pairs of a Gaussian and one of its {what} ({BLOCK_X}x{BLOCK_Y} pixels)"
    remedy = "draw fewer or smaller Gaussians, or a smaller image"
    if total > MAX_PAIRS:
        raise InputError(
            f"{what} may take {total * PAIR_BYTES / 2**30:,.1f} GiB, "
            f"and {MAX_PAIRS:,} are the most; {remedy}"
        )
    check_room(total * PAIR_BYTES, what, remedy)
    return total


def _run_numbers(start: Any, length: Any, count: int) -> Any:
    """The run that each of `count` consecutive numbers belongs to, UInt32 [count]. start, length:
    first number and length of each run, UInt32; a length may be 0."""
    if count == 0:
        return mi.UInt32()
    # Mark the first number of each run with the run's index; a running maximum fills the rest.
    marks = dr.zeros(mi.UInt32, count)
    dr.scatter(
        marks, dr.arange(mi.UInt32, len(start)), start, length > 0, mode=dr.ReduceMode.NoConflicts
    )
    return dr.block_prefix_reduce(dr.ReduceOp.Max, marks, count, exclusive=False)


def _blocks_of_row(
    shapes: Any, splat: Any, offset: Any, first_block: tuple[Any, Any], blocks_x: int
) -> tuple[Any, Any]:
    """Blocks that an ellipse touches in one row of blocks: number of the first (row by row), count.

    shapes: two packets per splat, front to back: (mean_x, mean_y, shear, white_x) and
        (white_y, level, first row, unused).
    splat: index in `shapes`, UInt32. offset: row, counted from the splat's first row, UInt32.
    first_block: as `first` in `_orders`.

    The ellipse counts between the centres of the row's first and last pixels. At height y from the
    splat's centre its right rim is x = k y + sqrt(q - e^2 y^2) / p (letters: docs/notation.md),
    which is concave in y. So in this band it is largest at its own maximum, or at the end of the
    band nearest to that. The left rim is its mirror image."""
    u, v, k, p = dr.gather(mi.Vector4f, shapes, 2 * splat)
    e, q, first_row, _ = dr.gather(mi.Vector4f, shapes, 2 * splat + 1)
    # Band of the row's pixel centres, cut to the ellipse: y from low to high.
    by, half = mi.UInt32(first_row) + offset, dr.sqrt(q) * dr.rcp(e)
    top = mi.Float((by + first_block[1]) * BLOCK_Y) + 0.5 - v
    low, high = dr.maximum(top, -half), dr.minimum(top + (BLOCK_Y - 1), half)
    # x = k y + sqrt(q - e^2 y^2) / p is largest at y = k p sqrt(q) / (e sqrt(e^2 + k^2 p^2)).
    slant = k * p
    summit = slant * half * dr.rsqrt(e * e + slant * slant)

    def rim(side: float) -> Any:
        y = dr.clip(side * summit, low, high)
        return u + k * y + side * dr.sqrt(dr.maximum(dr.fma(-e * y, e * y, q), 0)) / p

    column = mi.Float(first_block[0])
    # Blocks with a pixel centre between the left and the right rim.
    # Column i ends with the pixel centre BLOCK_X (i + 1) - 0.5, which is right of the left rim x
    # for i >= (x + 0.5) / BLOCK_X - 1, and begins with BLOCK_X i + 0.5.
    first = dr.clip(dr.ceil((rim(-1) + 0.5) / BLOCK_X) - 1 - column, 0, blocks_x)
    last = dr.clip(dr.floor((rim(1) - 0.5) / BLOCK_X) + 1 - column, 0, blocks_x)
    columns = mi.UInt32(dr.select(low <= high, dr.maximum(last - first, 0), 0))
    return by * blocks_x + mi.UInt32(first), columns


def _by_block(owner: Any, number: Any, numbers: int) -> tuple[Any, Any, Any, Any]:
    """Sort pairs by block. owner, number: place of each pair's splat, and its block, one of
    `numbers`, UInt32 [M]. Returns, as UInt32: the splat's place of each sorted pair and the sorted
    pair at each slot, [_room(M)] both; first pair and end of each block's pairs [numbers], 0 and 0
    if it has none."""
    count = len(number)
    pair = dr.zeros(mi.UInt32, _room(count))
    start, end = dr.zeros(mi.UInt32, numbers), dr.zeros(mi.UInt32, numbers)
    if count == 0:  # Dr.Jit has no operations on arrays of length 0
        return dr.zeros(mi.UInt32, _room(count)), pair, start, end
    # slot: of each sorted pair. at: its number. Beyond `count` there is only padding.
    slot, at = _permutation(number, numbers), dr.arange(mi.UInt32, _room(count))
    valid, last = at < dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, count - 1)
    slot = dr.gather(mi.UInt32, slot, at, valid)
    dr.scatter(pair, at, slot, valid, mode=dr.ReduceMode.NoConflicts)
    dr.eval(pair)  # three kernels, since one with all random addresses is slower
    splat = dr.gather(mi.UInt32, owner, slot, valid)
    dr.eval(splat)
    number = dr.gather(mi.UInt32, number, slot, valid)
    dr.eval(number)
    # A list starts where the block differs from the pair before, and ends where from the next.
    previous = dr.gather(mi.UInt32, number, dr.maximum(at, 1) - 1)
    following = dr.gather(mi.UInt32, number, dr.minimum(at + 1, last))
    is_first = valid & ((at == 0) | (previous != number))
    is_last = valid & ((at == last) | (following != number))
    dr.scatter(start, at, number, is_first, mode=dr.ReduceMode.NoConflicts)
    dr.scatter(end, at + 1, number, is_last, mode=dr.ReduceMode.NoConflicts)
    return splat, pair, start, end


def _room(pairs: int) -> int:
    """Length of the lists of this many pairs, rounded up by at most an eighth: a kernel is recorded
    for each length."""
    step = max(1024, 1 << max(pairs.bit_length() - 4, 0))
    return -(-max(pairs, 1) // step) * step
