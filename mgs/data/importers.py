"""Imports of nerfstudio, NeRF-synthetic and COLMAP data into a dataset folder, with lens distortion
undone."""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera, opencv_from_opengl
from mgs.data.clouds import SparseCloud, read_cloud, write_cloud
from mgs.data.colmap import is_model, read_model
from mgs.data.dataset import (
    FRAME_INTERVAL,
    PINHOLES,
    TEST_FOLDER,
    Dataset,
    Frame,
    load_dataset,
    read_records,
    resumes,
    write_transforms,
)
from mgs.data.lens import Undo, fit_to_camera, shrunk, undistorter
from mgs.data.meshes import read_mesh
from mgs.data.rock_image import premultiplied, write_rock_image
from mgs.data.up import PLUS_Z, Up, angle_between, unit_up, up_of_cameras
from mgs.errors import InputError
from mgs.files import copy_file, fingerprint, locked, new_folder, write_json
from mgs.images import read_exr, read_mask, read_rgba, read_values, write_exr, write_png

RECORD = "import.json"
"""File in the output folder that says what is imported. It is written before the first frame, and
an interrupted import is continued only where it asks for the same."""

DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
"""Coefficients of the OPENCV camera model, in OpenCV's order."""

LEVELLED = 10.0
"""A transforms.json whose cameras have their common up vector within this angle of +Z, degrees, was
made with +Z up."""

SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".PNG")
"""NeRF-synthetic names images without a suffix."""


@dataclass(frozen=True)
class Shot:
    """One frame of the data to import: its camera, with the distortion not yet undone, and its
    files.

    distortion: coefficients in OpenCV's order. timestamp: seconds. depth_unit: metres per step of a
    depth image in PNG.
    """

    name: str
    camera: Camera
    distortion: np.ndarray
    timestamp: float
    image: Path
    depth: Path | None = None
    depth_unit: float = 1.0
    mask: Path | None = None
    rock: Path | None = None


@dataclass(frozen=True)
class Source:
    """The data to import: its format, the shots whose image exists, the number of those whose image
    does not, and the points
    that were triangulated with the cameras. up: which way is up, unit: "m" or "unit", what a length
    of 1 is; None where the
    source does not say. no_cloud: the file of points that the source names and that does not
    exist."""

    kind: str
    shots: list[Shot]
    missing: int
    sparse: SparseCloud | None = None
    up: Up | None = None
    unit: str | None = None
    no_cloud: Path | None = None

    def in_metres(self, unit: float) -> Source:
        """The same data, whose unit of length is so many metres: cameras and points are scaled,
        depth is metres already.

        Raises InputError if that is not positive and finite.
        """
        if not 0 < unit < np.inf:
            raise InputError(
                f"import: --unit {unit} must be a positive number of metres; correct it"
            )
        shots = [replace(shot, camera=shot.camera.scaled(unit)) for shot in self.shots]
        return replace(self, shots=shots, sparse=self.sparse and self.sparse.scaled(unit), unit="m")

    def set_apart(self, every: int) -> tuple[Source, Source]:
        """The data in two parts: all shots but every Nth by name, counted from the first; and
        these, the test views, without
        points. every: N.

        Raises InputError where one of the two would have no shots.
        """
        names = sorted(shot.name for shot in self.shots)[::every]
        apart = [shot for shot in self.shots if shot.name in names]
        kept = [shot for shot in self.shots if shot.name not in names]
        if not kept:
            raise InputError(
                f"import: --test-every {every} of {len(self.shots)} images leaves none to choose from; correct it"
            )
        return replace(self, shots=kept), replace(self, shots=apart, sparse=None)

    def up_or_estimate(self) -> tuple[Up, str]:
        """Which way is up, and how that is known: as the source says, or as the cameras were held
        (`up_of_cameras`).

        NeRF-synthetic data are +Z up, and so is a transforms.json whose cameras agree to 10
        degrees. Raises InputError as `up_of_cameras`.
        """
        if self.up is not None:
            return self.up, "as the source says"
        if self.kind == "NeRF-synthetic":
            return PLUS_Z, "the rule of NeRF-synthetic data"
        found = up_of_cameras([shot.camera for shot in self.shots])
        if self.kind == "nerfstudio" and angle_between(found, PLUS_Z) < LEVELLED:
            return PLUS_Z, f"the cameras' common up vector is within {LEVELLED:.0f} degrees of it"
        return found, "the cameras' common up vector"


