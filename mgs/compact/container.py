"""The file of a compact model: a header, and packets that each improve it.

All numbers are little-endian. Header: `HEAD`; coded integers: axes of the colours [3,3], centres of
the columns by layer [2,C], and codes of the steps [BANDS,C], each less that of the band before;
CRC-32 of all that.

Packets: MARK, `PACKET`, the payload, CRC-32 of both. One that is damaged or lost takes only what it
adds: the reader goes on at the next MARK.
"""

import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mgs.compact.coder import LARGEST, Stream, decoder, encode, integers
from mgs.compact.tree import BANDS, DEPTH
from mgs.errors import InputError
from mgs.files import parsing
from mgs.gaussians import MAX_GAUSSIANS, MAX_SH_DEGREE

MAGIC, MARK, VERSION = b"MGSC", b"\xa7\x5e", 4
MOST_LAYERS = 8
# Magic, version, flags, SH degree, cut of the tree, layers, number of Gaussians, tiles, packets;
# corner of the grid [3], up and origin of the world of the data [3], step of the grid, inset, scale
# of the steps, hash of the prior, bytes of the integers.
HEAD = struct.Struct("<4sBBBBBIHH3d3d3dddd16sH")
PACKET = struct.Struct("<HBBI")  # tile, group, layer, and size of the payload
ANTIALIASED, LINEAR, SHARED = 1, 2, 4  # flags. SHARED: positions follow from the receiver's prior.
# Content of a packet, by its number.
GROUPS = ("position", "colour", "directional", "shape")
# 2^(k/4): steps are coded as exponents, with no power function that differs by machine.
QUARTERS = (1.0, 1.189207115002721, 1.4142135623730951, 1.681792830507429)
ZERO_STEP = 128  # code of a step of 1
AXES, CENTRES = 14, 10  # binary digits of the axes of colours and of the centres
Key = tuple[int, str, int]  # tile, group and layer of a packet


