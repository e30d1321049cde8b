"""The mesh prior (paper, section III-A): built from a dataset or from a given mesh, written to a
folder and read back.

Building it goes from the cloud of a dataset to ground plane, rock, Poisson mesh, and samples of the
mesh's surface. Without depth, `mgs.prior.photographs` builds the mesh, of triangulated points or of
masks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from plyfile import PlyData, PlyParseError
from scipy.spatial import cKDTree

from mgs.camera import Camera
from mgs.data.clouds import SparseCloud, write_cloud
from mgs.data.dataset import Dataset, Frame
from mgs.data.lens import shrunk_to
from mgs.data.meshes import Mesh, distances_to_mesh, read_mesh
from mgs.data.up import PLUS_Z, Up, unit_up
from mgs.data.visibility import in_mask, visible
from mgs.errors import InputError
from mgs.files import atomic_path, new_folder, read_json, write_json
from mgs.prior.hull import MOST_PIXELS
from mgs.prior.photographs import Surface, check_masks, source_of, surface_of
from mgs.prior.resolution import Resolution, resolution
from mgs.prior.segmentation import Plane, SegmentedCloud, segment_dataset
from mgs.prior.settings import PriorSettings
from mgs.prior.surface import poisson_mesh, sample_surface, spread_first
from mgs.prior.truth import error_to_truth
from mgs.seeds import derive_seed


@dataclass(frozen=True)
class Prior:
    """A mesh of the rock, and N samples of its surface.

    mesh: the mesh; its faces that count as seen were sampled. points: [N,3] samples in the world,
    metres. normals: [N,3] unit.
    spacing: sqrt(sampled area / N), metres: about the distance between neighbouring samples.
    depth_tolerance: by how much a depth image may differ from the prior and still show the same
    surface, metres. It is the largest of three rms distances of the cloud from the mesh, a voxel,
    and two standard deviations of the depth images; for a given mesh, the spacing.
    numbers: what prior.json holds.
    backed: the first so many points, which are spread evenly by themselves, have a Gaussian behind
    them too (`mgs.prior.initial`). up: unit vector that points upwards in the world.
    """

    mesh: Mesh
    points: np.ndarray
    normals: np.ndarray
    spacing: float
    depth_tolerance: float
    numbers: dict[str, Any]
    backed: int = 0
    up: Up = PLUS_Z


def build_prior(
    dataset: Dataset,
    settings: PriorSettings,
    on_stage: Callable[[str], None] | None = None,
    *,
    source: str | None = None,
    points: Path | None = None,
    up: Up | Literal["auto"] | None = None,
) -> tuple[Prior, SegmentedCloud | None]:
    """Build the prior of a dataset from its depth images, from triangulated points, or from its
    masks.

    on_stage(name) is called as each stage starts. source: "depth", "points" or "hull"; None: the
    first of these that the
    dataset has. points: a PLY file of points, in place of the dataset's. up: which way is up;
    "auto": the normal of the ground plane where one was found; None, or no such plane: as the
    dataset says. Returns the prior, and the cloud that its mesh was built from, None for a hull.
    Raises InputError as `source_of`, `check_masks`, `surface_of` and `segment_dataset` (nothing to
    build it from, too few photographs, no rock, two equal rocks), `poisson_mesh` (no closed
    surface) and `sample_surface` (too few or too many samples), or if no frame sees the mesh; and
    NoSurface, which has the cloud, where points give no surface.
    """
    tell = on_stage or (lambda stage: None)
    chosen = source_of(dataset, source, points)
    surface = (
        _of_depth(dataset, settings, tell)
        if chosen == "depth"
        else surface_of(dataset, chosen, settings, tell, points)
    )
    mesh, segmented, cell = surface.mesh, surface.segmented, surface.cell
    tell("surface samples")
    residual, noise = 0.0, 0.0
    if segmented is not None:
        residual = float(
            np.sqrt(
                np.mean(distances_to_mesh(segmented.rock_points, mesh.vertices, mesh.faces) ** 2)
            )
        )
        noise = segmented.cloud.noise
    tolerance = max(3 * residual, cell, 2 * noise)
    mesh = _seen_by(mesh, dataset.frames, tolerance)
    pixel = cell if chosen == "depth" else _pixel(dataset.frames, mesh.vertices.mean(0))
    resolved = _resolved(mesh, settings, [frame.camera for frame in dataset.frames])
    samples, normals, spacing, backed = _samples(mesh, settings, resolved, pixel)
    plane = None if segmented is None else segmented.plane
    ground_up = None if plane is None else unit_up(plane.normal)
    upward = (ground_up if up == "auto" else up) or dataset.up
    numbers = {
        "from": chosen,
        "frames": len(dataset.frames),
        **surface.numbers,
        **({} if segmented is None or plane is None else _plane_numbers(plane, segmented.ground)),
        "fit_rms": residual,
        "depth_tolerance": tolerance,
        **_sample_numbers(mesh, samples, spacing, backed, resolved),
        **_world_numbers(upward, dataset.unit),
        "settings": asdict(settings),
    }
    truth = dataset.root / "rock.glb"
    if truth.is_file() and chosen == "depth" and segmented is not None:
        tell("distance to the true rock")
        numbers["truth"] = error_to_truth(
            samples, spacing, mesh, truth, dataset.frames, segmented, settings.seed
        )
    return Prior(mesh, samples, normals, spacing, tolerance, numbers, backed, upward), segmented


def _of_depth(dataset: Dataset, settings: PriorSettings, tell: Callable[[str], None]) -> Surface:
    """The surface by the source "depth"."""
    segmented = segment_dataset(dataset, settings, tell)
    check_masks(dataset.frames)
    cloud, plane = segmented.cloud, segmented.plane
    assert plane is not None
    tell("Poisson mesh")
    cell = max(cloud.voxel, settings.noise)
    mesh, depth = poisson_mesh(
        segmented.rock_points, segmented.rock_normals, cell, plane, settings.poisson_depth
    )
    numbers = {
        "pixels": cloud.pixels,
        "points": len(cloud.points),
        "voxel": cloud.voxel,
        "depth_noise": cloud.noise,
        "eps": segmented.eps,
        "clusters": segmented.clusters,
        "cluster_size": len(segmented.rock_points),
        "poisson_depth": depth,
    }
    return Surface(mesh, cloud.voxel, segmented, numbers)


def _plane_numbers(plane: Plane, ground: np.ndarray) -> dict[str, Any]:
    """What prior.json holds of the ground plane; ground: [P] bool, the points on it."""
    return {
        "plane_inliers": int(ground.sum()),
        "plane_sigma": plane.sigma,
        "plane_tolerance": plane.tolerance,
        "plane_normal": plane.normal.tolist(),
    }


def _world_numbers(up: Up, unit: str) -> dict[str, Any]:
    """What prior.json holds of the world: which way is up, and what a length of 1 is."""
    return {"up": list(up), "unit": unit}


def _pixel(frames: Sequence[Frame], point: np.ndarray) -> float:
    """The median size of a pixel of the frames at a point [3], in units of the world."""
    return float(
        np.median([np.linalg.norm(f.camera.position - point) / f.camera.K[0, 0] for f in frames])
    )


def _resolved(mesh: Mesh, settings: PriorSettings, cameras: Sequence[Camera]) -> Resolution | None:
    """What the cameras resolve of a mesh, where the settings leave the number of Gaussians to it.
    Raises InputError as `resolution`."""
    return resolution(mesh, cameras) if settings.resolved_by_cameras else None


def _samples(
    mesh: Mesh, settings: PriorSettings, resolved: Resolution | None, pixel: float
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """(points [N,3], unit normals [N,3], spacing in metres, how many of the first are backed) of a
    surface.

    resolved: what `_resolved` found. pixel: that a density counts by, metres. Raises InputError as
    `sample_surface`.
    """
    asked, share = settings.gaussians, settings.backing
    total = asked if isinstance(asked, int) else None
    count = None if total is None else total - round(total * share / (1 + share))
    seed = derive_seed(settings.seed, "prior/samples")
    asked_spacing = (
        resolved.spacing
        if resolved
        else settings.spacing or pixel / (settings.density or 1.0) ** 0.5
    )
    points, normals, spacing = sample_surface(mesh, seed, count=count, spacing=asked_spacing)
    backed = round(share * len(points)) if total is None else total - len(points)
    order = spread_first(points, backed, spacing)
    return points[order], normals[order], spacing, backed


def _sample_numbers(
    mesh: Mesh, points: np.ndarray, spacing: float, backed: int, resolved: Resolution | None
) -> dict[str, Any]:
    """What prior.json holds of the mesh and of its samples [N,3]; areas in square metres, distances
    in metres."""
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
        **({} if resolved is None else {"resolution": asdict(resolved)}),
    }


def prior_from_mesh(
    path: str | Path,
    settings: PriorSettings,
    up: Up = PLUS_Z,
    unit: str = "m",
    cameras: Sequence[Camera] = (),
) -> Prior:
    """The prior of a given mesh in world coordinates, all of whose surface is sampled. up, unit,
    cameras: of the dataset it is for; the cameras are read only where the number of Gaussians is
    left to them.

    Raises InputError as `read_mesh`, `resolution` and `sample_surface`, and for the settings that
    only a mesh built from a
    cloud has: noise, holes, poisson_depth and density.
    """
    settings.refuse_shaping("--mesh gives one")
    mesh = read_mesh(path)
    if settings.density is not None:
        raise InputError(
            f"{path}: a density counts by the voxels of a cloud, which a mesh has not; give a number or a spacing"
        )
    resolved = _resolved(mesh, settings, cameras)
    points, normals, spacing, backed = _samples(mesh, settings, resolved, 0.0)
    done = {
        key: value
        for key, value in asdict(settings).items()
        if key in ("gaussians", "spacing", "seed", "backing")
    }
    numbers = {
        "from": "mesh",
        "mesh": str(path),
        "depth_tolerance": spacing,
        **_sample_numbers(mesh, points, spacing, backed, resolved),
        **_world_numbers(up, unit),
        "settings": done,
    }
    return Prior(mesh, points, normals, spacing, spacing, numbers, backed, up)


def _seen_by(mesh: Mesh, frames: Sequence[Frame], tolerance: float) -> Mesh:
    """The mesh, of which only those faces still count as seen that have a corner some frame sees
    inside its rock mask.

    What no frame sees is buried in the ground, or closes a gap that frames look through, or cannot
    be seen from any candidate
    view. Gaussians there would be of no use, or would show where they should not. tolerance:
    depth_tolerance of the prior, metres. If no frame has depth, the depth of the mesh itself says
    what hides what. Raises InputError if no frame sees any of the mesh.
    """
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    with_depth = [frame for frame in frames if frame.depth_path is not None]
    of_mesh = None if with_depth else mesh_depth(mesh)
    seen, normals = np.zeros(len(mesh.vertices), bool), mesh.vertex_normals
    for frame in with_depth or frames:
        camera = frame.camera
        if of_mesh:  # of a large photograph every few pixels will do
            camera = shrunk_to(camera, MOST_PIXELS)[0]
        depth = of_mesh(camera) if of_mesh else frame.depth()
        seen |= visible(mesh.vertices, normals, camera, depth, tolerance) & in_mask(
            mesh.vertices, frame
        )
    narrowed = mesh.seen & seen[mesh.faces].any(1)
    if not narrowed.any():
        raise InputError("prior: no frame sees the mesh in its rock mask; check masks and poses")
    return replace(mesh, seen=narrowed)


def save_prior(out: str | Path, prior: Prior) -> Path:
    """Write a prior into a new folder: mesh.ply, points.ply (x y z nx ny nz) and prior.json.
    Returns the folder.

    Raises InputError if the folder is not empty or cannot be written.
    """
    import trimesh

    out = new_folder(out)
    with atomic_path(out / "mesh.ply") as temporary:
        trimesh.Trimesh(prior.mesh.vertices, prior.mesh.faces, process=False).export(temporary)
    write_cloud(out / "points.ply", SparseCloud(prior.points, prior.normals))
    write_json(out / "prior.json", prior.numbers)
    return out


def load_prior(folder: str | Path) -> Prior:
    """Read a prior from a folder that `save_prior` wrote.

    All of its mesh counts as seen, because the file does not say which part was sampled. Raises
    InputError if the folder or a file is missing, or a file is damaged or holds NaN.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"{folder}: no such prior; make one with `mgs prior DATASET --out {folder}`"
        )
    numbers = read_json(folder / "prior.json")
    path = folder / "points.ply"
    if not path.is_file():
        raise InputError(f"{path}: no such file; make the prior again with `mgs prior`")
    try:
        data = PlyData.read(str(path))["vertex"].data
        columns = np.stack(
            [np.asarray(data[name], np.float64) for name in ("x", "y", "z", "nx", "ny", "nz")], 1
        )
        spacing, tolerance = float(numbers["spacing"]), float(numbers["depth_tolerance"])
        backed = int(numbers.get("backed", 0))  # older priors have no backing
        up = unit_up(numbers["up"]) if "up" in numbers else PLUS_Z
    except (PlyParseError, KeyError, ValueError, TypeError, UnicodeDecodeError) as error:
        raise InputError(
            f"{folder}: not a readable prior ({error}); make it again with `mgs prior`"
        ) from None
    if not np.isfinite(columns).all() or len(columns) < 2:
        raise InputError(
            f"{path}: has NaN values, or fewer than two points; make the prior again with `mgs prior`"
        )
    if not (0 < spacing < np.inf and 0 < tolerance < np.inf):
        raise InputError(
            f"{folder / 'prior.json'}: spacing and depth_tolerance must be positive metres; make the prior again"
        )
    if not 0 <= backed <= len(columns):
        raise InputError(
            f"{folder / 'prior.json'}: backed must be a number of the points; make the prior again"
        )
    return Prior(
        read_mesh(folder / "mesh.ply"),
        columns[:, :3],
        columns[:, 3:],
        spacing,
        tolerance,
        numbers,
        backed,
        up,
    )
