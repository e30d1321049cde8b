"""`mgs prior`: from the depth images of a dataset to a mesh of the rock, and samples of its surface."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from mgs.data.dataset import Dataset, Frame
    from mgs.prior.build import Prior

SEEDS = 4
"""Number of seed frames in the paper, and of those for which the share of samples that they see is printed."""


def prior(
    dataset: Annotated[Path, typer.Argument(help="Dataset folder (transforms.json) with depth images.")],
    out: Annotated[Path | None, typer.Option(help="Folder to write, new or empty. Default: DATASET/prior.")] = None,
    gaussians: Annotated[int | None, typer.Option(help="Number N of samples on the surface, one for each Gaussian.")] = None,
    spacing: Annotated[
        float | None,
        typer.Option(help="Distance between samples, metres, instead of N. Default: about the size of a pixel on the rock."),
    ] = None,
    mesh: Annotated[
        Path | None,
        typer.Option(help="Sample this mesh instead of building one. World coordinates, metres; a GLB is turned from +Y up."),
    ] = None,
    poisson_depth: Annotated[
        int | None, typer.Option(help="Octree depth of the Poisson surface, 3 to 12. Default: by the density of the cloud.")
    ] = None,
    prior_noise: Annotated[
        float, typer.Option(help="Make the rock's points worse on purpose: noise of this standard deviation, metres.")
    ] = 0.0,
    holes: Annotated[
        float, typer.Option(help="Make them worse on purpose: cut round holes until this share of the points is removed.")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Root seed: the same seed gives the same prior.")] = 0,
) -> None:
    """Build a mesh of the rock from depth images, and sample N points on it.

    The steps: fuse the depth images into a cloud, find the ground plane and the rock above it, reconstruct the rock's surface
    (Poisson), spread samples evenly over what some frame saw of it. Writes mesh.ply, points.ply, prior.json and prior.png.
    """
    from rich.console import Console

    from mgs import runtime
    from mgs.data.dataset import load_dataset
    from mgs.data.meshes import GLTF
    from mgs.files import atomic_folder, check_new_folder
    from mgs.prior.build import build_prior, prior_from_mesh, save_prior
    from mgs.prior.figure import draw_prior
    from mgs.prior.initial import with_share_seen
    from mgs.prior.settings import PriorSettings

    console = Console()
    loaded = load_dataset(dataset)
    folder = check_new_folder(out if out is not None else dataset / "prior")  # before the work, not after it
    settings = PriorSettings(gaussians, spacing, poisson_depth, prior_noise, holes, seed)
    with console.status("reading") as status:
        if mesh is not None:
            if mesh.suffix.lower() in GLTF:
                console.print(f"{mesh}: turned from +Y up, the rule of its format, to +Z up")
            result, segmented = prior_from_mesh(mesh, settings), None
        else:
            result, segmented = build_prior(loaded, settings, lambda stage: status.update(f"prior: {stage}"))
        status.update("prior: what four seed frames see")
        seeds = _seed_frames(loaded, result)
        if not all(frame.depth_path for frame in seeds):
            runtime.start()  # to cast rays at the mesh in place of depth images
        result = with_share_seen(result, seeds)
        status.update("prior: picture")
        with atomic_folder(folder) as unfinished:
            save_prior(unfinished, result)
            draw_prior(unfinished / "prior.png", result, segmented)
    console.print(_table(result.numbers))
    console.print(f"wrote {folder}: mesh.ply, points.ply, prior.json, prior.png")


def _seed_frames(dataset: Dataset, prior: Prior) -> list[Frame]:
    """The frames that `mgs nbv` would take as its SEEDS seeds, or all frames if there are fewer."""
    import numpy as np

    from mgs.active.pose_policies import seed_views

    positions = np.stack([frame.camera.position for frame in dataset.frames])
    return [dataset.frames[k] for k in seed_views(positions, prior.points.mean(0), min(SEEDS, len(dataset)))]


def _table(numbers: dict[str, Any]) -> Any:
    """The table that is printed, from the numbers of prior.json."""
    from rich.table import Table

    n, spacing, area = numbers["n"], numbers["spacing"], numbers["sampled_area"]
    table = Table("station", "number", title="Mesh prior")
    if "points" in numbers:
        _add_cloud_rows(table, numbers)
    part = "" if "mesh" in numbers else f" sampled (what some frame saw), of {numbers['mesh_area']:.4f} m²"
    table.add_row("area, A", f"{area:.4f} m²{part}")
    table.add_row("samples, N = A / spacing²", f"{n:,} = {area:.4f} / {spacing:.6f}²")
    mean, least = (numbers[key] / spacing for key in ("nearest_neighbour_mean", "nearest_neighbour_min"))
    table.add_row("nearest neighbour over spacing", f"mean {mean:.2f}, least {least:.2f}")
    table.add_row(f"samples that {SEEDS} evenly spaced frames see", f"{numbers['seen_by_seeds']:.1%}; the rest starts grey")
    truth = numbers.get("truth")
    if truth is None:
        table.add_row("distance to the true rock", "not measured: a given mesh, no depth, or no rock.glb in the dataset")
        return table
    table.add_section()
    for name in ("accuracy", "completeness", "chamfer", "hausdorff"):
        table.add_row(f"{name} to the true rock", f"{1e3 * truth[name]:.2f} mm")
    table.add_row("true surface seen by some frame", f"{truth['visible_share']:.2%} of what is above the ground")
    table.add_row("seen surface within 2 spacings", f"{truth['visible_within_2_spacing']:.2%}")
    return table


def _add_cloud_rows(table: Any, numbers: dict[str, Any]) -> None:
    """The rows of a mesh that was built from a cloud."""
    table.add_row("depth pixels in the cloud", f"{numbers['pixels']:,}")
    table.add_row("noise of a depth pixel", f"{1e3 * numbers['depth_noise']:.2f} mm")
    table.add_row("points of the fused cloud", f"{numbers['points']:,} on a {1e3 * numbers['voxel']:.2f} mm grid")
    table.add_row(
        "ground plane inliers (RANSAC)",
        f"{numbers['plane_inliers']:,} within {1e3 * numbers['plane_tolerance']:.1f} mm "
        f"(sigma {1e3 * numbers['plane_sigma']:.2f} mm)",
    )
    table.add_row(
        "rock cluster (DBSCAN)",
        f"{numbers['cluster_size']:,} points, one of {numbers['clusters']} clusters, eps {1e3 * numbers['eps']:.1f} mm",
    )
    table.add_row("mesh (Poisson)", f"{numbers['mesh_faces']:,} faces, octree depth {numbers['poisson_depth']}, watertight")
    table.add_row("cloud to mesh, rms", f"{1e3 * numbers['fit_rms']:.2f} mm")
