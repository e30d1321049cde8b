"""The surface: watertight mesh of the rock's points (Poisson), the sample spacing that images can
resolve, even samples (blue noise), and their distance from the true rock. A detail of a period
under two pixels is in no image (Nyquist); samples closer than pixels differ by noise only."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mgs.camera import Camera
from mgs.data.dataset import Dataset
from mgs.data.frames import in_image, visible
from mgs.data.meshes import Mesh, distances_to_mesh, read_mesh
from mgs.errors import InputError
from mgs.prior.segmentation import Plane, SegmentedCloud
from mgs.seeds import derive_seed

# Edge of the cube of the Poisson reconstruction, over the extent of the points. Below the open
# underside the surface bulges out; with pymeshlab's default, 1.1, it leaves the cube and is not
# closed.
POISSON_SCALE = 2.0
POISSON_CELL = 1.5  # largest edge of the finest cells, over the voxel. Finer cells fit noise.
POISSON_DEPTHS = (5, 10)  # least and largest octree depth chosen; beyond 12 pymeshlab crashes
# A shell fills what is so near to points, over their spacing, but at least this share of their
# extent, then loses two thirds of that at its outside. It is so many cells of a grid.
SHELL, LEAST_SHELL, SHELL_CELLS = 3.0, 1 / 40, 3
SUPPORT = 0.02  # least share of the points next to a piece of the surface, for the piece to be kept
CUBES = ((1, 0), (2, 1))  # to try: factor on POISSON_SCALE, and octree levels that keep the cells
OVERSAMPLING = 5  # random candidates per sample
SAMPLE_BYTES = 3400  # memory per sample, bytes, mostly for pairs of candidates (measured)


@dataclass(frozen=True)
class Surface:
    """A surface and its origin."""

    mesh: Mesh  # closed, world
    cell: float  # resolution, units of the world
    numbers: dict[str, Any]  # items of prior.json
    segmented: SegmentedCloud | None = None  # the cloud, if any


def poisson_mesh(
    points: np.ndarray, normals: np.ndarray, voxel: float, plane: Plane, depth: int | None
) -> tuple[Mesh, int]:
    """Watertight screened Poisson surface of the rock, cut flat at the ground plane, and octree
    depth.

    points, normals: [M,3], metres and unit vectors; voxel: distance between neighbours, metres;
    depth: of the octree, None for finest cells of at most 1.5 voxels. The reconstruction closes the
    underside with a bulge that no data supports; the cut replaces it by a flat base, not seen.
    Raises InputError if there is no closed surface above the ground. Sources: Kazhdan and Hoppe
    2013, by pymeshlab; the cut by manifold3d."""
    solid, depth = _closed_solid(points, normals, voxel, depth, plane)
    return _above(plane, solid, points), depth


def _above(plane: Plane, solid: Any, points: np.ndarray) -> Mesh:
    """Mesh of what is above the ground of a solid of manifold3d around points [M,3]; its flat base
    is not seen. Raises InputError if there is nothing."""
    solid = _supported(solid.trim_by_plane(plane.normal, plane.offset), points)
    if solid.is_empty():
        cure = "give more frames, or take the source hull"
        raise InputError(f"prior: the surface of the points is nowhere above the ground; {cure}")
    mesh = _from_solid(solid)
    limit = 1e-6 * np.ptp(mesh.vertices, axis=0).max()
    on_ground = np.abs(plane.height(mesh.vertices)) < limit
    return replace(mesh, seen=~on_ground[mesh.faces].all(1))


def closed_poisson(
    points: np.ndarray, normals: np.ndarray, voxel: float, depth: int | None
) -> tuple[Mesh, int]:
    """The watertight Poisson surface of points all around an object, and octree depth. Arguments
    and errors as `poisson_mesh`, without plane and cut."""
    solid, depth = _closed_solid(points, normals, voxel, depth, None)
    return _from_solid(_supported(solid, points)), depth


def shell(points: np.ndarray, spacing: float, plane: Plane | None) -> Mesh:
    """Closed mesh of what is near points [M,3] (SHELL), or enclosed by that, cut at the ground if
    there is one: for points of which Poisson makes no closed surface. spacing: of the points.
    Raises InputError if nothing is above the ground."""
    from scipy.ndimage import binary_fill_holes, distance_transform_edt
    from skimage.measure import marching_cubes

    low, high = points.min(0), points.max(0)
    reach = max(SHELL * spacing, LEAST_SHELL * float((high - low).max()))
    cell = reach / SHELL_CELLS
    low, high = low - reach - 2 * cell, high + reach + 2 * cell
    cells = np.indices(np.ceil((high - low) / cell).astype(int) + 1)
    near = cKDTree(points).query(low + cell * np.moveaxis(cells, 0, -1))[0] < reach
    filled = binary_fill_holes(near)
    depth = distance_transform_edt(filled) - distance_transform_edt(~filled)
    vertices, faces, *_ = marching_cubes(depth, SHELL_CELLS * 2 / 3, gradient_direction="ascent")
    solid = _to_solid(low + cell * vertices, faces)
    return _above(plane, solid, points) if plane else _from_solid(_supported(solid, points))


def _supported(solid: Any, points: np.ndarray) -> Any:
    """The pieces of a solid of manifold3d next to which SUPPORT of the points [M,3] or more lie."""
    import manifold3d

    pieces = [piece for piece in solid.decompose() if piece.num_vert()]
    if len(pieces) < 2:
        return solid
    corners = [np.asarray(piece.to_mesh64().vert_properties)[:, :3] for piece in pieces]
    owner = np.repeat(np.arange(len(pieces)), [len(each) for each in corners])
    nearest = owner[cKDTree(np.concatenate(corners)).query(points)[1]]
    share = np.bincount(nearest, minlength=len(pieces)) / len(points)
    main = [piece for piece, part in zip(pieces, share, strict=True) if part >= SUPPORT]
    return manifold3d.Manifold.compose(main)


def intersection(a: Mesh, b: Mesh) -> Mesh:
    """Largest piece of the intersection of watertight meshes. Raises InputError if empty."""
    pieces = (_to_solid(a.vertices, a.faces) ^ _to_solid(b.vertices, b.faces)).decompose()
    if not pieces:
        cure = "correct poses, points or masks"
        raise InputError(f"prior: no point lies in the hull of the masks; {cure}")
    return _from_solid(max(pieces, key=lambda part: part.volume()))


def _to_solid(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """Solid of manifold3d; its status says whether the mesh is closed."""
    import manifold3d

    # It takes writable arrays only, so they are copied.
    mesh = manifold3d.Mesh64(np.array(vertices, np.float64), np.array(faces, np.uint64))
    return manifold3d.Manifold(mesh)


def _from_solid(solid: Any) -> Mesh:
    mesh = solid.to_mesh64()
    vertices = np.asarray(mesh.vert_properties)[:, :3]
    faces = np.asarray(mesh.tri_verts).astype(np.int64)
    return Mesh(vertices, faces, np.ones(len(faces), bool))


def _closed_solid(
    points: np.ndarray, normals: np.ndarray, voxel: float, depth: int | None, plane: Plane | None
) -> tuple[Any, int]:
    """Poisson surface as a solid of manifold3d, and the octree depth. Under an open cloud the
    surface may leave the cube. Then a larger cube is tried, and last the points are mirrored in the
    ground plane too; cells keep their size. Raises InputError if no try gives a closed surface."""
    import manifold3d
    import pymeshlab

    if depth is None:
        cells = POISSON_SCALE * float(np.ptp(points, axis=0).max()) / (POISSON_CELL * voxel)
        depth = int(np.clip(np.ceil(np.log2(cells)), *POISSON_DEPTHS))
    both = points, normals
    if plane is not None:
        points_below = points - 2 * plane.height(points)[:, None] * plane.normal
        normals_below = normals - 2 * (normals @ plane.normal)[:, None] * plane.normal
        both = np.concatenate([points, points_below]), np.concatenate([normals, normals_below])
    tries = [(p, n, scale, finer) for p, n in ((points, normals), both) for scale, finer in CUBES]
    for p, n, scale, finer in tries:
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
    cure = "try another `poisson_depth`, more frames, or take the source hull"
    raise InputError(f"prior: Poisson at depth {depth} gives no closed surface; {cure}")


def sample_surface(
    mesh: Mesh, seed: int, *, count: int | None = None, spacing: float | None = None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Evenly spread samples (blue noise) of the seen part of a mesh.

    Give count N, or spacing in metres for N = area / spacing^2. Of 5 N random candidates, points
    are taken in turn unless closer than a radius to one taken before (Poisson disks). The radius is
    the largest that leaves at least N; the few too many, nearest to a neighbour, are dropped.
    Returns (points [N,3], unit normals [N,3], spacing: sqrt(area / N), metres). Raises InputError
    for fewer than two samples, more than memory holds, and if float32 cannot tell neighbours apart
    at their distance from the origin."""
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
            f"prior: float32 does not resolve samples {spacing:.3g} m apart at {furthest:.3g} m "
            "from the origin; move the mesh and the cameras to the origin, or ask for fewer "
            "Gaussians"
        )
    rng = np.random.default_rng(seed)
    face = rng.choice(len(areas), OVERSAMPLING * count, p=areas / area)
    u, v = rng.random((2, len(face)))
    root = np.sqrt(u)
    weights = np.stack([1 - root, root * (1 - v), root * v], 1)
    points = np.einsum("nk,nki->ni", weights, mesh.vertices[mesh.faces[face]])
    keep = _blue_noise(points, count, spacing)
    normals = np.einsum("nk,nki->ni", weights[keep], mesh.vertex_normals[mesh.faces[face[keep]]])
    # At a fold the normals of a face's corners may cancel; its own normal replaces them.
    flat = np.linalg.norm(normals, axis=1) < 1e-6
    normals[flat] = mesh.crosses[face[keep[flat]]]
    return points[keep], normals / np.linalg.norm(normals, axis=1, keepdims=True), spacing


