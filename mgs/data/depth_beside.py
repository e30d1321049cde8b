"""Depth images beside photographs without poses, and the scale that they give."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.agreement import DepthScale
from mgs.data.lens import read_fitting
from mgs.data.shots import Shot, Source
from mgs.errors import InputError
from mgs.images import exif_orientation, read_depth, read_rgba
from mgs.progress import report

FOLDER = "depth"  # of the depth images, named as the photographs
SUFFIXES = (".exr", ".png", ".tif", ".tiff")
MILLIMETRE = 1e-3  # metres in a step of a depth image of whole numbers
LEAST_DEPTHS = 100  # fewest depths at triangulated points that give a scale
MOST_SPREAD = 0.1  # spread beyond which depth is no z-depth of these photographs
QUARTILES = (0.25, 0.5, 0.75)


def depth_files(*folders: Path) -> list[Path]:
    """Depth images in the folder `depth`, and in folders of that, of the first that has any."""
    for folder in folders:
        paths = sorted((folder / FOLDER).rglob("*"))
        if files := [one for one in paths if one.suffix.lower() in SUFFIXES and one.is_file()]:
            return files
    return []


def depth_beside(root: Path, paths: Sequence[Path], places: Sequence[Path]) -> dict[Path, Path]:
    """Depth image of each photograph that has one: of `depth_files` of places the one under its
    path in `root`, or its name alone. Raises InputError where none is named so, or one cannot be
    read."""
    files = depth_files(*places)
    if not files:
        return {}
    folder = next(place / FOLDER for place in places if files[0].is_relative_to(place / FOLDER))
    by_name = {path.relative_to(folder).with_suffix("").as_posix(): path for path in files}
    namesakes, found = Counter(path.stem for path in paths), {}
    for path in paths:
        names = [path.relative_to(root).with_suffix("").as_posix()]
        names += [path.stem] if namesakes[path.stem] == 1 else []
        if depth := next((by_name[name] for name in names if name in by_name), None):
            found[path] = depth
    if not found:
        why = f"none of its {len(files)} depth images has the name of a photograph"
        raise InputError(f"{folder}: {why}, as {paths[0].stem}.png; rename them, or the folder")
    for k, depth in enumerate(found.values()):
        report("reading depth", k, len(found))
        read_depth(depth)
    return found


def depth_of(shot: Shot) -> np.ndarray:
    """Depth of a shot that has a file of it, metres, [H,W] of its camera before undistortion. It is
    0 where its confidence is."""
    assert shot.depth is not None
    reader = partial(read_depth, unit=shot.depth_unit, float_unit=shot.float_unit)
    stored = exif_orientation(shot.image) if shot.turned else 1
    how: Any = {"turned": shot.turned, "resized": True, "stored": stored}
    depth = shot.depth_factor * read_fitting(reader, shot.depth, shot.camera, **how)
    if shot.confidence is not None and shot.confidence.is_file():
        depth[read_fitting(read_rgba, shot.confidence, shot.camera, **how)[..., 0] == 0] = 0
    return depth


def with_depth(
    source: Source, depths: Mapping[Path, Path], model: Any, numbers: Mapping[Path, int]
) -> Source:
    """Source with the depth image of each photograph, and what its lengths are by that. A note says
    why where depth gives none, and is left out. model: reconstruction of pycolmap of the source.
    numbers: of its images."""
    unit = MILLIMETRE
    shots = [replace(s, depth=depths.get(s.image), depth_unit=unit) for s in source.shots]
    measured = [shot for shot in shots if shot.depth]
    if not measured:
        return source
    both = []
    for k, shot in enumerate(measured):
        report("comparing depth", k, len(measured))
        marks = model.images[numbers[shot.image]].get_observation_points2D()
        points = np.reshape([model.points3D[mark.point3D_id].xyz for mark in marks], (-1, 3))
        pixels = np.floor(np.reshape([mark.xy for mark in marks], (-1, 2))).astype(int)
        most = np.array([shot.camera.width, shot.camera.height]) - 1
        column, row = np.clip(pixels, 0, most).T
        depth, z = depth_of(shot)[row, column], shot.camera.project(points)[1]
        both.append(np.stack([depth, z])[:, depth > 0])
    depth, z = np.concatenate(both, axis=1)
    if why := _fault(depth, z):
        note = f"the depth of {len(measured)} photographs is left out: {why}"
        return replace(source, notes=(*source.notes, note))
    low, metres, high = np.quantile(depth / z, QUARTILES).tolist()
    scale = DepthScale(metres, (high - low) / 2 / metres, len(measured))
    return replace(source, shots=shots, depth_scale=scale)


def _fault(depth: np.ndarray, z: np.ndarray) -> str:
    """Why measured depths [N] give no scale of depths z [N] of the same points; "" if they do."""
    if len(depth) < LEAST_DEPTHS:
        return f"it is known at {len(depth)} of their points, and a scale needs {LEAST_DEPTHS}"
    low, middle, high = np.quantile(depth / z, QUARTILES)
    spread, far = (high - low) / 2 / middle, z > np.median(z)
    growth = np.median(depth[far]) / np.median(depth[~far])
    if spread < MOST_SPREAD and growth > np.sqrt(np.median(z[far]) / np.median(z[~far])):
        return ""
    cure = "give z-depth aligned with the photographs, no inverse or guess, in mm (PNG) or m (EXR)"
    return f"it contradicts the distance of their points (spread {100 * spread:.0f} %); {cure}"


def with_scale_of_depth(source: Source, given: str) -> Source:
    """Source in metres by its `depth_scale`, if any, and a note. given: what gave the scale
    already, to which depth is made to fit then, or ""."""
    scale = source.depth_scale
    if scale is None:
        return source
    many, spread = f"the depth of {scale.images} photographs", f"spread {100 * scale.spread:.1f} %"
    if not given:
        note = f"scale {scale.metres:.4g} m per unit from {many}, {spread}"
        return replace(source.in_metres(scale.metres), notes=(*source.notes, note))
    factor = 1 / scale.metres
    note = f"{given} gives the scale; {many} is multiplied by {factor:.4g} to fit it, {spread}"
    shots = [replace(shot, depth_factor=factor) for shot in source.shots]
    return replace(source, shots=shots, notes=(*source.notes, note))
