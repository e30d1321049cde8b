"""Gaussians as PLY files: the layout of 3DGS, and the compressed one of SuperSplat and PlayCanvas.

The layout of 3DGS has one vertex per Gaussian: x y z; nx ny nz (zero); f_dc_0..2, the coefficients
of degree 0; f_rest_*, those of higher degrees, all of red, then all of green, then all of blue;
opacity (its logit); scale_0..2 (natural logarithms); rot_0..3 (quaternion w x y z)."""

import re
from collections.abc import Mapping
from pathlib import Path
from tempfile import NamedTemporaryFile

import numpy as np
from plyfile import PlyData
from scipy.spatial import cKDTree
from scipy.special import expit, logit

from mgs.colour import SH_C0
from mgs.errors import InputError
from mgs.files import parsing, reading, write_columns
from mgs.gaussians import Gaussians
from mgs.splat_places import settled

# Comment in the header of the files that mgs writes; the layout has no field for the colour space.
# Most other tools train on sRGB values, so the colours in their files must be blended as sRGB.
LINEAR_COMMENT = "mgs: colours are linear RGB"
ANTIALIASED_COMMENT = "SplatRenderMode: mip"  # as of Brush and PlayCanvas
# Of Brush (default, mip, 2dgs), Postshot (0, 1), and mgs 0.1 (antialiased), in lower case.
RENDER_MODE = re.compile(r"(splatrendermode: |antialiased |mgs: )(\S+)")
CHUNK = 256  # consecutive splats of a compressed PLY that share one row of its element `chunk`
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")  # 32-bit words
VECTOR_BITS = ((21, 11), (11, 10), (0, 11))  # of x, y, z in a word: lowest bit, number of bits
TO_ASCII = bytes(byte if byte < 128 else ord("?") for byte in range(256))  # others become ?


def _ply_names(coefficients: int) -> list[str]:
    """Properties of the 3DGS layout in order. coefficients: K, per colour channel."""
    rest = 3 * (coefficients - 1)
    return (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(rest)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )


