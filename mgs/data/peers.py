"""Cameras of other programs: Metashape, OpenSfM and ODM, Bundler, LLFF, MVSNet, 3D Gaussian
Splatting, and of openMVG's benchmark.

Each reader turns the program's axes into those of `Camera`: x right, y down, z forward."""

import io
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PureWindowsPath
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mgs.camera import Camera
from mgs.data.clouds import SparseCloud
from mgs.data.colmap import models_in
from mgs.data.dataset import FRAME_INTERVAL
from mgs.data.lens import Lens
from mgs.data.shots import (
    PHOTOGRAPH,
    PICTURE_SUFFIXES,
    Shot,
    Source,
    find_image,
    frame_name,
    none_exists,
    orthonormal,
)
from mgs.data.world import PLUS_Z
from mgs.errors import InputError
from mgs.files import parsing, read_bytes, read_json, read_text, read_xml
from mgs.images import image_size

OPENSFM = {  # projections of OpenSfM and COLMAP's model of the same formula
    **dict.fromkeys(("perspective", "simple_radial", "radial", "brown"), "OPENCV"),
    **dict.fromkeys(("fisheye", "fisheye_opencv"), "OPENCV_FISHEYE"),
}
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


class View(NamedTuple):
    """A camera as a file lists it.

    name: of its image. pose: world to camera [4,4]. focal: pixels, x and y. size, centre: pixels;
    None: the image's own size, and its middle. model, coefficients: as in `Lens.of`."""

    name: str
    pose: np.ndarray
    focal: tuple[float, float]
    size: tuple[float, float] | None = None
    centre: tuple[float, float] | None = None
    model: str = "PINHOLE"
    coefficients: Mapping[str, float] = MappingProxyType({})


class Contents(NamedTuple):
    """Cameras and points [N,3] of a file. track: images of each point [N]. world: up and unit, as
    of `Source`, where the file says them. left_out: numbers of other images, by reason."""

    views: list[View]
    points: Sequence[Any] = ()
    track: Sequence[int] | None = None
    world: Mapping[str, Any] = MappingProxyType({})
    notes: tuple[str, ...] = ()
    left_out: Mapping[str, int] = MappingProxyType({})


def _matrix(rotation: Any, translation: Any) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.reshape(rotation, (3, 3)), np.reshape(translation, 3)
    return pose


METASHAPE = {"frame": "OPENCV", "fisheye": "THIN_PRISM_FISHEYE"}  # as OPENSFM


def _metashape(path: Path, folders: list[Path]) -> Contents:
    """Agisoft Metashape (File, Export, Cameras: XML): aligned and enabled cameras. Lengths are
    metres where the chunk has a scale. Position and north of a georeferenced chunk are left out. K
    has its origin in the middle of the image, and p1 and p2 are OpenCV's p2 and p1 (its manual,
    appendix D)."""
    chunk, views, left_out = read_xml(path).find("chunk"), list[View](), Counter[str]()
    if chunk is None:
        raise ValueError("no chunk")
    lenses = {lens.get("id"): lens for lens in chunk.iterfind("sensors/sensor")}
    scale = chunk.find("transform/scale")
    factor = 1.0 if scale is None else float(scale.text or "")
    for camera in chunk.iterfind("cameras//camera"):
        if camera.find("transform") is None:
            left_out["not aligned"] += 1
        elif camera.get("enabled", "true") in ("false", "0"):
            left_out["disabled"] += 1
        else:
            label, numbers = camera.get("label") or "", camera.find("transform").text.split()
            pose = np.array([float(number) for number in numbers]).reshape(4, 4)
            pose[:3, 3] *= factor
            where, lens = f"{path}: camera {label}", lenses[camera.get("sensor_id")]
            views.append(View(label, np.linalg.inv(pose), *_metashape_lens(where, lens)))
    world = {} if scale is None else {"unit": "m"}
    return Contents(views, world=world, left_out=left_out)


