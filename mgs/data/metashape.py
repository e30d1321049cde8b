"""Cameras exported by Agisoft Metashape (File, Export, Cameras: XML)."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.files import parsing, reading


def is_metashape(path: Path) -> bool:
    """Whether a path is an XML file."""
    return path.is_file() and path.suffix.lower() == ".xml"


def read_metashape(path: Path, images: Path) -> tuple[list[dict[str, Any]], str | None]:
    """Aligned cameras as fields of `mgs.data.sources.Shot`, and their unit of length.

    images: folder of the images, named as the cameras' labels. Lengths are metres where the chunk
    has a scale, else of unknown unit. Position and north of a georeferenced chunk are left out.
    Raises InputError where the file is damaged, or a lens is not a frame camera.
    """
    with reading(path):
        data = path.read_bytes()
    with parsing(path, "XML of Metashape's cameras", "export it again"):
        chunk = ElementTree.fromstring(data).find("chunk")
        if chunk is None:
            raise ValueError("no chunk")
        lenses = {lens.get("id"): lens for lens in chunk.iterfind("sensors/sensor")}
        scale = chunk.find("transform/scale")
        factor = 1.0 if scale is None else float(scale.text or "")
        shots = [
            _shot(path, camera, lenses[camera.get("sensor_id")], factor, images)
            for camera in chunk.iterfind("cameras//camera")
            if camera.find("transform") is not None
        ]
    for k, shot in enumerate(shots):
        shot["timestamp"] = 0.5 * k
    return shots, None if scale is None else "m"


def _shot(path: Path, camera: Any, lens: Any, factor: float, images: Path) -> dict[str, Any]:
    """Fields of a camera. Metashape's K has its origin in the middle of the image, and its p1 and
    p2 are OpenCV's p2 and p1 (its manual, appendix D)."""
    label = camera.get("label") or ""
    if lens.get("type", "frame") != "frame":
        raise InputError(
            f"{path}: camera {label} is of type {lens.get('type')}, and only frame is supported; "
            "export undistorted photographs"
        )
    found = lens.find("calibration[@class='adjusted']")
    found = lens.find("calibration") if found is None else found
    size = lens.find("resolution") if found is None else found.find("resolution")
    if found is None or size is None:
        raise InputError(f"{path}: camera {label} has no calibration; align the photographs first")
    value = {one.tag: float(one.text) for one in found if one.tag != "resolution"}
    if value.get("b2") or value.get("k4"):
        raise InputError(f"{path}: camera {label} has b2 or k4; align without them")
    width, height = int(size.get("width")), int(size.get("height"))
    cx, cy = width / 2 + value.get("cx", 0.0), height / 2 + value.get("cy", 0.0)
    f = value["f"]
    K = np.array([[f + value.get("b1", 0.0), 0, cx], [0, f, cy], [0, 0, 1]])
    pose = np.array([float(word) for word in camera.find("transform").text.split()]).reshape(4, 4)
    pose[:3, 3] *= factor
    names = (label, *(f"{label}{end}" for end in (".jpg", ".JPG", ".jpeg", ".png", ".PNG")))
    there = [images / name for name in names if (images / name).is_file()]
    return {
        "name": Path(label).stem
        if Path(label).suffix.lower() in (".jpg", ".jpeg", ".png")
        else label,
        "camera": Camera(K, width, height, np.linalg.inv(pose)),
        "distortion": np.array([value.get(key, 0.0) for key in ("k1", "k2", "p2", "p1", "k3")]),
        "image": there[0] if there else images / label,
    }