@dataclass(frozen=True)
class Header:
    """Data that all packets need. steps: [BANDS,C] codes, uint8; see `last_steps`. The rest as in
    `HEAD`."""

    flags: int
    degree: int
    cut: int
    layers: int
    n: int
    tiles: int
    packets: int
    low: np.ndarray
    up: np.ndarray
    origin: np.ndarray
    grid: float
    inset: float
    scale: float
    digest: bytes
    colours: np.ndarray
    centres: np.ndarray
    steps: np.ndarray

    def _integers(self) -> list[np.ndarray]:
        """Integers of the tables: colours [9], centres [2C] and differences of steps [BANDS*C]."""
        colours, centres = np.ldexp(self.colours, AXES), np.ldexp(self.centres, CENTRES)
        steps = np.diff(self.steps.astype(np.int64), axis=0, prepend=ZERO_STEP)
        return [np.rint(part).astype(np.int64).ravel() for part in (colours, centres, steps)]

    @property
    def last_steps(self) -> np.ndarray:
        """Steps [BANDS,C] of the last layer."""
        code = self.steps.astype(np.int64) - ZERO_STEP
        return np.asarray(np.ldexp(np.array(QUARTERS)[code % 4], code // 4) * self.scale)

    def __bytes__(self) -> bytes:
        tables = encode(partial(_tables, numbers=self._integers()))
        numbers = self.flags, self.degree, self.cut, self.layers, self.n, self.tiles, self.packets
        reals = *self.low, *self.up, *self.origin, self.grid, self.inset, self.scale
        head = HEAD.pack(MAGIC, VERSION, *numbers, *reals, self.digest, len(tables))
        return _with_sum(head + tables)


def _tables(stream: Stream, numbers: list[np.ndarray]) -> list[np.ndarray]:
    """Code the integers of `Header`; a decoder gets zeros."""
    return [integers(stream, part[:, None], np.zeros((len(part), 1)))[:, 0] for part in numbers]


def fixed(values: np.ndarray, digits: int) -> np.ndarray:
    """Numbers of so many binary digits after the point nearest to values, up to what is coded."""
    return np.ldexp(np.clip(np.rint(np.ldexp(values, digits)), -LARGEST, LARGEST), -digits)


def step_codes(steps: np.ndarray) -> np.ndarray:
    """Codes of steps nearest to these, uint8."""
    code = np.rint(4 * np.log2(steps)) + ZERO_STEP
    return np.clip(code, 0, 255).astype(np.uint8)


def _with_sum(data: bytes) -> bytes:
    return data + zlib.crc32(data).to_bytes(4, "little")


def packet(key: Key, payload: bytes) -> bytes:
    tile, group, layer = key
    return _with_sum(MARK + PACKET.pack(tile, GROUPS.index(group), layer, len(payload)) + payload)


def join(header: Header, packets: Iterable[bytes]) -> bytes:
    return bytes(header) + b"".join(packets)


def split(data: bytes, path: Path) -> tuple[Header, dict[Key, bytes]]:
    """Header and payloads of a file's whole packets, in their order. Raises InputError for another
    format, version or a damaged header. Nothing is allocated by a number of the file before it was
    checked."""
    again = "; send or export it again"
    if data[:4] != MAGIC or len(data) < HEAD.size:
        raise InputError(f"{path}: is no mgs file, or ends within its header{again}")
    _, version, *numbers = HEAD.unpack_from(data)
    flags, degree, cut, layers, n, tiles, packets, *reals, digest, size = numbers
    if version != VERSION:
        other = f"is of version {version}, and this mgs reads {VERSION}"
        raise InputError(f"{path}: {other}; use the mgs that made it")
    if degree > MAX_SH_DEGREE:
        raise InputError(f"{path}: has SH degree {degree}, and {MAX_SH_DEGREE} is the most{again}")
    columns = 3 * (degree + 1) ** 2 + 7
    end = HEAD.size + size
    if len(data) < end + 4 or zlib.crc32(data[:end]) != int.from_bytes(
        data[end : end + 4], "little"
    ):
        raise InputError(f"{path}: its header is damaged or incomplete{again}")
    zeros = [np.zeros(length, np.int64) for length in (9, 2 * columns, BANDS * columns)]
    with parsing(path, "mgs file", "send or export it again"):
        colours, centres, steps = _tables(decoder(data[HEAD.size : end]), zeros)
    steps = ZERO_STEP + np.cumsum(steps.reshape(BANDS, columns), 0)
    up = np.abs(reals[3:6]).max()
    usable = (
        up > 1e-9
        and 0 < n <= MAX_GAUSSIANS
        and 0 < tiles <= n
        and 0 < layers <= MOST_LAYERS
        and 3 <= cut < DEPTH
        and 0 <= steps.min() <= steps.max() < 256
    )
    if not usable or not (np.abs(reals) < 1e15).all() or min(reals[9], reals[11]) <= 0:
        raise InputError(f"{path}: its header has impossible numbers{again}")
    low, up, origin = np.reshape(reals[:9], (3, 3))
    grid, inset, scale = reals[9:]
    header = Header(
        *(flags, degree, cut, layers, n, tiles, packets),
        *(low, up, origin, grid, inset, scale, digest),
        np.ldexp(colours.reshape(3, 3), -AXES),
        np.ldexp(centres.reshape(2, columns), -CENTRES),
        steps.astype(np.uint8),
    )
    return header, _packets(data, end + 4, header)


def _packets(data: bytes, at: int, header: Header) -> dict[Key, bytes]:
    """Payloads of the whole packets from `at` on; the first of each key counts."""
    whole: dict[Key, bytes] = {}
    while (at := data.find(MARK, at)) >= 0 and at + 2 + PACKET.size <= len(data):
        tile, group, layer, size = PACKET.unpack_from(data, at + 2)
        start = at + 2 + PACKET.size
        end = start + size
        said = int.from_bytes(data[end : end + 4], "little")
        if end + 4 > len(data) or zlib.crc32(data[at:end]) != said:
            at += 1
            continue
        if tile <= header.tiles and group < len(GROUPS) and layer < header.layers:
            whole.setdefault((tile, GROUPS[group], layer), data[start:end])
        at = end + 4
    return whole
