"""The rock's points -> watertight Poisson mesh -> blue-noise surface samples."""

from __future__ import annotations

import os
from decimal import Decimal
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from mgs.errors import InputError
from mgs.prior.segmentation import Plane

if TYPE_CHECKING:
    pass
from mgs.data.meshes import Mesh, _crosses

POISSON_SCALE = 2.0
"""Edge of Poisson's cube over the extent of the points: at pymeshlab's 1.1 the bulge below the open underside leaves the cube
and the surface is not closed."""

POISSON_CELL = 1.5
"""Edge of Poisson's finest cell over the cloud's voxel: finer cells fit noise and cost time (halving it gained nothing)."""

POISSON_DEPTHS = (5, 10)
"""Least and largest octree depth chosen automatically; a caller may ask for 3 to 12 (beyond, pymeshlab crashes)."""

OVERSAMPLING = 5
"""Random candidates per blue-noise sample."""

SAMPLE_BYTES = 3400
"""Memory that sampling takes per sample, most of it for pairs of candidates (measured: 3.3 to 3.5 kB from 10^5 to 10^6)."""


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


def spread_first(points: np.ndarray, count: int, spacing: float) -> np.ndarray:
    """An order of points in which the first `count` are evenly spread by themselves: indices [N].

    points [N,3]: evenly spread, `spacing` metres apart.
    """
    first = _blue_noise(points, count, spacing * np.sqrt(len(points) / count)) if count else np.zeros(0, int)
    return np.concatenate([first, np.setdiff1d(np.arange(len(points)), first)])


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