def _metashape_lens(where: str, lens: Any) -> tuple[Any, ...]:
    """Fields of `View` from `focal` on."""
    model = METASHAPE.get(lens.get("type", "frame"))
    if model is None:
        raise InputError(
            f"{where} is of type {lens.get('type')}, and only {' and '.join(METASHAPE)} are "
            "supported; export undistorted photographs"
        )
    adjusted = lens.find("calibration[@class='adjusted']")
    calibration = lens.find("calibration") if adjusted is None else adjusted
    size = lens.find("resolution") if calibration is None else calibration.find("resolution")
    if calibration is None or size is None:
        raise InputError(f"{where} has no calibration; align the photographs first")
    value = {one.tag: float(one.text) for one in calibration if one.tag != "resolution"}
    if value.get("b2") or (value.get("k4") and model == "OPENCV"):
        raise InputError(f"{where} has b2 or k4; align without them")
    width, height, f = int(size.get("width")), int(size.get("height")), value["f"]
    centre = width / 2 + value.get("cx", 0.0), height / 2 + value.get("cy", 0.0)
    keys = {"k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4", "p1": "p2", "p2": "p1"}
    coefficients = {ours: value.get(theirs, 0.0) for ours, theirs in keys.items()}
    return (f + value.get("b1", 0.0), f), (width, height), centre, model, coefficients


def _opensfm(path: Path, folders: list[Path]) -> Contents:
    """OpenSfM: the largest part. A rotation vector and a translation take the world to the camera.
    Focal lengths and centres are over the longer side, from the middle of the image. With GPS the
    world is in metres, x east, y north, z up (opensfm.org/docs/geometry.html)."""
    parts = read_json(path)
    part = max(parts, key=lambda one: len(one["shots"]))
    views = []
    for name, shot in sorted(part["shots"].items()):
        lens = part["cameras"][shot["camera"]]
        kind, width, height = lens["projection_type"], float(lens["width"]), float(lens["height"])
        if kind not in OPENSFM:
            raise InputError(f"{path}: {name} is {kind}, not supported; undistort the images first")
        side, focal = max(width, height), float(lens.get("focal_x", lens.get("focal", 0)))
        fy = float(lens.get("focal_y", focal))
        cx, cy = float(lens.get("c_x", 0)), float(lens.get("c_y", 0))
        views.append(
            View(
                name,
                _matrix(Rotation.from_rotvec(shot["rotation"]).as_matrix(), shot["translation"]),
                (focal * side, fy * side),
                (width, height),
                (width / 2 + side * cx, height / 2 + side * cy),
                OPENSFM[kind],
                {key: float(lens[key]) for key in COEFFICIENTS if key in lens},
            )
        )
    place = part.get("reference_lla") or {}
    metric = any(float(place.get(key, 0)) for key in ("latitude", "longitude"))
    others = [len(one["shots"]) for one in parts if one is not part]
    note = f"took the largest part, of {len(views)} images; others have {others}"
    points = [point["coordinates"] for point in part.get("points", {}).values()]
    world = {"up": PLUS_Z, "unit": "m"} if metric else {}
    return Contents(views, points, None, world, (note,) if others else ())


def _bundler(path: Path, folders: list[Path]) -> Contents:
    """Bundler: x right, y up, z backwards; f, k1, k2 in pixels from the middle of the image. The
    images are those of list.txt; f is 0 where one is not placed (Bundler's manual)."""
    beside = path.name.removesuffix("bundle.out") + "list.txt"
    lists = [path.with_name(beside), path.parent.parent / beside]
    listed = read_text(next((file for file in lists if file.is_file()), lists[0])).splitlines()
    names = [line.split()[0] for line in listed if line.strip()]
    lines = [line for line in read_text(path).splitlines() if not line.startswith("#")]
    cameras, points = map(int, lines[0].split())
    if len(names) != cameras or len(lines) < 1 + 5 * cameras + 3 * points:
        raise ValueError(f"{cameras} cameras and {points} points of {len(names)} listed images")
    views = []
    for name, first in zip(names, range(1, 1 + 5 * cameras, 5), strict=True):
        f, k1, k2 = map(float, lines[first].split())
        rows = np.array([line.split() for line in lines[first + 1 : first + 5]], float)
        pose = np.diag([1.0, -1, -1, 1]) @ _matrix(rows[:3], rows[3])
        if f:
            views.append(View(name, pose, (f, f), None, None, "OPENCV", {"k1": k1, "k2": k2}))
    rest = lines[1 + 5 * cameras : 1 + 5 * cameras + 3 * points]
    track = [int(line.split()[0]) for line in rest[2::3]]
    return Contents(views, [line.split() for line in rest[::3]], track)


