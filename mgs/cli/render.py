"""`mgs render`: pictures of any 3DGS PLY through given cameras."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mgs.camera import Camera
    from mgs.gaussians import Gaussians


class ColourSpace(StrEnum):
    """In which space a model's colours are blended."""

    auto = "auto"
    linear = "linear"
    srgb = "srgb"


def render(
    splats: Annotated[
        Path, typer.Argument(help="3DGS PLY of SH degree 0 to 3, binary, ascii or compressed, of mgs or another tool.")
    ],
    cameras: Annotated[Path, typer.Option(help="transforms.json (nerfstudio), or the dataset folder that holds it.")],
    out: Annotated[Path, typer.Option(help="Folder to write; new or empty.")],
    width: Annotated[
        int | None, typer.Option(min=1, help="Image width, pixels; height follows. Default: the cameras'.")
    ] = None,
    colour_space: Annotated[
        ColourSpace,
        typer.Option(
            help="Space in which the PLY's colours are blended: mgs trains in linear RGB, other tools in sRGB. "
            "auto: linear for files that mgs wrote (their header says so), srgb for others."
        ),
    ] = ColourSpace.auto,
    background: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="R G B", show_default="black", help="Colour behind the Gaussians, as displayed (sRGB), 0 to 1."),
    ] = (0.0, 0.0, 0.0),
    exr: Annotated[
        bool,
        typer.Option("--exr", help="Write an OpenEXR too: linear R G B, alpha A, expected z-depth Z in metres (0: nothing)."),
    ] = False,
) -> None:
    """Draw a Gaussian model through every camera of a transforms.json, whose images need not exist.

    Writes one PNG per camera, under the name of the camera's image.
    """
    from rich.progress import Progress

    from mgs import runtime
    from mgs.data.dataset import load_cameras
    from mgs.errors import InputError
    from mgs.files import new_folder
    from mgs.splat_ply import ply_colour_space, read_ply

    if not all(0 <= value <= 1 for value in background):
        raise InputError(f"--background {' '.join(map(str, background))}: must be three numbers from 0 to 1")
    views = [(name, _resized(camera, width)) for name, camera in load_cameras(cameras)]
    gaussians = read_ply(splats)
    space = ply_colour_space(splats) if colour_space == ColourSpace.auto else colour_space.value
    new_folder(out)
    runtime.start()

    from mgs.splat import as_drjit

    model = as_drjit(gaussians)
    names = _file_names([name for name, _ in views])
    with Progress(transient=True) as bar:
        for name, (_, camera) in bar.track(list(zip(names, views, strict=True)), description="rendering"):
            _draw(model, camera, space, background, out / f"{name}.png", exr)
    degree = f"SH degree {gaussians.sh_degree}, colours in {'linear RGB' if space == 'linear' else 'sRGB'}"
    typer.echo(f"wrote {len(views)} views of {len(gaussians):,} Gaussians ({degree}) to {out}")


def _resized(camera: Camera, width: int | None) -> Camera:
    """The same view at another width; the height is the nearest whole number."""
    import numpy as np

    from mgs.camera import Camera

    if width is None:
        return camera
    height = max(1, round(camera.height * width / camera.width))
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    return Camera(scale @ camera.K, width, height, camera.world_to_camera)


def _file_names(paths: list[str]) -> list[str]:
    """A file name for each image path: its stem, or with its number in front where stems repeat."""
    stems = [Path(path).stem for path in paths]
    return stems if len(set(stems)) == len(stems) else [f"{i:04d}_{stem}" for i, stem in enumerate(stems)]


def _draw(model: Gaussians, camera: Camera, space: str, background: tuple[float, float, float], path: Path, exr: bool) -> None:
    """Render one view and write its files."""
    import numpy as np

    from mgs.colour import linear_from_srgb
    from mgs.images import write_exr, write_png
    from mgs.splat import render

    linear = space == "linear"
    behind = linear_from_srgb(background) if linear else np.asarray(background, np.float32)
    image = render(model, camera, behind.tolist())
    rgb = np.asarray(image.rgb)
    write_png(path, rgb, linear=linear)
    if exr:
        r, g, b = np.moveaxis(rgb if linear else linear_from_srgb(rgb), -1, 0)
        channels = {"R": r, "G": g, "B": b, "A": np.asarray(image.alpha), "Z": np.asarray(image.depth)}
        write_exr(path.with_suffix(".exr"), channels)
