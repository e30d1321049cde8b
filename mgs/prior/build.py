"""The mesh prior (paper, section III-A): build it from a dataset or a mesh, save and load it
(docs/prior.md)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from plyfile import PlyData

from mgs.camera import Camera
from mgs.data.clouds import SparseCloud, write_cloud
from mgs.data.dataset import Dataset, load_dataset
from mgs.data.frames import Frame, in_mask, outlines_apart, visible
from mgs.data.lens import shrunk_to
from mgs.data.meshes import Mesh, distances_to_mesh, mesh_of, read_mesh
from mgs.data.world import UPRIGHT, World, unit_up
from mgs.errors import InputError
from mgs.files import atomic_path, check_new_folder, parsing, read_json, reading, write_json
from mgs.notebook import cloud, html
from mgs.prior.hull import MOST_PIXELS
from mgs.prior.photographs import check_masks, check_photographs, choose_source, surface_of
from mgs.prior.points import has_points, scattered
from mgs.prior.segmentation import SegmentedCloud, segment_dataset
from mgs.prior.settings import PriorSettings
from mgs.prior.surface import (
    MOST_GAUSSIANS,
    PIXELS_OF_PHOTOGRAPHS,
    PIXELS_PER_SAMPLE,
    Surface,
    error_to_truth,
    poisson_mesh,
    resolution,
    sample_surface,
    spread_first,
)
from mgs.progress import report
from mgs.seeds import derive_seed

LEAST_DIVIDED = 100  # Gaussians that a fit starts with, though it will split them, if as many


@dataclass(frozen=True, repr=False)
class Prior:
    """A mesh of the rock, and N samples of those of its faces that some frame sees.

    - points: [N,3] samples in the upright world of the dataset, metres. normals: [N,3], unit.
    - spacing: sqrt(sampled area / N), metres, about the distance between neighbours.
    - depth_tolerance: largest difference between a depth image and the prior that counts as the
      same surface, metres. It is three rms distances of the cloud from the mesh, a voxel, or two
      standard deviations of depth noise, whichever is largest; for a given mesh, the spacing.
    - numbers: contents of prior.json, where `up` is the dataset's upward direction in its files.
    - backed: the first `backed` points, evenly spread, have a second Gaussian behind the surface
      (`mgs.prior.initial`)."""

    mesh: Mesh
    points: np.ndarray
    normals: np.ndarray
    spacing: float
    depth_tolerance: float
    numbers: dict[str, Any]
    backed: int = 0

    def __repr__(self) -> str:
        points, unit = len(self.points), self.numbers.get("unit", "m")
        number = f"{points:,} points, {points + self.backed:,} Gaussians"
        return f"Prior({number}, spacing {self.spacing:.4g} {unit})"

    def _repr_html_(self) -> str:
        return html(repr(self), [cloud(self.points, 0.5 + self.normals / 2)])

    @property
    def kind(self) -> str:
        """What it was made from: depth, points, hull, mesh or random; empty if unknown."""
        return str(self.numbers.get("from", ""))

    @property
    def world(self) -> World:
        """World of the files of the dataset that the prior was built from."""
        return World(unit_up(self.numbers["up"])) if "up" in self.numbers else UPRIGHT

    def with_up(self, up: Sequence[float]) -> "Prior":
        """The prior turned so that this direction in the dataset's files is +Z."""
        old, new = self.world, World(unit_up(up))
        prior = self.moved(lambda points: new.enter(old.leave(points)))
        return replace(prior, numbers=self.numbers | {"up": list(new.up)})

    def moved(self, change: Callable[[np.ndarray], np.ndarray]) -> "Prior":
        """The prior with `change` applied to its vertices, points and normals [N,3]."""
        mesh = replace(self.mesh, vertices=change(self.mesh.vertices))
        points, normals = change(self.points), change(self.normals)
        return replace(self, mesh=mesh, points=points, normals=normals)


def build_prior(
    dataset: str | Path | Dataset,
    settings: PriorSettings | None = None,
    *,
    source: str | None = None,
    points: Path | None = None,
    shown: Sequence[Frame] | None = None,
    **fields: Any,
) -> Prior:
    """Build the prior of a dataset, as in `build_prior("demo/dataset", gaussians=2000)`.

    - settings, or keyword arguments: fields of `PriorSettings`.
    - source: "depth", "points", "hull" (of the masks) or "random"; by default the first that the
      dataset has. points: PLY file in place of the dataset's points.
    - shown: frames whose masks a "random" prior may read, by default all.

    Raises InputError if the dataset lacks the source, or no surface is found that a frame sees."""
    dataset = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    settings = replace(settings or PriorSettings(), **fields)
    if source == "random" and shown is not None:
        return _random_prior(dataset, settings, shown)
    return prior_and_cloud(dataset, settings, source=source, points=points)[0]