def spread_first(points: np.ndarray, count: int, spacing: float) -> np.ndarray:
    """Order [N] of points whose first `count` are evenly spread by themselves."""
    if not count:
        return np.arange(len(points))
    first = _blue_noise(points, count, spacing * np.sqrt(len(points) / count))
    return np.concatenate([first, np.setdiff1d(np.arange(len(points)), first)])


def _checked_count(samples: float) -> int:
    """Rounded number of samples. Raises InputError if below 2, or beyond the machine's memory."""
    need = Decimal(samples) * SAMPLE_BYTES
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if need > there:
        raise InputError(
            f"prior: N = {Decimal(samples):.4g} samples take about {need / 10**9:.3g} GB of "
            f"memory, and this machine has {there / 1e9:.3g} GB; "
            "ask for fewer Gaussians (or a larger `spacing`)"
        )
    count = round(samples)
    if count < 2:
        few = f"{count} samples are too few for a model"
        raise InputError(f"prior: {few}; ask for more Gaussians (or a smaller `spacing`)")
    return count


def _blue_noise(points: np.ndarray, count: int, spacing: float) -> np.ndarray:
    """Choose `count` of random points [N,3] as `sample_surface` describes: indices [count]. The
    radius is found by bisection and less than the spacing, metres."""
    pairs = cKDTree(points).query_pairs(0.95 * spacing, output_type="ndarray")
    distance = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    low, high = 0.0, 0.95 * spacing
    best = np.arange(len(points))
    for _ in range(12):
        radius = (low + high) / 2
        subset = _independent(pairs[distance < radius], len(points))
        if len(subset) >= count:
            best, low = subset, radius
        else:
            high = radius
        if len(best) <= 1.002 * count:
            break
    nearest = cKDTree(points[best]).query(points[best], 2)[0][:, 1]
    return np.sort(best[np.argsort(-nearest, kind="stable")[:count]])


