"""A binary tree of cells in space by Morton codes, and RAHT along it (de Queiroz and Chou 2016):
two children become their weighted sum, which goes on to the parent, and difference, a coefficient.
Only +, *, / and sqrt of float64, element by element, which IEEE 754 defines to the last bit."""

from dataclasses import dataclass

import numpy as np

from mgs.compact.coder import Stream, adaptive

AXIS_BITS = 20  # bits of a cell's index along an axis
DEPTH = 3 * AXIS_BITS + 1  # bits of a code: those of three axes, and a leading one for the layer
MANY = 4  # cells below a node that count as many, in the contexts of `code_descendants`
ON_SIDE, BESIDE = 3, 4  # neighbours of a node that count as many there, on a side and beside it
AXES = tuple(sum(1 << (3 * bit + axis) for bit in range(AXIS_BITS)) for axis in range(3))
BANDS = 12  # kinds of coefficients by the size of their node, each twice as large; then the rest


def codes_of(cells: np.ndarray, layer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order [N] of cells [N,3] by code, and their codes in it, uint64, strictly increasing. layer:
    [N] 0 or 1. Of equal codes all but the first are raised, which moves a Gaussian to a
    neighbouring cell."""
    code = layer.astype(np.int64) << (DEPTH - 1)
    for bit in range(AXIS_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    order = np.argsort(code, kind="stable")
    rank = np.arange(len(code))
    return order, np.maximum.accumulate(code[order] - rank) + rank


def cells_of(codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells [N,3] and layers [N] of codes, the inverse of `codes_of`."""
    cells = np.zeros((len(codes), 3), np.int64)
    for bit in range(AXIS_BITS):
        for axis in range(3):
            cells[:, axis] |= ((codes >> (3 * bit + axis)) & 1) << bit
    return cells, codes >> (DEPTH - 1)


def code_descendants(
    stream: Stream,
    nodes: np.ndarray,
    depth: int,
    most: int,
    codes: np.ndarray | None = None,
    among: np.ndarray | None = None,
) -> np.ndarray:
    """Code which descendants nodes [M] have `depth` levels below; returns their codes. codes:
    these, to be written; None: they are read. Each node has a left child, a right one, or both.
    among: sorted codes of the cells that can be there; None: all. Raises ValueError if more than
    `most` are read."""
    # Context of a node: its neighbours; where it is known what can be there, whether its parent
    # forked, and how many cells each child can have, up to MANY. Counts of the kinds by context.
    counts = np.ones((max((ON_SIDE + 1) ** 2 * (BESIDE + 1), 2 * MANY**2), 3))
    forked = np.zeros(len(nodes), np.int64)
    for shift in range(depth - 1, -1, -1):
        pairs = np.column_stack([2 * nodes, 2 * nodes + 1])
        kinds, turned = np.zeros(len(nodes), np.int64), np.zeros(len(nodes), bool)
        if among is None:
            context, turned = _surroundings(nodes, shift + 1)
        else:  # children without a cell need no code
            ends = np.searchsorted(among, np.column_stack([pairs, pairs[:, 1] + 1]) << shift)
            left, right = np.minimum(np.diff(ends), MANY).T
            kinds = np.where(left == 0, 1, 0)
            context = forked + 2 * (MANY * (left - 1) + right - 1)
            context[(left == 0) | (right == 0)] = -1  # nothing to code
        if codes is not None:
            left, right = _found(codes >> shift, pairs)[0].T
            kinds = _mirrored(left + 2 * right - 1, turned)
        for number in np.unique(context[context >= 0]):
            rows = np.flatnonzero(context == number)
            kinds[rows] = adaptive(stream, kinds[rows], counts[number])
        kinds = _mirrored(kinds, turned)
        there = np.column_stack([kinds != 1, kinds != 0])
        nodes, forked = pairs[there], np.repeat(kinds == 2, 1 + (kinds == 2)).astype(np.int64)
        if len(nodes) > most:
            raise ValueError(f"more than {most} cells")
    return nodes


def _mirrored(kinds: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Kinds of nodes, 0: left child, 1: right child, 2: both; where `turned`, 0 and 1 exchanged."""
    return np.where(turned & (kinds < 2), 1 - kinds, kinds)


def _found(nodes: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether each of `wanted` is among sorted nodes, and its place where it is."""
    place = np.minimum(np.searchsorted(nodes, wanted), len(nodes) - 1)
    return nodes[place] == wanted, place


def _surroundings(nodes: np.ndarray, shift: int) -> tuple[np.ndarray, np.ndarray]:
    """Context [M] of sorted nodes that are `shift` levels above the cells, and whether its two
    sides, left and right along the axis that divides the node, are exchanged.

    A context counts the neighbours across a face or an edge on the side that has more, on the
    other, and those beside the node."""
    left, right, beside = np.zeros((3, len(nodes)), np.int64)
    if shift == DEPTH:  # what divides it is no axis but the layer
        return left, left > right
    axis, *across = (shift - 1) % 3, (shift + 1) % 3, shift % 3
    cells = nodes << shift

    def moved(cells: np.ndarray, axis: int, steps: int) -> np.ndarray:
        """Cells of the neighbours along an axis, -1 where there is none."""
        mask, unit = AXES[axis], 1 << (3 * ((shift + 2 - axis) // 3) + axis)
        along = cells & mask
        there = ((along | ~mask) + unit if steps > 0 else along - unit) & mask
        inside = (cells >= 0) & ((there > along) == (steps > 0)) & (there != along)
        return np.where(inside, (cells & ~mask) | there, -1)

    ahead = moved(cells, axis, 1)
    aslant = [moved(ahead, other, steps) for other in across for steps in (-1, 1)]
    for neighbour in (ahead, *aslant):
        found, place = _found(nodes, neighbour >> shift)
        right += found
        left[place[found]] += 1
    for other in across:
        found, place = _found(nodes, moved(cells, other, 1) >> shift)
        beside += found
        beside[place[found]] += 1
    more, fewer = np.maximum(left, right), np.minimum(left, right)
    sides = np.minimum(more, ON_SIDE) * (ON_SIDE + 1) + np.minimum(fewer, ON_SIDE)
    return sides * (BESIDE + 1) + np.minimum(beside, BESIDE), right > left


@dataclass(frozen=True)
class Tree:
    """Tree of N cells, and how their values are transformed. merges: for each level, from cells to
    the root, the places of the left ones of its pairs of children, and the weights of both."""

    merges: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    cut: int  # level at which a node's sum becomes its mean, where its cells are unknown
    counts: np.ndarray  # cells of each node there
    band: np.ndarray  # [N] of each coefficient, 0 to BANDS - 1
    tile: np.ndarray  # [N] 0 above the cut, else the tile of the node there, from 1

    def forward(self, values: np.ndarray, adjoint: bool = False) -> np.ndarray:
        """Coefficients [N,C] of values [N,C]. adjoint: those of a gradient by the values, which is
        a gradient by the coefficients."""
        parts = []
        for level, (left, a, b) in enumerate(self.merges):
            if level == self.cut:
                root = np.sqrt(self.counts)[:, None]
                values = values * root if adjoint else values / root
            first, second = values[left], values[left + 1]
            parts.append(a * second - b * first)
            values = np.delete(values, left + 1, axis=0)
            values[left - np.arange(len(left))] = a * first + b * second
        return np.concatenate([*parts, values])

    def inverse(self, coefficients: np.ndarray) -> np.ndarray:
        """Values [N,C] of coefficients [N,C]."""
        values, end = coefficients[-1:], len(coefficients) - 1
        for level in range(len(self.merges) - 1, -1, -1):
            left, a, b = self.merges[level]
            part = coefficients[end - len(left) : end]
            place = left - np.arange(len(left))
            low = values[place]
            values = np.insert(values, place + 1, b * low + a * part, axis=0)
            values[left] = a * low - b * part
            if level == self.cut:
                values = values * np.sqrt(self.counts)[:, None]
            end -= len(left)
        return values


def tree_of(codes: np.ndarray, cut: int, tiles: int) -> Tree:
    """Tree of sorted codes [N], with its nodes `cut` levels above the cells in this many tiles."""
    nodes, weight, counts = codes, np.ones(len(codes)), np.ones(1)
    top = np.unique(codes >> cut)
    merges, bands, of_tile = [], [], []
    for level in range(DEPTH):
        if level == cut:
            counts, weight = weight, np.ones(len(nodes))
        parents = nodes >> 1
        left = np.flatnonzero(parents[1:] == parents[:-1])
        first, second = weight[left, None], weight[left + 1, None]
        total = first + second
        merges.append((left, np.sqrt(first / total), np.sqrt(second / total)))
        bands.append(np.full(len(left), min(level // 3, BANDS - 1)))
        place = np.searchsorted(top, nodes[left] >> max(cut - level, 0)) if level < cut else left
        of_tile.append(1 + place * tiles // len(top) if level < cut else np.zeros(len(left)))
        weight[left] += weight[left + 1]
        weight, nodes = np.delete(weight, left + 1), np.delete(parents, left + 1)
    band = np.concatenate([*bands, [BANDS - 1]]).astype(np.int64)
    return Tree(merges, cut, counts, band, np.concatenate([*of_tile, [0]]).astype(np.int64))