def prior_and_cloud(
    dataset: Dataset,
    settings: PriorSettings,
    *,
    source: str | None = None,
    points: Path | None = None,
) -> tuple[Prior, SegmentedCloud | None]:
    """Build the prior of a dataset. Returns it, and the cloud of its mesh (None for a hull).
    Arguments as `build_prior`. Raises InputError as `choose_source`, `check_masks`, `surface_of`,
    `scattered`, `segment_dataset`, `poisson_mesh` and `sample_surface`, and if no frame sees the
    mesh; NoSurface, which holds the cloud, if points give no surface."""
    kind = choose_source(dataset, source, points)
    if kind == "random":
        return _random_prior(dataset, settings, dataset.frames), None
    if kind != "depth":
        check_photographs(dataset.frames, "is fitted without a prior (`mgs fit`)")
        check_masks(dataset.frames)
    if kind == "depth":
        surface = _depth_surface(dataset, settings)
    else:
        surface = surface_of(dataset, kind, settings, points)
    mesh, segmented, cell = surface.mesh, surface.segmented, surface.cell
    report("surface samples")
    residual, noise, plane = 0.0, 0.0, None
    if segmented is not None:
        distances = distances_to_mesh(segmented.rock_points, mesh.vertices, mesh.faces)
        residual = float(np.sqrt(np.mean(distances**2)))
        noise, plane = segmented.cloud.noise, segmented.plane
    tolerance = max(3 * residual, cell, 2 * noise)
    mesh = _seen_by(mesh, dataset.frames, tolerance)
    cameras = [frame.camera for frame in dataset.frames]
    middle = mesh.vertices.mean(0)
    pixels = [np.linalg.norm(camera.position - middle) / camera.focal for camera in cameras]
    pixel = cell if kind == "depth" else float(np.median(pixels))
    closest = PIXELS_PER_SAMPLE if kind == "depth" else PIXELS_OF_PHOTOGRAPHS
    samples, normals, spacing, sampled = _samples(mesh, settings, cameras, pixel, closest)
    numbers = {"from": kind, "frames": len(dataset.frames), **surface.numbers}
    if segmented is not None and plane is not None:
        numbers |= {
            "plane_inliers": int(segmented.ground.sum()),
            "plane_sigma": plane.sigma,
            "plane_tolerance": plane.tolerance,
            "plane_normal": dataset.world.leave(plane.normal).tolist(),
        }
    numbers |= {"fit_rms": residual, "depth_tolerance": tolerance, **sampled}
    numbers |= _place(dataset) | {"settings": asdict(settings)}
    truth = dataset.root / "rock.glb"
    if truth.is_file() and kind == "depth" and segmented is not None:
        report("distance to the true rock")
        numbers["truth"] = error_to_truth(
            samples, spacing, mesh, truth, dataset, segmented, settings.seed
        )
    prior = Prior(mesh, samples, normals, spacing, tolerance, numbers, sampled["backed"])
    return prior.moved(_as_in_files), segmented


def _as_in_files(values: np.ndarray) -> np.ndarray:
    """Values as `save_prior` writes them: a prior in memory is the one that is read back."""
    return values.astype(np.float32).astype(np.float64)


def _place(dataset: Dataset) -> dict[str, Any]:
    """Items of prior.json about the world of the dataset's files."""
    return {"up": list(dataset.world.up), "unit": dataset.unit}


def _random_prior(dataset: Dataset, settings: PriorSettings, shown: Sequence[Frame]) -> Prior:
    """The prior of the source "random". shown: frames whose masks are read."""
    needs = "needs points, which `mgs import` triangulates at the given poses, or depth"
    check_photographs(dataset.frames, None if has_points(dataset) else needs)
    check_masks(shown)
    mesh, points, normals, spacing, numbers = scattered(dataset, settings, shown)
    about = {"from": "random", "frames": len(dataset.frames), **_place(dataset)}
    tolerance = float(numbers["depth_tolerance"])
    return Prior(mesh, points, normals, spacing, tolerance, about | numbers).moved(_as_in_files)


