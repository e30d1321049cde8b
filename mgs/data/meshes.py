"""Triangle meshes and point clouds on disk, and distances to a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mgs.errors import InputError
from mgs.files import atomic_path, reading
from mgs.rotation import WORLD_FROM_GLTF

if TYPE_CHECKING:
    import trimesh


def write_points(path: str | Path, points: np.ndarray, normals: np.ndarray) -> None:
    """Write points and normals [N,3] as a binary PLY (x y z nx ny nz, float32), atomically."""
    columns = np.concatenate([points, normals], 1).astype(np.float32)
    vertices = np.empty(
        len(columns), dtype=[(name, "f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    )
    for k, name in enumerate(vertices.dtype.names or ()):
        vertices[name] = columns[:, k]
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")]).write(str(temporary))


GLTF = (".glb", ".gltf")

GLTF_UP = "+Y"
"""Value of `up` in the extras of the mesh in GLB files that `to_glb` makes."""

FURTHEST = 1e15
"""Largest coordinate of a mesh, metres. Areas are squared, and with larger coordinates these
squares would not fit float32."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh: vertices [V,3] world, metres; faces [F,3], indices of their vertices; seen
    [F] bool.

    `seen` marks the faces that a survey saw. Only these are sampled: a reconstruction also closes
    holes that nobody has seen.
    """

    vertices: np.ndarray
    faces: np.ndarray
    seen: np.ndarray

    @property
    def areas(self) -> np.ndarray:
        """[F] square metres."""
        return np.linalg.norm(_crosses(self.vertices, self.faces), axis=1) / 2

    @property
    def vertex_normals(self) -> np.ndarray:
        """[V,3] unit normals: the mean over the seen faces around a vertex, weighted by area; zero
        where there is none."""
        cross = _crosses(self.vertices, self.faces) * self.seen[:, None]
        normals = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(normals, self.faces[:, k], cross)
        norm = np.linalg.norm(normals, axis=1, keepdims=True)
        return normals / np.where(norm > 0, norm, 1.0)


def _crosses(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[F,3] vectors along the normals of the faces; the length of each is twice the area of its
    face."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """Read a triangle mesh (GLB, OBJ, PLY ...) with its texture, in the axes and units of its file.

    Raises InputError where the file is missing or unreadable, where the mesh has no faces or no
    area, and where a vertex is NaN, infinite or beyond FURTHEST, or a face names a vertex that does
    not exist.
    """
    import trimesh

    path = Path(path)
    with reading(path, "mesh; give a GLB, OBJ or PLY file"), path.open("rb") as file:
        file.read(1)
    try:
        mesh: Any = trimesh.load(path, process=False) if path.suffix.lower() in GLTF else None
        parts = list(mesh.graph.nodes_geometry) if isinstance(mesh, trimesh.Scene) else []
        if len(parts) == 1:
            transform, name = mesh.graph[parts[0]]
            mesh = mesh.geometry[name].apply_transform(
                transform
            )  # force="mesh" below would lose the file's normals
        else:
            mesh = trimesh.load(path, force="mesh", process=False)
    except (
        Exception
    ) as error:  # trimesh's readers raise many types; each means a damaged or unknown file.
        reason = " ".join(str(error).split())[:120]
        raise InputError(
            f"{path}: not a readable mesh ({reason}); export it again as GLB, OBJ or PLY"
        ) from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{path}: has no faces; give a triangle mesh, not a point cloud")
    if not np.isfinite(mesh.vertices).all():
        first = int(np.argwhere(~np.isfinite(mesh.vertices))[0][0])
        raise InputError(f"{path}: vertex {first} is NaN or infinite; repair the mesh")
    absent = (mesh.faces < 0) | (mesh.faces >= len(mesh.vertices))
    if absent.any():
        face, corner = np.argwhere(absent)[0]
        raise InputError(
            f"{path}: face {face} names vertex {mesh.faces[face, corner]} of {len(mesh.vertices)}; repair the mesh"
        )
    if np.abs(mesh.vertices).max() > FURTHEST:
        raise InputError(
            f"{path}: has vertices further than {FURTHEST:g} m from the origin; repair or scale the mesh"
        )
    if not _crosses(np.asarray(mesh.vertices, np.float64), mesh.faces).any():
        raise InputError(f"{path}: none of its faces has an area; repair the mesh")
    return mesh


def read_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh in world coordinates, metres, and make it one clean surface; all of it
    counts as seen.

    glTF and GLB files are +Y up by their format, and are turned to +Z up; other formats have no
    rule, and are taken as they are. Faces without area, repeated faces and vertices without a face
    are left out. A face whose corners run the other way round than those of its neighbours is
    turned over, and so are all faces where the mesh is inside out. Raises InputError as
    `load_mesh`.
    """
    return _in_world(load_mesh(path), Path(path).suffix.lower() in GLTF)


