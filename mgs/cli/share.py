"""`mgs export`: models for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from mgs.cli.options import argument, option
from mgs.errors import InputError


def export(
    model: Annotated[
        Path,
        argument("Folder that `mgs nbv` wrote, or a PLY, GLB or SPZ.", metavar="RUN|SPLATS"),
    ],
    to: Annotated[
        Literal["glb", "spz", "ply", "compressed-ply"],
        option(
            "glb: glTF with KHR_gaussian_splatting; spz: needs gsply; compressed-ply: 4 times "
            "smaller than ply."
        ),
    ] = "glb",
    out: Annotated[
        Path | None, option("File to write. Default: export.* in the run; for a file, beside it.")
    ] = None,
    colour_space: Annotated[
        Literal["srgb", "linear"],
        option("Colours to write: sRGB, as most viewers expect, or linear RGB, in which mgs fits."),
    ] = "srgb",
    force: Annotated[bool, option("Replace a file that is there.", "--force")] = False,
) -> None:
    """Write a model for other programs: viewers, game engines, web pages.

    Reads and writes the same formats, so it converts between them, too.
    """
    from mgs.report.exporting import in_srgb, read_model, to_y_up
    from mgs.splat_files import FORMATS, write_gaussians

    found = read_model(model)
    if found.space == "srgb" and colour_space == "linear":
        raise InputError(f"{model}: its colours are sRGB already; leave out --colour-space linear")
    shown = in_srgb(found) if colour_space == "srgb" else found
    folder, stem = (model, "export") if model.is_dir() else (model.parent, f"{model.stem}-export")
    path = out or folder / f"{stem}{FORMATS[to]}"
    if path.is_dir() or (path.exists() and not force):
        raise InputError(f"{path}: is there already; give another --out, or --force")
    write_gaussians(path, shown.gaussians, to, shown.space, to_y_up(shown.up))
    megabytes = path.stat().st_size / 1e6
    typer.echo(f"wrote {len(shown.gaussians):,} Gaussians to {path} ({megabytes:.1f} MB)")