def _llff(path: Path, folders: list[Path]) -> Contents:
    """LLFF: rows of a matrix [3,5] and two depths, for the images in order of name. Columns of the
    matrix: camera-to-world of x down, y right, z backwards; position; height, width, focal length
    (LLFF's README)."""
    table = np.load(io.BytesIO(read_bytes(path)), allow_pickle=False)
    folder = next((one for one in folders if one.is_dir()), path.parent)
    names = sorted(one.name for one in folder.iterdir() if one.suffix.lower() in PICTURE_SUFFIXES)
    if not names:
        raise InputError(f"{path}: {folder} has no pictures; give their folder as `images`")
    if table.ndim != 2 or table.shape[1] != 17:
        raise ValueError(f"an array of {table.shape}, not [N,17]")
    if len(table) != len(names):
        why = f"has {len(table)} poses for {len(names)} pictures in {folder}"
        cure = "restore what lacks, or give their folder as `images`"
        raise InputError(f"{path}: {why}; {cure}")
    views = []
    for name, row in zip(names, table.astype(np.float64), strict=True):
        down, right, back, eye, (height, width, f) = row[:15].reshape(3, 5).T
        pose = _matrix(np.column_stack([right, down, -back]), eye)
        views.append(View(name, np.linalg.inv(pose), (f, f), (width, height)))
    return Contents(views)


def _mvsnet(path: Path, folders: list[Path]) -> Contents:
    """MVSNet: cams/NAME_cam.txt with `extrinsic`, world to camera [4,4], and `intrinsic` [3,3] of
    the image NAME (MVSNet's README)."""
    views = []
    for file in sorted(path.glob("*_cam.txt")):
        words = read_text(file).split()
        pose, K = (
            np.array(words[first : first + side**2], float).reshape(side, side)
            for first, side in (
                (words.index("extrinsic") + 1, 4),
                (words.index("intrinsic") + 1, 3),
            )
        )
        views.append(View(file.name.removesuffix("_cam.txt"), pose, *_pinhole(file, K)))
    return Contents(views)


def _benchmark(path: Path, folders: list[Path]) -> Contents:
    """openMVG's SfM_quality_evaluation: gt_dense_cameras/IMAGE.camera with K [3,3], three numbers
    of distortion, camera-to-world rotation [3,3], position, width and height."""
    views = []
    for file in sorted(path.glob("*.camera")):
        numbers = np.array(read_text(file).split(), float)
        K, lens, R, eye, size = np.split(numbers, (9, 12, 21, 24))
        if lens.any():
            raise InputError(f"{file}: has distortion; undistort the images")
        pose = np.linalg.inv(_matrix(R, eye))
        focal, _, centre = _pinhole(file, K.reshape(3, 3))
        name = file.name.removesuffix(".camera")
        views.append(View(name, pose, focal, (size[0], size[1]), centre))
    return Contents(views)


def _pinhole(file: Path, K: np.ndarray) -> tuple[Any, ...]:
    """Fields of `View` from `focal` to `centre`, of an image of unknown size."""
    if K[0, 1]:
        raise InputError(f"{file}: has skew, {K[0, 1]:g}; resample the images without it")
    return (K[0, 0], K[1, 1]), None, (K[0, 2], K[1, 2])


def _splatting(path: Path, folders: list[Path]) -> Contents:
    """3D Gaussian Splatting: camera-to-world rotation and position; the centre is the middle of the
    image (camera_utils.py of its authors)."""
    views = []
    for one in read_json(path):
        pose = np.linalg.inv(_matrix(one["rotation"], one["position"]))
        focal = float(one["fx"]), float(one["fy"])
        size = float(one["width"]), float(one["height"])
        views.append(View(str(one["img_name"]), pose, focal, size))
    return Contents(views)


