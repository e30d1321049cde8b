"""`mgs render`: pictures of any 3DGS PLY through given cameras."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class ColourSpace(StrEnum):
    """Space in which the colours of a model are blended."""

    auto = "auto"
    linear = "linear"
    srgb = "srgb"


def render(
    splats: Annotated[
        Path,
        typer.Argument(
            help="3DGS PLY of SH degree 0 to 3, binary, ascii or compressed, "
            "of mgs or another tool."
        ),
    ],
    cameras: Annotated[
        Path,
        typer.Option(help="transforms.json (nerfstudio), or the dataset folder that holds it."),
    ],
    out: Annotated[Path, typer.Option(help="Folder to write, new or empty.")],
    width: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Width of the images, pixels; the height follows. Default: the cameras' own.",
        ),
    ] = None,
    colour_space: Annotated[
        ColourSpace,
        typer.Option(
            help="Space in which the PLY's colours are blended: mgs trains in linear RGB, most "
            "other tools in sRGB. auto: linear for files that mgs wrote (their header says so), "
            "srgb for all others."
        ),
    ] = ColourSpace.auto,
    background: Annotated[
        tuple[float, float, float],
        typer.Option(
            metavar="R G B",
            show_default="black",
            help="Colour behind the Gaussians, sRGB, each from 0 to 1.",
        ),
    ] = (0.0, 0.0, 0.0),
    exr: Annotated[
        bool,
        typer.Option(
            "--exr",
            help="Write an OpenEXR too: linear R G B, opacity A, expected z-depth Z in metres "
            "(0: nothing).",
        ),
    ] = False,
) -> None:
    """Draw a model of Gaussians through every camera of a transforms.json. The images it lists need
    not exist.

    Writes one PNG for each camera, with the name of the camera's image.
    """
    from functools import partial

    from mgs import runtime
    from mgs.cli.progress import progress_bar
    from mgs.data.dataset import load_cameras
    from mgs.errors import InputError
    from mgs.files import check_new_folder, folder_locked
    from mgs.report.pictures import draw_views
    from mgs.splat_ply import ply_colour_space, read_ply

    if not all(0 <= value <= 1 for value in background):
        given = " ".join(map(str, background))
        raise InputError(f"--background {given}: must be three numbers from 0 to 1")
    views = [
        (name, camera.resized(width) if width else camera) for name, camera in load_cameras(cameras)
    ]
    gaussians = read_ply(splats)
    space = ply_colour_space(splats) if colour_space is ColourSpace.auto else colour_space.value
    runtime.start()
    with folder_locked(out), progress_bar() as bar:
        check_new_folder(out)
        progress = partial(bar, "rendering")
        draw_views(out, gaussians, views, space, background, exr, progress)
    colours = "linear RGB" if space == "linear" else "sRGB"
    model = f"{len(gaussians):,} Gaussians (SH degree {gaussians.sh_degree}, colours in {colours})"
    typer.echo(f"wrote {len(views)} views of {model} to {out}")
