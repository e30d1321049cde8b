"""`mgs export` and `mgs video`: models and films for others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from mgs.cli.options import argument, option
from mgs.cli.progress import progress_bar
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


def video(
    run: Annotated[Path, argument("Folder that `mgs nbv` wrote.")],
    out: Annotated[
        Path | None,
        option("File to write: .mp4 (needs imageio-ffmpeg), .gif or .png. Default: RUN/video.mp4."),
    ] = None,
    path: Annotated[
        Literal["turntable", "spiral", "cameras"],
        option("Way of the camera: a circle, two turns up and down, or through the dataset's."),
    ] = "turntable",
    beside: Annotated[
        Literal["truth", "uncertainty"] | None,
        option(
            "Second picture: the map of what is unknown, or the truth, which shows the dataset's "
            "own views."
        ),
    ] = None,
    story: Annotated[
        bool,
        option("Show how the model came to be, view by view; fits it again for that.", "--story"),
    ] = False,
    seconds: Annotated[
        float | None, option("Length. Default: 8, or 1 a view with --story or truth.", min=0.1)
    ] = None,
    fps: Annotated[int, option("Frames a second along a path.", min=1, max=60)] = 25,
    width: Annotated[
        int | None, option("Width of a picture in pixels. Default: the cameras' own.", min=16)
    ] = None,
    force: Annotated[bool, option("Replace a file that is there.", "--force")] = False,
) -> None:
    """Write a film of a run: around its model, or how it came to be."""
    from mgs import runtime
    from mgs.report.story import story_frames
    from mgs.report.video import check_film, path_frames, write_film
    from mgs.run.folder import open_run

    target = out or run / "video.mp4"
    check_film(target)
    if target.is_dir() or (target.exists() and not force):
        raise InputError(f"{target}: is there already; give another --out, or --force")
    opened = open_run(run)
    taken, views = len(opened.state.taken), len(opened.dataset)
    runtime.start()
    with progress_bar("drawing") as bar:
        if story:
            frames, count = story_frames(opened, bar), taken
        else:
            count = views if beside == "truth" else max(1, round((seconds or 8.0) * fps))
            wide = width or opened.dataset.frames[0].camera.width
            frames = path_frames(opened, path, beside, count, wide)
        one_by_one = story or beside == "truth"
        each = (seconds or float(count)) / count if one_by_one else 1 / fps
        lengths = [each] * (count - 1) + [3 * each if story else each]
        write_film(target, frames, lengths, lambda done, total: bar.whole("frames", done, total))
    size = target.stat().st_size / 1e6
    typer.echo(f"wrote {count} frames to {target} ({size:.1f} MB)")
