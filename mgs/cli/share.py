"""`mgs render`, `view`, `export`, `video`: show a model, and write it or a film for others."""

import re
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import typer

from mgs import runtime
from mgs.cli.options import Count, refuse_unused
from mgs.cli.terminal import echo, progress_bar
from mgs.errors import InputError
from mgs.files import (
    Ours,
    atomic_folder,
    atomic_path,
    check_new_file,
    check_new_folder,
    folder_locked,
)

if TYPE_CHECKING:
    from mgs.gaussians import Gaussians


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
    - colour_space: Space in which the colours are blended. auto: what the file says, else srgb.
    - antialiased: Whether Gaussians that are smaller than a pixel are fainter. Default: what the
      file says, else not.
    - background R G B: Colour behind the Gaussians, sRGB, each from 0 to 1. Default: black.
    - prior: Folder of the prior that an mgs file was written with, if it needs one.
    - exr: Write an EXR too: linear R G B, opacity A, z-depth Z in metres (0: none)."""
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
    with folder_locked(out), progress_bar():
        if not force:
            check_new_folder(out)
        draw_views(out, gaussians, views, background, exr)
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

    - subject RUN|SPLATS: Folder that `mgs nbv` wrote, or a PLY, GLB, SPZ or MGS.
    - port: Port to serve on; 0: any free one.
    - host: Address to serve on. With any but 127.0.0.1, other machines can reach the page.
    - follow: Show every new step of a run in progress."""
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


def export(
    models: list[Path],
    to: Literal["glb", "spz", "ply", "compressed-ply", "mgs", "nerfstudio", "colmap"] | None = None,
    out: Path | None = None,
    colour_space: Literal["srgb", "linear"] = "srgb",
    sh: Annotated[int | None, typer.Option(min=0, max=3)] = None,
    views: Literal["taken", "all"] = "taken",
    most: Annotated[str | None, typer.Option("--bytes")] = None,
    psnr: float | None = None,
    shared_prior: bool = False,
    prior: Path | None = None,
    force: bool = False,
) -> None:
    """Write a model for other programs: viewers, game engines, web pages; or the views that a run
    chose, for programs that train on them: cameras, images, masks, depth and points.

    All formats can also be read, so the command converts between them, too.

    - models RUN|SPLATS...: Folders that `mgs nbv` wrote, or PLY, GLB, SPZ, MGS.
    - to: glb (default): glTF with KHR_gaussian_splatting; spz: needs gsply; compressed-ply: 4 times
      smaller than ply; mgs (default with --bytes or --psnr, which it needs): as few bytes as a link
      allows. nerfstudio, colmap: the run's views, a folder to train on.
    - out: File to write. Default: export.* in the run; for a file, beside it.
    - colour_space: Colours to write: sRGB, as viewers expect (those of a linear run are fitted once
      more), or linear RGB, of linear models.
    - sh: Raise the SH degree, for programs that read degree 3 only.
    - views: Views of nerfstudio and colmap: those taken, or all.
    - most N|Nk|NM: Write the best model of a run of at most so many bytes, as in 40k. Formats other
      than mgs get fewer Gaussians, fitted once more.
    - psnr: Write the smallest model of a run of so many dB in the views taken.
    - shared_prior: For mgs: the reader has the run's prior, which gives the positions.
    - prior: Folder of the prior that an mgs file was written with, to read it."""
    from mgs.reports.exporting import read_model, to_y_up
    from mgs.splat_files import FORMATS, write_gaussians

    limited = most is not None or psnr is not None
    to = to or ("mgs" if limited else "glb")
    linear = True if colour_space == "linear" else None
    if to in ("nerfstudio", "colmap"):
        refuse_unused(f"with --to {to}", sh=sh, colour_space=linear, prior=prior)
    else:
        refuse_unused(f"with --to {to}", views="all" if views == "all" else None)
    if shared_prior and to != "mgs":
        raise InputError("--shared-prior: is for --to mgs; leave it out")
    if to == "mgs" or limited:
        if (most is None) == (psnr is None):
            raise InputError(f"--to {to}: needs one of --bytes and --psnr")
        if to in ("nerfstudio", "colmap"):
            raise InputError("--bytes, --psnr: are for models, not for views; leave them out")
        refuse_unused("with --bytes or --psnr", sh=sh, colour_space=linear, prior=prior)
        _export_compact(models, to, out, most, psnr, shared_prior, force)
        return
    if to in ("nerfstudio", "colmap"):
        _export_views(models, to, out, views == "all", force)
        return
    defaults = [
        (one if one.is_dir() else one.parent)
        / f"{'export' if one.is_dir() else f'{one.stem}-export'}{FORMATS[to]}"
        for one in models
    ]
    for model, path in _targets(models, defaults, out, force):
        gaussians, up = read_model(model, prior)
        if not gaussians.linear and linear:
            raise InputError(f"{model}: its colours are sRGB; leave out --colour-space linear")
        srgb = gaussians.linear and not linear
        splats = _in_srgb(model, gaussians) if srgb else gaussians
        splats = replace(splats, origin=gaussians.origin)
        splats = splats.with_degree(max(sh or 0, splats.sh_degree))
        write_gaussians(path, splats, to, to_y_up(up))
        megabytes = path.stat().st_size / 1e6
        echo(f"wrote {len(splats):,} Gaussians to {path} ({megabytes:.1f} MB){_hidden(model)}")


def _hidden(model: Path) -> str:
    """How many Gaussians of a run are not written (`Run.shown`), to follow a line."""
    from mgs.run.folder import open_run

    count = np.count_nonzero(~open_run(model).shown) if model.is_dir() else 0
    whole = f"{model / 'gaussians.ply'} has them"
    return f"; left out {count:,} that no view taken shows; {whole}" if count else ""


