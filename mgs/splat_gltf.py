"""Gaussians as binary glTF (.glb) with the extension KHR_gaussian_splatting of Khronos.

A primitive of points holds positions, rotations (x y z w), scales (standard deviations), opacities
in [0,1], and the coefficients of spherical harmonics: linear, activated values, not the logarithms
and logits of a PLY. `colorSpace` names the space in which colours are blended.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logit

from mgs.colour import SH_C0
from mgs.errors import InputError
from mgs.files import atomic_path, parsing, reading
from mgs.gaussians import Gaussians

MAGIC = b"glTF"
EXTENSION = "KHR_gaussian_splatting"
SPACES = {True: "lin_rec709_display", False: "srgb_rec709_display"}
"""`Gaussians.linear` -> `colorSpace` of the extension."""

JSON, BINARY = 0x4E4F534A, 0x004E4942
"""Types of the two chunks of a GLB."""

FLOAT = 5126
COMPONENTS = {FLOAT: "f4", 5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2"}
"""Component types of accessors -> NumPy's."""
SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

CLEAREST = 1e-6
"""Opacities are kept this far from 0 and 1 when read, so that their logits are finite."""


def _sh_names(coefficients: int) -> list[str]:
    """Attributes of K coefficients, in the order of `Gaussians.sh`."""
    degrees = range(round(coefficients**0.5))
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in degrees for n in range(2 * d + 1)]


def write_glb(path: str | Path, gaussians: Gaussians, to_y_up: np.ndarray) -> None:
    """Write Gaussians (NumPy fields) as a GLB; the file appears complete.

    to_y_up: rotation [3,3] from the model's world to glTF's, in which +Y is up; it becomes the
    transform of the file's only node.
    Raises InputError as `mgs.files.atomic_path`.
    """
    g, scales = gaussians, np.exp(gaussians.log_scales)
    quats = g.quats / np.maximum(np.linalg.norm(g.quats, axis=1, keepdims=True), 1e-12)
    colours = np.clip(np.column_stack([0.5 + SH_C0 * g.sh[:, 0], g.opacities]), 0, 1)
    attributes = {
        "POSITION": g.means,
        "COLOR_0": colours,  # what viewers without the extension show
        f"{EXTENSION}:ROTATION": np.roll(quats, -1, axis=1),
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": g.opacities[:, None],
    }
    attributes |= dict(zip(_sh_names(g.sh.shape[1]), np.moveaxis(g.sh, 1, 0), strict=True))
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    body = b""
    for name, values in attributes.items():
        data = np.ascontiguousarray(values, "<f4")
        kind = next(kind for kind, size in SIZES.items() if size == data.shape[1])
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": data.nbytes})
        accessor = {"bufferView": len(accessors), "componentType": FLOAT, "count": len(data)}
        accessors.append(accessor | {"type": kind})
        if name == "POSITION":
            accessors[0] |= {"min": data.min(0).tolist(), "max": data.max(0).tolist()}
        body += data.tobytes()
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": 0,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": SPACES[g.linear]}},
        "extras": {"antialiased": g.antialiased},
    }
    matrix = np.eye(4)
    matrix[:3, :3] = to_y_up
    content = {
        "asset": {"version": "2.0", "generator": "mgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": matrix.T.ravel().tolist()}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON) + text + struct.pack("<II", len(body), BINARY)
    with atomic_path(path) as temporary:
        header = struct.pack("<4sII", MAGIC, 2, 12 + len(chunks) + len(body))
        temporary.write_bytes(header + chunks + body)


def read_glb(path: str | Path) -> Gaussians:
    """Read the first primitive of Gaussians of a GLB.

    Positions are those of the primitive: transforms of nodes are ignored. Raises InputError if the
    file is missing or damaged, holds no Gaussians, or only compressed ones.
    """
    path = Path(path)
    with reading(path, "file; give a GLB"), parsing(path, "GLB", "export it again"):
        content, body = _chunks(path.read_bytes())
        return _gaussians(path, content, body)


def _chunks(data: bytes) -> tuple[Any, bytes]:
    """JSON and binary chunk of a GLB. Raises ValueError or struct.error if it is damaged."""
    start = 12
    chunks: dict[int, bytes] = {}
    while start + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, start)
        if start + 8 + size > len(data):
            raise ValueError("it ends within a chunk")
        chunks.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size
    return json.loads(chunks[JSON]), chunks.get(BINARY, b"")


def _gaussians(path: Path, content: Any, body: bytes) -> Gaussians:
    """Gaussians from the chunks of a GLB."""
    primitives = [p for mesh in content.get("meshes", []) for p in mesh["primitives"]]
    found = next((p for p in primitives if EXTENSION in p.get("extensions", {})), None)
    if found is None:
        raise InputError(f"{path}: no Gaussians in it (no {EXTENSION}); export it as a splat PLY")
    extension = found["extensions"][EXTENSION]
    if extension.get("extensions"):
        kind = next(iter(extension["extensions"]))
        raise InputError(f"{path}: its Gaussians are compressed ({kind}); export it uncompressed")

    def values(name: str) -> np.ndarray:
        return _accessor(path, content, found["attributes"][name], body)

    coefficients = sum(name.startswith(f"{EXTENSION}:SH_") for name in found["attributes"])
    opacities = values(f"{EXTENSION}:OPACITY")[:, 0].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):  # bad scales are refused by `check`
        log_scales = np.log(values(f"{EXTENSION}:SCALE"))
    return Gaussians(
        means=values("POSITION"),
        log_scales=log_scales,
        quats=np.roll(values(f"{EXTENSION}:ROTATION"), 1, axis=1),
        logit_opacities=logit(np.clip(opacities, CLEAREST, 1 - CLEAREST)).astype(np.float32),
        sh=np.stack([values(name) for name in _sh_names(coefficients)], axis=1),
        antialiased=found.get("extras", {}).get("antialiased") is True,
        linear=extension.get("colorSpace") == SPACES[True],
    ).check(path)


def _accessor(path: Path, content: Any, index: int, body: bytes) -> np.ndarray:
    """Values of an accessor, float32 [N,size]. NumPy raises TypeError or ValueError if they do not
    lie within the binary chunk."""
    accessor = content["accessors"][index]
    if "sparse" in accessor:
        raise InputError(
            f"{path}: has sparse accessors, which are not supported; export it without"
        )
    view = content["bufferViews"][accessor["bufferView"]]
    kind, size = np.dtype(COMPONENTS[accessor["componentType"]]), SIZES[accessor["type"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    stride = view.get("byteStride", kind.itemsize * size)
    if not isinstance(accessor["count"], int) or start < 0 or stride < kind.itemsize * size:
        raise ValueError("an accessor lies outside its buffer")
    shape, strides = (accessor["count"], size), (stride, kind.itemsize)
    stored: np.ndarray = np.ndarray(shape, kind.newbyteorder("<"), body, start, strides)
    numbers = stored.astype(np.float32)
    if accessor.get("normalized") and kind.kind != "f":
        numbers = np.maximum(numbers / np.iinfo(kind).max, -1)
    return numbers
