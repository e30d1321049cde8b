"""`mgs import`: make a dataset of cameras and images in other formats (docs/howto/data.md)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mgs.cli.options import Force, argument, option, parse_up
from mgs.cli.progress import progress_bar
from mgs.cli.terminal import Terminal
from mgs.errors import InputError
from mgs.files import Ours, clear_folder

if TYPE_CHECKING:
    from mgs.data.sources import Shot

MANY_PIXELS = 2_000_000
"""Pixels of an image beyond which --downscale is recommended."""

EXPOSURE_DIFFERS = 0.1
"""Difference of exposure by EXIF, stops, beyond which --exposure is recommended."""

FILES = ("import.json", "transforms.json", "images", "depth", "masks", "rock", "sparse.ply", "test")
"""Names in a folder of this command."""


def import_data(
    source: Annotated[
        Path,
        argument(
            "A transforms.json or a folder with one, a COLMAP model (sparse/0), ROS bag, Metashape "
            "XML, or a folder of TUM RGB-D, Open3D or RTAB-Map."
        ),
    ],
    out: Annotated[Path, option("Folder to write: new, empty, or left by an interrupted import.")],
    images: Annotated[
        Path | None,
        option("Folder of COLMAP's or Metashape's images (default: images), or topic of a bag."),
    ] = None,
    keyframes: Annotated[
        str,
        option("Of a recording, import frames at least this time or distance apart: 0.5s or 0.2m."),
    ] = "0.5s",
    masks: Annotated[
        Path | None, option("Folder of masks, named like the images; the rock is white.")
    ] = None,
    mesh: Annotated[
        Path | None,
        option(
            "Mesh of the rock, world coordinates; masks are its projections. "
            "GLB is converted from +Y up to +Z up."
        ),
    ] = None,
    downscale: Annotated[
        int,
        option("Average blocks of K x K pixels; 4 suits 12 megapixels.", min=1, metavar="K"),
    ] = 1,
    up: Annotated[
        str,
        option("Up direction: X,Y,Z in the source's world, or auto: from how cameras were held."),
    ] = "auto",
    unit: Annotated[
        float | None,
        option("Metres per unit of length of the source. Default: as the source says, if it does."),
    ] = None,
    test_every: Annotated[
        int | None,
        option(
            "Make the first and every further Nth image, by name, a test view; 8 is usual.",
            min=2,
            metavar="N",
        ),
    ] = None,
    split: Annotated[
        str, option("Split of NeRF-synthetic data to import: train, val or test.")
    ] = "train",
    force: Force = False,
) -> None:
    """Make a dataset from your own data: cameras and images, with depth and masks if there are any.
    Lens distortion is undone.

    Masks come from --masks, else from --mesh, the source's own mask files, or the images' alpha.
    Partial alpha is kept in rock/, images of the rock alone. Points that came with the cameras are
    kept in sparse.ply for `mgs prior`. The same command continues an interrupted import.
    """
    from mgs.data.dataset import TEST_FOLDER
    from mgs.data.importers import import_source
    from mgs.data.meshes import GLTF
    from mgs.data.sources import read_source
    from mgs.images import exif_exposure

    console, notes = Terminal(), Terminal(stderr=True)
    if masks is not None and mesh is not None:
        raise InputError(
            "import: --masks and --mesh both say where masks come from; give one of them"
        )
    unpacked = out.with_name(f"{out.name}.unpacked")
    found = read_source(source, images, split, keyframes=keyframes, unpack=unpacked)
    found = found if unit is None else found.in_metres(unit)
    given = parse_up(up)
    upward, reason = found.up_or_estimate() if given is None else (given, "as --up says")
    if force:
        clear_folder(out, Ours(FILES, [path for path in (source, images, masks, mesh) if path]))
    finished = os.path.isfile(out / "transforms.json")  # else the import refuses what is there
    tests, listed = None, found.missing + len(found.shots)
    if test_every is not None:
        found, tests = found.set_apart(test_every)
    with progress_bar("importing", console) as progress:
        result = import_source(
            found,
            out,
            masks=masks,
            mesh=mesh,
            downscale=downscale,
            up=upward,
            tests=tests,
            on_frame=partial(progress, "importing"),
        )
    if mesh is not None and mesh.suffix.lower() in GLTF:
        console.print(f"{mesh}: turned from +Y up, as its format prescribes, to +Z up")
    if found.missing:
        notes.print(f"mgs: {found.missing} of {listed} listed images do not exist; skipped them")
    if found.no_cloud:
        notes.print(
            f"mgs: the points that {source.name} names, {found.no_cloud}, do not exist; "
            "imported without them"
        )
    axis = ", ".join(f"{value:.4g}" for value in upward)
    lengths = "metres" if result.unit == "m" else f"in {result.unit}s (no --unit was given)"
    console.print(f"up is ({axis}): {reason}; lengths are {lengths}")
    stops = [value for shot in found.shots if (value := exif_exposure(shot.image)) is not None]
    if stops and max(stops) - min(stops) > EXPOSURE_DIFFERS:
        notes.print(
            f"mgs: by their EXIF, exposure differs by up to {max(stops) - min(stops):.1f} stops "
            "between photographs; `mgs fit --exposure` estimates a gain for each"
        )
    camera = result.frames[0].camera
    if camera.width * camera.height > MANY_PIXELS:
        notes.print(
            f"mgs: images of {camera.width}x{camera.height} take long to fit; "
            "--downscale 2 or more makes them smaller"
        )
    masked = sum(frame.mask_path is not None for frame in result.frames)
    layered = sum(frame.rock_path is not None for frame in result.frames)
    deep = sum(frame.depth_path is not None for frame in result.frames)
    undone = sum(shot.distortion.any() for shot in found.shots)
    points = 0 if found.sparse is None else len(found.sparse.points)
    console.print(
        f"{found.kind}: {len(result)} frames, {masked} with mask, {layered} with alpha, "
        f"{deep} with depth, {undone} undistorted, {points:,} points; "
        + (f"{out} is finished already" if finished else f"wrote {out}")
    )
    if tests is not None:
        console.print(
            f"test views: {len(tests.shots)} images, which are never fitted; "
            f"wrote {out / TEST_FOLDER}"
        )
    _tidy([*found.shots, *(tests.shots if tests else ())], unpacked)


def _tidy(shots: Sequence[Shot], unpacked: Path) -> None:
    """Remove the files that were unpacked of a bag."""
    for path in (path for shot in shots for path in (shot.image, shot.depth) if path):
        if path.parent == unpacked:
            path.unlink(missing_ok=True)
    with suppress(OSError):
        unpacked.rmdir()
