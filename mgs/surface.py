"""The rock's points -> watertight Poisson mesh -> blue-noise surface samples; and distances between surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from mgs.cloud import Plane
from mgs.conventions import WORLD_FROM_GLTF
from mgs.errors import InputError
from mgs.files import reading

if TYPE_CHECKING:
    import trimesh

NORMAL_NEIGHBOURS = (16, 128)
"""Points of the local plane fit of a normal: without noise, and at most."""
POISSON_SCALE = 2.0
"""Edge of Poisson's cube over the extent of the points: at pymeshlab's 1.1 the bulge below the open underside leaves the cube
and the surface is not closed."""
POISSON_CELL = 1.5
"""Edge of Poisson's finest cell over the cloud's voxel: finer cells fit noise and cost time (halving it gained nothing)."""
POISSON_DEPTHS = (5, 10)
"""Least and largest octree depth chosen automatically; a caller may ask for 3 to 12 (beyond, pymeshlab crashes)."""
GLTF = (".glb", ".gltf")
GLTF_UP = "+Y"
"""What our GLB files hold in the extras of their mesh under `up`."""
OVERSAMPLING = 5
"""Random candidates per blue-noise sample."""


@dataclass(frozen=True)
class Mesh:
    """vertices [V,3] world, metres; faces [F,3]; seen [F] bool: faces that the survey saw, so those that samples cover."""

    vertices: np.ndarray
    faces: np.ndarray
    seen: np.ndarray

    @property
    def areas(self) -> np.ndarray:
        """[F] square metres."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    @property
    def vertex_normals(self) -> np.ndarray:
        """[V,3] unit, area-weighted over the seen faces (zero at vertices of none)."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        cross = np.cross(b - a, c - a) * self.seen[:, None]
        normals = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(normals, self.faces[:, k], cross)
        norm = np.linalg.norm(normals, axis=1, keepdims=True)
        return normals / np.where(norm > 0, norm, 1.0)


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """A triangle mesh (GLB, OBJ, PLY ...) as it is in its file, with its texture.

    Raises InputError where it is missing or unreadable, has no faces, or holds NaN vertices.
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
            mesh = mesh.geometry[name].apply_transform(transform)  # keeps the file's normals, which force="mesh" loses
        else:
            mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh's readers raise many types; each means a damaged or unknown file.
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: not a readable mesh ({reason}); export it again as GLB, OBJ or PLY") from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{path}: has no faces; give a triangle mesh, not a point cloud")
    if not np.isfinite(mesh.vertices).all():
        first = int(np.argwhere(~np.isfinite(mesh.vertices))[0][0])
        raise InputError(f"{path}: vertex {first} is NaN or infinite; repair the mesh")
    return mesh


def read_mesh(path: str | Path) -> Mesh:
    """A triangle mesh in world coordinates, metres, turned right side out; all of it counts as seen.

    glTF and GLB are +Y up, as their format has it, and are turned; other formats have no rule, and are taken as they are.
    Raises InputError as `load_mesh`.
    """
    return _in_world(load_mesh(path), Path(path).suffix.lower() in GLTF)


def read_rock(path: str | Path) -> Mesh:
    """The true rock of a dataset, `rock.glb`, as `read_mesh`. One without the mark of `to_glb` is of an older mgs: +Z up."""
    mesh = load_mesh(path)
    return _in_world(mesh, mesh.metadata.get("up") == GLTF_UP)


def to_glb(mesh: trimesh.Trimesh) -> bytes:
    """A GLB file of a mesh in world coordinates, with its normals and texture: turned to +Y up, and marked so."""
    turned: Any = mesh.copy(include_cache=True)  # the cache holds the vertex normals
    turned.apply_transform(WORLD_FROM_GLTF.T)
    turned.metadata["up"] = GLTF_UP
    return turned.export(None, file_type="glb", include_normals=True)


def _in_world(mesh: trimesh.Trimesh, y_up: bool) -> Mesh:
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if y_up:
        vertices = vertices @ WORLD_FROM_GLTF[:3, :3].T
    a, b, c = (vertices[faces[:, k]] - vertices.mean(0) for k in range(3))
    inside_out = np.einsum("fk,fk->f", a, np.cross(b, c)).sum() < 0  # six times the signed volume
    return Mesh(vertices, faces[:, ::-1] if inside_out else faces, np.ones(len(faces), bool))


def estimate_normals(points: np.ndarray, views: np.ndarray, roughness: float = 0.0) -> np.ndarray:
    """Unit normals [N,3] by plane fits to neighbours (Hoppe et al. 1992), turned towards the cameras (views [N,3]).

    roughness: noise over the distance of neighbouring points; the number of neighbours, 16, grows with it.
    """
    least, most = NORMAL_NEIGHBOURS
    count = min(int(least * (1 + 2 * roughness)), most, len(points))
    neighbours = points[cKDTree(points).query(points, count)[1]]
    centred = neighbours - neighbours.mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))[1][..., 0]
    return normals * np.where(np.einsum("nk,nk->n", normals, views) < 0, -1.0, 1.0)[:, None]


