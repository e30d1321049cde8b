"""The mesh prior: survey cloud -> plane removal -> rock cluster -> Poisson mesh -> surface samples (paper, section III-A)."""

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
from mgs.prior.segmentation import Rock, find_rock
from mgs.prior.settings import PriorSettings, _check
from mgs.prior.surface import poisson_mesh, sample_surface, spread_first
from mgs.prior.truth import error_to_truth
from mgs.seeds import derive_seed


@dataclass(frozen=True)
class Prior:
    """The surface of a rock, and samples of it.

    mesh: what was sampled. points [N,3] world, metres; normals [N,3] unit. spacing: sqrt(area / N), metres.
    depth_tolerance: metres a depth may differ from the prior and still be the same surface (the largest of three rms residuals
    of the cloud, a voxel, and two standard deviations of the depth images).
    numbers: what prior.json holds.
    backed: the first so many points, which are spread evenly, have a Gaussian behind them too (`mgs.prior.initial`).
    """

    mesh: Mesh
    points: np.ndarray
    normals: np.ndarray
    spacing: float
    depth_tolerance: float
    numbers: dict[str, Any]
    backed: int = 0


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
    points, normals, spacing, backed = _samples(mesh, settings, cloud.voxel)
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
        **_sample_numbers(mesh, points, spacing, backed),
        "settings": asdict(settings),
    }
    truth = dataset.root / "rock.glb"
    if truth.is_file() and any(frame.depth_path for frame in dataset.frames):
        tell("distance to the true rock")
        numbers["truth"] = error_to_truth(points, spacing, mesh, truth, dataset.frames, rock, settings.seed)
    return Prior(mesh, points, normals, spacing, tolerance, numbers, backed), rock


def _samples(mesh: Mesh, settings: PriorSettings, pixel: float) -> tuple[np.ndarray, np.ndarray, float, int]:
    """(points [N,3], unit normals [N,3], spacing in metres, how many of the first are backed) of a surface.

    pixel: the spacing where the settings name neither number nor spacing, metres. Raises InputError as `sample_surface`.
    """
    count, share = settings.gaussians, settings.backing
    if count is not None:
        count -= round(count * share / (1 + share))
    seed = derive_seed(settings.seed, "prior/samples")
    points, normals, spacing = sample_surface(mesh, seed, count=count, spacing=settings.spacing or pixel)
    backed = round(share * len(points)) if settings.gaussians is None else settings.gaussians - len(points)
    order = spread_first(points, backed, spacing)
    return points[order], normals[order], spacing, backed


def _sample_numbers(mesh: Mesh, points: np.ndarray, spacing: float, backed: int) -> dict[str, Any]:
    nearest = cKDTree(points).query(points, 2)[0][:, 1]
    return {
        "mesh_faces": len(mesh.faces),
        "mesh_area": float(mesh.areas.sum()),
        "sampled_area": float(mesh.areas[mesh.seen].sum()),
        "n": len(points),
        "backed": backed,
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
    points, normals, spacing, backed = _samples(mesh, settings, 0.0)
    done = {key: value for key, value in asdict(settings).items() if key in ("gaussians", "spacing", "seed", "backing")}
    numbers = {
        "mesh": str(path),
        "depth_tolerance": spacing,
        **_sample_numbers(mesh, points, spacing, backed),
        "settings": done,
    }
    return Prior(mesh, points, normals, spacing, spacing, numbers, backed)


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
        backed = int(numbers.get("backed", 0))  # older priors have no backing
    except (PlyParseError, KeyError, ValueError, TypeError, UnicodeDecodeError) as error:
        raise InputError(f"{folder}: not a readable prior ({error}); make it again with `mgs prior`") from None
    if not np.isfinite(columns).all() or len(columns) < 2:
        raise InputError(f"{path}: has NaN values, or fewer than two points; make the prior again with `mgs prior`")
    if not (0 < spacing < np.inf and 0 < tolerance < np.inf):
        raise InputError(f"{folder / 'prior.json'}: spacing and depth_tolerance must be positive metres; make the prior again")
    if not 0 <= backed <= len(columns):
        raise InputError(f"{folder / 'prior.json'}: backed must be a number of the points; make the prior again")
    return Prior(read_mesh(folder / "mesh.ply"), columns[:, :3], columns[:, 3:], spacing, tolerance, numbers, backed)