def _export_compact(
    runs: list[Path],
    to: str,
    out: Path | None,
    most: str | None,
    psnr: float | None,
    shared: bool,
    force: bool,
) -> None:
    from mgs.reports.compacting import compact_run, thin_run
    from mgs.run.folder import open_run
    from mgs.splat_files import FORMATS

    size = None if most is None else _bytes(most)
    ending = FORMATS.get(to, ".mgs")
    targets = _targets(runs, [run / f"export{ending}" for run in runs], out, force)
    runtime.start()
    for run, path in targets:
        with progress_bar():
            if to == "mgs":
                result = compact_run(open_run(run), size, psnr, shared)
            else:
                result = thin_run(open_run(run), to, size, psnr)
        data, count, (before, after) = result.data, result.count, result.psnr
        with atomic_path(path) as temporary:
            temporary.write_bytes(data)
        values = f"PSNR of the views taken: {before:.2f} dB in the run, {after:.2f} dB in the file"
        echo(f"wrote {count:,} Gaussians to {path} ({len(data):,} bytes); {values}")


def _bytes(text: str) -> int:
    """Number of bytes of a text like 40k. Raises InputError for anything else."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", text)
    number = float(match[1]) * {"": 1, "k": 1e3, "M": 1e6}[match[2]] if match else 0
    if not 1 <= number < 1e12:
        raise InputError(f"--bytes {text}: expected a number of bytes, as in 40k or 1.5M")
    return int(number)


def _export_views(runs: list[Path], kind: str, out: Path | None, every: bool, force: bool) -> None:
    from mgs.reports.exporting import NAMES, write_views
    from mgs.run.folder import open_run

    if out is not None and len(runs) > 1:
        raise InputError(f"--out {out}: is one folder for {len(runs)}; leave it out")
    for run in runs:
        opened, folder = open_run(run), out or run / f"export.{kind}"
        with atomic_folder(folder, Ours(NAMES[kind]) if force else None) as unfinished:
            what = write_views(unfinished, opened, kind, every)
        echo(f"wrote {what} to {folder}")


def _in_srgb(model: Path, linear: "Gaussians") -> "Gaussians":
    """Gaussians of a linear model for sRGB blending; prints what that costs."""
    from mgs.reports.evaluation import compare_models
    from mgs.reports.exporting import as_imported, in_srgb, refit_in_srgb
    from mgs.run.folder import open_run

    if not model.is_dir():
        cost = "colours are converted from linear RGB to sRGB one by one, and mixtures are a little"
        echo(f"{cost} darker; the export of a run folder fits them again")
        return in_srgb(linear)
    run = open_run(model)
    with progress_bar():
        fitted = refit_in_srgb(run)
    name, values = compare_models([run.gaussians, fitted], run)
    if values is not None:
        linear_rgb = f"{values[0]:.2f} dB blended in linear RGB, as in the run"
        srgb = f"{values[1]:.2f} dB blended in sRGB, as exported, with colours fitted again"
        echo(f"PSNR of the {name} views: {linear_rgb}; {srgb} to the views taken")
    return as_imported(run, fitted)


def _targets(
    sources: list[Path], defaults: list[Path], out: Path | None, force: bool
) -> list[tuple[Path, Path]]:
    """Pairs of what is read and the file to write."""
    if out is not None and len(sources) > 1:
        raise InputError(f"--out {out}: is one file for {len(sources)}; leave it out")
    targets = [out] if out is not None else defaults
    return [(one, check_new_file(path, force)) for one, path in zip(sources, targets, strict=True)]


def video(
    runs: list[Path],
    out: Path | None = None,
    beside: Literal["uncertainty"] | None = None,
    story: bool = False,
    seconds: Annotated[float | None, typer.Option(min=0.1, max=3600)] = None,
    fps: Annotated[int | None, typer.Option(min=1, max=60)] = None,
    width: Annotated[int | None, typer.Option(min=16)] = None,
    force: bool = False,
) -> None:
    """Make a video of each run: a turntable of its model, or the model view by view.

    - out: File to write: .mp4 (needs imageio-ffmpeg), .gif or .png. Default: RUN/video.mp4.
    - beside: Second picture: the map of what is unknown.
    - story: Show the model after each view of the run; repeats the fits.
    - seconds: Length, seconds. Default: 8, or 1 per view with --story.
    - fps: Frames per second of a turntable. Default: 25.
    - width: Width of a picture in pixels. Default: the cameras' own."""
    from mgs.reports.video import check_film, path_frames, story_frames, write_film
    from mgs.run.folder import open_run

    if story:
        refuse_unused("with --story", beside=beside, width=width, fps=fps)
    fps = fps or 25
    targets = _targets(runs, [run / "video.mp4" for run in runs], out, force)
    check_film(targets[0][1])
    runtime.start()
    for run, target in targets:
        opened = open_run(run)
        with progress_bar("drawing") as bar:
            if story:
                frames, count = story_frames(opened), len(opened.state.taken)
                each = (seconds or count) / count
            else:
                count, each = max(1, round((seconds or 8) * fps)), 1 / fps
                wide = width or opened.dataset.frames[0].camera.width
                frames = path_frames(opened, beside, count, wide)
            lengths = [each] * (count - 1) + [3 * each if story else each]
            write_film(target, frames, lengths, partial(bar.whole, "frames"))
        size = target.stat().st_size / 1e6
        echo(f"wrote {count} frames to {target} ({size:.1f} MB)")
