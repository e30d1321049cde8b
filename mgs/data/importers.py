"""Imports of a `Source` into a dataset folder, with lens distortion undone."""

import hashlib
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.clouds import write_cloud
from mgs.data.dataset import TEST_FOLDER, Dataset, load_dataset, resumes, write_transforms
from mgs.data.depth_beside import depth_of
from mgs.data.frames import Frame, premultiplied, write_rock_image
from mgs.data.lens import Undo, cut, read_fitting, shrunk, undistorter
from mgs.data.meshes import Mesh, read_mesh
from mgs.data.shots import Shot, Source, find_image
from mgs.data.world import PLUS_Z, Vector, World
from mgs.errors import InputError, Notice
from mgs.files import (
    Ours,
    clear_folder,
    copy_file,
    fingerprint,
    folder_locked,
    read_leftover,
    remove_file,
    write_json,
)
from mgs.images import PNG_BIT_DEPTH, read_mask, read_rgba, write_exr, write_png
from mgs.progress import report

Silhouette = Callable[[Camera], np.ndarray]  # mask of a camera, bool [H,W]

MOST_PIXELS = 2_100_000  # of an image by default, as 1920x1080: ten for each Gaussian
CHECKED = 4  # about the number of pictures that are checked before an import
RECORD = "import.json"  # record of what is imported; an interrupted import of the same continues


def import_source(
    source: Source,
    out: Path,
    *,
    masks: Path | None = None,
    mesh: Path | None = None,
    downscale: int | None = 1,
    up: Vector = PLUS_Z,
    tests: Source | None = None,
    options: Mapping[str, Any] | None = None,
    replaced: Ours | None = None,
) -> Dataset:
    """Write a source as a dataset into `out`: new, empty, or left by an interrupted import of it.

    masks: folder of mask files named as the images (0001.png, 0001_mask.png or 0001.jpg.png for
    0001.jpg). mesh: mesh file whose projection gives the masks, world coordinates. By default masks
    come from the source's mask files or the images' alpha. Rock images come from the source, or
    from an alpha with intermediate values that gives the mask; with `masks` or `mesh` there are
    none. Images, depth and masks are undistorted to a pinhole camera in which every pixel is valid,
    then reduced by blocks of `downscale` x `downscale`; None: those of the import that is there,
    else `least_factor`. up: as `World`. tests: shots of the same world, which become the test
    views. options: recorded, values of JSON; of others an interrupted import is not continued.
    replaced: kind of folder that is deleted first, once masks and mesh are found.

    When an interrupted import continues, a finished frame is made again only if one of its files
    is newer; the result is the same bit for bit. A finished import is loaded as it is. Raises
    InputError as `read_mesh`; if a file is missing, damaged or of another size than its camera; if
    `out` holds anything else or is locked by another process. Finished frames are kept."""
    shots, silhouette = source.shots, None
    every = [*shots, *(tests.shots if tests else ())]
    if masks is not None:
        shots = [replace(shot, mask=_mask_file(masks, shot, every), rock=None) for shot in shots]
    elif mesh is not None:
        shots = [replace(shot, mask=None, rock=None) for shot in shots]
        from mgs.data.raycast import mesh_in_sight  # imported here because it loads Mitsuba

        cameras, world = [shot.camera for shot in shots], World(origin=source.origin)
        silhouette = silhouette_of(mesh_in_sight(read_mesh(mesh), cameras, world, mesh))
    if replaced:
        clear_folder(out, replaced)
    before = read_leftover(out / RECORD)
    before = before if isinstance(before, dict) else {}
    old = before.get("downscale")
    factor = downscale or (old if isinstance(old, int) and old > 0 else least_factor(shots))
    record: dict[str, Any] = {
        "kind": source.kind,
        "frames": len(shots),
        "sha256_of_frames": _digest(shots),
        "mesh": fingerprint(mesh) if mesh is not None and masks is None else None,
        "downscale": factor,
        "test_views": None if tests is None else len(tests.shots),
    }
    with folder_locked(out):
        # Records of earlier versions lack options; of whole imports the caller compares them. One
        # whose poses are not checked yet begins with those of the source.
        begun = options and (not before or ("options" in before and "files" not in before))
        if begun:
            record["options"] = options
        if resumes(out, RECORD, record) and (out / "transforms.json").is_file() and not begun:
            return load_dataset(out)

        def begin() -> None:
            if not (out / RECORD).is_file():
                write_json(out / RECORD, record)
                if downscale is None and factor > 1:
                    _say_reduced(shots[0].camera, factor)

        _warn_of_bits(shots)
        frames = []
        for k, shot in enumerate(shots):
            report("importing", k, len(shots))
            frames.append(import_shot(shot, out, silhouette, factor, begin))
        if source.sparse is not None:
            write_cloud(out / "sparse.ply", source.sparse)
        if tests is not None:
            how: Any = {"masks": masks, "mesh": mesh, "downscale": factor, "up": up}
            import_source(tests, out / TEST_FOLDER, **how, options=options)
        world = World(up, source.unit or "unit", source.origin)
        upright = [replace(frame, camera=world.enter(frame.camera)) for frame in frames]
        place = {"place": source.place} if source.place and up == PLUS_Z else {}
        write_transforms(out, upright, world, place)
    return load_dataset(out)


