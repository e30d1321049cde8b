"""Triangle meshes on disk, and distances to a mesh."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mgs.colour import linear_from_srgb
from mgs.errors import InputError
from mgs.files import parsing, reading
from mgs.images import check_pixels, unlimited_headers
from mgs.memory import decoding
from mgs.rotation import WORLD_FROM_GLTF

if TYPE_CHECKING:
    import trimesh

GLTF = (".glb", ".gltf")
MESHES = (*GLTF, ".obj", ".ply", ".stl", ".off")  # the library reads others, including archives
TEXTURES = ("image", "baseColorTexture")  # images of trimesh's materials, of files that are no glTF
PLAIN_PLY = re.compile(  # header of a PLY file with vertices and triangles only
    rb"ply\nformat binary_little_endian 1.0\n(?:comment [^\n]*\n)*element vertex (\d{1,9})\n"
    rb"property float x\nproperty float y\nproperty float z\nelement face (\d{1,9})\n"
    rb"property list uchar int vertex_indices\nend_header\n"
)

FURTHEST = 1e15  # largest coordinate of a mesh, metres: the squares of areas must fit float32


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh."""

    vertices: np.ndarray  # [V,3] world, metres
    faces: np.ndarray  # [F,3] vertex indices
    seen: np.ndarray  # [F] bool, by a survey: these alone are sampled, others close holes

    @property
    def crosses(self) -> np.ndarray:
        """[F,3] face normals, of length twice the area."""
        return face_crosses(self.vertices, self.faces)

    @property
    def areas(self) -> np.ndarray:
        """[F] square metres."""
        return np.linalg.norm(self.crosses, axis=1) / 2

    @property
    def vertex_normals(self) -> np.ndarray:
        """[V,3] unit normals: area-weighted mean over the seen faces at a vertex; zero if none."""
        cross = self.crosses * self.seen[:, None]
        normals = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(normals, self.faces[:, k], cross)
        norm = np.linalg.norm(normals, axis=1, keepdims=True)
        return normals / np.where(norm > 0, norm, 1.0)