def poisson_mesh(points: np.ndarray, normals: np.ndarray, voxel: float, plane: Plane, depth: int | None) -> tuple[Mesh, int]:
    """Screened Poisson surface (Kazhdan and Hoppe 2013, pymeshlab) cut flat at the ground plane (manifold3d).

    Poisson closes the unseen underside with a bulge that no data supports; the cut replaces it by a flat cap on the ground, so
    that the mesh stays watertight; the cap counts as not seen. depth: octree depth; by default cells of at most 1.5 voxels.
    Returns (mesh, octree depth). Raises InputError where Poisson gives no closed surface above the ground.
    """
    import manifold3d
    import pymeshlab

    if depth is not None and not 3 <= depth <= 12:
        raise InputError(f"prior: Poisson depth {depth} is not within 3 to 12; correct --poisson-depth")
    if depth is None:
        cells = POISSON_SCALE * float(np.ptp(points, axis=0).max()) / (POISSON_CELL * voxel)
        depth = int(np.clip(np.ceil(np.log2(cells)), *POISSON_DEPTHS))
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(points, v_normals_matrix=normals))
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, scale=POISSON_SCALE, threads=1)
    surface = meshes.current_mesh()
    vertices, faces = surface.vertex_matrix(), surface.face_matrix()
    failure = InputError(f"prior: Poisson at depth {depth} gives no closed surface; try another --poisson-depth or more frames")
    if len(faces) == 0:
        raise failure
    solid = manifold3d.Manifold(manifold3d.Mesh64(vertices, faces.astype(np.uint64)))
    if solid.status() != manifold3d.Error.NoError:
        raise failure
    solid = max(solid.trim_by_plane(plane.normal, plane.offset).decompose(), key=lambda part: part.volume(), default=None)
    if solid is None or solid.is_empty():
        raise failure
    cut = solid.to_mesh64()
    vertices, faces = np.asarray(cut.vert_properties)[:, :3], np.asarray(cut.tri_verts).astype(np.int64)
    base = (np.abs(plane.height(vertices)) < 1e-6 * np.ptp(vertices, axis=0).max())[faces].all(1)
    return Mesh(vertices, faces, ~base), depth


def sample_surface(
    mesh: Mesh, seed: int, *, count: int | None = None, spacing: float | None = None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Blue-noise samples of the seen surface: exactly N = A / spacing^2 of them (rounded), A its area.

    Give count N or spacing (metres). A greedy Poisson-disk subset of 5 N uniform candidates, with the largest radius that
    keeps N of them; the few too many with the nearest neighbours are dropped.
    Returns (points [N,3], unit normals [N,3], spacing in metres). Raises InputError for fewer than two samples.
    """
    areas = np.where(mesh.seen, mesh.areas, 0.0)
    area = float(areas.sum())
    if count is None:
        assert spacing is not None
        count = round(area / spacing**2)
    if count < 2:
        raise InputError(f"prior: {count} samples are too few for a model; ask for more Gaussians (or a smaller --spacing)")
    spacing = float(np.sqrt(area / count))
    rng = np.random.default_rng(seed)
    face = rng.choice(len(areas), OVERSAMPLING * count, p=areas / area)
    u, v = rng.random((2, len(face)))
    root = np.sqrt(u)
    weights = np.stack([1 - root, root * (1 - v), root * v], 1)
    points = np.einsum("nk,nki->ni", weights, mesh.vertices[mesh.faces[face]])
    keep = _blue_noise(points, count, spacing)
    normals = np.einsum("nk,nki->ni", weights[keep], mesh.vertex_normals[mesh.faces[face[keep]]])
    return points[keep], normals / np.linalg.norm(normals, axis=1, keepdims=True), spacing


def _blue_noise(points: np.ndarray, count: int, spacing: float) -> np.ndarray:
    """Indices [count] of a Poisson-disk subset of random points [N,3]."""
    pairs = cKDTree(points).query_pairs(0.95 * spacing, output_type="ndarray")
    distance = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    low, high = 0.0, 0.95 * spacing
    best = np.arange(len(points))
    for _ in range(12):
        radius = (low + high) / 2
        kept = _independent(pairs[distance < radius], len(points))
        if len(kept) >= count:
            best, low = kept, radius
        else:
            high = radius
        if len(best) <= 1.002 * count:
            break
    nearest = cKDTree(points[best]).query(points[best], 2)[0][:, 1]
    return np.sort(best[np.argsort(-nearest, kind="stable")[:count]])


def _independent(pairs: np.ndarray, n: int) -> np.ndarray:
    """The greedy (first come, first kept) subset of 0..n-1 in which no pair of `pairs` [P,2] is together."""
    low, high = pairs.min(1), pairs.max(1)
    undecided, kept = np.ones(n, bool), np.zeros(n, bool)
    while undecided.any():
        chosen = undecided.copy()
        chosen[high] = False
        kept |= chosen
        undecided &= ~chosen
        undecided[high[chosen[low]]] = False
        active = undecided[low] & undecided[high]
        low, high = low[active], high[active]
    return np.flatnonzero(kept)


def distances_to_mesh(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Exact distances [N], metres, from points [N,3] to a triangle mesh (pymeshlab)."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    meshes.add_mesh(pymeshlab.Mesh(points))
    meshes.compute_scalar_by_distance_from_another_mesh_per_vertex(measuremesh=1, refmesh=0, signeddist=False)
    return meshes.mesh(1).vertex_scalar_array()
