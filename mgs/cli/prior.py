"""`mgs prior`: from depth images, points, masks or a mesh to a mesh of the rock, and samples of its
surface."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.status import Status

    from mgs.data.dataset import Dataset, Frame
    from mgs.prior.build import Prior
    from mgs.prior.segmentation import SegmentedCloud
    from mgs.prior.settings import PriorSettings

SEEDS = 4
"""Number of seed frames in the paper, and of those for which the share of samples that they see is
printed."""

WHY = {
    "depth": ": the dataset has depth images",
    "points": ": the dataset has points (sparse.ply) and no depth",
    "hull": ": the dataset has masks, and neither depth nor points",
}
"""What is said of a source that nobody asked for."""


def prior(
    dataset: Annotated[Path, typer.Argument(help="Dataset folder (transforms.json).")],
    out: Annotated[
        Path | None, typer.Option(help="Folder to write, new or empty. Default: DATASET/prior.")
    ] = None,
    gaussians: Annotated[
        str | None,
        typer.Option(
            metavar="N|auto",
            help="Number of Gaussians, on the surface and behind it. Default: auto, what the closest pixel resolves.",
        ),
    ] = None,
    spacing: Annotated[
        float | None,
        typer.Option(help="Distance between samples, metres, instead of N."),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="depth, mesh, points or hull (of the masks). Default: the first of depth, points, hull that there is.",
        ),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            help="Build it of the points in this PLY file. World coordinates of the dataset."
        ),
    ] = None,
    up: Annotated[
        str | None,
        typer.Option(
            help="Which way is up: X,Y,Z, or auto: the ground plane's normal. Default: as the dataset says."
        ),
    ] = None,
    mesh: Annotated[
        Path | None,
        typer.Option(
            help="Sample this mesh instead of building one. World coordinates, metres; a GLB is turned from +Y up."
        ),
    ] = None,
    backing: Annotated[
        float,
        typer.Option(
            help="Gaussians behind the surface for each one on it, to keep it opaque. 0: none, as in the paper."
        ),
    ] = 0.5,
    poisson_depth: Annotated[
        int | None,
        typer.Option(
            help="Octree depth of the Poisson surface, 3 to 12. Default: by the density of the cloud."
        ),
    ] = None,
    prior_noise: Annotated[
        float,
        typer.Option(
            help="Make the rock's points worse on purpose: noise of this standard deviation, metres."
        ),
    ] = 0.0,
    holes: Annotated[
        float,
        typer.Option(
            help="Make them worse on purpose: cut round holes until this share of the points is removed."
        ),
    ] = 0.0,
    seed: Annotated[
        int, typer.Option(min=0, help="Root seed: the same seed gives the same prior.")
    ] = 0,
) -> None:
    """Build a mesh of the rock, and sample N points on it.

    From depth images: fuse them into a cloud, find the ground plane and the rock above it,
    reconstruct the rock's surface (Poisson). From points that came with the cameras: the same, of
    those inside the masks or above the ground. From a hull: the largest body that fits into all
    masks. Then spread samples evenly over what some frame saw. Writes mesh.ply, points.ply,
    prior.json and prior.png.
    """
    from rich.console import Console

    from mgs.cli.options import parse_gaussians, parse_up
    from mgs.data.dataset import load_dataset
    from mgs.data.meshes import GLTF
    from mgs.errors import InputError
    from mgs.files import atomic_folder, check_new_folder
    from mgs.prior.build import prior_from_mesh, save_prior
    from mgs.prior.figure import draw_prior
    from mgs.prior.initial import with_share_seen
    from mgs.prior.photographs import source_of
    from mgs.prior.settings import PriorSettings

    console = Console()
    axis = None if up is None else parse_up(up)
    if mesh is not None and (source not in (None, "mesh") or points is not None):
        raise InputError(
            "prior: --mesh gives the surface, and --from or --points build one; give one of them"
        )
    loaded = load_dataset(dataset)
    folder = check_new_folder(
        out if out is not None else dataset / "prior"
    )  # before the work, not after it
    settings = PriorSettings(
        parse_gaussians(gaussians), spacing, poisson_depth, prior_noise, holes, seed, backing
    )
    with console.status("reading") as status:
        if mesh is not None:
            cameras = [frame.camera for frame in loaded.frames]
            result, segmented = (
                prior_from_mesh(mesh, settings, axis or loaded.up, loaded.unit, cameras),
                None,
            )
            if mesh.suffix.lower() in GLTF:
                console.print(f"{mesh}: turned from +Y up, the rule of its format, to +Z up")
        else:
            upward: Any = "auto" if up == "auto" else axis
            chosen = source_of(loaded, source, points)
            console.print(f"prior from {chosen}" + ("" if source or points else WHY[chosen]))
            result, segmented = _built(
                loaded, settings, folder, status, source=chosen, points=points, up=upward
            )
        status.update("prior: what four seed frames see")
        result = with_share_seen(result, _seed_frames(loaded, result))
        status.update("prior: picture")
        with atomic_folder(folder) as unfinished:
            save_prior(unfinished, result)
            draw_prior(unfinished / "prior.png", result, segmented)
    console.print(_table(result.numbers))
    if "resolution" in result.numbers:
        console.print(_reason(result.numbers), soft_wrap=True)
    console.print(f"wrote {folder}: mesh.ply, points.ply, prior.json, prior.png")


def _built(
    dataset: Dataset, settings: PriorSettings, folder: Path, status: Status, **options: Any
) -> tuple[Prior, SegmentedCloud | None]:
    """`build_prior` with its stages shown; a refused cloud is drawn beside `folder`, and the
    picture is named in the error."""
    import numpy as np

    from mgs.errors import InputError
    from mgs.prior.build import build_prior
    from mgs.prior.figure import draw_refused
    from mgs.prior.segmentation import NoSurface

    try:
        return build_prior(
            dataset, settings, lambda stage: status.update(f"prior: {stage}"), **options
        )
    except NoSurface as refused:
        picture = folder.with_name(f"{folder.name}-refused.png")
        draw_refused(picture, refused.points, refused.kept, np.array(dataset.up))
        raise InputError(f"{refused} (the points: {picture})") from None


def _seed_frames(dataset: Dataset, prior: Prior) -> list[Frame]:
    """The frames that `mgs nbv` would take as its SEEDS seeds, or all frames if there are fewer."""
    import numpy as np

    from mgs.data.up import upright
    from mgs.policy.poses import seed_views

    turn = upright(prior.up)
    positions = np.stack([frame.camera.position for frame in dataset.frames]) @ turn.T
    return [
        dataset.frames[k]
        for k in seed_views(positions, turn @ prior.points.mean(0), min(SEEDS, len(dataset)))
    ]


def _table(numbers: dict[str, Any]) -> Any:
    """The table that is printed, from the numbers of prior.json."""
    from rich.table import Table

    metres = numbers["unit"] == "m"
    n, spacing, area, unit = (
        numbers["n"],
        numbers["spacing"],
        numbers["sampled_area"],
        "m" if metres else "unit",
    )
    table = Table("station", "number", title="Mesh prior")

    def length(value: float) -> str:
        return f"{1e3 * value:.2f} mm" if metres else f"{value:.4g} unit"

    if "points" in numbers:
        _add_cloud_rows(table, numbers, length)
    if "hull_cell" in numbers:
        table.add_row(
            "visual hull",
            f"cells of {length(numbers['hull_cell'])}, fills {numbers['hull_fills_masks']:.1%} of the masks",
        )
    if "poisson_depth" in numbers:
        table.add_row(
            "mesh (Poisson)",
            f"{numbers['mesh_faces']:,} faces, octree depth {numbers['poisson_depth']}, watertight",
        )
        table.add_row("cloud to mesh, rms", length(numbers["fit_rms"]))
    part = (
        ""
        if "mesh" in numbers
        else f" sampled (what some frame saw), of {numbers['mesh_area']:.4f} {unit}²"
    )
    table.add_row("area, A", f"{area:.4f} {unit}²{part}")
    table.add_row("samples, N = A / spacing²", f"{n:,} = {area:.4f} / {spacing:.6f}²")
    table.add_row(
        "Gaussians",
        f"{n + numbers['backed']:,}: a sample each, and {numbers['backed']:,} behind the surface",
    )
    mean, least = (
        numbers[key] / spacing for key in ("nearest_neighbour_mean", "nearest_neighbour_min")
    )
    table.add_row("nearest neighbour over spacing", f"mean {mean:.2f}, least {least:.2f}")
    table.add_row(
        f"samples that {SEEDS} evenly spaced frames see",
        f"{numbers['seen_by_seeds']:.1%}; the rest starts grey",
    )
    table.add_row("up", _up(numbers))
    truth = numbers.get("truth")
    if truth is None:
        table.add_row(
            "distance to the true rock", "not measured: needs depth, and rock.glb in the dataset"
        )
        return table
    table.add_section()
    for name in ("accuracy", "completeness", "chamfer", "hausdorff"):
        table.add_row(f"{name} to the true rock", f"{1e3 * truth[name]:.2f} mm")
    table.add_row(
        "true surface seen by some frame",
        f"{truth['visible_share']:.2%} of what is above the ground",
    )
    table.add_row("seen surface within 2 spacings", f"{truth['visible_within_2_spacing']:.2%}")
    return table


def _reason(numbers: dict[str, Any]) -> str:
    """Why there are so many Gaussians, where their number was left to the images."""
    from mgs.prior.resolution import PIXELS_PER_SAMPLE

    pixel, n, backed = numbers["resolution"]["pixel"], numbers["n"], numbers["backed"]
    size = f"{1e3 * pixel:.2f} mm" if numbers["unit"] == "m" else f"{pixel:.4g} unit"
    return (
        f"{n + backed:,} Gaussians, since the closest pixel covers {size} of the surface, and samples nearer than "
        f"{PIXELS_PER_SAMPLE:g} pixels gain too little"
    )


def _up(numbers: dict[str, Any]) -> str:
    """Which way is up, and how far the ground plane's normal is from it where there is a plane."""
    from mgs.data.up import degrees_between, unit_up

    up = unit_up(numbers["up"])
    text = f"({', '.join(f'{value:.3g}' for value in up)})"
    if "plane_normal" not in numbers:
        return text
    return f"{text}; the ground plane's normal is {degrees_between(up, unit_up(numbers['plane_normal'])):.1f}° from it"