def _independent(pairs: np.ndarray, n: int) -> np.ndarray:
    """Take 0, 1, ... n-1 in turn, except partners in `pairs` [P,2] of one taken before. Vectorised
    rounds: a number is taken if it has no smaller undecided partner; partners of taken numbers are
    dropped."""
    low, high = pairs.min(1), pairs.max(1)
    undecided, members = np.ones(n, bool), np.zeros(n, bool)
    while undecided.any():
        new = undecided.copy()
        new[high] = False
        members |= new
        undecided &= ~new
        undecided[high[new[low]]] = False
        active = undecided[low] & undecided[high]
        low, high = low[active], high[active]
    return np.flatnonzero(members)


# Spacing of the samples over the size of the closest pixel. Closer samples gain little, and much
# closer ones lose: the model then has more parameters than the images have values
# (docs/parsimony.md).
PIXELS_PER_SAMPLE = 0.9
PIXELS_OF_PHOTOGRAPHS = 1.15  # for photographs: more Gaussians need more passes (docs/fit.md)
MOST_GAUSSIANS = 200_000  # most that cameras decide: close-ups ask for millions. A chosen constant


@dataclass(frozen=True)
class Resolution:
    """Resolution of the closest camera on the surface."""

    pixel: float  # on the surface, metres, rms over the area
    spacing: float  # of the samples, metres
    area: float  # square metres

    @property
    def samples(self) -> int:
        """Number of samples, area / spacing^2."""
        return round(self.area / self.spacing**2)


