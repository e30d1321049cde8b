"""Gaussians in files: PLY, compressed PLY, binary glTF, SPZ, and what `mgs.compact` writes, told
apart by their first bytes."""

import errno
import gzip
import os
import struct
import warnings
import zlib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np

from mgs.compact import container
from mgs.compact.decode import read_compact, up_of_compact
from mgs.data.gltf import MAGIC
from mgs.data.world import PLUS_Z, Vector
from mgs.errors import InputError, Notice
from mgs.files import atomic_path, parsing, reading
from mgs.gaussians import ARRAYS, Gaussians
from mgs.prior.build import load_prior
from mgs.rotation import QUAT_MIN
from mgs.splat.constants import LOG_SCALE_RANGE
from mgs.splat_gltf import read_glb, up_of_glb, write_glb
from mgs.splat_places import mirrored
from mgs.splat_ply import parse_ply, write_compressed_ply, write_ply

# Formats that are written, with the endings of their files.
FORMATS = {"ply": ".ply", "compressed-ply": ".compressed.ply", "glb": ".glb", "spz": ".spz"}
SPZ_MAGIC = (b"\x1f\x8b", b"NGSP")  # of versions up to 3, compressed by gzip, and of 4
SPZ_BITS = 23  # bits of the magnitude of an SPZ position, a fixed-point number
# Magic, version, Gaussians N, SH degree, fractional bits, flags; of version 4 streams, their table.
SPZ_HEADER = struct.Struct("<4sIIBBBBI")
SPZ_ANTIALIASED, SPZ_EXTENSIONS = 1, 2  # flags of the header
GZIP_RATIO = 1032  # most bytes that a byte of gzip can stand for
SPZ_EXTENSION_BYTES = 1 << 20  # most bytes of the extensions of a file up to version 3
SPZ_AXES = 0xADBE0003  # type of the extension that names the axes (`_axes`)
RUB = 3  # axes right, up, back: those of an SPZ that names no others
UNBOUNDED = 13.8  # logit that stands for an infinite one: an opacity of 1 - 1e-6
OTHERS = {  # formats that are not read
    ".splat": "a .splat",
    ".ksplat": "a .ksplat",
    ".sog": "a SOG",
    ".sogs": "a SOG",
    ".gltf": "a glTF of several",
}


def load_gaussians(path: str | Path, prior: str | Path | None = None) -> Gaussians:
    """Read Gaussians from a PLY in the layout of 3DGS, a compressed PLY, a GLB, an SPZ or a file
    of the format mgs. prior: folder of the prior that the last was made with, if it needs one.

    Colours are unchanged. Infinite logits of opacity are cut to finite ones, flat Gaussians get the
    least thickness, and quaternions of a length under QUAT_MIN, which would mean the identity, are
    made longer. Those with a NaN or another infinite number are left out, with a Notice.
    Raises InputError if the file is missing, damaged or of another format, or if a package that it
    needs is missing."""
    path = Path(path)
    kind = _kind(path)
    if kind == "mgs":
        return read_compact(path, load_prior(prior) if prior else None).check(path)
    if prior is not None:
        raise InputError(f"{path}: has positions, and needs no prior; leave out `prior`")
    g = {"glb": read_glb, "spz": _read_spz, "ply": parse_ply}[kind](path)
    g.check_shapes(path)
    flat, logits = np.isneginf(g.log_scales), np.clip(g.logit_opacities, -UNBOUNDED, UNBOUNDED)
    longest = np.abs(g.quats).max(axis=1, keepdims=True, initial=0)
    short = (longest > 0) & (longest <= QUAT_MIN)
    g = replace(
        g,
        quats=np.where(short, g.quats / np.where(short, longest, np.float32(1)), g.quats),
        log_scales=np.where(flat, np.float32(LOG_SCALE_RANGE[0]), g.log_scales),
        logit_opacities=np.where(np.isinf(g.logit_opacities), logits, g.logit_opacities),
    )
    good = np.ones(len(g), bool)
    for array in (getattr(g, name) for name in ARRAYS):
        good &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    if not good.all():
        if not good.any():
            raise InputError(f"{path}: no Gaussian has finite numbers; export it again")
        notice = f"{path}: {(~good).sum():,} Gaussians with NaN or infinite numbers are left out"
        warnings.warn(notice, Notice, stacklevel=2)
        g = g[good]
    step = np.spacing(np.abs(g.means).max(initial=0))
    if len(g.means) and step > (size := _drawn_size(g)) / 2:
        notice = (
            f"{path}: positions of float32 have steps of {step:.2g} so far from the origin, and "
            f"Gaussians are {size:.2g} large; export it with doubles, or nearer to the origin"
        )
        warnings.warn(notice, Notice, stacklevel=2)
    return g.check(path)