def _depth_surface(dataset: Dataset, settings: PriorSettings) -> Surface:
    segmented = segment_dataset(dataset, settings)
    check_masks(dataset.frames)
    cloud, plane = segmented.cloud, segmented.plane
    assert plane is not None
    report("Poisson mesh")
    points, normals = segmented.rock_points, segmented.rock_normals
    mesh, depth = poisson_mesh(points, normals, cloud.voxel, plane, settings.poisson_depth)
    numbers = {
        "pixels": cloud.pixels,
        "points": len(cloud.points),
        "voxel": cloud.voxel,
        "depth_noise": cloud.noise,
        "eps": segmented.eps,
        "clusters": segmented.clusters,
        "cluster_size": len(points),
        "poisson_depth": depth,
    }
    return Surface(mesh, cloud.voxel, numbers, segmented)


def _samples(
    mesh: Mesh,
    settings: PriorSettings,
    cameras: Sequence[Camera],
    pixel: float = 0.0,
    closest_pixels: float = PIXELS_PER_SAMPLE,
) -> tuple[np.ndarray, np.ndarray, float, dict[str, Any]]:
    """Samples of a surface: points [N,3], unit normals [N,3], spacing in metres, and items of
    prior.json about mesh and samples; square metres, metres. cameras: the closest one sets the
    spacing, to `closest_pixels` of its pixels, if the settings do not. pixel: unit of
    `settings.density`, metres. Raises InputError as `resolution` and `sample_surface`."""
    resolved = None
    if settings.resolved_by_cameras:
        resolved = resolution(mesh, cameras, closest_pixels)
    gaussians, share = settings.gaussians, settings.backing
    total = gaussians if isinstance(gaussians, int) else None
    if resolved and resolved.samples * (1 + share) > MOST_GAUSSIANS:
        total = MOST_GAUSSIANS
    total = total and max(min(total, LEAST_DIVIDED), round(total / settings.parts))
    count = None if total is None else total - round(total * share / (1 + share))
    if resolved:
        spacing = resolved.spacing
    else:
        spacing = settings.spacing or pixel / (settings.density or 1.0) ** 0.5
    spacing *= settings.parts**0.5
    seed = derive_seed(settings.seed, "prior/samples")
    points, normals, spacing = sample_surface(mesh, seed, count=count, spacing=spacing)
    backed = round(share * len(points)) if total is None else total - len(points)
    order = spread_first(points, backed, spacing)
    points = points[order]
    numbers = {
        "mesh_faces": len(mesh.faces),
        "mesh_area": float(mesh.areas.sum()),
        "sampled_area": float(mesh.areas[mesh.seen].sum()),
        "n": len(points),
        "backed": backed,
        "spacing": spacing,
        **({} if resolved is None else {"resolution": asdict(resolved)}),
    }
    return points, normals[order], spacing, numbers


def prior_from_mesh(
    source: str | Path | tuple[ArrayLike, ArrayLike],
    settings: PriorSettings,
    dataset: Dataset | None = None,
) -> Prior:
    """Sample a mesh in the coordinates of the dataset's files, all over.

    source: a file, or vertices [V,3], metres, and faces [F,3], indices of vertices. The cameras of
    the dataset decide the number of Gaussians if the settings do not. Without a dataset the mesh
    has +Z up, and lengths are metres. Raises InputError if the mesh cannot be read or sampled, if
    no camera sees it, and for settings that only a cloud has: poisson_depth and density."""
    settings.refuse_shaping("`mesh` gives one")
    from mgs.data.raycast import mesh_in_sight  # imported here because it loads Mitsuba

    if isinstance(source, tuple):
        where, mesh = "arrays", mesh_of(*source)
    else:
        where, mesh = str(source), read_mesh(source)
    cameras = [frame.camera for frame in dataset.frames] if dataset else []
    if dataset:
        mesh = mesh_in_sight(mesh, cameras, dataset.world, where)
    if settings.density is not None:
        why = "a density is relative to the voxels of a cloud, and a mesh has none"
        raise InputError(f"{where}: {why}; give a number or a spacing")
    points, normals, spacing, sampled = _samples(mesh, settings, cameras)
    values = {key: getattr(settings, key) for key in ("gaussians", "spacing", "seed", "backing")}
    numbers = {
        "from": "mesh",
        "mesh": where,
        "depth_tolerance": spacing,
        **sampled,
        **_place(dataset or Dataset(Path(), ())),
        "settings": values,
    }
    prior = Prior(mesh, points, normals, spacing, spacing, numbers, sampled["backed"])
    return prior.moved(_as_in_files)