def _add_cloud_rows(table: Any, numbers: dict[str, Any], length: Callable[[float], str]) -> None:
    """The rows of a mesh that was built from a cloud."""
    if "pixels" in numbers:
        table.add_row("depth pixels in the cloud", f"{numbers['pixels']:,}")
        table.add_row("noise of a depth pixel", length(numbers["depth_noise"]))
        table.add_row(
            "points of the fused cloud",
            f"{numbers['points']:,} on a {length(numbers['voxel'])} grid",
        )
    else:
        table.add_row(
            "points", f"{numbers['points']:,}, {numbers['points_kept']:,} of them well triangulated"
        )
    if "plane_normal" in numbers:
        within = (
            f"within {length(numbers['plane_tolerance'])} (sigma {length(numbers['plane_sigma'])})"
        )
        table.add_row("ground plane inliers (RANSAC)", f"{numbers['plane_inliers']:,} {within}")
    if "eps" in numbers:
        found = f"one of {numbers['clusters']} clusters, eps {length(numbers['eps'])}"
        table.add_row("rock cluster (DBSCAN)", f"{numbers['cluster_size']:,} points, {found}")
    elif "points_kept" in numbers:
        chosen = (
            f"one of {numbers['clusters']} clusters (HDBSCAN)"
            if numbers["clusters"]
            else "inside the masks"
        )
        table.add_row(
            "points of the rock",
            f"{numbers['cluster_size']:,} {chosen}, {length(numbers['cloud_spacing'])} apart",
        )