def _drawn_size(g: Gaussians) -> float:
    """Median standard deviation of the Gaussians as they are drawn."""
    return float(np.exp(np.median(np.clip(g.log_scales, *LOG_SCALE_RANGE))))


def upward(path: str | Path) -> Vector:
    """Upward direction of a file's world: what a GLB or mgs file says, else +Z."""
    ups = {"glb": up_of_glb, "mgs": up_of_compact}
    return ups.get(_kind(Path(path)), lambda path: PLUS_Z)(Path(path))


def _kind(path: Path) -> str:
    """Format of a file by its first bytes: "glb", "mgs", "spz" or "ply". Raises InputError."""
    with reading(path, "file; give a PLY, GLB, SPZ or MGS of Gaussians"), path.open("rb") as file:
        first = file.read(4)
    if first == MAGIC:
        return "glb"
    if first == container.MAGIC:
        return "mgs"
    if first.startswith(SPZ_MAGIC):
        return "spz"
    suffix = path.suffix.lower()
    if not first.startswith(b"ply") and suffix in OTHERS:
        raise InputError(
            f"{path}: {OTHERS[suffix]} file, which mgs does not read; convert it to PLY, "
            f"for example: npx @playcanvas/splat-transform {path.name} {path.stem}.ply"
        )
    return "ply"


def write_gaussians(path: str | Path, gaussians: Gaussians, kind: str, to_y_up: np.ndarray) -> None:
    """Write Gaussians (NumPy fields) in a format of FORMATS; the file appears complete. Compressed
    PLY and SPZ cannot say that colours are linear. to_y_up: for a GLB (`write_glb`). The two lose
    an origin, with a Notice. Raises InputError as `mgs.files.atomic_path`, if a package is missing,
    and if there are no Gaussians or their positions are too far for the format."""
    if len(gaussians) == 0:
        raise InputError(f"{path}: there are no Gaussians to write")
    if any(gaussians.origin) and kind not in ("ply", "glb"):
        place = ", ".join(f"{x:.0f}" for x in gaussians.origin)
        notice = f"{path}: positions count from {place}, which only PLY and GLB can hold"
        warnings.warn(notice, Notice, stacklevel=2)
    if kind == "glb":
        write_glb(path, gaussians, to_y_up)
    elif kind == "spz":
        _write_spz(Path(path), gaussians)
    elif kind == "compressed-ply":
        write_compressed_ply(path, gaussians)
    else:
        write_ply(path, gaussians)


def _spz_codec(path: Path) -> Any:
    """The codec of the package gsply. Its Python interface would compile itself for half a minute.
    Raises InputError if it is not installed."""
    try:
        import gsply_cpp
    except ImportError:
        why = "SPZ needs gsply, which is not installed"
        raise InputError(f"{path}: {why}; `pip install gsply`, or use PLY") from None
    return gsply_cpp


def _axes(number: int) -> tuple[int, int, int]:
    """Signs of x, y, z between 3DGS files (right, down, front) and the axes of a number: bit 0
    right, bit 1 up, bit 2 front."""
    return (1 if number & 1 else -1, -1 if number & 2 else 1, 1 if number & 4 else -1)


def _spz_end(head: bytes) -> int:
    """Bytes of an SPZ up to version 3 before its extensions, from its header."""
    _, version, n, degree = SPZ_HEADER.unpack_from(head)[:4]
    return int(16 + n * ((20 if version == 3 else 19) + 3 * ((degree + 1) ** 2 - 1)))


def _unzipped(data: bytes) -> bytes:
    """Contents of a gzip file of SPZ. Raises ValueError if it is cut off, or if its header says
    more than so small a file can hold, or less than it does, before they take memory."""
    stream = zlib.decompressobj(zlib.MAX_WBITS + 16)
    head = stream.decompress(data, SPZ_HEADER.size)
    size = _spz_end(head) + SPZ_EXTENSION_BYTES
    if _spz_end(head) > GZIP_RATIO * len(data):
        raise ValueError("its header says more than it can hold")
    contents = stream.decompress(stream.unconsumed_tail, size)
    if stream.unconsumed_tail:
        raise ValueError("it unpacks to more than its header says")
    if not stream.eof:
        raise ValueError("it is cut off")
    if int.from_bytes(data[-4:], "little") != len(head + contents):  # which the codec allocates
        raise ValueError("it unpacks to another size than its end says")
    return head + contents


