"""The mesh prior (paper, section III-A): built from a dataset or from a given mesh, written to a folder and read back.

Building it goes from the cloud of a dataset to ground plane, rock, Poisson mesh, and samples of the mesh's surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyParseError
from scipy.spatial import cKDTree

from mgs.data.dataset import Dataset, Frame
from mgs.data.meshes import Mesh, distances_to_mesh, read_mesh, write_points
from mgs.data.visibility import in_mask, visible
from mgs.errors import InputError
from mgs.files import atomic_path, new_folder, read_json, write_json
from mgs.prior.segmentation import SegmentedCloud, segment_dataset
from mgs.prior.settings import PriorSettings
from mgs.prior.surface import poisson_mesh, sample_surface
from mgs.prior.truth import error_to_truth
from mgs.seeds import derive_seed


@dataclass(frozen=True)
class Prior:
    """A mesh of the rock, and N samples of its surface.

    mesh: the mesh; its faces that count as seen were sampled. points: [N,3] samples in the world, metres. normals: [N,3] unit.
    spacing: sqrt(sampled area / N), metres: about the distance between neighbouring samples.
    depth_tolerance: by how much a depth image may differ from the prior and still show the same surface, metres. It is the
    largest of three rms distances of the cloud from the mesh, a voxel, and two standard deviations of the depth images; for a
    given mesh, the spacing.
    numbers: what prior.json holds.
    """

    mesh: Mesh
    points: np.ndarray
    normals: np.ndarray
    spacing: float
    depth_tolerance: float
    numbers: dict[str, Any]


def build_prior(
    dataset: Dataset, settings: PriorSettings, on_stage: Callable[[str], None] | None = None
) -> tuple[Prior, SegmentedCloud]:
    """Build the prior of a dataset from its depth images, or if it has none from COLMAP's points that `mgs import` kept.

    on_stage(name) is called as each stage starts. Returns the prior, and the cloud that its mesh was built from.
    Raises InputError as `segment_dataset` (no depth, no ground plane, no rock, two equal rocks), `poisson_mesh` (no closed
    surface) and `sample_surface` (too few or too many samples), or if no frame sees the mesh.
    """
    tell = on_stage or (lambda stage: None)
    segmented = segment_dataset(dataset, settings, tell)
    cloud = segmented.cloud
    tell("Poisson mesh")
    cell = max(cloud.voxel, settings.noise)
    mesh, depth = poisson_mesh(segmented.rock_points, segmented.rock_normals, cell, segmented.plane, settings.poisson_depth)
    residual = float(np.sqrt(np.mean(distances_to_mesh(segmented.rock_points, mesh.vertices, mesh.faces) ** 2)))
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
        "plane_inliers": int(segmented.ground.sum()),
        "plane_sigma": segmented.plane.sigma,
        "plane_tolerance": segmented.plane.tolerance,
        "eps": segmented.eps,
        "clusters": segmented.clusters,
        "cluster_size": len(segmented.rock_points),
        "poisson_depth": depth,
        "fit_rms": residual,
        "depth_tolerance": tolerance,
        **_sample_numbers(mesh, points, spacing),
        "settings": asdict(settings),
    }
    truth = dataset.root / "rock.glb"
    if truth.is_file() and any(frame.depth_path for frame in dataset.frames):
        tell("distance to the true rock")
        numbers["truth"] = error_to_truth(points, spacing, mesh, truth, dataset.frames, segmented, settings.seed)
    return Prior(mesh, points, normals, spacing, tolerance, numbers), segmented


def _sample_numbers(mesh: Mesh, points: np.ndarray, spacing: float) -> dict[str, Any]:
    """What prior.json holds of the mesh and of its samples [N,3]; areas in square metres, distances in metres."""
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
    """The prior of a given mesh in world coordinates, metres, all of whose surface is sampled.

    Raises InputError as `read_mesh` and `sample_surface`, if neither the number of samples nor their spacing is given, and for
    the settings that only a mesh built from a cloud has: noise, holes and poisson_depth.
    """
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


def _seen_by(mesh: Mesh, frames: Sequence[Frame], tolerance: float) -> Mesh:
    """The mesh, of which only those faces still count as seen that have a corner some frame sees inside its rock mask.

    What no frame sees is buried in the ground, or closes a gap that frames look through, or cannot be seen from any candidate
    view. Gaussians there would be of no use, or would show where they should not. tolerance: depth_tolerance of the prior,
    metres. If no frame has depth, the mesh is returned as it is. Raises InputError if no frame sees any of the mesh.
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


def save_prior(out: str | Path, prior: Prior) -> Path:
    """Write a prior into a new folder: mesh.ply, points.ply (x y z nx ny nz) and prior.json. Returns the folder.

    Raises InputError if the folder is not empty or cannot be written.
    """
    import trimesh

    out = new_folder(out)
    with atomic_path(out / "mesh.ply") as temporary:
        trimesh.Trimesh(prior.mesh.vertices, prior.mesh.faces, process=False).export(temporary)
    write_points(out / "points.ply", prior.points, prior.normals)
    write_json(out / "prior.json", prior.numbers)
    return out


def load_prior(folder: str | Path) -> Prior:
    """Read a prior from a folder that `save_prior` wrote.

    All of its mesh counts as seen, because the file does not say which part was sampled. Raises InputError if the folder or a
    file is missing, or a file is damaged or holds NaN.
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
