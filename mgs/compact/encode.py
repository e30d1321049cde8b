"""Write a compact model: `Encoder`."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from mgs.compact import allocate
from mgs.compact.coder import FINER, Stream, encode, flag, integers
from mgs.compact.columns import Start, colour_axes, columns_of, gaussians_of, gradient_of, groups
from mgs.compact.container import (
    ANTIALIASED,
    AXES,
    CENTRES,
    GROUPS,
    LINEAR,
    MOST_LAYERS,
    SHARED,
    Header,
    Key,
    fixed,
    join,
    packet,
    step_codes,
)
from mgs.compact.decode import IDENTITY, decoded, grid_cells, lone_cells, restored, rows_of
from mgs.compact.tree import AXIS_BITS, DEPTH, Tree, cells_of, code_descendants, codes_of, tree_of
from mgs.data.world import PLUS_Z, Vector
from mgs.gaussians import Gaussians

COARSEST = 0.16  # scale of the steps of a first layer, about
TILE = 2500  # Gaussians of a tile: a packet of their positions has 5 kB
# Where positions are sent, a node stands for its cells in the first packets; elsewhere it has 8
# times as many, which takes 3 % fewer bytes.
TOP = 3  # fewest cells of a node at the cut, in the mean
FINEST = 1 / 16  # smallest step of positions over neighbours' median distance
WIDEST = 0.6  # largest one; neighbours would share a cell of a larger one

Gradients = Callable[[Gaussians], Iterator[Mapping[str, np.ndarray]]]
"""Gradients of sum(z image) by the fields of a model, of some views, z independent signs."""


@dataclass(frozen=True)
class Compact:
    """A file and what it was made of. expected: squared change of the images, (pixel value)^2."""

    header: Header
    payloads: dict[Key, bytes]
    start: Start | None
    expected: float

    def __bytes__(self) -> bytes:
        return join(self.header, [packet(key, data) for key, data in self.payloads.items()])

    def __len__(self) -> int:
        return len(bytes(self))

    @property
    def model(self) -> Gaussians:
        """The model that a reader gets, in the upright world."""
        return decoded(self.header, self.payloads, self.start)

    def first(self, most: int) -> "Compact":
        """The first packets, up to so many bytes in all."""
        ends = np.cumsum([len(packet(key, data)) for key, data in self.payloads.items()])
        count = int((len(bytes(self.header)) + ends <= most).sum())
        payloads = dict(list(self.payloads.items())[:count])
        return replace(self, header=replace(self.header, packets=count), payloads=payloads)


class Encoder:
    """Files of one model at any size.

    g: NumPy fields. gradients: called once with the model. start: of the receiver's prior; None:
    positions are sent. kept: [N] indices of the Gaussians in the start, increasing; None: all.
    layer: [N] 0 or 1, sets of Gaussians of different kinds, where positions are sent. up, origin:
    of the world of the data (`mgs.data.world.World`); g is upright. placed: header of
    the file that g was read from, whose positions it keeps.
    """

    def __init__(
        self,
        g: Gaussians,
        gradients: Gradients,
        start: Start | None = None,
        kept: np.ndarray | None = None,
        layer: np.ndarray | None = None,
        up: Vector = PLUS_Z,
        origin: Vector = (0.0, 0.0, 0.0),
        placed: Header | None = None,
    ) -> None:
        self.world, self.placed = (np.array(up), np.array(origin)), placed
        self.g, self.start = g, start
        self.kept = np.arange(len(g)) if kept is None else kept
        if start is None:
            layer = np.zeros(len(g), np.int64) if layer is None else layer
            quats = np.repeat(IDENTITY, len(g), axis=0)
            start = Start(g.means.astype(np.float64), quats, layer, bytes(16), 0.0)
        self.places = start
        near = cKDTree(start.means).query(start.means, min(2, len(start.means)))[0].max(axis=-1)
        self.spacing = float(np.median(near)) or float(np.exp(g.log_scales).mean())
        self.low = placed.low if placed else start.means.min(0)
        self.extent = float(np.ptp(start.means, 0).max()) or self.spacing
        self.axes = fixed(colour_axes(g.sh[self._codes(self.extent / 1e6)[0]]), AXES)
        quats = start.quats[self.kept]
        columns = columns_of(g, quats, self.axes)
        # Reading cuts to ranges, so the gradients are those of what is read.
        model = gaussians_of(columns, start.means[self.kept], quats, self.axes)
        model = replace(model, antialiased=g.antialiased, linear=g.linear)
        each = [(gradient_of(model, quats, self.axes, by), by["means"]) for by in gradients(model)]
        self.columns, self.gradients = columns, np.stack([columns for columns, _ in each], axis=1)
        self.of_means = float(np.square([means for _, means in each]).sum(0).mean())

    def _codes(self, grid: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Order of the Gaussians by code, their codes in it, and the codes of the whole start."""
        cells = grid_cells(self.places.means, self.low, grid)
        order, among = codes_of(cells, self.places.layer)
        mine = np.isin(order, self.kept)
        return np.searchsorted(self.kept, order[mine]), among[mine], among

    def file(self, scale: float) -> Compact:
        """The file whose last layer rounds each coefficient at an expected cost of scale^2 / 12,
        (pixel value)^2."""
        plan = self.plan(scale)
        return plan.file(plan.values)

    def plan(self, scale: float) -> "Plan":
        """Everything about a file of this scale but its whole numbers."""
        grid = scale / np.sqrt(self.of_means + 1e-30) if self.start is None else 0.0
        grid = float(np.clip(grid, self.spacing * FINEST, self.spacing * WIDEST))
        grid = max(grid, 2 * self.extent / 2**AXIS_BITS)
        grid = self.placed.grid if self.placed else grid
        order, codes, among = self._codes(grid)
        least = 8 * TOP if self.start and len(codes) == len(among) else TOP
        depths = [d for d in range(3, DEPTH, 3) if len(np.unique(codes >> d)) * least < len(codes)]
        cut = depths[0] if depths else 3
        top = np.unique(codes >> cut)
        layers = 1 + round(np.log(COARSEST / scale) / np.log(FINER))
        layers = int(np.clip(layers, 1, MOST_LAYERS))
        most = 0xFFFF // (len(GROUPS) * layers) - 1  # 16 bits of the header count the packets
        tiles = int(np.clip(len(codes) // TILE, 1, min(len(top), most)))
        tree = tree_of(codes, cut, tiles)
        layer = self.places.layer[self.kept][order]
        columns = self.columns[order]
        centres = np.zeros((2, columns.shape[1]))
        for number in np.unique(layer):
            centres[number] = columns[layer == number].mean(0)
        centres = fixed(centres, CENTRES)
        slopes = tree.forward(self.gradients[order].reshape(len(order), -1), adjoint=True)
        h = allocate.sensitivity(slopes.reshape(self.gradients.shape).swapaxes(0, 1), tree.band)
        start, g = self.places, self.g
        flags = ANTIALIASED * g.antialiased + LINEAR * g.linear + SHARED * bool(self.start)
        header = Header(
            *(flags, self.g.sh_degree, cut, layers, len(codes), tiles, 0),
            *(self.low, *self.world, grid, start.inset, scale),
            *(start.digest, self.axes, centres, step_codes(1 / np.sqrt(h))),
        )
        payloads, moves = dict[Key, bytes](), dict[Key, float]()
        if not self.start or len(codes) < len(among):
            payloads, moves = _positions(header, codes, among if self.start else None)
        # What stands for a part lies elsewhere: its error, as far as that is linear.
        worth = {key: self.of_means * move for key, move in moves.items()}
        means = start.means[self.kept]
        if self.start is None:  # those of the file
            means = (self.low + (cells_of(codes)[0] + 0.5) * grid)[np.argsort(order)]
        return Plan(self, header, payloads, worth, tree, order, means, h)


@dataclass(frozen=True)
class Plan:
    """Positions, tree and steps of a file, and what its coefficients [N,C] mean.

    payloads, worth: of positions. order: [N] of the encoder's Gaussians along the tree. means:
    [N,3] of the encoder's Gaussians, as a reader gets them. h: as in
    `mgs.compact.allocate.sensitivity`."""

    encoder: Encoder
    header: Header
    payloads: dict[Key, bytes]
    worth: dict[Key, float]
    tree: Tree
    order: np.ndarray
    means: np.ndarray
    h: np.ndarray

    @property
    def _quats(self) -> np.ndarray:
        """Axes [N,4] of the columns of the encoder's Gaussians."""
        return self.encoder.places.quats[self.encoder.kept]

    @property
    def _centres(self) -> np.ndarray:
        """Centres [N,C] of their columns."""
        return self.header.centres[self.encoder.places.layer[self.encoder.kept]]

    @property
    def values(self) -> np.ndarray:
        """Coefficients of the encoder's model."""
        return self.tree.forward((self.encoder.columns - self._centres)[self.order])

    def values_of(self, g: Gaussians) -> np.ndarray:
        """Coefficients of other values of the encoder's Gaussians."""
        columns = columns_of(g, self._quats, self.encoder.axes)
        return self.tree.forward((columns - self._centres)[self.order])

    def model(self, values: np.ndarray) -> Gaussians:
        """Model of coefficients, in the encoder's order. A reader gets that of `whole` ones."""
        columns = self.tree.inverse(values)[np.argsort(self.order)] + self._centres
        g = gaussians_of(columns, self.means, self._quats, self.encoder.axes)
        return replace(g, antialiased=self.encoder.g.antialiased, linear=self.encoder.g.linear)

    def whole(self, values: np.ndarray) -> np.ndarray:
        """Coefficients as a reader gets them."""
        steps = self.header.last_steps[self.tree.band]
        return steps * allocate.rounded(values, steps, 1)[0]

    def file(self, values: np.ndarray) -> Compact:
        header, tree, h = self.header, self.tree, self.h[self.tree.band]
        payloads, worth = dict(self.payloads), dict(self.worth)
        steps = header.last_steps[tree.band]
        parts = allocate.rounded(values, steps, header.layers)
        shown = [steps * restored(part, header.layers - 1 - k) for k, part in enumerate(parts)]
        gains = allocate.gain(values, shown, h)
        parts = [np.zeros_like(parts[0]), *parts]
        for tile in range(header.tiles + 1):
            rows = rows_of(tree, tile)
            for group, of in groups(self.encoder.g.sh.shape[1]).items():
                for layer, pair in enumerate(pairwise(parts)):
                    before, numbers = (part[rows, of] for part in pair)
                    if numbers.any():
                        key = tile, group, layer
                        payloads[key] = _numbers(numbers, before)
                        worth[key] = float(gains[layer][rows, of].sum())
        sizes = {key: len(packet(key, data)) for key, data in payloads.items()}
        keys = allocate.in_order(worth, sizes)
        header, start = replace(header, packets=len(keys)), self.encoder.start
        expected = float((h * np.square(values)).sum() - gains.sum())
        if start is None:
            expected += self.encoder.of_means * header.grid**2 / 12 * 3 * header.n
        return Compact(header, {key: payloads[key] for key in keys}, start, expected)


def _numbers(numbers: np.ndarray, before: np.ndarray) -> bytes:
    """Payload of whole numbers [n,C]. before: those of the layer before."""

    def write(stream: Stream) -> None:
        flag(stream, not before.any())
        integers(stream, numbers, before)

    return encode(write)


def _positions(
    header: Header, codes: np.ndarray, among: np.ndarray | None
) -> tuple[dict[Key, bytes], dict[Key, float]]:
    """Packets of the cells: of the nodes at the cut, and of each tile below; and by how much the
    latter move Gaussians, sums of squares, m^2. among: as in `code_descendants`."""
    top, node = np.unique(codes >> header.cut, return_inverse=True)
    tile = 1 + np.arange(len(top)) * header.tiles // len(top)
    between = cells_of(codes)[0] - cells_of(lone_cells(top, header.cut, among))[0][node]
    move = np.square(between * header.grid).sum(1)

    def coded(nodes: np.ndarray, depth: int, below: np.ndarray, among: np.ndarray | None) -> bytes:
        return encode(
            lambda stream: code_descendants(stream, nodes, depth, len(below), below, among)
        )

    above = None if among is None else np.unique(among >> header.cut)
    payloads = {(0, "position", 0): coded(np.zeros(1, np.int64), DEPTH - header.cut, top, above)}
    moves: dict[Key, float] = {}
    for number in range(1, header.tiles + 1):
        key, inside = (number, "position", 0), tile[node] == number
        payloads[key] = coded(top[tile == number], header.cut, codes[inside], among)
        moves[key] = float(move[inside].sum())
    return payloads, moves
