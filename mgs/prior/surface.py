"""The surface: the rock's points -> a watertight mesh (Poisson reconstruction) -> evenly spread
samples (blue noise)."""

from __future__ import annotations

import os
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mgs.data.meshes import Mesh
from mgs.errors import InputError
from mgs.prior.segmentation import Plane

POISSON_SCALE = 2.0
"""Edge of the cube that Poisson reconstruction works in, over the extent of the points. Below the
open underside of the points the surface bulges out; with pymeshlab's own value, 1.1, it leaves the
cube there and is not closed."""

POISSON_CELL = 1.5
"""Largest edge of the finest cells of the reconstruction, over the cloud's voxel. Finer cells fit
noise and take longer; half the edge gained nothing."""

POISSON_DEPTHS = (5, 10)
"""Least and largest depth of the octree that is chosen automatically. A caller may ask for 3 to 12;
beyond, pymeshlab crashes."""

OVERSAMPLING = 5
"""Number of random candidates for each sample."""

SAMPLE_BYTES = 3400
"""Memory that sampling takes for each sample, bytes, most of it for pairs of candidates (measured:
3.3 to 3.5 kB for 10^5 to 10^6 samples)."""


def poisson_mesh(
    points: np.ndarray, normals: np.ndarray, voxel: float, plane: Plane, depth: int | None
) -> tuple[Mesh, int]:
    """A watertight mesh of the rock: its screened Poisson surface, cut flat at the ground plane.

    points, normals: [M,3] of the rock, metres and unit vectors; voxel: distance between
    neighbouring points, metres; depth: of the octree, None to choose it such that its finest cells
    have an edge of at most 1.5 voxels. Poisson reconstruction closes the underside, where there are
    no points, with a bulge that no data supports. The cut replaces the bulge by a flat base on the
    ground, which does not count as seen. Returns (mesh, depth of the octree). Raises InputError if
    the depth is not within 3 to 12, or there is no closed surface
    above the ground. Sources: Kazhdan and Hoppe 2013, by pymeshlab; the cut by manifold3d.
    """
    solid, depth = _closed_solid(points, normals, voxel, depth, plane)
    solid = max(
        solid.trim_by_plane(plane.normal, plane.offset).decompose(),
        key=lambda part: part.volume(),
        default=None,
    )
    if solid is None or solid.is_empty():
        raise InputError(
            f"prior: Poisson at depth {depth} gives nothing above the ground; give more frames, or --from hull"
        )
    mesh = _from_solid(solid)
    base = (np.abs(plane.height(mesh.vertices)) < 1e-6 * np.ptp(mesh.vertices, axis=0).max())[
        mesh.faces
    ].all(1)
    return replace(mesh, seen=~base), depth


def closed_poisson(
    points: np.ndarray, normals: np.ndarray, voxel: float, depth: int | None
) -> tuple[Mesh, int]:
    """The largest piece of the watertight screened Poisson surface of points all around an object.

    Arguments, result and errors as `poisson_mesh`, without the plane and the cut."""
    solid, depth = _closed_solid(points, normals, voxel, depth, None)
    return _from_solid(max(solid.decompose(), key=lambda part: part.volume())), depth


def intersection(a: Mesh, b: Mesh) -> Mesh:
    """The largest piece of what two watertight meshes have in common (manifold3d). Raises
    InputError if that is nothing."""
    pieces = (_to_solid(a.vertices, a.faces) ^ _to_solid(b.vertices, b.faces)).decompose()
    if not pieces:
        raise InputError(
            "prior: the points and the hull of the masks have nothing in common; poses, points or masks are wrong"
        )
    return _from_solid(max(pieces, key=lambda part: part.volume()))


