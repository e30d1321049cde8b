"""glTF 2.0 files: JSON, the numbers of accessors, and the meshes that a scene places."""

import base64
import json
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from mgs.errors import InputError
from mgs.rotation import rotmat_from_quat

MAGIC = b"glTF"  # first bytes of a binary file (.glb)
JSON, BINARY = 0x4E4F534A, 0x004E4942  # types of the two chunks of a GLB
# Component types of accessors -> NumPy's.
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}  # of an accessor -> numbers of an element
INSTANCING = "EXT_mesh_gpu_instancing"
DEEPEST = 200  # most levels of nodes
Transform = np.ndarray  # affine map [4,4] from a mesh's coordinates to the scene's


class Gltf:
    """Contents of a file: `json`, and its numbers by `accessor` and `bytes_of`.

    handled: pattern of the extensions that are read. resolve: returns the bytes of a file that is
    named beside it. Raises InputError if it needs another extension (`extensionsRequired`), and
    errors of many types if it is damaged (`mgs.files.parsing`)."""

    def __init__(
        self, path: Path, handled: str, resolve: Callable[[str], bytes] | None = None
    ) -> None:
        self.path, self.resolve = path, resolve
        data = path.read_bytes()
        chunks = _chunks(data) if data.startswith(MAGIC) else {JSON: data}
        self.json: dict[str, Any] = json.loads(chunks[JSON])
        self.binary = chunks.get(BINARY, b"")
        for name in self.json.get("extensionsRequired", []):
            if not re.fullmatch(handled, str(name)):
                raise self.unread(name)
        self._buffers: dict[int, bytes] = {}

    def unread(self, name: object) -> InputError:
        """Error for an extension that is not read."""
        return InputError(
            f"{self.path}: needs the glTF extension {name}, which mgs does not read; "
            "export it without"
        )

    def file(self, uri: str) -> bytes:
        """Bytes of a data URI or of a file beside this one."""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition("base64,")[2])
        if self.resolve is None:
            raise InputError(f"{self.path}: names the file {uri}; export it as one GLB")
        return self.resolve(unquote(uri))

    def bytes_of(self, view: int) -> bytes:
        entry = self.json["bufferViews"][view]
        index, start = entry["buffer"], entry.get("byteOffset", 0)
        if index not in self._buffers:
            buffer = self.json["buffers"][index]
            if index > 0 and "uri" not in buffer:  # what a decoder would fill
                raise self.unread(next(iter(entry.get("extensions", {})), "of its buffer"))
            self._buffers[index] = self.file(buffer["uri"]) if "uri" in buffer else self.binary
        data = self._buffers[index][start : start + entry["byteLength"]]
        if start < 0 or len(data) != entry["byteLength"]:
            raise ValueError("a buffer view lies outside its buffer")
        return data

    def accessor(self, index: int) -> np.ndarray:
        """Numbers of an accessor [N,size]; float64 if it is normalised, else of its own type."""
        entry = self.json["accessors"][index]
        kind, size, count = COMPONENTS[entry["componentType"]], SIZES[entry["type"]], entry["count"]
        if "bufferView" in entry:
            start = entry.get("byteOffset", 0)
            values = self._numbers(entry["bufferView"], start, kind, count, size)
        else:
            values = np.zeros((count, size), kind)
        if "sparse" in entry:
            sparse, values = entry["sparse"], values.copy()
            n, at, new = sparse["count"], sparse["indices"], sparse["values"]
            whole = COMPONENTS[at["componentType"]]
            places = self._numbers(at["bufferView"], at.get("byteOffset", 0), whole, n, 1)[:, 0]
            values[places] = self._numbers(
                new["bufferView"], new.get("byteOffset", 0), kind, n, size
            )
        if entry.get("normalized") and values.dtype.kind != "f":
            return np.maximum(values / np.iinfo(values.dtype).max, -1)
        return values

    def _numbers(self, view: int, start: int, kind: str, count: int, size: int) -> np.ndarray:
        """Numbers [count,size] of a buffer view. NumPy raises if they do not lie within it."""
        each = np.dtype(kind).itemsize
        stride = self.json["bufferViews"][view].get("byteStride", each * size)
        if not isinstance(count, int) or start < 0 or stride < each * size:
            raise ValueError("an accessor lies outside its buffer")
        return np.ndarray((count, size), kind, self.bytes_of(view), start, (stride, each))

    def placed(self) -> Iterator[tuple[int, Transform]]:
        """Each mesh of the default scene with its transform; repeated where it is instanced. In a
        file without nodes, all meshes as they are."""
        meshes, scenes = self.json.get("meshes", []), self.json.get("scenes")
        nodes = self.json.get("nodes") or [{"mesh": index} for index in range(len(meshes))]
        if scenes and "nodes" in self.json:
            roots = scenes[self.json.get("scene", 0)].get("nodes", [])
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in children]
        waiting, seen = [(root, np.eye(4), 0) for root in reversed(roots)], set()
        while waiting:
            index, above, depth = waiting.pop()
            node = nodes[index]
            if index in seen or depth > DEEPEST:
                raise ValueError("its nodes are no tree")
            seen.add(index)
            here = above @ node_matrix(node)
            if "mesh" in node:
                mesh = meshes[node["mesh"]]
                if "skin" in node or any(node.get("weights", mesh.get("weights", ()))):
                    why = "a skin or morph targets change its shape"
                    raise InputError(f"{self.path}: {why}; apply them and export it again")
                for instance in self._instances(node):
                    yield node["mesh"], here @ instance
            waiting += [(child, here, depth + 1) for child in reversed(node.get("children", []))]

    def _instances(self, node: dict[str, Any]) -> Iterator[Transform]:
        """Transforms of a node's instances (EXT_mesh_gpu_instancing); the identity without."""
        index = node.get("extensions", {}).get(INSTANCING, {}).get("attributes", {})
        names = ("TRANSLATION", "ROTATION", "SCALE")
        columns = {x.lower(): self.accessor(index[x]).tolist() for x in names if x in index}
        for values in zip(*columns.values(), strict=True) if columns else [()]:
            yield node_matrix(dict(zip(columns, values, strict=True)))


def _chunks(data: bytes) -> dict[int, bytes]:
    """Chunks of a GLB by their type. Raises ValueError or struct.error if it is damaged."""
    start = 12
    chunks: dict[int, bytes] = {}
    while start + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, start)
        if start + 8 + size > len(data):
            raise ValueError("it ends within a chunk")
        chunks.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size
    return chunks


def node_matrix(node: dict[str, Any]) -> Transform:
    """Transform [4,4] of a node relative to its parent: its matrix, or T R S."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    matrix[:3, :3] = rotmat_from_quat([w, x, y, z]) * np.array(node.get("scale", (1, 1, 1)), float)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def triangles(mode: int, indices: np.ndarray) -> np.ndarray:
    """Faces [F,3] of a primitive's indices; none of points and lines (modes 0 to 3)."""
    if mode == 4:
        return indices.reshape(-1, 3)
    if mode == 5:
        faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], 1)
        faces[1::2] = faces[1::2, [1, 0, 2]]
        return faces
    if mode == 6:
        return np.stack([np.full(len(indices) - 2, indices[0]), indices[1:-1], indices[2:]], 1)
    return np.zeros((0, 3), np.int64)