def outline_error(mesh: Mesh, frames: Sequence[Frame]) -> float:
    """Share of the pixels covered by mask or mesh where the two disagree by more than two pixels,
    median over the frames with a mask; NaN without masks."""
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    depth, errors = mesh_depth(mesh), list[float]()
    for k, frame in enumerate(frames):
        report("comparing the surface with masks", k, len(frames))
        if frame.mask_path is None and frame.rock_path is None:
            continue
        errors.append(outlines_apart(frame.mask(), depth(frame.camera) > 0, 2))
    return float(np.median(errors)) if errors else math.nan


def _seen_by(mesh: Mesh, frames: Sequence[Frame], tolerance: float) -> Mesh:
    """The mesh, with only those faces seen that have a corner which some frame sees inside its rock
    mask. Other faces are buried, close a gap that frames look through, or are hidden from every
    view, so Gaussians there would be useless or wrong. tolerance: as `visible`, metres. If no frame
    has depth, the depth of the mesh decides. Raises InputError if no frame sees the mesh."""
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    with_depth = [frame for frame in frames if frame.depth_path is not None]
    depth_of_mesh = None if with_depth else mesh_depth(mesh)
    seen, normals = np.zeros(len(mesh.vertices), bool), mesh.vertex_normals
    for k, frame in enumerate(with_depth or frames):
        report("surface seen by frames", k, len(with_depth or frames))
        camera = frame.camera
        if depth_of_mesh:
            camera = shrunk_to(camera, MOST_PIXELS)[0]
        depth = depth_of_mesh(camera) if depth_of_mesh else frame.depth()
        in_view = visible(mesh.vertices, normals, camera, depth, tolerance)
        seen |= in_view & in_mask(mesh.vertices, frame)
    narrowed = mesh.seen & seen[mesh.faces].any(1)
    if not narrowed.any():
        raise InputError("prior: no frame sees the mesh in its rock mask; check masks and poses")
    return replace(mesh, seen=narrowed)


def save_prior(out: str | Path, prior: Prior) -> Path:
    """Write mesh.ply, points.ply (x y z nx ny nz) and prior.json into a new folder, and return it.
    The files are in the world of the dataset's files (`Prior.world`). Raises InputError if the
    folder is not empty or cannot be written."""
    import trimesh

    out, prior = check_new_folder(out), prior.moved(prior.world.leave)
    with atomic_path(out / "mesh.ply") as temporary:
        trimesh.Trimesh(prior.mesh.vertices, prior.mesh.faces, process=False).export(temporary)
    write_cloud(out / "points.ply", SparseCloud(prior.points, prior.normals))
    write_json(out / "prior.json", prior.numbers)
    return out


def load_prior(folder: str | Path) -> Prior:
    """Read a prior that `save_prior` wrote, turned upright. All faces of its mesh count as seen,
    since the file does not say which were sampled. Raises InputError if the folder or a file is
    missing, damaged or holds NaN."""
    folder = Path(folder)
    if not folder.is_dir():
        cure = f"make one with `mgs prior DATASET --out {folder}`"
        raise InputError(f"{folder}: no such prior; {cure}")
    numbers = read_json(folder / "prior.json")
    path, again = folder / "points.ply", "make it again with `mgs prior`"
    with reading(path, f"file; {again}"), parsing(folder, "prior", again):
        data = PlyData.read(str(path))["vertex"].data
        names = ("x", "y", "z", "nx", "ny", "nz")
        columns = np.stack([np.asarray(data[name], np.float64) for name in names], 1)
        spacing, tolerance = float(numbers["spacing"]), float(numbers["depth_tolerance"])
        backed, world = int(numbers["backed"]), World(unit_up(numbers["up"]))
        if not np.isfinite(columns).all() or len(columns) < 2:
            raise ValueError("points.ply has NaN values, or fewer than two points")
        if not (0 < spacing < np.inf and 0 < tolerance < np.inf):
            raise ValueError("prior.json: spacing and depth_tolerance must be positive metres")
        numbered = backed, numbers.get("triangulated", 0)
        if not all(isinstance(one, int) and 0 <= one <= len(columns) for one in numbered):
            raise ValueError("prior.json: backed and triangulated must be numbers of the points")
    mesh = read_mesh(folder / "mesh.ply")
    points, normals = columns[:, :3], columns[:, 3:]
    prior = Prior(mesh, points, normals, spacing, tolerance, numbers, backed)
    return prior.moved(world.enter)
