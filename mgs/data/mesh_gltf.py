"""Triangle meshes of glTF files, with their base colours as one texture or at the vertices."""

from collections.abc import Callable
from functools import cache, partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data.gltf import INSTANCING, Gltf, Transform, triangles
from mgs.errors import InputError
from mgs.images import check_pixels

SHAPES = rf"KHR_mesh_quantization|{INSTANCING}|KHR_materials_\w+"  # these change no shape
GLOSS = "KHR_materials_pbrSpecularGlossiness"
REPEAT = 10497


def load_gltf_mesh(
    path: Path, resolve: Callable[[str], bytes], coloured: bool
) -> trimesh.Trimesh | None:
    """All triangles of a file's scene as one mesh, in the file's axes; None if there are none.
    resolve: as of `Gltf`. coloured: whether to read the base colours: factor, texture and its
    transform, vertex colours. Raises InputError for extensions and colours that are not read."""
    textures = "KHR_texture_transform|EXT_texture_webp" if coloured else r"\w+_texture_\w+"
    gltf = Gltf(path, f"{SHAPES}|{textures}", resolve)
    image = cache(partial(_image, gltf))
    pairs = [
        (primitive, place)
        for mesh, place in gltf.placed()
        for primitive in gltf.json["meshes"][mesh]["primitives"]
    ]
    textured = any(_base_colour(gltf, primitive)[1] for primitive, _ in pairs)
    meshes = [_shape(gltf, *one) for one in pairs]
    parts = [(one, mesh) for (one, _), mesh in zip(pairs, meshes, strict=True) if mesh is not None]
    if coloured:
        for primitive, mesh in parts:
            visual = _visual(gltf, primitive, len(mesh.vertices), image, textured)
            mesh.visual = mesh.visual if visual is None else visual
    if len(parts) < 2:
        return parts[0][1] if parts else None
    whole: Any = trimesh.util.concatenate([mesh for _, mesh in parts])
    if all("NORMAL" in primitive["attributes"] for primitive, _ in parts):
        whole.vertex_normals = np.concatenate([mesh.vertex_normals for _, mesh in parts])
    return whole


def _shape(gltf: Gltf, primitive: dict[str, Any], place: Transform) -> trimesh.Trimesh | None:
    attributes = primitive["attributes"]
    positions = gltf.json["accessors"][attributes["POSITION"]]
    if primitive.get("extensions") and not {"bufferView", "sparse"} & set(positions):
        raise gltf.unread(next(iter(primitive["extensions"])))
    points = gltf.accessor(attributes["POSITION"]).astype(np.float64)
    indices = np.arange(len(points))
    if "indices" in primitive:
        indices = gltf.accessor(primitive["indices"])[:, 0].astype(np.int64)
    faces = triangles(primitive.get("mode", 4), indices)
    if len(faces) == 0:
        return None
    A = place[:3, :3]
    faces = faces if np.linalg.det(A) > 0 else faces[:, ::-1]
    mesh = trimesh.Trimesh(points @ A.T + place[:3, 3], faces, process=False)
    if "NORMAL" in attributes:
        normals = gltf.accessor(attributes["NORMAL"]) @ np.linalg.inv(A)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        mesh.vertex_normals = normals / np.where(length > 0, length, 1)  # type: ignore[method-assign]
    return mesh


def _base_colour(
    gltf: Gltf, primitive: dict[str, Any]
) -> tuple[np.ndarray | None, dict[str, Any] | None]:
    """Factor of the base colour, linear RGB, and the texture that it multiplies; None if absent."""
    if "material" not in primitive:
        return None, None
    material = gltf.json["materials"][primitive["material"]]
    pbr = material.get("pbrMetallicRoughness", {})
    gloss = material.get("extensions", {}).get(GLOSS, {})
    factor = pbr.get("baseColorFactor", gloss.get("diffuseFactor"))
    rgb = None if factor is None else np.array(factor[:3], np.float64)
    return rgb, pbr.get("baseColorTexture", gloss.get("diffuseTexture"))


