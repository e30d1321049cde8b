"""`mgs prior`: from depth images, points, masks or a mesh to a rock mesh and samples of it."""

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from mgs.cli.options import Seed, parse_gaussians, parse_up
from mgs.cli.terminal import Terminal, progress_bar
from mgs.errors import InputError
from mgs.files import Ours, atomic_folder, below

if TYPE_CHECKING:
    from mgs.data.dataset import Dataset
    from mgs.prior.build import Prior
    from mgs.prior.segmentation import SegmentedCloud
    from mgs.prior.settings import PriorSettings

FILES = ("prior.json", "mesh.ply", "points.ply", "prior.png")  # names in a folder of this command
OUTLINE = 0.05  # share of pixels where mesh and masks disagree, beyond which a line says so

WHY = {
    "depth": ": the dataset has depth images",
    "points": ": the dataset has points (sparse.ply) and no depth",
    "hull": ": the dataset has masks, and neither depth nor points",
    "random": ": the dataset has neither depth, points nor masks; fit it with `mgs fit`",
}
"""Reason for a source that was not asked for."""


LENGTHS = {
    *("depth_noise", "voxel", "plane_sigma", "plane_tolerance", "eps", "cloud_spacing", "radius"),
    *("hull_cell", "fit_rms", "pixel", "accuracy", "completeness", "chamfer", "hausdorff"),
}
"""Keys of prior.json that are lengths."""

ROWS = (
    ("pixels", "depth pixels in the cloud", "{pixels:,}, noise {depth_noise}"),
    ("voxel", "points of the fused cloud", "{points:,} on a {voxel} grid"),
    ("points_kept", "points", "{points:,}, {points_kept:,} of them well triangulated"),
    (
        "plane_inliers",
        "ground plane inliers (RANSAC)",
        "{plane_inliers:,} within {plane_tolerance} (sigma {plane_sigma})",
    ),
    (
        "eps",
        "object's cluster (DBSCAN)",
        "{cluster_size:,} points, of a cloud of {clusters} clusters, eps {eps}",
    ),
    ("cloud_spacing", "points of the object", "{cluster_size:,}, {cloud_spacing} apart"),
    ("hull_cell", "visual hull", "cells of {hull_cell}, fills {hull_fills_masks:.1%} of the masks"),
    ("fit_rms", "cloud to mesh, rms", "{fit_rms}"),
    ("poisson_depth", "octree depth (Poisson)", "{poisson_depth}"),
    ("mesh_faces", "mesh", "{mesh_faces:,} faces, {mesh_area:.4f} {unit}²"),
    ("sampled_area", "area that some frame sees, A", "{sampled_area:.4f} {unit}²"),
    ("sampled_area", "samples, N = A / spacing²", "{n:,} = {sampled_area:.4f} / {spacing:.6f}²"),
    ("apart", "closest pixel, on the surface", "{pixel}; samples lie {apart:.3g} pixels apart"),
    ("triangulated", "points of the cameras", "{triangulated:,}"),
    ("radius", "random points", "{scattered:,}, in and around a ball of radius {radius}"),
    ("sum", "Gaussians", "{sum:,}: a sample each, and {backed:,} behind the surface"),
    ("colour_agreement", "colour variance that all frames agree on", "{colour_agreement:.0%}"),
    ("outline_error", "outline against masks, median", "{outline_error:.2%} of pixels"),
    ("up", "up", "{up}"),
    ("accuracy", "accuracy to the true rock", "{accuracy}"),
    ("completeness", "completeness to the true rock", "{completeness}"),
    ("chamfer", "chamfer distance to the true rock", "{chamfer}"),
    ("hausdorff", "hausdorff distance to the true rock", "{hausdorff}"),
    ("visible_share", "true surface seen by some frame", "{visible_share:.2%} above the ground"),
    (
        "visible_within_2_spacing",
        "seen surface within 2 spacings",
        "{visible_within_2_spacing:.2%}",
    ),
)
"""Rows of the printed table: key of prior.json without which it is left out, label, text."""