PEERS: dict[str, tuple[tuple[str, ...], Callable[[Path, list[Path]], Contents]]] = {
    "Metashape": ((".xml",), _metashape),
    "OpenSfM": (("reconstruction.json", "opensfm/reconstruction.json"), _opensfm),
    "Bundler": (("bundle.out", "bundle/bundle.out"), _bundler),
    "LLFF": (("poses_bounds.npy",), _llff),
    "MVSNet": (("cams",), _mvsnet),
    "openMVG benchmark": (("gt_dense_cameras",), _benchmark),
    "3D Gaussian Splatting": (("cameras.json",), _splatting),
}
"""Kind of source -> (its file in a folder, or its folder of files; reader)."""


def _file_of(kind: str, source: Path) -> Path | None:
    """File of cameras that a path names, or that its folder holds beside no other poses."""
    names = PEERS[kind][0]
    if source.is_file():
        fits = "." in names[0] and source.name.lower().endswith(names[0]) and not _is_object(source)
        return source if fits else None
    if any(source.glob("transforms*.json")) or models_in(source):
        return None
    for path in (source / name for name in names):
        if path.is_dir() and (any(path.glob("*_cam.txt")) or any(path.glob("*.camera"))):
            return path
        if path.is_file() and not _is_object(path):
            return path
    return None


def _is_object(path: Path) -> bool:
    """Whether a JSON file has an object, as a transforms.json and the cameras.json of ODM, and no
    list of cameras or parts."""
    with path.open("rb") as file:
        return path.suffix == ".json" and file.read(64).lstrip().startswith(b"{")


def is_peer(kind: str, source: Path) -> bool:
    return _file_of(kind, source) is not None


def read_peer(kind: str, source: Path, images: Path | None, *_: Any) -> Source:
    """Cameras and points of a source of this kind of PEERS. images: folder of the images, by
    default one beside its file. Raises InputError where the file is damaged, or a lens is not
    supported."""
    path = _file_of(kind, source)
    assert path is not None
    near = [path.parent / "images", path.parent.parent / "images", path.parent, path.parent.parent]
    folders = [images] if images is not None else near
    with parsing(path, f"file of {kind}", "export it again"):
        contents = PEERS[kind][1](path, folders)
        shots, left_out = list[Shot](), Counter(contents.left_out)
        for view in contents.views:
            at = _image(view.name, folders)
            if at is None:
                left_out["whose file is missing"] += 1
                continue
            shots.append(_shot(f"{path}: {view.name}", view, *at, FRAME_INTERVAL * len(shots)))
        if contents.views and not shots:
            raise none_exists(path, len(contents.views), contents.views[0].name)
        points = np.array(contents.points, np.float64).reshape(-1, 3)
        track = None if contents.track is None else np.array(contents.track, np.float64)
        if not np.isfinite(points).all():
            raise ValueError("points that are not finite")
    sparse = SparseCloud(points, track=track) if len(points) > 1 else None
    return Source(kind, shots, left_out, contents.notes, sparse, **contents.world)


def _image(name: str, folders: list[Path]) -> tuple[Path, str] | None:
    """Image of a name, which may be a path of another machine, and its name in its folder."""
    for end in (name, PureWindowsPath(name).name):
        for folder in folders:
            if image := find_image(folder, end, PHOTOGRAPH):
                return image, end
    return None


def _shot(where: str, view: View, image: Path, name: str, time: float) -> Shot:
    """Frame of a view. An image of another size, and of the same shape, scales its camera."""
    own = image_size(image)
    width, height = view.size or own
    cx, cy = view.centre or (width / 2, height / 2)
    K = np.array([[view.focal[0], 0, cx], [0, view.focal[1], cy], [0, 0, 1]])
    across, down = np.divide(own, (width, height)).tolist()
    if abs(across * height - own[1]) <= 1:
        K, (width, height) = K * [[across], [down], [1]], own
    pose, mended = orthonormal(view.pose)
    lens = Lens.of(where, view.model, K, view.coefficients)
    try:
        camera = Camera(K, width, height, pose)  # type: ignore[arg-type]
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return Shot(frame_name(name), camera, lens, time, image, mended=mended)
