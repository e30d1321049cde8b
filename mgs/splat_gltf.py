"""Gaussians as binary glTF (.glb) with the extension KHR_gaussian_splatting of Khronos.

A primitive of points holds positions, rotations (x y z w), scales (standard deviations), opacities
in [0,1], and the coefficients of spherical harmonics: linear, activated values, not the logarithms
and logits of a PLY. `colorSpace` names the space in which colours are blended."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logit

from mgs.colour import SH_C0
from mgs.data.gltf import BINARY, INSTANCING, JSON, MAGIC, SIZES, Gltf
from mgs.data.world import PLUS_Z, Vector, unit_up
from mgs.errors import InputError
from mgs.files import atomic_path, parsing, reading
from mgs.gaussians import ARRAYS, Gaussians
from mgs.splat_places import mirrored, moved

EXTENSION = "KHR_gaussian_splatting"
SPACES = {True: "lin_rec709_display", False: "srgb_rec709_display"}  # linear -> `colorSpace`
FLOAT, VERTICES = 5126, 34962  # component type of the accessors, and target of the buffer views
HANDLED = f"{EXTENSION}|KHR_mesh_quantization|{INSTANCING}"  # extensions that are read
PLAYCANVAS = "splat-transform"  # its files have x and y against those of the PLY they were made of
CLEAREST = 1e-6  # distance of opacities from 0 and 1 when read, so that their logits are finite


def _sh_names(coefficients: int) -> list[str]:
    """Attributes of K coefficients, in the order of `Gaussians.sh`."""
    degrees = range(round(coefficients**0.5))
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in degrees for n in range(2 * d + 1)]


def write_glb(path: str | Path, gaussians: Gaussians, to_y_up: np.ndarray) -> None:
    """Write Gaussians (NumPy fields) as a GLB; the file appears complete. to_y_up: rotation [3,3]
    from the model's world to glTF's, in which +Y is up; it becomes the transform of the file's only
    node, with the origin. `read_glb` undoes it. Raises InputError as `mgs.files.atomic_path`."""
    g, scales = gaussians, np.exp(np.clip(gaussians.log_scales, -80, 80))  # within float32
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
        place = {"buffer": 0, "byteOffset": len(body), "byteLength": data.nbytes}
        views.append(place | {"target": VERTICES})
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
    matrix[:3, :3], matrix[:3, 3] = to_y_up, to_y_up @ np.array(g.origin)
    content = {
        "asset": {
            "version": "2.0",
            "generator": "mgs",
            "extras": {"y_up_from_model": to_y_up.tolist()},
        },
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
    """Read all Gaussians of a GLB's scene, under the transforms of their nodes. Files of mgs, and
    those that PlayCanvas' splat-transform made of a PLY, come back in the axes of the model; others
    stay in glTF's. Raises InputError if the file is missing or damaged, holds no Gaussians, or
    compressed ones, ones that differ in colour space, or a node has shear."""
    path = Path(path)
    with reading(path, "file; give a GLB"), parsing(path, "GLB", "export it again"):
        gltf = Gltf(path, HANDLED)
        back, parts = np.eye(4), list[Gaussians]()
        back[:3, :3] = _y_up_from_model(gltf).T
        for mesh, place in gltf.placed():
            for primitive in gltf.json["meshes"][mesh]["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    parts.append(moved(_gaussians(gltf, primitive), back @ place, path))
        if not parts:
            why = f"no Gaussians in it (no {EXTENSION})"
            raise InputError(f"{path}: {why}; export it as a splat PLY")
        whole = _joined(path, parts)
        made_by = str(gltf.json.get("asset", {}).get("generator", ""))
        return mirrored(whole, (-1, -1, 1)) if made_by.startswith(PLAYCANVAS) else whole


def up_of_glb(path: Path) -> Vector:
    """Upward direction in the world in which `read_glb` returns Gaussians. Raises InputError."""
    with reading(path, "file; give a GLB"), parsing(path, "GLB", "export it again"):
        gltf = Gltf(path, HANDLED)
        if str(gltf.json.get("asset", {}).get("generator", "")).startswith(PLAYCANVAS):
            return PLUS_Z
        return unit_up(_y_up_from_model(gltf)[1])


def _y_up_from_model(gltf: Gltf) -> np.ndarray:
    """Rotation [3,3] from the model's axes to glTF's, as a file of mgs names it, else none."""
    extras = gltf.json.get("asset", {}).get("extras", {})
    turn = extras.get("y_up_from_model") if isinstance(extras, dict) else None
    return np.eye(3) if turn is None else np.asarray(turn, np.float64).reshape(3, 3)


def _joined(path: Path, parts: list[Gaussians]) -> Gaussians:
    """One model of several parts, with their highest SH degree."""
    first, degree = parts[0], max(part.sh_degree for part in parts)
    if len(parts) == 1:
        return first
    if len({(part.linear, part.antialiased) for part in parts}) > 1:
        raise InputError(f"{path}: its parts differ in colour space or antialiasing; split it")
    same = [part.with_degree(degree) for part in parts]
    for part in same:
        part.means = part.means + np.subtract(part.origin, first.origin).astype(np.float32)
    arrays: Any = {name: np.concatenate([getattr(part, name) for part in same]) for name in ARRAYS}
    return replace(first, **arrays)


def _gaussians(gltf: Gltf, primitive: dict[str, Any]) -> Gaussians:
    extension, index = primitive["extensions"][EXTENSION], primitive["attributes"]
    if extension.get("extensions"):
        kind = next(iter(extension["extensions"]))
        raise InputError(f"{gltf.path}: its Gaussians are compressed ({kind}); export uncompressed")

    def values(name: str) -> np.ndarray:
        return gltf.accessor(index[name]).astype(np.float32)

    coefficients = sum(name.startswith(f"{EXTENSION}:SH_") for name in index)
    opacities = values(f"{EXTENSION}:OPACITY")[:, 0].astype(np.float64)
    scales = values(f"{EXTENSION}:SCALE")
    if (scales < 0).any():
        cure = "the program that wrote it must write standard deviations"
        raise InputError(f"{gltf.path}: has negative scales, which are probably logarithms; {cure}")
    with np.errstate(divide="ignore"):  # flat Gaussians
        log_scales = np.log(scales)
    return Gaussians(
        means=values("POSITION"),
        log_scales=log_scales,
        quats=np.roll(values(f"{EXTENSION}:ROTATION"), 1, axis=1),
        logit_opacities=logit(np.clip(opacities, CLEAREST, 1 - CLEAREST)).astype(np.float32),
        sh=np.stack([values(name) for name in _sh_names(coefficients)], axis=1),
        antialiased=primitive.get("extras", {}).get("antialiased") is True,
        linear=extension.get("colorSpace") == SPACES[True],
    )