def _to_solid(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """A solid of manifold3d; its status says whether the mesh is closed."""
    import manifold3d

    # It takes only arrays that it could write to, so they are copied.
    return manifold3d.Manifold(
        manifold3d.Mesh64(np.array(vertices, np.float64), np.array(faces, np.uint64))
    )


def _from_solid(solid: Any) -> Mesh:
    cut = solid.to_mesh64()
    vertices, faces = (
        np.asarray(cut.vert_properties)[:, :3],
        np.asarray(cut.tri_verts).astype(np.int64),
    )
    return Mesh(vertices, faces, np.ones(len(faces), bool))


def _closed_solid(
    points: np.ndarray, normals: np.ndarray, voxel: float, depth: int | None, plane: Plane | None
) -> tuple[Any, int]:
    """The Poisson surface as a solid of manifold3d, and the depth of the octree.

    Under an open cloud the surface may leave the cube. Then larger cubes are tried, at last with
    the points mirrored in the ground plane too, which closes any surface that stands on it; the
    cells keep their size. Raises InputError if the depth is not within 3 to 12, or none of that
    gives a closed surface.
    """
    import manifold3d
    import pymeshlab

    if depth is not None and not 3 <= depth <= 12:
        raise InputError(
            f"prior: Poisson depth {depth} is not within 3 to 12; correct --poisson-depth"
        )
    if depth is None:
        cells = POISSON_SCALE * float(np.ptp(points, axis=0).max()) / (POISSON_CELL * voxel)
        depth = int(np.clip(np.ceil(np.log2(cells)), *POISSON_DEPTHS))
    both = points, normals
    if plane is not None:
        image = (
            points - 2 * plane.height(points)[:, None] * plane.normal,
            normals - 2 * (normals @ plane.normal)[:, None] * plane.normal,
        )
        both = np.concatenate([points, image[0]]), np.concatenate([normals, image[1]])
    for scale, finer, (p, n) in [
        (1, 0, (points, normals)),
        (2, 1, (points, normals)),
        (1, 0, both),
        (2, 1, both),
    ]:
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(p, v_normals_matrix=n))
        meshes.generate_surface_reconstruction_screened_poisson(
            depth=min(depth + finer, 12), scale=scale * POISSON_SCALE, threads=1
        )
        surface = meshes.current_mesh()
        vertices, faces = surface.vertex_matrix(), surface.face_matrix()
        if len(faces):
            solid = _to_solid(vertices, faces)
            if solid.status() == manifold3d.Error.NoError and not solid.is_empty():
                return solid, depth
    raise InputError(
        f"prior: Poisson at depth {depth} gives no closed surface; try another --poisson-depth, more frames, or --from hull"
    )


def sample_surface(
    mesh: Mesh, seed: int, *, count: int | None = None, spacing: float | None = None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Samples of the part of a mesh that counts as seen, with about the same distance between all
    neighbours (blue noise).

    Give either count N, or spacing in metres: then N is the area divided by spacing^2, rounded.
    From 5 N random candidates, points are taken one after the other unless they are nearer than a
    radius to one taken before (Poisson disks). The radius is the largest that leaves at least N; of
    the few too many, those nearest to a neighbour are dropped.
    Returns (points [N,3], unit normals [N,3], spacing in metres: the square root of area / N).
    Raises InputError for fewer than two samples, for more than the memory holds, and if float32, in
    which Gaussians are kept, cannot tell neighbouring samples apart at their distance from the
    origin.
    """
    areas = np.where(mesh.seen, mesh.areas, 0.0)
    area = float(areas.sum())
    if count is None:
        assert spacing is not None
        square = spacing * spacing
        count = _checked_count(area / square if square > 0 else np.inf)
    else:
        count = _checked_count(count)
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
    # At a fold the normals of a face's corners may cancel; the face's own normal takes their place.
    flat = np.linalg.norm(normals, axis=1) < 1e-6
    corners = mesh.vertices[mesh.faces[face[keep[flat]]]]
    normals[flat] = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return points[keep], normals / np.linalg.norm(normals, axis=1, keepdims=True), spacing


def spread_first(points: np.ndarray, count: int, spacing: float) -> np.ndarray:
    """An order of points in which the first `count` are evenly spread by themselves: indices [N].

    points [N,3]: evenly spread, `spacing` metres apart.
    """
    first = (
        _blue_noise(points, count, spacing * np.sqrt(len(points) / count))
        if count
        else np.zeros(0, int)
    )
    return np.concatenate([first, np.setdiff1d(np.arange(len(points)), first)])


def _checked_count(samples: float) -> int:
    """A number of samples, rounded. Raises InputError if it is below 2, or would take more memory
    than the machine has."""
    needed, there = (
        Decimal(samples) * SAMPLE_BYTES,
        os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"),
    )
    if needed > there:
        raise InputError(
            f"prior: N = {Decimal(samples):.4g} samples take about {needed / 10**9:.3g} GB of memory, and this machine has "
            f"{there / 1e9:.3g} GB; ask for fewer Gaussians (or a larger --spacing)"
        )
    count = round(samples)
    if count < 2:
        raise InputError(
            f"prior: {count} samples are too few for a model; ask for more Gaussians (or a smaller --spacing)"
        )
    return count


def _blue_noise(points: np.ndarray, count: int, spacing: float) -> np.ndarray:
    """Choose `count` of the random points [N,3] in the way that `sample_surface` describes; returns
    their indices [count].

    About the largest possible radius is found by bisection; it is less than the spacing, metres.
    """
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
    """Take 0, 1, ... n-1 in this order, leaving out each that forms one of the `pairs` [P,2] with
    one taken before.

    Returns those taken. They are found in a few vectorised rounds. In each, a number is taken if no
    smaller one that is still undecided forms a pair with it, and the partners of all numbers taken
    are left out.
    """
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