def write_ply(
    path: str | Path, gaussians: Gaussians, marks: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write Gaussians (NumPy fields) as a binary PLY in the layout of 3DGS; the file appears
    complete.

    It opens in any splat viewer. Viewers that expect sRGB show linear RGB too dark. marks: {name:
    [N] bool}, extra properties of the vertices, bytes of 0 or 1, which `read_ply` and viewers
    ignore. Comments record that Gaussians are linear or antialiased. Positions are doubles where
    they have an origin. Raises InputError as `mgs.files.atomic_path`."""
    g, n = gaussians, len(gaussians)
    names = _ply_names(g.sh.shape[1])
    rest = np.transpose(g.sh[:, 1:, :], (0, 2, 1)).reshape(n, 3 * (g.sh.shape[1] - 1))
    opacity, normals = np.reshape(g.logit_opacities, (n, 1)), np.zeros((n, 3))
    parts = [g.means, normals, g.sh[:, 0, :], rest, opacity, g.log_scales, g.quats]
    columns = np.concatenate(parts, axis=1).astype(np.float32)
    vertices = {name: (values, "f4") for name, values in zip(names, columns.T, strict=True)}
    if any(g.origin):
        places = columns[:, :3].astype(np.float64) + g.origin
        vertices |= {name: (places[:, i], "f8") for i, name in enumerate("xyz")}
    vertices |= {name: (mask, "u1") for name, mask in (marks or {}).items()}
    comments = [LINEAR_COMMENT] * g.linear + [ANTIALIASED_COMMENT] * gaussians.antialiased
    write_columns(path, {"vertex": vertices}, comments)


def read_ply(path: str | Path) -> Gaussians:
    """Read a PLY in the layout of 3DGS (binary or ASCII, SH degree 0 to 3), or a compressed one.

    Properties are found by name, in any order; others are ignored. Only files of mgs say that
    they are linear. The smoothing filter of Mip-Splatting (`filter_3D`) is applied. Raises
    InputError if the file is missing, is not a PLY, lacks a property, or holds values that
    `Gaussians.check` refuses."""
    return parse_ply(path).check(path)


def parse_ply(path: str | Path) -> Gaussians:
    """`read_ply` without its check of the values."""
    path = Path(path)
    with reading(path, "file; give a 3DGS PLY"), parsing(path, "3DGS PLY", "export it again"):
        ply = _parse_any_comment(path)
    if "vertex" not in ply:
        why = "not a 3DGS PLY, it has no vertices"
        raise InputError(f"{path}: {why}; export it with a splatting tool")
    vertices = ply["vertex"].data
    if any(name in vertices.dtype.names for name in PACKED):
        columns = _decompress(path, ply)
    else:
        columns = {name: vertices[name] for name in vertices.dtype.names}
    said = [RENDER_MODE.fullmatch(comment.lower().strip()) for comment in ply.comments]
    mode = next((match[2] for match in reversed(said) if match), "0")
    if mode == "2dgs":
        raise InputError(f"{path}: holds flat discs (2DGS), which mgs does not draw")
    marks = mode in ("mip", "1", "antialiased"), LINEAR_COMMENT in ply.comments
    return _from_columns(path, columns, len(vertices), *marks)


def _parse_any_comment(path: Path) -> PlyData:
    try:
        return PlyData.read(str(path))
    except UnicodeDecodeError:
        header, mark, body = path.read_bytes().partition(b"end_header")
    with NamedTemporaryFile(suffix=".ply") as copy:  # plyfile is slow except from disk
        copy.write(header.translate(TO_ASCII) + mark + body)
        copy.flush()
        return PlyData.read(copy.name)


def _from_columns(
    path: Path, columns: Mapping[str, np.ndarray], n: int, antialiased: bool, linear: bool
) -> Gaussians:
    rest = sum(re.fullmatch("f_rest_[0-9]+", name) is not None for name in columns)
    coefficients = 1 + rest // 3
    if rest % 3 or coefficients not in (1, 4, 9, 16):
        why = f"{rest} f_rest properties fit no SH degree"
        raise InputError(f"{path}: {why}; expected 0, 9, 24 or 45")
    names = _ply_names(coefficients)
    wrong = {n: "is missing" for n in names if n not in columns and n not in ("nx", "ny", "nz")}
    if not wrong:
        present = [name for name in names if name in columns]
        wrong = {name: "is a list" for name in present if columns[name].dtype.kind == "O"}
    if wrong:
        name, what = next(iter(wrong.items()))
        why = f"not a 3DGS PLY, property {name!r} {what}"
        raise InputError(f"{path}: {why}; export it with a splatting tool")

    def stack(*names: str) -> np.ndarray:
        with np.errstate(over="ignore"):  # an overflow gives infinity, which the caller refuses
            return np.stack([np.asarray(columns[name], np.float32) for name in names], 1)

    log_scales, logits = stack("scale_0", "scale_1", "scale_2"), stack("opacity").ravel()
    if "filter_3D" in columns:
        log_scales, logits = _smoothed(log_scales, logits, np.asarray(columns["filter_3D"]))
    sh = stack("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :]
    if rest:
        higher = stack(*(f"f_rest_{i}" for i in range(rest))).reshape(n, 3, coefficients - 1)
        sh = np.concatenate([sh, np.transpose(higher, (0, 2, 1))], axis=1)
    gaussians = Gaussians(
        means=stack("x", "y", "z"),
        log_scales=log_scales,
        quats=stack("rot_0", "rot_1", "rot_2", "rot_3"),
        logit_opacities=logits,
        sh=np.ascontiguousarray(sh),
        antialiased=antialiased,
        linear=linear,
    )
    if any(columns[axis].dtype.itemsize < 8 for axis in "xyz"):
        return gaussians
    return settled(gaussians, np.stack([columns[axis] for axis in "xyz"], 1), np.zeros(3))


def _smoothed(
    log_scales: np.ndarray, logits: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log-scales [N,3] and logits [N] after the smoothing filter of standard deviation `width` [N]
    (Yu et al. 2024, Mip-Splatting, equation 9), which keeps each Gaussian's mass."""
    squares = np.exp(2 * log_scales.astype(np.float64))
    wider = squares + width[:, None].astype(np.float64) ** 2
    opacities = expit(logits.astype(np.float64)) * np.sqrt((squares / wider).prod(1))
    return (0.5 * np.log(wider)).astype(np.float32), logit(opacities).astype(np.float32)


def _decompress(path: Path, ply: PlyData) -> dict[str, np.ndarray]:
    """Properties of the 3DGS layout, an array [n] each, from a compressed PLY.

    PlayCanvas' splat-transform writes such files (`.compressed.ply`). A splat has four 32-bit words
    (PACKED). Their numbers are fractions between the least and the largest value within a chunk of
    256 splats, given in the element `chunk`. Some files have no range of colours, which is then 0
    to 1. Raises InputError if an element or a property is missing or of another type, or sizes do
    not match."""
    vertices, n = ply["vertex"].data, len(ply["vertex"].data)
    chunks = ply["chunk"].data if "chunk" in ply else np.empty(0, [])
    present = chunks.dtype.names or ()
    coloured = any(f"{end}_{channel}" in present for end in ("min", "max") for channel in "rgb")
    ranges = [*"xyz", "scale_x", "scale_y", "scale_z", *("rgb" if coloured else "")]
    needs = [(chunks, f"{end}_{name}", "f") for name in ranges for end in ("min", "max")]
    for table, name, kind in needs + [(vertices, name, "u") for name in PACKED]:
        dtype = table.dtype[name] if name in (table.dtype.names or ()) else None
        if dtype is None or dtype.kind != kind or dtype.itemsize < 4:
            why = f"a compressed PLY without a usable {name!r}"
            raise InputError(f"{path}: {why}; export it uncompressed")
    if len(chunks) * CHUNK < n:
        why = f"{len(chunks)} chunks are too few for {n} splats"
        raise InputError(f"{path}: {why}; export it again")
    chunk = np.arange(n) // CHUNK

    def share(word: str, lowest: int, bits: int) -> np.ndarray:
        return (vertices[word] >> lowest & (2**bits - 1)) / (2**bits - 1)

    def within(name: str, t: np.ndarray) -> np.ndarray:
        low, high = (chunks[f"{end}_{name}"][chunk].astype(np.float64) for end in ("min", "max"))
        return low + t * (high - low)

    columns = {}
    for i, (axis, field) in enumerate(zip("xyz", VECTOR_BITS, strict=True)):
        columns[axis] = within(axis, share("packed_position", *field))
        columns[f"scale_{i}"] = within(f"scale_{axis}", share("packed_scale", *field))
    for i, channel in enumerate("rgb"):
        value = share("packed_color", 24 - 8 * i, 8)
        columns[f"f_dc_{i}"] = ((within(channel, value) if coloured else value) - 0.5) / SH_C0
    # Opacities are stored in steps of 1/255. Those of 0 and 1 have infinite logits, so they become
    # the middle of the half step that was rounded to them.
    columns["opacity"] = logit(np.clip(share("packed_color", 0, 8), 0.25 / 255, 1 - 0.25 / 255))
    three = [np.sqrt(2) * (share("packed_rotation", lowest, 10) - 0.5) for lowest in (20, 10, 0)]
    quats = _unit_quats(vertices["packed_rotation"] >> 30, np.stack(three, 1))
    columns |= {f"rot_{i}": column for i, column in enumerate(quats.T)}
    return columns | _decompress_sh(path, ply, n)


def _unit_quats(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz [N,4] from the index of the largest component [N], which is positive,
    and the other three [N,3]."""
    place = np.arange(4)
    quats = np.take_along_axis(others, np.minimum(place - (place > largest[:, None]), 2), 1)
    rest = np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    return np.where(place == largest[:, None], rest[:, None], quats)


def _decompress_sh(path: Path, ply: PlyData, n: int) -> dict[str, np.ndarray]:
    """Properties f_rest_* of a compressed PLY, an array [n] each; {} if it has only degree 0. They
    are bytes, which divide the range -4 to 4 into 256 steps. A byte stands for the middle of its
    step, but 0 and 255 for -4 and 4."""
    if "sh" not in ply:
        return {}
    table = ply["sh"].data
    if len(table) != n or any(table.dtype[name] != np.uint8 for name in table.dtype.names):
        why = f"a compressed PLY whose element 'sh' is not {n} rows of bytes"
        raise InputError(f"{path}: {why}; export it again")
    values = (np.arange(256) + 0.5) / 32 - 4
    values[[0, 255]] = -4, 4
    return {name: values[table[name]] for name in table.dtype.names}


def write_compressed_ply(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians (NumPy fields) as a compressed PLY (`_decompress`); the file appears
    complete. Gaussians are sorted such that neighbours follow each other, which keeps the steps
    of positions of a chunk small. Raises InputError as `mgs.files.atomic_path`."""
    g = gaussians[cKDTree(gaussians.means, leafsize=2).indices]
    n, rest = len(g), 3 * (g.sh.shape[1] - 1)
    starts = np.arange(0, n, CHUNK)
    chunks, shares = dict[str, tuple[np.ndarray, str]](), []
    groups = (
        ("", "xyz", g.means),
        ("scale_", "xyz", g.log_scales),
        ("", "rgb", 0.5 + SH_C0 * g.sh[:, 0]),
    )
    for prefix, names, values in groups:
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        for end, bound in (("min", low), ("max", high)):
            columns = zip(names, bound.T, strict=True)
            chunks |= {f"{end}_{prefix}{name}": (column, "f4") for name, column in columns}
        first, span = (np.repeat(part, CHUNK, 0)[:n] for part in (low, high - low))
        shares.append((values - first) / np.where(span > 0, span, 1))
    colour = np.column_stack([shares[2], g.opacities])
    words = [
        _packed(shares[0], (11, 10, 11)),
        _packed_quats(g.quats),
        _packed(shares[1], (11, 10, 11)),
        _packed(colour, (8, 8, 8, 8)),
    ]
    packed = {name: (word, "u4") for name, word in zip(PACKED, words, strict=True)}
    elements = {"chunk": chunks, "vertex": packed}
    if rest:
        higher = np.transpose(g.sh[:, 1:], (0, 2, 1)).reshape(n, rest)
        # 0 lies between two steps. Taking the upper one everywhere would tint the whole model;
        # neighbours take opposite ones.
        steps = (higher / 8 + 0.5) * 256
        odd = (np.arange(n)[:, None] & 1) != (np.arange(rest) & 1)
        steps -= (steps == np.floor(steps)) & odd
        steps = np.clip(np.floor(steps), 0, 255)
        elements["sh"] = {f"f_rest_{i}": (step, "u1") for i, step in enumerate(steps.T)}
    write_columns(path, elements, [ANTIALIASED_COMMENT] * gaussians.antialiased)


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Words [N] of fractions [N,K] with these numbers of bits, the first in the highest."""
    word = np.zeros(len(shares), np.uint32)
    for share, width in zip(shares.T, bits, strict=True):
        whole = np.floor(np.clip(share, 0, 1) * (2**width - 1) + 0.5)
        word = word << np.uint32(width) | whole.astype(np.uint32)
    return word


def _packed_quats(quats: np.ndarray) -> np.ndarray:
    """Words [N] of quaternions: the index of the largest component, and the other three."""
    unit = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
    largest = np.abs(unit).argmax(1)
    sign = np.where(np.take_along_axis(unit, largest[:, None], 1) < 0, -1, 1)
    others = np.array([[j for j in range(4) if j != i] for i in range(4)])[largest]
    three = sign * np.take_along_axis(unit, others, 1)
    packed = _packed(0.5 + three * np.sqrt(0.5), (10, 10, 10))
    return packed | largest.astype(np.uint32) << np.uint32(30)