def read_source(source: str | Path, images: Path | None = None, split: str = "train") -> Source:
    """Recognise the format of a source, and read its cameras and the names of its files.

    source: a transforms.json or the folder that holds one; a folder with the transforms_SPLIT.json
    of NeRF-synthetic data; or a folder with a COLMAP model, in itself, in sparse/ or in sparse/0/.
    images: COLMAP's image folder, by default SOURCE/images.
    split: train, val or test of NeRF-synthetic data.
    Raises InputError where no format is recognised, none of the images exists, a frame is listed
    twice, or a camera model is not supported.
    """
    source = Path(source)
    if not source.exists():
        raise InputError(
            f"{source}: no such file or folder; give a transforms.json, its folder, or a COLMAP folder"
        )
    if source.is_file() or (source / "transforms.json").is_file():
        result = _read_transforms(source if source.is_file() else source / "transforms.json")
    elif (source / f"transforms_{split}.json").is_file():
        result = _read_transforms(source / f"transforms_{split}.json")
    else:
        model = next(
            (
                folder
                for folder in (source / "sparse/0", source / "sparse", source)
                if is_model(folder)
            ),
            None,
        )
        if model is None:
            three = "cameras, images and points3D, .bin or .txt, in sparse/0, sparse or the folder itself"
            raise InputError(
                f"{source}: holds no transforms.json, transforms_{split}.json or COLMAP model ({three})"
            )
        result = _read_colmap(model, images if images is not None else source / "images")
    if not result.shots:
        raise InputError(
            f"{source}: none of the {result.missing} images it lists exists; restore them or give --images"
        )
    repeated = [
        name for name, count in Counter(shot.name for shot in result.shots).items() if count > 1
    ]
    if repeated:
        raise InputError(
            f"{source}: lists {repeated[0]} more than once; remove the duplicate frames"
        )
    return result


def _find(folder: Path, name: str) -> Path | None:
    return next(
        (path for suffix in SUFFIXES if (path := folder / f"{name}{suffix}").is_file()), None
    )


def _frame_name(path: str) -> str:
    """A flat name for an image path: images/left/0001.png -> left_0001."""
    parts = [
        part for part in Path(path).with_suffix("").parts if part not in (".", "..", "/", "images")
    ]
    return "_".join(parts)


def _read_transforms(path: Path) -> Source:
    """Read a transforms.json of nerfstudio, or of NeRF-synthetic, which has camera_angle_x and
    image names without a suffix."""
    data, records = read_records(path)
    model = data.get("camera_model", "OPENCV")
    if model not in PINHOLES:
        raise InputError(
            f"{path}: camera model {model} is not supported; undistort the images to OPENCV or PINHOLE first"
        )
    scale = _number(path, "depth_unit_scale_factor", data.get("depth_unit_scale_factor", 1e-3))
    shots, missing = [], 0
    for index, record in enumerate(records):
        image = _find(path.parent, record["file_path"])
        if image is None:
            missing += 1
            continue
        keys = ("depth_file_path", "mask_path", "rock_file_path")
        depth, mask, rock = (path.parent / record[key] if record.get(key) else None for key in keys)
        camera, distortion = _transforms_camera(path, index, {**data, **record}, image)
        time = _number(
            path, f"timestamp of frame {index}", record.get("timestamp", FRAME_INTERVAL * index)
        )
        unit = 1.0 if depth is None or depth.suffix.lower() == ".exr" else scale
        shots.append(
            Shot(
                _frame_name(record["file_path"]),
                camera,
                distortion,
                time,
                image,
                depth,
                unit,
                mask,
                rock,
            )
        )
    kind = "NeRF-synthetic" if "camera_angle_x" in data and "fl_x" not in data else "nerfstudio"
    cloud = path.parent / str(data["ply_file_path"]) if data.get("ply_file_path") else None
    no_cloud = cloud if cloud is not None and not cloud.is_file() else None
    sparse = read_cloud(cloud) if cloud is not None and no_cloud is None else None
    up = unit_up(data["up"]) if data.get("up") else None
    length = str(data.get("unit") or "") or ("m" if any(shot.depth for shot in shots) else None)
    return Source(kind, shots, missing, sparse, up, length, no_cloud)


