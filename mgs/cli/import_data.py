"""`mgs import`: make a dataset of data in the formats of nerfstudio, NeRF-synthetic and COLMAP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def import_data(
    source: Annotated[Path, typer.Argument(help="A transforms.json, or a folder with one or with a COLMAP model (sparse/0).")],
    out: Annotated[Path, typer.Option(help="Folder to write: new, empty, or left by an interrupted import.")],
    images: Annotated[Path | None, typer.Option(help="Folder of COLMAP's images. Default: SOURCE/images.")] = None,
    masks: Annotated[Path | None, typer.Option(help="Folder of rock masks, named like the images; white is rock.")] = None,
    mesh: Annotated[
        Path | None,
        typer.Option(help="Make masks by projecting this mesh of the rock. World coordinates; a GLB is turned from +Y up."),
    ] = None,
    split: Annotated[str, typer.Option(help="Which split of NeRF-synthetic data to import: train, val or test.")] = "train",
) -> None:
    """Make a dataset of your own data: cameras and images, and depth and masks if there are any. Lens distortion is undone.

    Masks are taken from --masks, --mesh, the source's own mask files or the images' alpha: the first of these that there is.
    For data without depth, `mgs prior OUT` builds the prior from COLMAP's points, or takes your mesh with --mesh. An
    interrupted import goes on where it stopped when the same command is given again.
    """
    from rich.console import Console
    from rich.progress import Progress

    from mgs import runtime
    from mgs.data.importers import import_source, read_source
    from mgs.data.meshes import GLTF
    from mgs.errors import InputError

    console, notes = Console(), Console(stderr=True)
    if masks is not None and mesh is not None:
        raise InputError("import: --masks and --mesh both say where masks come from; give one of them")
    if mesh is not None and mesh.suffix.lower() in GLTF:
        console.print(f"{mesh}: turned from +Y up, the rule of its format, to +Z up")
    found = read_source(source, images, split)
    if mesh is not None:
        runtime.start()  # to cast rays at it
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task("importing")
        result = import_source(
            found,
            out,
            masks=masks,
            mesh=mesh,
            on_frame=lambda done, total: progress.update(bar, completed=done, total=total),
        )
    if found.missing:
        notes.print(f"mgs: {found.missing} of {found.missing + len(found.shots)} listed images do not exist; skipped them")
    masked, deep = (sum(bool(getattr(frame, key)) for frame in result.frames) for key in ("mask_path", "depth_path"))
    undone = sum(shot.distortion.any() for shot in found.shots)
    console.print(
        f"{found.kind}: {len(result)} frames, {masked} with mask, {deep} with depth, {undone} undistorted; wrote {out}"
    )