def resolution(
    mesh: Mesh, cameras: Sequence[Camera], pixels: float = PIXELS_PER_SAMPLE
) -> Resolution:
    """Spacing of samples that these cameras can tell apart, for the seen part of the mesh.

    pixels: spacing of the samples over the size of the closest pixel. The pixel on a face is
    z-depth / focal length, whatever the slant; the smallest counts among the cameras that have the
    face in their image and in front, occluded or not. N is the sum over faces of area / (pixels
    pixel)^2; faces in no image do not count. Raises InputError if none is."""
    middles = mesh.vertices[mesh.faces[mesh.seen]].mean(1)
    crosses, areas = mesh.crosses[mesh.seen], mesh.areas[mesh.seen]
    pixel = np.full(len(areas), np.inf)
    for camera in cameras:
        at, z = camera.project(middles)
        inside = in_image(camera, at, z)
        facing = np.einsum("fk,fk->f", crosses, camera.position - middles) > 0
        size = z / camera.focal
        pixel = np.where(inside & facing & (size < pixel), size, pixel)
    in_view = np.isfinite(pixel) & (areas > 0)
    if not in_view.any():
        why = "no frame shows the mesh, so nothing says how many Gaussians"
        raise InputError(f"prior: {why}; give `gaussians`")
    area = float(areas[in_view].sum())
    typical = float(np.sqrt(area / (areas[in_view] / pixel[in_view] ** 2).sum()))
    return Resolution(typical, pixels * typical, area)


TRUTH_SAMPLES = 50_000  # random points on the true rock whose distance to the prior is measured


def error_to_truth(
    points: np.ndarray,
    spacing: float,
    mesh: Mesh,
    truth: Path,
    dataset: Dataset,
    segmented: SegmentedCloud,
    seed: int,
) -> dict[str, float]:
    """Distances between a prior and the true rock, metres.

    points: [N,3] samples, `spacing` metres apart; truth: file of the rock; dataset: with depth;
    segmented: the cloud of the mesh; seed: root of the random points. Returns:

    - accuracy, completeness (Knapitsch et al. 2017): mean distance from the samples to the true
      surface, and from the seen true surface to the mesh;
    - chamfer: the mean of the two; hausdorff: the largest distance in either direction;
    - visible_within_2_spacing: share of the seen true surface within two spacings of the mesh;
    - visible_share: share of the true surface above the ground that some frame sees.

    Raises InputError if the rock's file or a depth image cannot be read, or no frame sees the rock.
    """
    import trimesh

    rock = read_mesh(truth)
    vertices = dataset.world.enter(rock.vertices)
    true = trimesh.Trimesh(vertices, rock.faces, process=False)
    sample_seed = derive_seed(seed, "prior/truth")
    surface, face = trimesh.sample.sample_surface(true, TRUTH_SAMPLES, seed=sample_seed)
    surface, normals = np.asarray(surface), true.face_normals[face]
    if segmented.plane is not None:
        exposed = segmented.plane.height(surface) > 0
        surface, normals = surface[exposed], normals[exposed]
    tolerance = max(spacing / 2, 2 * segmented.cloud.noise)
    seen = np.zeros(len(surface), bool)
    for frame in dataset.frames:
        # Faces of a scanned rock may be wound either way.
        seen |= visible(surface, normals, frame.camera, frame.depth(), tolerance, two_sided=True)
    if not seen.any():
        cure = "it is of another dataset or in other coordinates, so remove or replace it"
        raise InputError(f"{truth}: no frame sees the true rock; {cure}")
    there = distances_to_mesh(points, true.vertices, true.faces)
    back = distances_to_mesh(surface[seen], mesh.vertices, mesh.faces)
    return {
        "accuracy": float(there.mean()),
        "completeness": float(back.mean()),
        "chamfer": float((there.mean() + back.mean()) / 2),
        "hausdorff": float(max(there.max(), back.max())),
        "visible_within_2_spacing": float((back < 2 * spacing).mean()),
        "visible_share": float(seen.mean()),
    }