def _mask_file(masks: Path, shot: Shot, shots: Sequence[Shot]) -> Path:
    """Mask file of a shot, named as its image with or without folders."""
    if not masks.is_dir():
        raise InputError(f"{masks}: no such folder; give the folder of the masks")
    photograph = None
    if (path := find_image(masks, shot.name)) and not path.samefile(shot.image):
        return path
    for end in (3, 2, 1):
        image = Path(*shot.image.parts[-end:])
        stem = image.with_suffix("").as_posix()
        # The last two: as Metashape exports masks, and as COLMAP names them.
        for name in (stem, f"{stem}_mask", image.as_posix()):
            path = find_image(masks, name)
            if path and path.samefile(shot.image):  # a mask may lie beside it
                photograph = path
            elif path:
                others = [one for one in shots if one.image.parts[-end:] == image.parts]
                if len(others) > 1:
                    raise InputError(
                        f"{path}: {len(others)} images have this name; put masks into folders as "
                        "the images are, or name them as the frames, "
                        f"{others[0].name} and {others[1].name}"
                    )
                return path
    if photograph:
        return photograph
    raise InputError(f"{masks}: no mask for image {shot.image.name}; name masks as their images")


def _digest(shots: list[Shot]) -> str:
    """SHA-256 of names, cameras, times and paths of the shots, but not of file contents."""
    rows = [
        (
            shot.name,
            shot.camera.K.tolist(),
            shot.camera.width,
            shot.camera.height,
            shot.camera.world_to_camera.tolist(),
            shot.lens and [shot.lens.model, *shot.lens.parameters],
            shot.timestamp,
            shot.depth_factor * shot.depth_unit,
            shot.float_unit,
            shot.turned,
            [
                path and str(path.resolve())
                for path in (shot.image, shot.depth, shot.mask, shot.rock)
            ],
            *([shot.rim, str(shot.confidence)] if shot.rim or shot.confidence else ()),
        )
        for shot in shots
    ]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def import_shot(
    shot: Shot, out: Path, silhouette: Silhouette | None, downscale: int, begin: Callable[[], None]
) -> Frame:
    """Write the files of a frame, the image last, unless the image exists and is no older than its
    sources. silhouette: mask of a camera by `silhouette_of`. begin: makes the output folder, called
    between reading and writing, so that a source that cannot be read leaves no folder behind."""
    camera, undo = cut(*undistorter(shot.camera, shot.lens), shot.rim)
    camera, undo = shrunk(camera, downscale, undo)
    image, mask_path, rock_path = (
        out / folder / f"{shot.name}.png" for folder in ("images", "masks", "rock")
    )
    depth_path = None if shot.depth is None else out / "depth" / f"{shot.name}.exr"
    newest = max(path.stat().st_mtime_ns for path in shot.files if path.is_file())
    if not image.is_file() or image.stat().st_mtime_ns < newest:
        rgba = read_fitting(read_rgba, shot.image, shot.camera, shot.turned)
        mask, rock = silhouette(camera) if silhouette else None, None
        if silhouette is None:
            mask, rock = _mask_and_rock(shot, rgba, undo)
        depth = None if shot.depth is None else depth_of(shot)
        begin()
        if depth_path is not None and depth is not None:
            write_exr(depth_path, {"Z": undo(depth, False)})
        remove_file(out, mask_path)
        if mask is not None:
            write_png(mask_path, mask)
        remove_file(out, rock_path)
        if rock is not None:
            write_rock_image(rock_path, rock)
        if _is_plain_png(shot.image, camera) and not (shot.lens or shot.turned):
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
    source gives; None if it gives none. rgba [H,W,4]: pixels of the shot's image. Premultiplied
    light is resampled, since straight colours would mix with those of empty pixels and leave a
    rim."""
    about = shot.camera, shot.turned
    cutout = None if shot.rock is None else read_fitting(read_rgba, shot.rock, *about)
    layer = rgba if cutout is None else cutout
    full = np.iinfo(layer.dtype).max
    alpha = layer[..., 3]
    if cutout is None and shot.mask is None and ((alpha > 0) & (alpha < full)).any():
        cutout = rgba
    rock = None if cutout is None else undo(premultiplied(cutout), True)
    if shot.mask is not None:
        mask = read_fitting(read_mask, shot.mask, *about, resized=True)
        return undo(mask.astype(np.uint8) * 255, True) >= 128, rock
    return undo(alpha, True) > full // 2 if alpha.min() < full else None, rock


def _is_plain_png(path: Path, camera: Camera) -> bool:
    """Whether a file is what `write_png` writes: an 8-bit RGB PNG of the camera's size."""
    header = _png_header(path)
    size = camera.width.to_bytes(4, "big") + camera.height.to_bytes(4, "big")
    return header[16:] == size + b"\x08\x02"


