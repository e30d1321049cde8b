"""`mgs prior`: from depth images, points, masks or a mesh to a rock mesh and samples of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from mgs.cli.options import Seed, parse_gaussians, parse_up
from mgs.cli.progress import progress_bar
from mgs.cli.terminal import Terminal
from mgs.errors import InputError
from mgs.files import Ours, atomic_folder, below

if TYPE_CHECKING:
    from mgs.data.dataset import Dataset
    from mgs.prior.build import Prior
    from mgs.prior.segmentation import SegmentedCloud
    from mgs.prior.settings import PriorSettings

FILES = ("prior.json", "mesh.ply", "points.ply", "prior.png")
"""Names in a folder of this command."""

OUTLINE = 0.05
"""Disagreement of the outlines of mesh and masks, share of the covered pixels, beyond which a line
says so."""

WHY = {
    "depth": ": the dataset has depth images",
    "points": ": the dataset has points (sparse.ply) and no depth",
    "hull": ": the dataset has masks, and neither depth nor points",
    "random": ": the dataset has neither depth, points nor masks; fit it with `mgs fit`",
}
"""Reason for a source that was not asked for."""


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
    """Build the prior: a mesh of the rock, and points sampled on it, where the Gaussians start.

    From depth images: fuse a cloud, find the ground plane and the rock above it, and reconstruct
    its surface (Poisson). From points that came with the cameras: reconstruct the surface of those
    inside the masks or above the ground. From a hull: take the largest body inside all masks. Then
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
      density.
    """
    from mgs.data.check import taken_frames
    from mgs.data.dataset import load_dataset
    from mgs.data.meshes import GLTF
    from mgs.prior.build import outline_error, prior_from_mesh, save_prior
    from mgs.prior.figure import draw_prior
    from mgs.prior.initial import AGREEMENT, colour_agreement
    from mgs.prior.photographs import source_of
    from mgs.prior.settings import PriorSettings

    console = Terminal()
    axis = None if up is None else parse_up(up)
    if mesh is not None and (source not in (None, "mesh") or points is not None):
        raise InputError(
            "prior: --mesh gives the surface, and --source or --points build one; give one of them"
        )
    loaded = load_dataset(dataset)
    folder = out if out is not None else below(dataset, "prior")
    number = parse_gaussians(gaussians)
    settings = PriorSettings(number, spacing, poisson_depth, seed, backing)
    # The folder is checked and locked before the work.
    ours = Ours(FILES, [path for path in (dataset, mesh, points) if path]) if force else None
    with atomic_folder(folder, ours) as unfinished, progress_bar(console=console) as progress:
        segmented = None
        if mesh is not None:
            cameras = [frame.camera for frame in loaded.frames]
            result = prior_from_mesh(
                mesh, settings, axis or loaded.up, loaded.unit, cameras, loaded.origin
            )
            if mesh.suffix.lower() in GLTF:
                console.print(f"{mesh}: turned from +Y up, as its format prescribes, to +Z up")
        else:
            upward: Any = "auto" if up == "auto" else axis
            chosen = source_of(loaded, source, points)
            console.print(f"prior from {chosen}" + ("" if source or points else WHY[chosen]))
            options = {"source": chosen, "points": points, "up": upward}
            result, segmented = _built(loaded, settings, folder, progress, **options)
        if result.numbers["from"] != "random" and not loaded.on_demand:
            progress("colours of the surface")
            agreed = colour_agreement(result, loaded.frames)
            if not math.isnan(agreed):
                numbers = result.numbers | {"colour_agreement": agreed}
                result = replace(result, numbers=numbers)
        if result.numbers["from"] != "random":
            wrong = outline_error(result.mesh, taken_frames(loaded))
            if not math.isnan(wrong):
                result = replace(result, numbers=result.numbers | {"outline_error": wrong})
        progress("figure")
        save_prior(unfinished, result)
        draw_prior(unfinished / "prior.png", result, segmented)
    console.print(_random(result.numbers) if "radius" in result.numbers else _table(result.numbers))
    agreed = result.numbers.get("colour_agreement", 1.0)
    if agreed < AGREEMENT:
        console.print(
            f"the photographs agree on only {agreed:.0%} of the surface's colours (on a correct "
            f"surface on {AGREEMENT:.0%} or more), so it may be wrong; fit with `--means free`",
            soft_wrap=True,
        )
    wrong = result.numbers.get("outline_error", 0.0)
    if wrong > OUTLINE:
        console.print(
            f"the outlines of mesh and masks disagree in {wrong:.1%} of the covered pixels of the "
            f"median view (limit {OUTLINE:.0%}): a part of the object is missing or too much, or "
            "masks and poses do not fit",
            soft_wrap=True,
        )
    if "resolution" in result.numbers:
        console.print(_reason(result.numbers), soft_wrap=True)
    written = sorted(path.name for path in folder.iterdir())
    console.print(f"wrote {folder}: {', '.join(written)}")


def _built(
    dataset: Dataset,
    settings: PriorSettings,
    folder: Path,
    on_stage: Callable[[str], None],
    **options: Any,
) -> tuple[Prior, SegmentedCloud | None]:
    """`prior_and_cloud`. A refused cloud is drawn beside `folder`; the error names the picture."""
    from mgs.prior.build import prior_and_cloud
    from mgs.prior.figure import draw_refused
    from mgs.prior.segmentation import NoSurface

    try:
        return prior_and_cloud(dataset, settings, on_stage, **options)
    except NoSurface as refused:
        picture = folder.with_name(f"{folder.name}-refused.png")
        draw_refused(picture, refused.points, refused.kept, np.array(dataset.up))
        raise InputError(f"{refused} (the points: {picture})") from None


def _random(numbers: dict[str, Any]) -> str:
    """Line about a random start."""
    given = numbers["triangulated"]
    return (
        (f"{given:,} points that came with the cameras, and " if given else "")
        + f"{numbers['n'] - given:,} random points in and around a ball of radius "
        f"{numbers['radius']:.3g} {numbers['unit']}"
    )


def _table(numbers: dict[str, Any]) -> Table:
    """Table of the numbers of prior.json."""
    metres = numbers["unit"] == "m"
    unit = "m" if metres else "unit"
    n, spacing, area = numbers["n"], numbers["spacing"], numbers["sampled_area"]
    table = Table("step", "number", title="Mesh prior")

    def length(value: float) -> str:
        return f"{1e3 * value:.2f} mm" if metres else f"{value:.4g} unit"

    if "points" in numbers:
        _add_cloud_rows(table, numbers, length)
    if "hull_cell" in numbers:
        filled = f"fills {numbers['hull_fills_masks']:.1%} of the masks"
        table.add_row("visual hull", f"cells of {length(numbers['hull_cell'])}, {filled}")
    if "poisson_depth" in numbers:
        depth = f"octree depth {numbers['poisson_depth']}"
        table.add_row("mesh (Poisson)", f"{numbers['mesh_faces']:,} faces, {depth}, watertight")
        table.add_row("cloud to mesh, rms", length(numbers["fit_rms"]))
    whole = f" sampled (what some frame saw), of {numbers['mesh_area']:.4f} {unit}²"
    table.add_row("area, A", f"{area:.4f} {unit}²{'' if 'mesh' in numbers else whole}")
    table.add_row("samples, N = A / spacing²", f"{n:,} = {area:.4f} / {spacing:.6f}²")
    behind = f"a sample each, and {numbers['backed']:,} behind the surface"
    table.add_row("Gaussians", f"{n + numbers['backed']:,}: {behind}")
    if "colour_agreement" in numbers:
        agreed = f"{numbers['colour_agreement']:.0%}"
        table.add_row("colour variance that all frames agree on", agreed)
    if "outline_error" in numbers:
        table.add_row("outline against masks, median", f"{numbers['outline_error']:.2%} of pixels")
    table.add_row("up", _up(numbers))
    truth = numbers.get("truth")
    if truth is None:
        lacks = "not measured: needs depth, and rock.glb in the dataset"
        table.add_row("distance to the true rock", lacks)
        return table
    table.add_section()
    for name in ("accuracy", "completeness", "chamfer", "hausdorff"):
        table.add_row(f"{name} to the true rock", f"{1e3 * truth[name]:.2f} mm")
    share = f"{truth['visible_share']:.2%} of what is above the ground"
    table.add_row("true surface seen by some frame", share)
    table.add_row("seen surface within 2 spacings", f"{truth['visible_within_2_spacing']:.2%}")
    return table


def _reason(numbers: dict[str, Any]) -> str:
    """Reason for the number of Gaussians, if the cameras decided it."""
    from mgs.prior.resolution import MOST_GAUSSIANS

    pixel, count = numbers["resolution"]["pixel"], numbers["n"] + numbers["backed"]
    size = f"{1e3 * pixel:.2f} mm" if numbers["unit"] == "m" else f"{pixel:.4g} unit"
    if count == MOST_GAUSSIANS:
        return (
            f"{count:,} Gaussians, the most without --gaussians; the closest pixel covers {size} "
            "of the surface, and would allow more"
        )
    return (
        f"{count:,} Gaussians, since the closest pixel covers {size} of the surface, and samples "
        f"lie {numbers['resolution']['spacing'] / pixel:.3g} pixels apart"
    )


def _up(numbers: dict[str, Any]) -> str:
    """The up vector, and its angle from the ground plane's normal, if any."""
    from mgs.data.up import degrees_between, unit_up

    up = unit_up(numbers["up"])
    text = f"({', '.join(f'{value:.3g}' for value in up)})"
    if "plane_normal" not in numbers:
        return text
    angle = degrees_between(up, unit_up(numbers["plane_normal"]))
    return f"{text}; the ground plane's normal is {angle:.1f}° from it"