def _number(path: Path, what: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if not np.isfinite(number):
        raise InputError(f"{path}: {what} is {value!r}, no finite number; correct it")
    return number


def _transforms_camera(
    path: Path, index: int, record: dict[str, Any], image: Path
) -> tuple[Camera, np.ndarray]:
    where = f"{path}: frame {index}"
    try:
        if "w" in record and "h" in record:
            width, height = int(record["w"]), int(record["h"])
        else:
            height, width = read_rgba(image).shape[:2]
        fl_x = (
            float(record["fl_x"])
            if "fl_x" in record
            else width / 2 / math.tan(float(record["camera_angle_x"]) / 2)
        )
        fl_y, cx, cy = (
            float(record.get(*pair))
            for pair in (("fl_y", fl_x), ("cx", width / 2), ("cy", height / 2))
        )
        K = np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]])
        distortion = np.array([float(record.get(key, 0)) for key in DISTORTION_KEYS])
        pose = np.array(record["transform_matrix"], np.float64)
    except (KeyError, TypeError, ValueError, ArithmeticError):
        raise InputError(
            f"{where} has no usable intrinsics or pose; give fl_x (or camera_angle_x) and a matrix"
        ) from None
    if record.get("k4"):
        raise InputError(
            f"{where} has k4, which the OPENCV model lacks; undistort the images first"
        )
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not np.isfinite(distortion).all():
        raise InputError(
            f"{where} has a pose or distortion that is not finite, or no 4x4 matrix; correct it"
        )
    try:
        return Camera(K, width, height, opencv_from_opengl(pose)), distortion
    except (np.linalg.LinAlgError, InputError) as error:
        raise InputError(f"{where}: {error}; correct the pose") from None


def _read_colmap(model: Path, images: Path) -> Source:
    listed, cloud = read_model(model)
    shots, missing = [], 0
    for index, (name, camera, distortion) in enumerate(listed):
        if (images / name).is_file():
            shots.append(
                Shot(_frame_name(name), camera, distortion, FRAME_INTERVAL * index, images / name)
            )
        else:
            missing += 1
    return Source("COLMAP", shots, missing, cloud)


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
    """Write a source as a dataset into the folder `out`: a new or empty one, or one that an
    interrupted import of it left.

    Masks come from the first of these that there is: files in the folder `masks` that are named as
    the images (0001.png, or
    0001.jpg.png for 0001.jpg); the pixels whose centre shows the `mesh` (world coordinates); the
    source's own mask files; the images' alpha. Images of the rock alone come from the source's own
    images of it, or from an alpha that gives the mask and has values between empty and full. With
    `masks` or `mesh` there are none. Distorted images, depth and masks are undistorted to a pinhole
    camera in which every pixel is valid; then blocks of `downscale` x `downscale` pixels become
    one. up: what transforms.json says is up. tests: shots of the same world that become the test
    views (`Dataset.test_views`), in the same way. One frame is in memory at a time.

    import.json, which says what is imported, is written first, and transforms.json last. When an
    interrupted import is continued, a finished frame is made again only if one of its files has a
    newer modification time. The result is the
    same, bit for bit, as that of an import in one go. on_frame: called as on_frame(frames done, all
    frames). Raises InputError as `read_mesh`, and where a file is missing, damaged or of another
    size than its camera, where `out` holds anything else, or where another process works on it. The
    frames that were finished before are kept.
    """
    shots, project = source.shots, None
    if masks is not None:
        shots = [replace(shot, mask=_mask_file(masks, shot), rock=None) for shot in shots]
    elif mesh is not None:
        shots, project = (
            [replace(shot, mask=None, rock=None) for shot in shots],
            mesh_silhouette(mesh),
        )
    by_mesh = None if project is None or mesh is None else fingerprint(mesh)
    asked = {
        "kind": source.kind,
        "frames": len(shots),
        "sha256_of_frames": _digest(shots),
        "mesh": by_mesh,
    }
    asked |= {"downscale": downscale} if downscale != 1 else {}
    asked |= {"test_views": len(tests.shots)} if tests is not None else {}
    frames = []
    with ExitStack() as lock:
        if resumes(out, RECORD, asked):
            lock.enter_context(locked(out))

        def begin() -> None:
            if not (out / RECORD).is_file():
                new_folder(out)
                write_json(out / RECORD, asked)
                lock.enter_context(locked(out))

        for k, shot in enumerate(shots):
            if on_frame:
                on_frame(k, len(shots))
            frames.append(_import_shot(shot, out, project, downscale, begin))
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
    names = (
        shot.image.stem,
        shot.name,
        shot.image.name,
    )  # the last with a suffix more, as COLMAP names masks: 0001.jpg.png
    path = next((found for name in names if (found := _find(masks, name))), None)
    if not masks.is_dir():
        raise InputError(f"{masks}: no such folder; give the folder of the masks")
    if path is None:
        raise InputError(
            f"{masks}: no mask for image {shot.image.name}; name masks as their images"
        )
    return path


