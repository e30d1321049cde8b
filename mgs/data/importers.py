"""Imports of a `Source` into a dataset folder, with lens distortion undone."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from mgs.camera import Camera
from mgs.data.clouds import write_cloud
from mgs.data.dataset import TEST_FOLDER, Dataset, load_dataset, resumes, write_transforms
from mgs.data.frames import Frame
from mgs.data.lens import Undo, read_fitting, shrunk, undistorter
from mgs.data.meshes import Mesh, read_mesh
from mgs.data.rock_image import premultiplied, write_rock_image
from mgs.data.sources import Shot, Source, find_image
from mgs.data.up import PLUS_Z, Up
from mgs.errors import InputError
from mgs.files import copy_file, fingerprint, folder_locked, remove_file, write_json
from mgs.images import read_exr, read_mask, read_rgba, read_values, write_exr, write_png

RECORD = "import.json"
"""Record of what is imported; an interrupted import of the same continues."""


def import_source(
    source: Source,
    out: Path,
    *,
    masks: Path | None = None,
    mesh: Path | None = None,
    downscale: int = 1,
    up: Up = PLUS_Z,
    tests: Source | None = None,
    on_frame: Callable[[int, int], None] | None = None,
) -> Dataset:
    """Write a source as a dataset into `out`: new, empty, or left by an interrupted import of it.

    masks: folder of mask files named as the images (0001.png, 0001_mask.png or 0001.jpg.png for
    0001.jpg). mesh: mesh file whose projection gives the masks, world coordinates. By default masks
    come from the source's mask files or the images' alpha. Rock images come from the source, or
    from an alpha with intermediate values that gives the mask; with `masks` or `mesh` there are
    none. Images, depth and masks are undistorted to a pinhole camera in which every pixel is valid,
    then reduced by blocks of `downscale` x `downscale`. up: as `Dataset`. tests: shots of the same
    world, which become the test views. on_frame: called (done, total) before each frame.

    When an interrupted import continues, a finished frame is made again only if one of its files
    is newer; the result is the same bit for bit. A finished import is loaded as it is. Raises
    InputError as `read_mesh`; if a file is missing, damaged or of another size than its camera; if
    `out` holds anything else or is locked by another process. Finished frames are kept.
    """
    shots, silhouette = source.shots, None
    if masks is not None:
        shots = [replace(shot, mask=_mask_file(masks, shot), rock=None) for shot in shots]
    elif mesh is not None:
        shots = [replace(shot, mask=None, rock=None) for shot in shots]
        silhouette = silhouette_of(read_mesh(mesh))
    asked = {
        "kind": source.kind,
        "frames": len(shots),
        "sha256_of_frames": _digest(shots),
        "mesh": fingerprint(mesh) if mesh is not None and masks is None else None,
        "downscale": downscale,
        "test_views": None if tests is None else len(tests.shots),
    }
    with folder_locked(out):
        if resumes(out, RECORD, asked) and (out / "transforms.json").is_file():
            return load_dataset(out)

        def begin() -> None:
            if not (out / RECORD).is_file():
                write_json(out / RECORD, asked)

        frames = []
        for k, shot in enumerate(shots):
            if on_frame:
                on_frame(k, len(shots))
            frames.append(import_shot(shot, out, silhouette, downscale, begin))
        if source.sparse is not None:
            write_cloud(out / "sparse.ply", source.sparse)
        if tests is not None and not (out / TEST_FOLDER / "transforms.json").is_file():
            import_source(
                tests,
                out / TEST_FOLDER,
                masks=masks,
                mesh=mesh,
                downscale=downscale,
                up=up,
                on_frame=on_frame,
            )
        write_transforms(out, frames, up, source.unit or "unit")
    return load_dataset(out)


def _mask_file(masks: Path, shot: Shot) -> Path:
    """Mask file of a shot. Raises InputError if there is none."""
    if not masks.is_dir():
        raise InputError(f"{masks}: no such folder; give the folder of the masks")
    stem, full = shot.image.stem, shot.image.name
    # The last two: as Metashape exports masks, and as COLMAP names them.
    for name in (stem, shot.name, f"{stem}_mask", full):
        if path := find_image(masks, name):
            return path
    raise InputError(f"{masks}: no mask for image {shot.image.name}; name masks as their images")


def _digest(shots: list[Shot]) -> str:
    """SHA-256 of names, cameras, times and paths of the shots, but not of file contents."""
    known = [
        (
            shot.name,
            shot.camera.K.tolist(),
            shot.camera.width,
            shot.camera.height,
            shot.camera.world_to_camera.tolist(),
            shot.distortion.tolist(),
            shot.timestamp,
            shot.depth_unit,
            [
                path and str(path.resolve())
                for path in (shot.image, shot.depth, shot.mask, shot.rock)
            ],
        )
        for shot in shots
    ]
    return hashlib.sha256(json.dumps(known).encode()).hexdigest()


def import_shot(
    shot: Shot,
    out: Path,
    silhouette: Callable[[Camera], np.ndarray] | None,
    downscale: int,
    begin: Callable[[], None],
) -> Frame:
    """Write the files of a frame, the image last, unless the image exists and is no older than its
    sources.

    silhouette: mask of a camera by `silhouette_of`. begin: makes the output folder, called between
    reading and writing, so that a source that cannot be read leaves no folder behind.
    """
    camera, undo = undistorter(shot.camera, shot.distortion)
    camera, undo = shrunk(camera, downscale, undo)
    image, mask_path, rock_path = (
        out / folder / f"{shot.name}.png" for folder in ("images", "masks", "rock")
    )
    depth_path = None if shot.depth is None else out / "depth" / f"{shot.name}.exr"
    files = [path for path in (shot.image, shot.depth, shot.mask, shot.rock) if path]
    newest = max(path.stat().st_mtime_ns for path in files if path.is_file())
    if not image.is_file() or image.stat().st_mtime_ns < newest:
        rgba = read_fitting(read_rgba, shot.image, shot.camera)
        mask, rock = silhouette(camera) if silhouette else None, None
        if silhouette is None:
            mask, rock = _mask_and_rock(shot, rgba, undo)
        read = partial(_read_depth, unit=shot.depth_unit)
        depth = None if shot.depth is None else read_fitting(read, shot.depth, shot.camera)
        begin()
        if depth_path is not None and depth is not None:
            write_exr(depth_path, {"Z": undo(depth, False)})
        remove_file(out, mask_path)
        if mask is not None:
            write_png(mask_path, mask)
        remove_file(out, rock_path)
        if rock is not None:
            write_rock_image(rock_path, rock)
        if _is_plain_png(shot.image, camera) and not shot.distortion.any():
            copy_file(shot.image, image)
        else:
            full, pixels = np.iinfo(rgba.dtype).max, undo(rgba[..., :3], True)
            write_png(image, pixels if full == 255 else pixels / full, linear=False)
    mask_file, rock_file = (path if path.is_file() else None for path in (mask_path, rock_path))
    return Frame(shot.name, camera, shot.timestamp, image, depth_path, mask_file, rock_file)


def _mask_and_rock(
    shot: Shot, rgba: np.ndarray, undo: Undo
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Undistorted mask, bool [H,W], and rock image, float32 [H,W,4] linear premultiplied, that the
    source gives; None if it gives none.

    rgba [H,W,4]: pixels of the shot's image. Premultiplied light is resampled, since straight
    colours would mix with those of empty pixels and leave a rim.
    """
    given = None if shot.rock is None else read_fitting(read_rgba, shot.rock, shot.camera)
    layer = rgba if given is None else given
    full = np.iinfo(layer.dtype).max
    alpha = layer[..., 3]
    if given is None and shot.mask is None and ((alpha > 0) & (alpha < full)).any():
        given = rgba
    rock = None if given is None else undo(premultiplied(given), True)
    if shot.mask is not None:
        mask = read_fitting(read_mask, shot.mask, shot.camera)
        return undo(mask.astype(np.uint8) * 255, True) >= 128, rock
    return undo(alpha, True) > full // 2 if alpha.min() < full else None, rock


def _is_plain_png(path: Path, camera: Camera) -> bool:
    """Whether a file is what `write_png` writes: an 8-bit RGB PNG of the camera's size."""
    with path.open("rb") as file:
        header = file.read(26)
    size = camera.width.to_bytes(4, "big") + camera.height.to_bytes(4, "big")
    return header[:8] == b"\x89PNG\r\n\x1a\n" and header[16:] == size + b"\x08\x02"


def _read_depth(path: Path, unit: float) -> np.ndarray:
    """Depth in metres, float32 [H,W], from EXR or from a 16-bit PNG in steps of `unit` metres."""
    if path.suffix.lower() == ".exr":
        channels = read_exr(path)
        return channels.get("Z", next(iter(channels.values())))
    return read_values(path).astype(np.float32) * unit


def silhouette_of(mesh: Mesh) -> Callable[[Camera], np.ndarray]:
    """Return mask(camera): bool [H,W], pixels whose centre shows the mesh."""
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    depth = mesh_depth(mesh)
    return lambda camera: depth(camera) > 0