def _add_cloud_rows(table: Table, numbers: dict[str, Any], length: Callable[[float], str]) -> None:
    """Add the rows of a mesh that was built from a cloud."""
    points, size = f"{numbers['points']:,}", f"{numbers['cluster_size']:,}"
    if "pixels" in numbers:
        table.add_row("depth pixels in the cloud", f"{numbers['pixels']:,}")
        table.add_row("noise of a depth pixel", length(numbers["depth_noise"]))
        grid = f"{points} on a {length(numbers['voxel'])} grid"
        table.add_row("points of the fused cloud", grid)
    else:
        table.add_row("points", f"{points}, {numbers['points_kept']:,} of them well triangulated")
    if "plane_normal" in numbers:
        sigma = f"(sigma {length(numbers['plane_sigma'])})"
        within = f"within {length(numbers['plane_tolerance'])} {sigma}"
        table.add_row("ground plane inliers (RANSAC)", f"{numbers['plane_inliers']:,} {within}")
    one_of = f"one of {numbers['clusters']} clusters"
    if "eps" in numbers:
        found = f"{one_of}, eps {length(numbers['eps'])}"
        table.add_row("rock cluster (DBSCAN)", f"{size} points, {found}")
    else:
        chosen = f"{one_of} (HDBSCAN)" if numbers["clusters"] else "inside the masks"
        apart = f"{length(numbers['cloud_spacing'])} apart"
        table.add_row("points of the rock", f"{size} {chosen}, {apart}")
