"""Cameras exported by Agisoft Metashape (File, Export, Cameras: XML)."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.dataset import FRAME_INTERVAL
from mgs.data.lens import Lens
from mgs.data.shots import Shot, Source, frame_name
from mgs.errors import InputError
from mgs.files import parsing, read_xml

MODELS = {"frame": "OPENCV", "fisheye": "THIN_PRISM_FISHEYE"}  # COLMAP's of the same formula


def is_metashape(path: Path) -> bool:
    """Whether a path is an XML file."""
    return path.is_file() and path.suffix.lower() == ".xml"


def read_metashape(path: Path, images: Path) -> Source:
    """Aligned and enabled cameras. images: folder of the images, named as the cameras' labels.
    Lengths are metres where the chunk has a scale, else of unknown unit. Position and north of a
    georeferenced chunk are left out. Raises InputError where the file is damaged, or a lens is not
    supported."""
    root = read_xml(path)
    shots, left_out = list[Shot](), Counter[str]()
    with parsing(path, "XML of Metashape's cameras", "export it again"):
        chunk = root.find("chunk")
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
                lens, time = lenses[camera.get("sensor_id")], FRAME_INTERVAL * len(shots)
                shots.append(_shot(path, camera, lens, factor, images, time))
    return Source("Metashape", shots, left_out, unit=None if scale is None else "m")


def _shot(path: Path, camera: Any, lens: Any, factor: float, images: Path, time: float) -> Shot:
    """A camera. Metashape's K has its origin in the middle of the image, and its p1 and p2 are
    OpenCV's p2 and p1 (its manual, appendix D)."""
    label = camera.get("label") or ""
    where, model = f"{path}: camera {label}", MODELS.get(lens.get("type", "frame"))
    if model is None:
        raise InputError(
            f"{where} is of type {lens.get('type')}, and only {' and '.join(MODELS)} are "
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
    width, height = int(size.get("width")), int(size.get("height"))
    cx, cy = width / 2 + value.get("cx", 0.0), height / 2 + value.get("cy", 0.0)
    f = value["f"]
    K = np.array([[f + value.get("b1", 0.0), 0, cx], [0, f, cy], [0, 0, 1]])
    pose = np.array([float(word) for word in camera.find("transform").text.split()]).reshape(4, 4)
    pose[:3, 3] *= factor
    keys = {"k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4", "p1": "p2", "p2": "p1"}
    coefficients = {ours: value.get(theirs, 0.0) for ours, theirs in keys.items()}
    names = (label, *(f"{label}{end}" for end in (".jpg", ".JPG", ".jpeg", ".png", ".PNG")))
    there = [images / name for name in names if (images / name).is_file()]
    return Shot(
        frame_name(label),
        Camera(K, width, height, np.linalg.inv(pose)),
        Lens.of(where, model, K, coefficients),
        time,
        there[0] if there else images / label,
    )
