"""The rock's points -> watertight Poisson mesh -> blue-noise surface samples; and distances between surfaces."""

from __future__ import annotations

import os
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
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
FURTHEST = 1e15
"""Largest coordinate of a mesh, metres: squares of areas beyond it leave float32."""
SAMPLE_BYTES = 3400
"""Memory that sampling takes per sample, most of it for pairs of candidates (measured: 3.3 to 3.5 kB from 10^5 to 10^6)."""


@dataclass(frozen=True)
class Mesh:
    """vertices [V,3] world, metres; faces [F,3]; seen [F] bool: faces that the survey saw, so those that samples cover."""

    vertices: np.ndarray
    faces: np.ndarray
    seen: np.ndarray

    @property
    def areas(self) -> np.ndarray:
        """[F] square metres."""
        return np.linalg.norm(_crosses(self.vertices, self.faces), axis=1) / 2

    @property
    def vertex_normals(self) -> np.ndarray:
        """[V,3] unit, area-weighted over the seen faces (zero at vertices of none)."""
        cross = _crosses(self.vertices, self.faces) * self.seen[:, None]
        normals = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(normals, self.faces[:, k], cross)
        norm = np.linalg.norm(normals, axis=1, keepdims=True)
        return normals / np.where(norm > 0, norm, 1.0)


def _crosses(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[F,3] along the normal of each face, twice its area long."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """A triangle mesh (GLB, OBJ, PLY ...) as it is in its file, with its texture.

    Raises InputError where it is missing or unreadable, has no faces or no area, holds NaN or infinite vertices, or has faces
    of vertices that are not there.
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
    absent = (mesh.faces < 0) | (mesh.faces >= len(mesh.vertices))
    if absent.any():
        face, corner = np.argwhere(absent)[0]
        raise InputError(
            f"{path}: face {face} names vertex {mesh.faces[face, corner]} of {len(mesh.vertices)}; repair the mesh"
        )
    if np.abs(mesh.vertices).max() > FURTHEST:
        raise InputError(f"{path}: has vertices further than {FURTHEST:g} m from the origin; repair or scale the mesh")
    if not _crosses(np.asarray(mesh.vertices, np.float64), mesh.faces).any():
        raise InputError(f"{path}: none of its faces has an area; repair the mesh")
    return mesh


def read_mesh(path: str | Path) -> Mesh:
    """A triangle mesh in world coordinates, metres, as one clean surface; all of it counts as seen.

    glTF and GLB are +Y up, as their format has it, and are turned; other formats have no rule, and are taken as they are.
    Left out: faces without area, faces that are there twice (whichever way round), vertices of no face. Faces wound against
    their neighbours are turned, and then all of them where the mesh is inside out. Raises InputError as `load_mesh`.
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
    """A mesh in world coordinates, cleaned as `read_mesh` says; y_up: it is +Y up."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if y_up:
        vertices = vertices @ WORLD_FROM_GLTF[:3, :3].T
    faces = faces[np.linalg.norm(_crosses(vertices, faces), axis=1) > 0]
    place = np.unique(vertices + 0.0, axis=0, return_inverse=True)[1].ravel()  # one number for vertices at one place; -0 is 0
    first = np.unique(np.sort(place[faces], axis=1), axis=0, return_index=True)[1]
    faces = faces[np.sort(first)]
    faces = np.where(_wound_against(place[faces])[:, None], faces[:, ::-1], faces)
    used, corners = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], corners.reshape(faces.shape)
    a, b, c = (vertices[faces[:, k]] - vertices.mean(0) for k in range(3))
    inside_out = np.einsum("fk,fk->f", a, np.cross(b, c)).sum() < 0  # six times the signed volume
    return Mesh(vertices, faces[:, ::-1] if inside_out else faces, np.ones(len(faces), bool))


def _wound_against(faces: np.ndarray) -> np.ndarray:
    """[F] bool: which faces [F,3] to turn so that neighbours are wound alike; in each connected piece, the fewer.

    Neighbours share an edge that no third face has, and are wound alike where they run along it in opposite directions. In a
    graph with two nodes for each face, one for either winding, the windings that go together are connected. A piece that has
    only one side (a Moebius strip) is left as it is.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward = edges[:, 0] < edges[:, 1]
    _, edge, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    edge = edge.ravel()
    order = np.argsort(edge, kind="stable")
    first, second = order[count[edge[order]] == 2].reshape(-1, 2).T
    against = forward[first] == forward[second]
    n, first, second = len(faces), first // 3, second // 3
    if not against.any():
        return np.zeros(n, bool)
    ends = np.concatenate([first, first + n]), np.concatenate([second + n * against, second + n * ~against])
    label = connected_components(coo_array((np.ones(len(ends[0]), bool), ends), shape=(2 * n, 2 * n)), directed=False)[1]
    turned, piece = label[:n] > label[n:], np.minimum(label[:n], label[n:])
    return turned ^ (np.bincount(piece, turned) > np.bincount(piece) / 2)[piece]


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
    Returns (points [N,3], unit normals [N,3], spacing in metres). Raises InputError for fewer than two samples, for more than
    memory holds, and where float32, in which Gaussians are kept, does not tell neighbours apart.
    """
    areas = np.where(mesh.seen, mesh.areas, 0.0)
    area = float(areas.sum())
    if count is None:
        assert spacing is not None
        square = spacing * spacing
        count = _count(area / square if square > 0 else np.inf)
    else:
        count = _count(count)
    spacing = float(np.sqrt(area / count))
    furthest = float(np.abs(mesh.vertices[mesh.faces[mesh.seen]]).max())
    if furthest * np.finfo(np.float32).eps > spacing / 10:
        raise InputError(
            f"prior: float32 does not resolve samples {spacing:.3g} m apart at {furthest:.3g} m from the origin; "
            "move the mesh and the cameras to the origin, or ask for fewer Gaussians"
        )
    rng = np.random.default_rng(seed)
    face = rng.choice(len(areas), OVERSAMPLING * count, p=areas / area)
    u, v = rng.random((2, len(face)))
    root = np.sqrt(u)
    weights = np.stack([1 - root, root * (1 - v), root * v], 1)
    points = np.einsum("nk,nki->ni", weights, mesh.vertices[mesh.faces[face]])
    keep = _blue_noise(points, count, spacing)
    normals = np.einsum("nk,nki->ni", weights[keep], mesh.vertex_normals[mesh.faces[face[keep]]])
    flat = np.linalg.norm(normals, axis=1) < 1e-6  # normals of the corners cancel (a fold): the face's own
    normals[flat] = _crosses(mesh.vertices, mesh.faces[face[keep[flat]]])
    return points[keep], normals / np.linalg.norm(normals, axis=1, keepdims=True), spacing


def _count(samples: float) -> int:
    """The number of samples, rounded. Raises InputError where it is below 2, or takes more memory than the machine has."""
    needed, there = Decimal(samples) * SAMPLE_BYTES, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > there:
        raise InputError(
            f"prior: N = {Decimal(samples):.4g} samples take about {needed / 10**9:.3g} GB of memory, and this machine has "
            f"{there / 1e9:.3g} GB; ask for fewer Gaussians (or a larger --spacing)"
        )
    count = round(samples)
    if count < 2:
        raise InputError(f"prior: {count} samples are too few for a model; ask for more Gaussians (or a smaller --spacing)")
    return count


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