def _spz_marks(data: bytes) -> tuple[bool, int]:
    """Whether the contents of an SPZ are antialiased, and the number of their axes. Raises errors
    of many types for damaged ones."""
    _, version, _, _, _, flags, _, end = SPZ_HEADER.unpack_from(data)
    start, axes = 32, RUB
    if version < 4:
        start = _spz_end(data)
        end = len(data)
    rest = data[start:end] if flags & SPZ_EXTENSIONS else b""
    while len(rest) >= 9:
        kind, size = struct.unpack_from("<II", rest)
        if kind == SPZ_AXES and rest[8] in range(1, 9):
            axes = rest[8] - 1
        rest = rest[8 + size :]
    return bool(flags & SPZ_ANTIALIASED), axes


def _read_spz(path: Path) -> Gaussians:
    """Read an SPZ of version 1 to 4 and turn it to the axes of 3DGS files. Version 1 is version 2
    with positions of float16, which the codec does not read. Raises InputError if it is damaged."""
    codec = _spz_codec(path)
    with reading(path), parsing(path, "SPZ", "export it again"), NamedTemporaryFile() as copy:
        data = path.read_bytes()
        data = _unzipped(data) if data.startswith(SPZ_MAGIC[0]) else data
        magic, version, n = SPZ_HEADER.unpack_from(data)[:3]
        if version == 1:
            halves = np.frombuffer(data, "<f2", 3 * n, 16).reshape(n, 3).astype(np.float32)
            head = data[8:13] + b"\1" + data[14:16]  # with fractional bits, which the codec checks
            data = struct.pack("<4sI", magic, 2) + head + bytes(9 * n) + data[16 + 6 * n :]
            copy.write(gzip.compress(data, 1))
            copy.flush()
        antialiased, axes = _spz_marks(data)
        fields = codec.read_spz(copy.name if version == 1 else str(path))
        if version == 1:
            fields["means"] = halves
        parts = [fields["sh0"][:, None, :]]
        if fields["shN"] is not None and fields["shN"].size:
            parts.append(fields["shN"])
        g = Gaussians(
            means=fields["means"],
            log_scales=fields["scales"],
            quats=fields["quats"],
            logit_opacities=fields["opacities"],
            sh=np.concatenate(parts, axis=1),
            antialiased=antialiased,
            linear=False,
        )
        return mirrored(g, _axes(axes))


def _write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write an SPZ of version 3, y up. Positions take as many fractional bits as their size allows.
    Values outside the format's range are clipped: log-scales to -10 to 5.9, coefficients of degree
    0 to +-3.3, and the others to +-1."""
    codec = _spz_codec(path)
    g = mirrored(gaussians, _axes(RUB))
    largest = max(float(np.abs(g.means).max()), 1e-6)
    bits = min(int(np.floor(SPZ_BITS - np.log2(largest * (1 + 1e-6)))), 24)
    if bits < 0 or 2.0**-bits > _drawn_size(g):
        raise InputError(
            f"{path}: positions up to {largest:.3g} have steps of {2.0**-bits:.3g} in an SPZ, "
            "coarser than the Gaussians; use ply or glb"
        )
    fields = (g.means, g.log_scales, g.quats, g.logit_opacities, g.sh[:, 0])
    arrays = [np.ascontiguousarray(values, np.float32) for values in fields]
    higher = np.ascontiguousarray(g.sh[:, 1:], np.float32) if g.sh.shape[1] > 1 else None
    data = bytearray()
    with atomic_path(path) as temporary:
        codec.write_spz(str(temporary), *arrays, higher, fractional_bits=bits)
        with suppress(EOFError):  # the codec does not notice a full disk
            data = bytearray(gzip.decompress(temporary.read_bytes()))
        if len(data) != 16 + len(g) * (20 + 3 * (g.sh.shape[1] - 1)):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if g.antialiased:  # the codec leaves the flags empty
            data[14] |= SPZ_ANTIALIASED
            temporary.write_bytes(gzip.compress(data, 6, mtime=0))
