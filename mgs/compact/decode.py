"""Read a compact model: `read_compact`. The same bytes give the same numbers on every machine."""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mgs.compact.coder import FINER, decoder, flag, integers
from mgs.compact.columns import Start, gaussians_of, groups, start_of
from mgs.compact.container import ANTIALIASED, LINEAR, SHARED, Header, Key, split
from mgs.compact.tree import DEPTH, Tree, cells_of, code_descendants, codes_of, tree_of
from mgs.data.world import Vector, World, unit_up
from mgs.errors import InputError, Notice
from mgs.files import parsing, read_bytes
from mgs.gaussians import Gaussians
from mgs.memory import check_room
from mgs.splat_places import to_source

if TYPE_CHECKING:
    from mgs.prior.build import Prior

MOST_BYTES = 1 << 28  # most bytes of a file
CELL_BYTES = 200  # memory of a Gaussian while it is decoded, for each column, bytes
CELLS_OF_BYTE = 64  # most cells that a byte of a packet places: a file of few bytes never has many
MIDDLE = 0.4  # place of a value in the interval that the layers so far leave: small ones are many
IDENTITY = np.array([[1.0, 0, 0, 0]])


def read_compact(path: Path, prior: "Prior | None" = None) -> Gaussians:
    """Read Gaussians from a file of the format mgs, in the world of the data; an incomplete file
    gives what it has, with a Notice. prior: where the file leaves positions to it. Raises
    InputError if the file is damaged at its start, needs a prior, or was made with another one."""
    header, packets = split(read_bytes(path, "file", MOST_BYTES), path)
    if losses := header.packets - len(packets):
        notice = (
            f"{path}: {losses} of {header.packets} packets are missing or damaged; the rest is read"
        )
        warnings.warn(notice, Notice, stacklevel=3)
    start = None
    if header.flags & SHARED:
        if prior is None:
            raise InputError(f"{path}: has no positions; give the prior it was made with, `prior`")
        start = start_of(prior, header.inset)
        if start.digest != header.digest or len(start.means) < header.n:
            raise InputError(f"{path}: was made with another prior; give that one")
    whole = start is not None and len(start.means) == header.n
    if not whole and (0, "position", 0) not in packets:
        raise InputError(f"{path}: has lost the packet that places its Gaussians; send it again")
    columns = header.centres.shape[1]
    most = sum(
        _most(header, data) for (_, group, _), data in packets.items() if group == "position"
    )
    check_room(
        (len(start.means) if start else min(most, header.n)) * columns * CELL_BYTES,
        f"{path}: decoding it",
        "give a smaller file",
    )
    with parsing(path, "mgs file", "send or export it again"):
        g = to_source(decoded(header, packets, start), World(unit_up(header.up)))
    x, y, z = header.origin.tolist()
    return replace(g, origin=(x, y, z))


def up_of_compact(path: Path) -> Vector:
    """Upward direction of a file's world. Raises InputError as `read_compact`."""
    return unit_up(split(read_bytes(path, "file", MOST_BYTES), path)[0].up)


def decoded(header: Header, packets: Mapping[Key, bytes], start: Start | None) -> Gaussians:
    """Gaussians of packets, in the upright world. Raises ValueError for what no encoder writes."""
    if start is None:
        codes, wider = _positions(header, packets)
        cells, layer = cells_of(codes)
        means, quats = header.low + (cells + 0.5) * header.grid, IDENTITY
        order = np.arange(len(codes))
    else:
        order, among = codes_of(grid_cells(start.means, header.low, header.grid), start.layer)
        whole = len(among) == header.n
        codes, wider = (among, np.zeros(1)) if whole else _positions(header, packets, among)
        order = order[np.searchsorted(among, codes)]
        means, quats, layer = start.means[order], start.quats[order], start.layer[order]
    tree = tree_of(codes, header.cut, header.tiles)
    columns = tree.inverse(_coefficients(header, packets, tree)) + header.centres[layer]
    columns[:, [-7, -5]] += wider[:, None]  # on the diagonal of the shape
    g = gaussians_of(columns, means, quats, header.colours)[np.argsort(order)]
    antialiased, linear = bool(header.flags & ANTIALIASED), bool(header.flags & LINEAR)
    return replace(g, antialiased=antialiased, linear=linear)


