"""The mesh prior: survey cloud -> plane removal -> rock cluster -> Poisson mesh -> surface samples (paper, section III-A)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyParseError
from scipy.spatial import cKDTree

from mgs.cloud import (
    FILTERED_SHARE,
    Cloud,
    Plane,
    degrade,
    focus,
    fuse_frames,
    ground_plane,
    rock_cluster,
    sparse_cloud,
    write_points,
)
from mgs.dataset import Dataset, Frame
from mgs.errors import InputError
from mgs.files import atomic_path, new_folder, read_json, write_json
from mgs.seeds import derive_seed, generator
from mgs.surface import Mesh, distances_to_mesh, estimate_normals, poisson_mesh, read_mesh, read_rock, sample_surface
from mgs.visibility import in_mask, visible

TRUTH_SAMPLES = 50_000
"""Samples of the true rock that its errors are measured on."""

FLOOR_UPRIGHT = 0.9
"""A cluster point within two plane tolerances of the ground whose normal is this upright (cosine) is a swell of the ground at
the foot of the rock, not rock."""


@dataclass(frozen=True)
class PriorSettings:
    """gaussians: exactly N samples, or spacing: metres between them (both None: one per voxel of the cloud, a pixel's
    footprint on the rock); poisson_depth: octree depth, None = cells of 1.5 voxels; noise: metres, and holes: share of the
    rock's points, by which the cloud is spoilt on purpose (see `degrade`); seed: root seed."""

    gaussians: int | None = None
    spacing: float | None = None
    poisson_depth: int | None = None
    noise: float = 0.0
    holes: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class Prior:
    """mesh: what was sampled; points [N,3] world, metres; normals [N,3] unit; spacing: sqrt(area / N), metres;
    depth_tolerance: metres a depth may differ from the prior and still be the same surface (the largest of three rms residuals
    of the cloud, a voxel, and two standard deviations of the depth images); numbers: what prior.json holds."""

    mesh: Mesh
    points: np.ndarray
    normals: np.ndarray
    spacing: float
    depth_tolerance: float
    numbers: dict[str, Any]


@dataclass(frozen=True)
class Rock:
    """From the cloud to the rock: ground [P] bool, points of the cloud on the plane; points [M,3], the rock's cluster, and
    normals [M,3]; eps: metres, and clusters: how many DBSCAN found."""

    cloud: Cloud
    plane: Plane
    ground: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    eps: float
    clusters: int


def build_prior(dataset: Dataset, settings: PriorSettings, on_stage: Callable[[str], None] | None = None) -> tuple[Prior, Rock]:
    """Build the prior of a dataset of RGB-D frames, or of its imported sparse points where frames have no depth, from its rock.

    on_stage is told the name of each stage as it starts.
    Raises InputError: no depth, no ground plane, no rock (empty cluster), two equal rocks, no closed surface, N below 2.
    """
    _check(settings)
    tell = on_stage or (lambda stage: None)
    rock = find_rock(dataset, settings, tell)
    cloud = rock.cloud
    tell("Poisson mesh")
    cell = max(cloud.voxel, settings.noise)
    mesh, depth = poisson_mesh(rock.points, rock.normals, cell, rock.plane, settings.poisson_depth)
    residual = float(np.sqrt(np.mean(distances_to_mesh(rock.points, mesh.vertices, mesh.faces) ** 2)))
    tolerance = max(3 * residual, cloud.voxel, 2 * cloud.noise)
    tell("surface samples")
    mesh = _seen_by(mesh, dataset.frames, tolerance)
    spacing = settings.spacing or (None if settings.gaussians else cloud.voxel)
    seed = derive_seed(settings.seed, "prior/samples")
    points, normals, spacing = sample_surface(mesh, seed, count=settings.gaussians, spacing=spacing)
    numbers = {
        "frames": len(dataset.frames),
        "pixels": cloud.pixels,
        "points": len(cloud.points),
        "voxel": cloud.voxel,
        "depth_noise": cloud.noise,
        "plane_inliers": int(rock.ground.sum()),
        "plane_sigma": rock.plane.sigma,
        "plane_tolerance": rock.plane.tolerance,
        "eps": rock.eps,
        "clusters": rock.clusters,
        "cluster_size": len(rock.points),
        "poisson_depth": depth,
        "fit_rms": residual,
        "depth_tolerance": tolerance,
        **_sample_numbers(mesh, points, spacing),
        "settings": asdict(settings),
    }
    truth = dataset.root / "rock.glb"
    if truth.is_file() and any(frame.depth_path for frame in dataset.frames):
        tell("distance to the true rock")
        numbers["truth"] = error_to_truth(points, spacing, mesh, truth, dataset.frames, rock, settings.seed)
    return Prior(mesh, points, normals, spacing, tolerance, numbers), rock


