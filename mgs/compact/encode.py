"""Write a compact model: `Encoder`."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from mgs.compact import allocate
from mgs.compact.coder import LARGEST, encode, integers
from mgs.compact.columns import Start, colour_axes, columns_of, gaussians_of, gradient_of, groups
from mgs.compact.container import ANTIALIASED, LINEAR, SHARED, Header, Key, join, packet, step_codes
from mgs.compact.decode import IDENTITY, decoded, grid_cells, lone_cells, rows_of
from mgs.compact.tree import AXIS_BITS, DEPTH, Tree, cells_of, code_descendants, codes_of, tree_of
from mgs.data.world import PLUS_Z, Vector
from mgs.gaussians import Gaussians

LAYERS = 3  # layers of a file; the first has steps 16 times those of the last
TILE = 8000  # Gaussians of a tile
# Where positions are sent, a node stands for its cells in the first packets; elsewhere it has 8
# times as many, which takes 3 % fewer bytes.
TOP = 3  # fewest cells of a node at the cut, in the mean
WIDEST = 0.6  # largest step of positions over neighbours' median distance, who would share a cell

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
    positions are sent. layer: [N] 0 or 1, sets of Gaussians of different kinds, by default that of
    the start. up, origin: of the world of the data (`mgs.data.world.World`); g is upright.
    """

    def __init__(
        self,
        g: Gaussians,
        gradients: Gradients,
        start: Start | None = None,
        layer: np.ndarray | None = None,
        up: Vector = PLUS_Z,
        origin: Vector = (0.0, 0.0, 0.0),
    ) -> None:
        self.world = np.array(up), np.array(origin)
        self.g, self.start = g, start
        self.quats = start.quats if start else np.repeat(IDENTITY, len(g), axis=0)
        self.means = start.means if start else g.means.astype(np.float64)
        layer = np.zeros(len(g), np.int64) if layer is None else layer
        self.layer = start.layer if start else layer
        near = cKDTree(self.means).query(self.means, min(2, len(g)))[0].max(axis=-1)
        self.spacing = float(np.median(near)) or 1.0
        self.low = self.means.min(0)
        rough = codes_of(
            grid_cells(self.means, self.low, np.ptp(self.means, 0).max() / 1e6), self.layer
        )
        self.axes = colour_axes(g.sh[rough[0]])
        columns = columns_of(g, self.quats, self.axes)
        # Reading cuts to ranges, so the gradients are those of what is read.
        model = gaussians_of(columns, self.means, self.quats, self.axes)
        model = replace(model, antialiased=g.antialiased, linear=g.linear)
        each = [
            (gradient_of(columns, self.quats, self.axes, by), by["means"])
            for by in gradients(model)
        ]
        self.columns, self.gradients = columns, np.stack([columns for columns, _ in each])
        self.of_means = float(np.square([means for _, means in each]).sum(0).mean())

    def file(self, scale: float) -> Compact:
        """The file whose last layer rounds each coefficient at an expected cost of scale^2 / 12,
        (pixel value)^2."""
        extent = float(np.ptp(self.means, 0).max())
        grid = scale / np.sqrt(self.of_means + 1e-30) if self.start is None else 0.0
        grid = float(np.clip(grid, self.spacing / 8, self.spacing * WIDEST))
        grid = max(grid, 2 * extent / 2**AXIS_BITS)
        order, codes = codes_of(grid_cells(self.means, self.low, grid), self.layer)
        least = TOP if self.start is None else 8 * TOP
        depths = [d for d in range(3, DEPTH, 3) if len(np.unique(codes >> d)) * least < len(codes)]
        cut = depths[0] if depths else 3
        top = np.unique(codes >> cut)
        tiles = int(np.clip(len(codes) // TILE, 1, min(len(top), 0xFFFF)))
        tree = tree_of(codes, cut, tiles)
        layer = self.layer[order]
        columns = self.columns[order]
        centres = np.zeros((2, columns.shape[1]))
        for number in np.unique(layer):
            centres[number] = columns[layer == number].mean(0)
        centres = centres.astype(np.float32).astype(np.float64)
        values = tree.forward(columns - centres[layer])
        slopes = np.stack([tree.forward(one[order], adjoint=True) for one in self.gradients])
        h = allocate.sensitivity(slopes, tree.band) * allocate.coherence(self.g.sh.shape[1])
        start, g = self.start, self.g
        flags = ANTIALIASED * g.antialiased + LINEAR * g.linear + SHARED * bool(start)
        header = Header(
            *(flags, self.g.sh_degree, cut, LAYERS, len(codes), tiles, 0),
            *(self.low, *self.world, grid, start.inset if start else 0.0, scale),
            *(start.digest if start else bytes(16), self.axes, centres, step_codes(1 / np.sqrt(h))),
        )
        return self._packed(header, codes, tree, values, h)

    def _packed(
        self, header: Header, codes: np.ndarray, tree: Tree, values: np.ndarray, h: np.ndarray
    ) -> Compact:
        """File of coefficients [N,C]. codes: of all cells, in order. h: [BANDS,C]."""
        steps = header.step(header.layers - 1)[tree.band]
        parts = allocate.rounded(values, steps, header.layers)
        parts = [np.clip(part, -LARGEST, LARGEST) for part in parts]
        gains = allocate.gain(values, parts, steps, h[tree.band])
        payloads, worth = dict[Key, bytes](), dict[Key, float]()
        if self.start is None:
            payloads, moves = _positions(header, codes)
            # What stands for a part lies elsewhere: its error, as far as that is linear.
            worth = {key: self.of_means * move for key, move in moves.items()}
        for tile in range(header.tiles + 1):
            rows = rows_of(tree, tile)
            for group, of in groups(self.g.sh.shape[1]).items():
                for layer, part in enumerate(parts):
                    numbers = part[rows, of]
                    if numbers.any():
                        key = tile, group, layer
                        payloads[key] = encode(partial(integers, values=numbers))
                        worth[key] = float(gains[layer][rows, of].sum())
        sizes = {key: len(data) + 13 for key, data in payloads.items()}
        keys = allocate.in_order(worth, sizes)
        header = replace(header, packets=len(keys))
        expected = float((h[tree.band] * np.square(values)).sum() - gains.sum())
        if self.start is None:
            expected += self.of_means * header.grid**2 / 12 * 3 * len(codes)
        return Compact(header, {key: payloads[key] for key in keys}, self.start, expected)


def _positions(header: Header, codes: np.ndarray) -> tuple[dict[Key, bytes], dict[Key, float]]:
    """Packets of the cells: of the nodes at the cut, and of each tile below; and by how much the
    latter move Gaussians, sums of squares, m^2."""
    top, node = np.unique(codes >> header.cut, return_inverse=True)
    tile = 1 + np.arange(len(top)) * header.tiles // len(top)
    between = cells_of(codes)[0] - cells_of(lone_cells(top, header.cut))[0][node]
    move = np.square(between * header.grid).sum(1)

    def coded(nodes: np.ndarray, depth: int, below: np.ndarray) -> bytes:
        return encode(lambda stream: code_descendants(stream, nodes, depth, len(below), below))

    payloads = {(0, "position", 0): coded(np.zeros(1, np.int64), DEPTH - header.cut, top)}
    moves: dict[Key, float] = {}
    for number in range(1, header.tiles + 1):
        key, inside = (number, "position", 0), tile[node] == number
        payloads[key] = coded(top[tile == number], header.cut, codes[inside])
        moves[key] = float(move[inside].sum())
    return payloads, moves
