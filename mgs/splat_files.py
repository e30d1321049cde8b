"""Gaussians in the formats of other programs: PLY, compressed PLY, binary glTF and SPZ.

`load_gaussians` tells the format from the first bytes of a file, not from its name.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.errors import InputError
from mgs.files import atomic_path, parsing, reading
from mgs.gaussians import Gaussians
from mgs.splat_gltf import MAGIC, read_glb, write_glb
from mgs.splat_ply import read_ply, write_compressed_ply, write_ply

FORMATS = {"ply": ".ply", "compressed-ply": ".compressed.ply", "glb": ".glb", "spz": ".spz"}
"""Formats that are written, with the endings of their files."""

SPZ_MAGIC = (b"\x1f\x8b", b"NGSP")
"""First bytes of SPZ files: of versions 1 to 3, which are compressed by gzip, and of 4."""

SPZ_BITS = 23
"""Bits of the magnitude of an SPZ position, a fixed-point number."""

Y_UP = np.array([1, -1, -1], np.float32)
"""Signs of x, y, z between the axes of 3DGS files (y down, z forward) and of SPZ (y up)."""

Y_UP_QUATS = np.array([1, 1, -1, -1], np.float32)
"""Signs of w, x, y, z of a quaternion between these axes."""

Y_UP_SH = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Signs s_k of the colour coefficients between these axes: Y_k(x, -y, -z) = s_k Y_k(x, y, z)."""

OTHERS = {
    ".splat": "a .splat",
    ".ksplat": "a .ksplat",
    ".sog": "a SOG",
    ".sogs": "a SOG",
    ".gltf": "a glTF of several",
}
"""Endings of formats that are not read."""


def load_gaussians(path: str | Path) -> Gaussians:
    """Read Gaussians from a PLY in the layout of 3DGS, a compressed PLY, a GLB, or an SPZ.

    Colours are unchanged. Raises InputError if the file is missing, damaged or of another format,
    or if a package that it needs is missing.
    """
    path = Path(path)
    kind = _kind(path)
    if kind == "glb":
        return read_glb(path)
    if kind == "spz":
        return _read_spz(path)
    return read_ply(path)


def _kind(path: Path) -> str:
    """Format of a file by its first bytes: "glb", "spz" or "ply". Raises InputError."""
    with reading(path, "file; give a PLY, GLB or SPZ of Gaussians"), path.open("rb") as file:
        first = file.read(4)
    if first == MAGIC:
        return "glb"
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
    """Write Gaussians (NumPy fields) in a format of FORMATS; the file appears complete.

    Compressed PLY and SPZ cannot say that colours are linear. to_y_up: for a GLB (`write_glb`).
    Raises InputError as `mgs.files.atomic_path`, and if a package is missing.
    """
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

    Raises InputError if it is not installed.
    """
    try:
        import gsply_cpp
    except ImportError:
        raise InputError(
            f"{path}: SPZ needs gsply, which is not installed; `pip install gsply`, or use PLY"
        ) from None
    return gsply_cpp


def _flip_y_up(g: Gaussians) -> Gaussians:
    """Turn Gaussians between the axes of 3DGS files and of SPZ; twice gives the same Gaussians."""
    sh = g.sh * Y_UP_SH[: g.sh.shape[1], None]
    return replace(g, means=g.means * Y_UP, quats=g.quats * Y_UP_QUATS, sh=sh)


def _read_spz(path: Path) -> Gaussians:
    """Read an SPZ of version 1 to 4 and turn it to the axes of 3DGS files.

    Raises InputError if it is damaged.
    """
    codec = _spz_codec(path)
    with reading(path), parsing(path, "SPZ", "export it again"):
        found = codec.read_spz(str(path))
        parts = [found["sh0"][:, None, :]]
        if found["shN"] is not None and found["shN"].size:
            parts.append(found["shN"])
        y_up = Gaussians(
            means=found["means"],
            log_scales=found["scales"],
            quats=found["quats"],
            logit_opacities=found["opacities"],
            sh=np.concatenate(parts, axis=1),
            antialiased=False,
            linear=False,
        ).check(path)
    return _flip_y_up(y_up)


def _write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write an SPZ of version 3, y up. Positions take as many fractional bits as their size allows.

    Values outside the format's range are clipped: log-scales to -10 to 5.9, coefficients of degree
    0 to +-3.3, and the others to +-1.
    """
    codec = _spz_codec(path)
    g = _flip_y_up(gaussians)
    largest = max(float(np.abs(g.means).max(initial=0)), 1e-6)
    bits = int(np.clip(np.floor(SPZ_BITS - np.log2(largest * (1 + 1e-6))), 1, 24))
    fields = (g.means, g.log_scales, g.quats, g.logit_opacities, g.sh[:, 0])
    arrays = [np.ascontiguousarray(values, np.float32) for values in fields]
    higher = np.ascontiguousarray(g.sh[:, 1:], np.float32) if g.sh.shape[1] > 1 else None
    with atomic_path(path) as temporary:
        codec.write_spz(str(temporary), *arrays, higher, fractional_bits=bits)