def find_rock(dataset: Dataset, settings: PriorSettings, on_stage: Callable[[str], None]) -> Rock:
    """Cloud, ground plane, rock cluster and its normals (spoilt as `settings` say). Raises InputError as `build_prior`."""
    on_stage("cloud")
    sparse = dataset.root / "sparse.ply"
    if sparse.is_file() and not any(frame.depth_path for frame in dataset.frames):
        cloud = sparse_cloud(sparse)
    else:
        cloud = fuse_frames(dataset.frames)
    on_stage("ground plane")
    plane = ground_plane(cloud, dataset.frames, derive_seed(settings.seed, "prior/plane"))
    ground = np.abs(plane.height(cloud.points)) <= plane.tolerance
    above = plane.height(cloud.points) > plane.tolerance
    on_stage("rock cluster")
    inside, eps, clusters = rock_cluster(cloud.points[above], cloud.voxel, focus(dataset.frames).point, str(dataset.root))
    points, views = cloud.points[above][inside], cloud.views[above][inside]
    points, kept = degrade(points, settings.noise, settings.holes, generator(settings.seed, "prior/degrade"))
    points, views = points[kept], views[kept]
    normals = estimate_normals(points, views, (FILTERED_SHARE * cloud.noise + settings.noise) / cloud.voxel)
    floor = (plane.height(points) < 2 * plane.tolerance) & (normals @ plane.normal > FLOOR_UPRIGHT)
    return Rock(cloud, plane, ground, points[~floor], normals[~floor], eps, clusters)


def _sample_numbers(mesh: Mesh, points: np.ndarray, spacing: float) -> dict[str, Any]:
    nearest = cKDTree(points).query(points, 2)[0][:, 1]
    return {
        "mesh_faces": len(mesh.faces),
        "mesh_area": float(mesh.areas.sum()),
        "sampled_area": float(mesh.areas[mesh.seen].sum()),
        "n": len(points),
        "spacing": spacing,
        "nearest_neighbour_mean": float(nearest.mean()),
        "nearest_neighbour_min": float(nearest.min()),
    }


def prior_from_mesh(path: str | Path, settings: PriorSettings) -> Prior:
    """The prior of a given mesh in world coordinates, metres: it is only sampled.

    Raises InputError as `read_mesh`, and for settings of a cloud and of Poisson's surface: there is neither.
    """
    _check(settings)
    built = {
        "--prior-noise": settings.noise > 0,
        "--holes": settings.holes > 0,
        "--poisson-depth": settings.poisson_depth is not None,
    }
    given = " and ".join(option for option, is_given in built.items() if is_given)
    if given:
        raise InputError(f"prior: {given} shape a mesh that is built here, but --mesh gives one; leave out either")
    mesh = read_mesh(path)
    if settings.gaussians is None and settings.spacing is None:
        raise InputError(f"{path}: a given mesh says nothing of how finely to sample it; give --gaussians or --spacing")
    seed = derive_seed(settings.seed, "prior/samples")
    points, normals, spacing = sample_surface(mesh, seed, count=settings.gaussians, spacing=settings.spacing)
    done = {"gaussians": settings.gaussians, "spacing": settings.spacing, "seed": settings.seed}
    numbers = {"mesh": str(path), "depth_tolerance": spacing, **_sample_numbers(mesh, points, spacing), "settings": done}
    return Prior(mesh, points, normals, spacing, spacing, numbers)


def _check(settings: PriorSettings) -> None:
    if settings.gaussians is not None and settings.gaussians < 2:
        raise InputError(f"prior: {settings.gaussians} Gaussians are too few for a model; ask for more with --gaussians")
    if settings.spacing is not None and not settings.spacing > 0:
        raise InputError(f"prior: spacing {settings.spacing} m must be positive; correct --spacing")
    if settings.gaussians is not None and settings.spacing is not None:
        raise InputError("prior: --gaussians and --spacing fix the same number; give one of them")
    if not 0 <= settings.noise < np.inf:
        raise InputError(f"prior: noise {settings.noise} m must be 0 or more; correct --prior-noise")
    if not 0 <= settings.holes <= 0.9:
        raise InputError(f"prior: holes {settings.holes} is a share of the rock's points, 0 to 0.9; correct --holes")