def grid_cells(means: np.ndarray, low: np.ndarray, grid: float) -> np.ndarray:
    """Cells [N,3] of positions [N,3]."""
    return np.clip(np.floor((means - low) / grid), 0, (1 << (DEPTH // 3)) - 1).astype(np.int64)


def _positions(
    header: Header, packets: Mapping[Key, bytes], among: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Codes of the cells [N], and by how much their log-scales grow [N]: where the packet of a tile
    is missing, one Gaussian stands for all of a node. among: as in `code_descendants`."""
    cut, tiles = header.cut, header.tiles
    data = packets[0, "position", 0]
    root = np.zeros(1, np.int64)
    above = None if among is None else np.unique(among >> cut)
    top = code_descendants(decoder(data), root, DEPTH - cut, _most(header, data), among=above)
    tile = 1 + np.arange(len(top)) * tiles // len(top)
    codes, lone, left = [], [], header.n
    for number in range(1, tiles + 1):
        nodes = top[tile == number]
        data = packets.get((number, "position", 0), b"")
        if data:
            part = code_descendants(decoder(data), nodes, cut, _most(header, data), among=among)
        else:
            part = lone_cells(nodes, cut, among)
        if (left := left - len(part)) < 0:
            raise ValueError("it has more Gaussians than its header says")
        codes.append(part)
        lone.append(np.full(len(part), not data))
    # Sizes grow by the fourth root of the cells of a node, n / M, in steps of 1/64. With the root,
    # by which areas add up, the demo's boulder is 3 dB worse after 10 kB.
    wider = np.rint(16 * np.log(max(header.n / len(top), 1))) / 64
    return np.concatenate(codes), wider * np.concatenate(lone)


def lone_cells(nodes: np.ndarray, cut: int, among: np.ndarray | None = None) -> np.ndarray:
    """Codes of the cells in the middle of nodes, where one Gaussian stands for all of a node.
    among: as in `code_descendants`."""
    if among is None:
        return (nodes << cut) | (7 << (cut - 3))
    first, end = np.searchsorted(among, [nodes << cut, (nodes + 1) << cut])
    return np.asarray(among[(first + end) // 2])


def _most(header: Header, data: bytes) -> int:
    """Most cells that a packet of positions can hold."""
    return header.n if header.flags & SHARED else min(CELLS_OF_BYTE * (len(data) + 8), header.n)


def _coefficients(header: Header, packets: Mapping[Key, bytes], tree: Tree) -> np.ndarray:
    """Coefficients [N,C] that the packets give; 0 where there is none. A layer whose predecessor is
    missing gives nothing."""
    table = np.zeros((len(tree.band), header.centres.shape[1]))
    of = groups((header.degree + 1) ** 2)
    whole = dict[tuple[int, str], tuple[int, np.ndarray]]()  # last layer and its numbers
    for tile, group, layer in sorted(packets):
        rows = rows_of(tree, tile)
        if group == "position" or not len(rows):
            continue
        zeros = np.zeros(table[rows, of[group]].shape, np.int64)
        last, before = whole.get((tile, group), (-1, zeros))
        stream = decoder(packets[tile, group, layer])
        if flag(stream, False):
            before = zeros
        elif last != layer - 1:
            continue
        whole[tile, group] = layer, integers(stream, zeros, before)
    for (tile, group), (layer, numbers) in whole.items():
        rows = rows_of(tree, tile)
        step = header.last_steps[tree.band[rows], of[group]]
        table[rows, of[group]] = step * restored(numbers, header.layers - 1 - layer)
    return table


def restored(numbers: np.ndarray, later: int) -> np.ndarray:
    """Values of whole numbers [n,C] in steps of the last layer. later: number of layers that are
    yet to come."""
    scale = float(FINER**later)
    magnitudes = np.abs(numbers) * scale + MIDDLE * (scale - 1)
    return np.asarray(np.sign(numbers) * magnitudes)


def rows_of(tree: Tree, tile: int) -> np.ndarray:
    """Coefficients of a tile, those of large nodes first."""
    return np.flatnonzero(tree.tile == tile)[::-1]
