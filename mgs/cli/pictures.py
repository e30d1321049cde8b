"""`mgs render` and `mgs view`: pictures of a model, through given cameras or in the browser."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from mgs import runtime
from mgs.cli.options import Count
from mgs.cli.terminal import echo, progress_bar
from mgs.errors import InputError
from mgs.files import check_new_folder, folder_locked


def render(
    subject: Path,
    out: Annotated[Path, typer.Option()],
    cameras: Path | None = None,
    width: Count = None,
    colour_space: Literal["auto", "linear", "srgb"] = "auto",
    antialiased: bool | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    exr: bool = False,
    prior: Path | None = None,
    force: bool = False,
) -> None:
    """Draw a run's model, or Gaussians from a file, through every camera of a transforms.json. The
    images it lists need not exist.

    Writes one PNG for each camera, with the name of the camera's image.

    - subject RUN|SPLATS: Folder that `mgs nbv` wrote, or Gaussians of mgs or others: 3DGS PLY
      (binary, ascii, compressed), GLB, SPZ or MGS.
    - out: Folder to write.
    - cameras: transforms.json (nerfstudio), or the dataset folder that holds it. Default: the
      run's.
    - width: Width in pixels; the height follows. Default: the cameras' own.
    - colour_space: Space in which the colours are blended: mgs trains in linear RGB, most other
      tools in sRGB. auto: what the file says, else srgb.
    - antialiased: Whether Gaussians that are smaller than a pixel are fainter. Default: what the
      file says, else not.
    - background R G B: Colour behind the Gaussians, sRGB, each from 0 to 1. Default: black.
    - prior: Folder of the prior that an mgs file was written with, if it needs one.
    - exr: Write an EXR too: linear R G B, opacity A, z-depth Z in metres (0: none).
    """
    from mgs.data.dataset import load_cameras, load_origin
    from mgs.reports.exporting import read_model
    from mgs.reports.video import draw_views
    from mgs.run.folder import open_run

    if not all(0 <= value <= 1 for value in background):
        numbers = " ".join(map(str, background))
        raise InputError(f"--background {numbers}: must be three numbers from 0 to 1")
    if cameras is None:
        if not subject.is_dir():
            raise InputError(f"{subject}: has no cameras; give --cameras TRANSFORMS.json")
        cameras = open_run(subject).dataset.root
    views = [
        (name, camera.resized(width) if width else camera) for name, camera in load_cameras(cameras)
    ]
    gaussians = read_model(subject, prior)[0].counted_from(load_origin(cameras))
    if colour_space != "auto":
        gaussians = replace(gaussians, linear=colour_space == "linear")
    if antialiased is not None:
        gaussians = replace(gaussians, antialiased=antialiased)
    runtime.start()
    with folder_locked(out), progress_bar() as bar:
        if not force:
            check_new_folder(out)
        progress = partial(bar, "rendering")
        draw_views(out, gaussians, views, background, exr, progress)
    colours = "linear RGB" if gaussians.linear else "sRGB"
    what = f"{len(gaussians):,} Gaussians (SH degree {gaussians.sh_degree}, colours in {colours})"
    echo(f"wrote {len(views)} views of {what} to {out}")


def view(
    subject: Path,
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8080,
    host: str = "127.0.0.1",
    follow: bool = False,
) -> None:
    """Show a run or a model in the browser: Gaussians, mesh and cameras, turned by mouse, keyboard
    or touch.

    While the camera moves, the browser draws the Gaussians, without view-dependent colour. When it
    rests, mgs renders the exact image. Layers: colour, alpha, depth; for a run also information,
    uncertainty and unobserved. A click on a camera shows its image and its numbers. Ctrl-C ends it.

    - subject RUN|SPLATS: Folder that `mgs nbv` wrote, or a PLY, GLB or SPZ.
    - port: Port to serve on; 0: any free one.
    - host: Address to serve on. With any but 127.0.0.1, other machines can reach the page.
    - follow: Show every new step of a run in progress.
    """
    from mgs.view.server import Viewer

    runtime.start()
    viewer = Viewer(subject, host, port, follow)
    try:
        token = viewer.access.token
        if token:
            echo(f"--host {host}: anyone who has the address below, with its token, can look")
        address = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        query = f"/?token={token}" if token else ""
        echo(f"open http://{address}:{viewer.port}{query} in a browser; Ctrl-C ends it")
        while True:
            viewer.tick()
            time.sleep(0.05)
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()