def prior(
    dataset: Path,
    out: Path | None = None,
    gaussians: str | None = None,
    spacing: float | None = None,
    source: str | None = None,
    points: Path | None = None,
    up: str | None = None,
    mesh: Path | None = None,
    backing: float = 0.5,
    poisson_depth: int | None = None,
    seed: Seed = 0,
    force: bool = False,
) -> None:
    """Build the prior: a mesh of the object, and points sampled on it, where the Gaussians start.

    From depth images: fuse a cloud, find the ground plane and the object above it, and reconstruct
    its surface (Poisson). From points that came with the cameras: reconstruct the surface of those
    inside the masks or above the ground. From a hull: take all that lies inside all masks. Then
    spread samples evenly over the faces that some frame sees. Writes mesh.ply, points.ply,
    prior.json and prior.png.

    - out: Folder to write, new or empty. Default: DATASET/prior.
    - gaussians N|auto: Number of Gaussians, on the surface and behind it. Default: auto, as many as
      the closest camera resolves.
    - spacing: Distance between samples, in the dataset's unit; in place of --gaussians.
    - source: Source of the surface: depth, points, hull (of the masks), mesh (--mesh) or random.
      Default: the first of depth, points and hull that the dataset has, else random.
    - points: PLY file of points for --source points, world coordinates.
    - up: Up direction: X,Y,Z, or auto: the ground's normal. Default: as the dataset says.
    - mesh: Mesh to sample, world coordinates. GLB is converted from +Y up to +Z up.
    - backing: Gaussians behind the surface for each on it, to keep it opaque; in the paper 0.
    - poisson_depth: Octree depth of the Poisson surface, 3 to 12. Default: from the cloud's
      density."""
    from mgs.data.check import taken_frames
    from mgs.data.dataset import load_dataset
    from mgs.data.meshes import GLTF
    from mgs.prior.build import outline_error, prior_from_mesh, save_prior
    from mgs.prior.figure import draw_prior
    from mgs.prior.initial import AGREEMENT, colour_agreement
    from mgs.prior.photographs import choose_source
    from mgs.prior.settings import PriorSettings
    from mgs.run.nbv import LOOSE

    console = Terminal()
    axis = None if up is None else parse_up(up)
    if mesh is not None and (source not in (None, "mesh") or points is not None):
        raise InputError("prior: --mesh, --source, --points each give a surface; give one of them")
    data = load_dataset(dataset, up=axis)
    folder = out if out is not None else below(dataset, "prior")
    number = parse_gaussians(gaussians)
    settings = PriorSettings(number, spacing, poisson_depth, seed, backing)
    # The folder is checked and locked before the work.
    ours = Ours(FILES, [path for path in (dataset, mesh, points) if path]) if force else None
    with atomic_folder(folder, ours) as unfinished, progress_bar(console=console) as progress:
        segmented = None
        if mesh is not None:
            result = prior_from_mesh(mesh, settings, data)
            if mesh.suffix.lower() in GLTF:
                console.print(f"{mesh}: turned from +Y up, as its format prescribes, to +Z up")
        else:
            chosen = choose_source(data, source, points)
            console.print(f"prior from {chosen}" + ("" if source or points else WHY[chosen]))
            options = {"source": chosen, "points": points}
            result, segmented = _built(data, settings, folder, **options)
        if result.kind != "random":
            progress("colours of the surface")
            agreement = math.nan if data.on_demand else colour_agreement(result, data.frames)
            wrong = outline_error(result.mesh, taken_frames(data))
            checks = {"colour_agreement": agreement, "outline_error": wrong}
            finite = {key: value for key, value in checks.items() if not math.isnan(value)}
            result = replace(result, numbers=result.numbers | finite)
        progress("figure")
        original = result
        if up == "auto" and "plane_normal" in result.numbers:
            result = result.with_up(result.numbers["plane_normal"])
        save_prior(unfinished, result)
        draw_prior(unfinished / "prior.png", original, segmented)
    console.print(_table(result.numbers))
    agreement = result.numbers.get("colour_agreement", 1.0)
    if agreement < AGREEMENT:
        few = f"the photographs agree on only {agreement:.0%} of the surface's colours"
        right = f"on a correct surface on {AGREEMENT:.0%} or more"
        of_photographs = "`mgs fit` lets means move for that, `mgs nbv --set train.means=free` too"
        cure = of_photographs if result.kind in LOOSE else "fit with `--means free`"
        console.print(f"{few} ({right}), so it may be wrong; {cure}", soft_wrap=True)
    wrong = result.numbers.get("outline_error", 0.0)
    if wrong > OUTLINE:
        many = f"{wrong:.1%} of the covered pixels of the median view (limit {OUTLINE:.0%})"
        why = "a part of the object is missing or too much, or masks and poses do not fit"
        console.print(f"the outlines of mesh and masks disagree in {many}: {why}", soft_wrap=True)
    written = sorted(path.name for path in folder.iterdir())
    console.print(f"wrote {folder}: {', '.join(written)}")


def _built(
    dataset: "Dataset", settings: "PriorSettings", folder: Path, **options: Any
) -> "tuple[Prior, SegmentedCloud | None]":
    """`prior_and_cloud`. A refused cloud is drawn beside `folder`; the error names the picture."""
    from mgs.prior.build import prior_and_cloud
    from mgs.prior.figure import draw_refused
    from mgs.prior.segmentation import NoSurface

    try:
        return prior_and_cloud(dataset, settings, **options)
    except NoSurface as refused:
        picture = Path(f"{os.path.abspath(folder)}-refused.png")
        draw_refused(picture, refused.points, refused.kept)
        raise InputError(f"{refused} (the points: {picture})") from None


def _table(numbers: dict[str, Any]) -> Table:
    table = Table("step", "number", title="Mesh prior")
    resolution, unit = numbers.get("resolution", {}), numbers["unit"]
    shown = numbers | numbers.get("truth", {}) | {"up": _up(numbers)}
    shown |= {"sum": numbers["n"] + numbers["backed"]}
    shown |= {"scattered": numbers["n"] - numbers.get("triangulated", 0)}
    if resolution:
        apart = resolution["spacing"] / resolution["pixel"]
        shown |= {"pixel": resolution["pixel"], "apart": apart}
    for key in LENGTHS & shown.keys():
        millimetres = f"{1e3 * shown[key]:.2f} mm"
        shown[key] = millimetres if unit == "m" else f"{shown[key]:.4g} {unit}"
    for key, label, text in ROWS:
        if key in shown:
            table.add_row(label, text.format(**shown))
    return table


def _up(numbers: dict[str, Any]) -> str:
    from mgs.data.world import degrees_between, unit_up

    up = unit_up(numbers["up"])
    text = f"({', '.join(f'{value:.3g}' for value in up)})"
    if "plane_normal" not in numbers:
        return text
    angle = degrees_between(up, unit_up(numbers["plane_normal"]))
    return f"{text}; the ground plane's normal is {angle:.1f}° from it"
