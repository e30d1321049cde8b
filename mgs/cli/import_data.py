"""`mgs import`: make a dataset of data in the formats of nerfstudio, NeRF-synthetic and COLMAP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

MANY_PIXELS = 2_000_000
"""Images with more pixels than this are worth a word on --downscale."""

EXPOSURE_DIFFERS = 0.1
"""Stops by which the exposure of photographs must differ, by their EXIF, to be worth a word."""


def import_data(
    source: Annotated[
        Path,
        typer.Argument(
            help="A transforms.json, or a folder with one or with a COLMAP model (sparse/0)."
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="Folder to write: new, empty, or left by an interrupted import.")
    ],
    images: Annotated[
        Path | None, typer.Option(help="Folder of COLMAP's images. Default: SOURCE/images.")
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(help="Folder of rock masks, named like the images; white is rock."),
    ] = None,
    mesh: Annotated[
        Path | None,
        typer.Option(
            help="Make masks by projecting this mesh of the rock. World coordinates; a GLB is turned from +Y up."
        ),
    ] = None,
    downscale: Annotated[
        int,
        typer.Option(
            min=1,
            help="Make blocks of so many pixels each way into one, as 4 for photographs of 12 megapixels.",
        ),
    ] = 1,
    up: Annotated[
        str,
        typer.Option(
            help="Which way is up: X,Y,Z in the source's world, or auto: as the cameras were held."
        ),
    ] = "auto",
    unit: Annotated[
        float | None,
        typer.Option(
            help="Metres in the source's unit of length. Default: unknown, unless there is depth."
        ),
    ] = None,
    test_every: Annotated[
        int | None,
        typer.Option(
            min=2,
            metavar="N",
            help="Set every Nth image apart as a test view, by name, from the first on; 8 is usual.",
        ),
    ] = None,
    split: Annotated[
        str, typer.Option(help="Which split of NeRF-synthetic data to import: train, val or test.")
    ] = "train",
) -> None:
    """Make a dataset of your own data: cameras and images, and depth and masks if there are any.
    Lens distortion is undone.

    Masks are taken from --masks, --mesh, the source's own mask files or the images' alpha: the
    first of these that there is. Where alpha has values between empty and full, it is kept, in
    images of the rock alone (rock/). Points that came with the cameras are kept for `mgs prior`, in
    sparse.ply. An interrupted import goes on where it stopped when the same command is given again.
    """
    from rich.console import Console
    from rich.progress import Progress

    from mgs.cli.options import parse_up
    from mgs.data.dataset import TEST_FOLDER
    from mgs.data.importers import import_source
    from mgs.data.meshes import GLTF
    from mgs.data.sources import read_source
    from mgs.errors import InputError
    from mgs.images import exif_exposure

    console, notes = Console(), Console(stderr=True)
    if masks is not None and mesh is not None:
        raise InputError(
            "import: --masks and --mesh both say where masks come from; give one of them"
        )
    found = read_source(source, images, split)
    found = found if unit is None else found.in_metres(unit)
    given = parse_up(up)
    upward, reason = found.up_or_estimate() if given is None else (given, "as --up says")
    tests, listed = None, found.missing + len(found.shots)
    if test_every is not None:
        found, tests = found.set_apart(test_every)
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task("importing")
        result = import_source(
            found,
            out,
            masks=masks,
            mesh=mesh,
            downscale=downscale,
            up=upward,
            tests=tests,
            on_frame=lambda done, total: progress.update(bar, completed=done, total=total),
        )
    if mesh is not None and mesh.suffix.lower() in GLTF:
        console.print(f"{mesh}: turned from +Y up, the rule of its format, to +Z up")
    if found.missing:
        notes.print(f"mgs: {found.missing} of {listed} listed images do not exist; skipped them")
    if found.no_cloud:
        notes.print(
            f"mgs: the points that {source.name} names, {found.no_cloud}, do not exist; imported without them"
        )
    keys = ("mask_path", "rock_path", "depth_path")
    masked, layered, deep = (
        sum(bool(getattr(frame, key)) for frame in result.frames) for key in keys
    )
    undone = sum(shot.distortion.any() for shot in found.shots)
    axis = ", ".join(f"{value:.4g}" for value in upward)
    lengths = "metres" if result.unit == "m" else f"in {result.unit}s (no --unit was given)"
    console.print(f"up is ({axis}): {reason}; lengths are {lengths}")
    stops = [value for shot in found.shots if (value := exif_exposure(shot.image)) is not None]
    if stops and max(stops) - min(stops) > EXPOSURE_DIFFERS:
        notes.print(
            f"mgs: by their EXIF, exposure differs by up to {max(stops) - min(stops):.1f} stops between photographs; "
            "`mgs nbv --exposure` estimates a gain for each"
        )
    points = 0 if found.sparse is None else len(found.sparse.points)
    camera = result.frames[0].camera
    if camera.width * camera.height > MANY_PIXELS:
        notes.print(
            f"mgs: images of {camera.width}x{camera.height} take long to fit; --downscale 2 or more makes them smaller"
        )
    console.print(
        f"{found.kind}: {len(result)} frames, {masked} with mask, {layered} with alpha, {deep} with depth, "
        f"{undone} undistorted, {points:,} points; wrote {out}"
    )
    if tests is not None:
        console.print(
            f"test views: {len(tests.shots)} images, which are no candidates; wrote {out / TEST_FOLDER}"
        )