def _visual(
    gltf: Gltf,
    primitive: dict[str, Any],
    n: int,
    image: Callable[[int], Image.Image],
    textured: bool,
) -> Any:
    """Colours of a primitive with n vertices for trimesh; None if its file says none. textured:
    whether another primitive has a texture, so that this one needs one, too."""
    attributes = primitive["attributes"]
    factor, texture = _base_colour(gltf, primitive)
    colours = gltf.accessor(attributes["COLOR_0"])[:, :3] if "COLOR_0" in attributes else None
    if (texture or textured) and colours is not None and (colours < 0.99).any():
        cure = "bake them into the texture"
        raise InputError(f"{gltf.path}: has vertex colours beside a texture; {cure}")
    white = np.ones(3) if factor is None else factor
    if not texture and not textured:
        if factor is None and colours is None:
            return None
        rgb = np.broadcast_to(white, (n, 3)) * (1 if colours is None else colours)
        levels = np.round(255 * srgb_from_linear(rgb)).astype(np.uint8)
        return trimesh.visual.ColorVisuals(vertex_colors=levels)
    if texture:
        pixels, uv = image(texture["index"]), _coordinates(gltf, attributes, texture)
    else:
        pixels, uv = Image.new("RGB", (2, 2), (255, 255, 255)), np.full((n, 2), 0.5)
    if (white != 1).any():
        linear = linear_from_srgb(np.asarray(pixels, np.float32) / 255) * white
        pixels = Image.fromarray(np.round(255 * srgb_from_linear(linear)).astype(np.uint8))
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=pixels, metallicFactor=0.0, roughnessFactor=0.9
    )
    return trimesh.visual.TextureVisuals(uv=uv * [1, -1] + [0, 1], material=material)


def _coordinates(gltf: Gltf, attributes: dict[str, int], texture: dict[str, Any]) -> np.ndarray:
    """Texture coordinates [V,2] after KHR_texture_transform, v downwards."""
    change = texture.get("extensions", {}).get("KHR_texture_transform", {})
    number = change.get("texCoord", texture.get("texCoord", 0))
    uv = gltf.accessor(attributes[f"TEXCOORD_{number}"]).astype(np.float64)
    c, s = np.cos(change.get("rotation", 0)), np.sin(change.get("rotation", 0))
    uv = (uv * change.get("scale", (1, 1))) @ [[c, -s], [s, c]] + change.get("offset", (0, 0))
    sampler = gltf.json["textures"][texture["index"]].get("sampler")
    wraps = {} if sampler is None else gltf.json["samplers"][sampler]
    repeats = all(wraps.get(axis, REPEAT) == REPEAT for axis in ("wrapS", "wrapT"))
    if not repeats and not ((uv > -1e-3) & (uv < 1.001)).all():
        cure = "bake it anew"
        raise InputError(f"{gltf.path}: its texture is clamped or mirrored beyond its edge; {cure}")
    return uv


def _image(gltf: Gltf, texture: int) -> Image.Image:
    """Image of a texture, 8-bit RGB. Raises InputError as `check_pixels`, and if it is not read."""
    entry = gltf.json["textures"][texture]
    others = entry.get("extensions", {})
    source = others.get("EXT_texture_webp", {}).get("source", entry.get("source"))
    if source is None:
        raise gltf.unread(next(iter(others), "of its texture"))
    one = gltf.json["images"][source]
    data = gltf.bytes_of(one["bufferView"]) if "bufferView" in one else gltf.file(one["uri"])
    with Image.open(BytesIO(data)) as opened:
        check_pixels(gltf.path, *opened.size)
        if opened.mode in ("I", "I;16"):  # which Pillow would cut at 255
            return Image.fromarray(np.uint8(np.asarray(opened) / 257 + 0.5)).convert("RGB")
        return opened.convert("RGB")