def _png_header(path: Path) -> bytes:
    """Start of a PNG file up to its colour type; empty for other files."""
    with path.open("rb") as file:
        header = file.read(26)
    return header if header[:8] == b"\x89PNG\r\n\x1a\n" else b""


def _warn_of_bits(shots: Sequence[Shot]) -> None:
    """Warn where pictures of 16 bits use only the lower ones, so that they are nearly black."""
    some = [shot.image for shot in shots[:: max(1, len(shots) // CHECKED)]]
    deep = [
        path for path in some if _png_header(path)[PNG_BIT_DEPTH : PNG_BIT_DEPTH + 1] == b"\x10"
    ]
    bits = int(max((read_rgba(path)[..., :3].max() for path in deep), default=0)).bit_length()
    if deep and bits <= 13:
        text = (
            f"{deep[0]}: its values use {bits} of 16 bits, so the pictures are nearly black; "
            f"multiply them by {2 ** (16 - bits)}"
        )
        warnings.warn(Notice(text), stacklevel=2)


def least_factor(shots: Sequence[Shot]) -> int:
    """Least factor of a reduction that leaves no image of more than MOST_PIXELS."""
    most = max(shot.camera.width * shot.camera.height for shot in shots)
    return int(np.ceil(np.sqrt(most / MOST_PIXELS)))


def _say_reduced(camera: Camera, factor: int) -> None:
    """Say so before images are written, since that takes long, too."""
    text = (
        f"images of {camera.width}x{camera.height} are written at 1/{factor} of their sides; "
        "downscale 1 keeps them, for longer fits and more memory"
    )
    warnings.warn(Notice(text), stacklevel=2)


def silhouette_of(mesh: Mesh) -> Silhouette:
    """Return mask(camera): bool [H,W], pixels whose centre shows the mesh."""
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    depth = mesh_depth(mesh)
    return lambda camera: depth(camera) > 0