def face_crosses(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[F,3] normals of faces [F,3], of length twice the area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def load_mesh(path: str | Path, coloured: bool = True) -> "trimesh.Trimesh":
    """Read a triangle mesh (GLB, OBJ, PLY ...) in the axes and units of its file. coloured: with
    its texture or vertex colours. Raises InputError if the file is missing or unreadable, the mesh
    has no faces or no area, a vertex is NaN, infinite or beyond FURTHEST, or a face names a vertex
    that does not exist."""
    import trimesh

    path = Path(path)
    with reading(path, "mesh; give a GLB, OBJ or PLY file"), path.open("rb") as file:
        file.read(1)
    if path.suffix.lower() not in MESHES:
        raise InputError(f"{path}: not a readable mesh; give one of {', '.join(MESHES)}")
    with parsing(path, "mesh", "export it again as GLB, OBJ or PLY"), unlimited_headers():
        mesh = _load(path, coloured)
    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(f"{path}: has no faces; give a triangle mesh, not points or lines")
    _check(path, mesh.vertices, mesh.faces)
    return mesh


def _check(path: object, vertices: np.ndarray, faces: np.ndarray) -> None:
    if len(faces) == 0:
        raise InputError(f"{path}: has no faces; give a triangle mesh, not points or lines")
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise InputError(f"{path}: its vertices or faces have no three numbers; export it again")
    if not np.isfinite(vertices).all():
        first = int(np.argwhere(~np.isfinite(vertices))[0][0])
        raise InputError(f"{path}: vertex {first} is NaN or infinite; repair the mesh")
    absent = (faces < 0) | (faces >= len(vertices))
    if absent.any():
        face, corner = np.argwhere(absent)[0]
        what = f"vertex {faces[face, corner]} of {len(vertices)}"
        raise InputError(f"{path}: face {face} names {what}; repair the mesh")
    if np.abs(vertices).max() > FURTHEST:
        why = f"has vertices further than {FURTHEST:g} m from the origin"
        raise InputError(f"{path}: {why}; scale the mesh")
    if not face_crosses(np.asarray(vertices, np.float64), faces).any():
        raise InputError(f"{path}: none of its faces has an area; repair the mesh")


def _load(path: Path, coloured: bool) -> Any:
    import trimesh

    from mgs.data.mesh_gltf import load_gltf_mesh

    class Files(trimesh.resolvers.FilePathResolver):
        """Reads the files that a mesh names, but no pipe and no device, which may never end."""

        def get(self, name: str) -> bytes:
            for one in (Path(self.parent, name.strip()), Path(self.parent, Path(name).name)):
                if one.exists() and not (one.is_file() or one.is_dir()):
                    raise InputError(f"{path}: {one} is no regular file; correct the name")
            return super().get(name)

    files = Files(str(path))
    if path.suffix.lower() in GLTF:
        return load_gltf_mesh(path, files.get, coloured)
    mesh = trimesh.load(path, process=False, resolver=files, force="mesh")
    _check_textures(path, mesh)
    return mesh


def _check_textures(path: Path, mesh: Any) -> None:
    """Raise InputError as `check_pixels` for the textures of a mesh, which are not decoded yet."""
    material = getattr(mesh.visual, "material", None)
    for kind in TEXTURES:
        image = getattr(material, kind, None)
        if image is not None:
            check_pixels(path, *image.size)


def _plain_ply(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices and faces of a PLY file as `mgs.prior.build.save_prior` writes it, None of any other
    file. (It takes 0.6 s to import trimesh.)"""
    if path.suffix != ".ply" or not path.is_file():
        return None
    with reading(path), path.open("rb") as file, decoding(path):
        header = PLAIN_PLY.match(file.read(1024))
        if header is None:
            return None
        start, n, m = header.end(), int(header[1]), int(header[2])
        if path.stat().st_size - start != 12 * n + 13 * m:
            return None
        file.seek(start)
        data = file.read()
    vertices = np.frombuffer(data, "<f4", 3 * n).reshape(n, 3)
    lists = np.frombuffer(data, [("count", "u1"), ("faces", "<i4", 3)], m, 12 * n)
    if (lists["count"] != 3).any():
        return None
    return vertices, lists["faces"]


def read_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh in world coordinates, metres, as one clean surface, all of it seen. glTF
    and GLB are +Y up by their format and turned to +Z up; other formats have no rule and are taken
    as they are. Faces without area, repeated faces and unused vertices are removed. Faces are wound
    as their neighbours, and outwards. Raises InputError as `load_mesh`."""
    path = Path(path)
    arrays = _plain_ply(path)
    if not arrays:
        mesh = load_mesh(path, coloured=False)
        arrays = mesh.vertices, mesh.faces
    vertices, faces = arrays
    if path.suffix.lower() in GLTF:
        vertices = vertices @ WORLD_FROM_GLTF[:3, :3].T
    return mesh_of(vertices, faces, path)


def mesh_of(corners: ArrayLike, triangles: ArrayLike, where: object = "mesh") -> Mesh:
    """One clean surface of vertices [V,3] and faces [F,3], as `read_mesh`. where: begins a
    message."""
    try:
        vertices, faces = np.array(corners, np.float64), np.array(triangles, np.int64)
    except (TypeError, ValueError):
        raise InputError(f"{where}: vertices and faces must be arrays of numbers") from None
    _check(where, vertices, faces)
    faces = faces[distinct_faces(vertices, faces)]
    place = _places(vertices)
    faces = np.where(_wound_against(place[faces])[:, None], faces[:, ::-1], faces)
    indices, corners = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[indices], corners.reshape(faces.shape)
    a, b, c = (vertices[faces[:, k]] - vertices.mean(0) for k in range(3))
    inside_out = np.einsum("fk,fk->f", a, np.cross(b, c)).sum() < 0  # six times the signed volume
    return Mesh(vertices, faces[:, ::-1] if inside_out else faces, np.ones(len(faces), bool))


def to_glb(mesh: "trimesh.Trimesh") -> bytes:
    """GLB file of a mesh in world coordinates, with normals and texture, turned to +Y up."""
    copy: Any = mesh.copy(include_cache=True)  # the cache holds the vertex normals
    if copy.visual.kind == "vertex":  # glTF's are linear
        rgb = linear_from_srgb(copy.visual.vertex_colors[:, :3] / 255)
        copy.visual.vertex_colors = np.round(255 * rgb).astype(np.uint8)
    copy.apply_transform(WORLD_FROM_GLTF.T)
    return copy.export(None, file_type="glb", include_normals=True)


def distinct_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Indices of the distinct faces [F,3] that have an area, ascending; of equal ones the first."""
    indices = np.flatnonzero(np.linalg.norm(face_crosses(vertices, faces), axis=1) > 0)
    corners = np.sort(_places(vertices)[faces[indices]], axis=1)
    order, number = _numbered(corners)
    return indices[
        np.sort(order[np.searchsorted(number[order], np.arange(number.max(initial=-1) + 1))])
    ]


def _places(vertices: np.ndarray) -> np.ndarray:
    """[V] number of each vertex's place. 0.0 and -0.0 are the same coordinate."""
    return _numbered(vertices)[1]


def _numbered(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stable lexicographic order of rows [N,K], and the number [N] of each row among the different
    ones in that order: as `np.unique(axis=0)`, but many times faster."""
    order = np.lexsort(rows.T[::-1])
    new = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    number = np.zeros(len(rows), np.int64)
    number[order[1:]] = np.cumsum(new)
    return order, number


def _wound_against(faces: np.ndarray) -> np.ndarray:
    """Mask [F] of the faces [F,3] to flip so that neighbours are wound alike, as few as possible in
    each connected piece.

    Neighbours share an edge with no third face, and are wound alike if they traverse it in opposite
    directions. Method: a graph with nodes f ("keep") and F + f ("flip"), and an edge between nodes
    of neighbours that go together; its connected components decide. One-sided pieces (Moebius
    strips) are left as they are."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward = edges[:, 0] < edges[:, 1]
    order, edge = _numbered(np.sort(edges, axis=1))
    first, second = order[np.bincount(edge)[edge[order]] == 2].reshape(-1, 2).T
    against = forward[first] == forward[second]
    n, first, second = len(faces), first // 3, second // 3
    if not against.any():
        return np.zeros(n, bool)
    starts = np.concatenate([first, first + n])
    ends = np.concatenate([second + n * against, second + n * ~against])
    graph = coo_array((np.ones(len(starts), bool), (starts, ends)), shape=(2 * n, 2 * n))
    label = connected_components(graph, directed=False)[1]
    flipped, piece = label[:n] > label[n:], np.minimum(label[:n], label[n:])
    return flipped ^ (np.bincount(piece, flipped) > np.bincount(piece) / 2)[piece]


def distances_to_mesh(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Exact distances [N], metres, from points [N,3] to a triangle mesh (pymeshlab)."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    meshes.add_mesh(pymeshlab.Mesh(points))
    meshes.compute_scalar_by_distance_from_another_mesh_per_vertex(
        measuremesh=1,
        refmesh=0,
        signeddist=False,
        maxdist=pymeshlab.PureValue(1e9),  # its default is the extent of the points
    )
    return meshes.mesh(1).vertex_scalar_array()
