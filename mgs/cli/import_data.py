"""`mgs import`: make a dataset of nerfstudio, NeRF-synthetic or COLMAP data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def import_data(
    source: Annotated[Path, typer.Argument(help="A transforms.json, a folder with one, or a folder with a COLMAP model.")],
    out: Annotated[Path, typer.Option(help="Folder to write; new, or one that an interrupted import left.")],
    images: Annotated[Path | None, typer.Option(help="Folder of COLMAP's images; by default SOURCE/images.")] = None,
    masks: Annotated[Path | None, typer.Option(help="Folder of masks, named as the images; white is rock.")] = None,
    mesh: Annotated[
        Path | None, typer.Option(help="Masks by projecting this mesh (world coordinates; a GLB is turned from +Y up).")
    ] = None,
    split: Annotated[str, typer.Option(help="Split of NeRF-synthetic data: train, val or test.")] = "train",
) -> None:
    """Bring your own data: make a dataset of cameras and images, and of depth and masks if there are any.

    Lens distortion is undone. Masks come from the first of these that there is: --masks, --mesh, the source's own mask files,
    the images' alpha. An alpha with values between empty and full is kept too, in images of the rock alone (rock/). Without
    depth, the prior comes from `mgs prior OUT --mesh MESH`, or from COLMAP's sparse points. An interrupted import goes on where
    it stopped when the same command is given again.
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
        runtime.start()  # rays are cast at the mesh
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
    keys = ("mask_path", "rock_path", "depth_path")
    masked, layered, deep = (sum(bool(getattr(frame, key)) for frame in result.frames) for key in keys)
    undone = sum(shot.distortion.any() for shot in found.shots)
    console.print(
        f"{found.kind}: {len(result)} frames, {masked} with mask, {layered} with alpha, {deep} with depth, "
        f"{undone} undistorted; wrote {out}"
    )