def _seen_by(mesh: Mesh, frames: Sequence[Frame], tolerance: float) -> Mesh:
    """The mesh with `seen` narrowed to faces with a corner that some frame sees inside its rock mask.

    What no frame sees is buried, bridges a gap that frames look through, or lies where no view could ever use it: Gaussians
    there are wasted, or show where they should not. Without depth nothing is narrowed.
    """
    frames = [frame for frame in frames if frame.depth_path is not None]
    if not frames:
        return mesh
    seen, normals = np.zeros(len(mesh.vertices), bool), mesh.vertex_normals
    for frame in frames:
        seen |= visible(mesh.vertices, normals, frame.camera, frame.depth(), tolerance) & in_mask(mesh.vertices, frame)
    narrowed = mesh.seen & seen[mesh.faces].any(1)
    if not narrowed.any():
        raise InputError("prior: no frame sees the mesh in its rock mask; check masks and poses")
    return replace(mesh, seen=narrowed)


def error_to_truth(
    points: np.ndarray, spacing: float, mesh: Mesh, truth: Path, frames: Sequence[Frame], rock: Rock, seed: int
) -> dict[str, float]:
    """How far the prior is from the true rock, metres (Knapitsch et al. 2017 name accuracy and completeness).

    accuracy: mean distance of the prior's samples to the true surface; completeness: mean distance of the true surface that
    some frame sees to the prior's mesh; chamfer: their mean; hausdorff: the largest distance either way;
    visible_within_2_spacing: share of that visible surface within two spacings of the mesh; visible_share: share of the true
    surface above the ground that some frame sees.
    """
    import trimesh

    known = read_rock(truth)
    true = trimesh.Trimesh(known.vertices, known.faces, process=False)
    surface, face = trimesh.sample.sample_surface(true, TRUTH_SAMPLES, seed=derive_seed(seed, "prior/truth"))
    exposed = rock.plane.height(np.asarray(surface)) > 0
    surface, normals = np.asarray(surface)[exposed], true.face_normals[face[exposed]]
    tolerance = max(spacing / 2, 2 * rock.cloud.noise)
    seen = np.zeros(len(surface), bool)
    for frame in frames:
        # Two-sided: scanned rocks come with either winding.
        seen |= visible(surface, normals, frame.camera, frame.depth(), tolerance, two_sided=True)
    if not seen.any():
        raise InputError(f"{truth}: no frame sees the true rock; it does not belong to this dataset (or is in another frame)")
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


def save_prior(out: str | Path, prior: Prior) -> Path:
    """Write mesh.ply, points.ply (x y z nx ny nz) and prior.json into a new folder. Raises InputError if it is not empty."""
    import trimesh

    out = new_folder(out)
    with atomic_path(out / "mesh.ply") as temporary:
        trimesh.Trimesh(prior.mesh.vertices, prior.mesh.faces, process=False).export(temporary)
    write_points(out / "points.ply", prior.points, prior.normals)
    write_json(out / "prior.json", prior.numbers)
    return out


def load_prior(folder: str | Path) -> Prior:
    """Read a folder that `save_prior` wrote. Raises InputError where a file is missing, damaged or holds NaN.

    All of the mesh counts as seen: its file does not say what was sampled.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such prior; make one with `mgs prior DATASET --out {folder}`")
    numbers = read_json(folder / "prior.json")
    path = folder / "points.ply"
    if not path.is_file():
        raise InputError(f"{path}: no such file; make the prior again with `mgs prior`")
    try:
        data = PlyData.read(str(path))["vertex"].data
        columns = np.stack([np.asarray(data[name], np.float64) for name in ("x", "y", "z", "nx", "ny", "nz")], 1)
        spacing, tolerance = float(numbers["spacing"]), float(numbers["depth_tolerance"])
    except (PlyParseError, KeyError, ValueError, TypeError, UnicodeDecodeError) as error:
        raise InputError(f"{folder}: not a readable prior ({error}); make it again with `mgs prior`") from None
    if not np.isfinite(columns).all() or len(columns) < 2:
        raise InputError(f"{path}: has NaN values, or fewer than two points; make the prior again with `mgs prior`")
    if not (0 < spacing < np.inf and 0 < tolerance < np.inf):
        raise InputError(f"{folder / 'prior.json'}: spacing and depth_tolerance must be positive metres; make the prior again")
    return Prior(read_mesh(folder / "mesh.ply"), columns[:, :3], columns[:, 3:], spacing, tolerance, numbers)