def read_rock(path: str | Path) -> Mesh:
    """Read the true rock of a dataset, `rock.glb`, as `read_mesh` does.

    A file without the mark of `to_glb` was written by an older version of mgs, and is +Z up.
    """
    mesh = load_mesh(path)
    return _in_world(mesh, mesh.metadata.get("up") == GLTF_UP)


def to_glb(mesh: trimesh.Trimesh) -> bytes:
    """The bytes of a GLB file of a mesh in world coordinates, with normals and texture, turned to
    +Y up and marked GLTF_UP."""
    turned: Any = mesh.copy(include_cache=True)  # the cache holds the vertex normals
    turned.apply_transform(WORLD_FROM_GLTF.T)
    turned.metadata["up"] = GLTF_UP
    return turned.export(None, file_type="glb", include_normals=True)


def _in_world(mesh: trimesh.Trimesh, y_up: bool) -> Mesh:
    """A mesh in world coordinates, cleaned as `read_mesh` says; y_up: whether the given mesh is +Y
    up."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if y_up:
        vertices = vertices @ WORLD_FROM_GLTF[:3, :3].T
    faces = faces[distinct_faces(vertices, faces)]
    place = _places(vertices)
    faces = np.where(_wound_against(place[faces])[:, None], faces[:, ::-1], faces)
    used, corners = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], corners.reshape(faces.shape)
    a, b, c = (vertices[faces[:, k]] - vertices.mean(0) for k in range(3))
    inside_out = np.einsum("fk,fk->f", a, np.cross(b, c)).sum() < 0  # six times the signed volume
    return Mesh(vertices, faces[:, ::-1] if inside_out else faces, np.ones(len(faces), bool))


def distinct_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which faces [F,3] to keep: indices, ascending, of those with an area, and of faces at the
    same three places, whichever
    way round, only the first. vertices: [V,3]."""
    kept = np.flatnonzero(np.linalg.norm(_crosses(vertices, faces), axis=1) > 0)
    corners = np.sort(_places(vertices)[faces[kept]], axis=1)
    return kept[np.sort(np.unique(corners, axis=0, return_index=True)[1])]


def _places(vertices: np.ndarray) -> np.ndarray:
    """[V] a number for each vertex; vertices at the same place have the same number. 0.0 and -0.0
    are the same coordinate."""
    return np.unique(vertices + 0.0, axis=0, return_inverse=True)[1].ravel()


def _wound_against(faces: np.ndarray) -> np.ndarray:
    """Which of the faces [F,3] to turn over so that neighbours are wound alike, bool [F]; of each
    connected piece, the fewer.

    A face is wound clockwise or counter-clockwise: the order of its corners. Neighbours are two
    faces that share an edge which no third face has. They are wound alike where their corners
    follow that edge in opposite directions.
    Method: a graph has two nodes for each face, f for "keep" and F + f for "turn over". An edge of
    the graph joins two nodes of neighbours that go together. The connected components then say what
    goes with what. A piece that has only one side (a Moebius strip) cannot be wound alike, and is
    left as it is.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward = edges[:, 0] < edges[:, 1]
    _, edge, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    edge = edge.ravel()
    order = np.argsort(edge, kind="stable")
    first, second = order[count[edge[order]] == 2].reshape(-1, 2).T
    against = forward[first] == forward[second]
    n, first, second = len(faces), first // 3, second // 3
    if not against.any():
        return np.zeros(n, bool)
    ends = (
        np.concatenate([first, first + n]),
        np.concatenate([second + n * against, second + n * ~against]),
    )
    label = connected_components(
        coo_array((np.ones(len(ends[0]), bool), ends), shape=(2 * n, 2 * n)), directed=False
    )[1]
    turned, piece = label[:n] > label[n:], np.minimum(label[:n], label[n:])
    return turned ^ (np.bincount(piece, turned) > np.bincount(piece) / 2)[piece]


def distances_to_mesh(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Exact distances [N], metres, from points [N,3] to a triangle mesh (pymeshlab)."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    meshes.add_mesh(pymeshlab.Mesh(points))
    meshes.compute_scalar_by_distance_from_another_mesh_per_vertex(
        measuremesh=1, refmesh=0, signeddist=False
    )
    return meshes.mesh(1).vertex_scalar_array()