def _digest(shots: list[Shot]) -> str:
    """SHA-256 of the shots: names, cameras, times and paths of files, but not what the files
    hold."""
    known = [
        (shot.name, shot.camera.K.tolist(), shot.camera.width, shot.camera.height, shot.camera.world_to_camera.tolist(),
         shot.distortion.tolist(), shot.timestamp, shot.depth_unit,
         [None if path is None else str(path.resolve()) for path in (shot.image, shot.depth, shot.mask, shot.rock)])
        for shot in shots
    ]  # fmt: skip
    return hashlib.sha256(json.dumps(known).encode()).hexdigest()


def _import_shot(
    shot: Shot,
    out: Path,
    project: Callable[[Camera], np.ndarray] | None,
    downscale: int,
    begin: Callable[[], None],
) -> Frame:
    """Write the files of a frame, the image last. Nothing is done where the image exists and is no
    older than its sources.

    project: the mask by `mesh_silhouette`, or None. begin: called after all is read and before
    anything is written, to make the output folder; so a source that cannot be read leaves no folder
    behind.
    """
    camera, undo = shrunk(*undistorter(shot.camera, shot.distortion), downscale)
    image, mask_path, rock_path = (
        out / folder / f"{shot.name}.png" for folder in ("images", "masks", "rock")
    )
    depth_path = None if shot.depth is None else out / "depth" / f"{shot.name}.exr"
    sources = (
        path
        for path in (shot.image, shot.depth, shot.mask, shot.rock)
        if path is not None and path.is_file()
    )
    if not image.is_file() or image.stat().st_mtime_ns < max(
        path.stat().st_mtime_ns for path in sources
    ):
        rgba = fit_to_camera(shot.image, read_rgba(shot.image), shot.camera)
        mask, rock = (
            (project(camera), None) if project is not None else _mask_and_rock(shot, rgba, undo)
        )
        depth = (
            None
            if shot.depth is None
            else fit_to_camera(shot.depth, _read_depth(shot.depth, shot.depth_unit), shot.camera)
        )
        begin()
        if depth_path is not None and depth is not None:
            write_exr(depth_path, {"Z": undo(depth, False)})
        mask_path.unlink(missing_ok=True)
        if mask is not None:
            write_png(mask_path, mask)
        rock_path.unlink(missing_ok=True)
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
    """The mask and the image of the rock alone that the source itself gives, undistorted; None for
    what it does not give.

    rgba [H,W,4]: the pixels of the shot's image. undo: as `undistorter` gives it. The mask is bool
    [H,W]; the image of the rock
    is linear RGB premultiplied by alpha, and alpha, float32 [H,W,4]. Premultiplied light is what
    undistortion resamples: straight colours would mix with those of empty pixels, and leave a rim.
    """
    given = (
        None if shot.rock is None else fit_to_camera(shot.rock, read_rgba(shot.rock), shot.camera)
    )
    layer = rgba if given is None else given
    full = np.iinfo(layer.dtype).max
    alpha = layer[..., 3]
    if given is None and shot.mask is None and ((alpha > 0) & (alpha < full)).any():
        given = rgba
    rock = None if given is None else undo(premultiplied(given.astype(np.float32) / full), True)
    if shot.mask is not None:
        return undo(
            fit_to_camera(shot.mask, read_mask(shot.mask), shot.camera).astype(np.uint8) * 255, True
        ) >= 128, rock
    return undo(alpha, True) > full // 2 if alpha.min() < full else None, rock


def _is_plain_png(path: Path, camera: Camera) -> bool:
    """Whether a file is what `write_png` would write: a PNG of the camera's size and of colour type
    2 (RGB), 8 bits each."""
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


def mesh_silhouette(path: Path) -> Callable[[Camera], np.ndarray]:
    """A function of a camera: bool [H,W], the pixels whose centre shows the mesh.

    Raises InputError as `read_mesh` and `mesh_depth`.
    """
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    depth = mesh_depth(read_mesh(path))
    return lambda camera: depth(camera) > 0
