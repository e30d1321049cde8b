"""Masks for photographs that have none: a mesh of the object is projected into them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, binary_fill_holes

from mgs.colour import srgb_from_linear
from mgs.data.dataset import Dataset, write_transforms
from mgs.data.meshes import Mesh
from mgs.data.visibility import has_masks
from mgs.errors import InputError
from mgs.images import write_png

SHEET = "masks.png"
"""Contact sheet, in the folder of the dataset."""

THUMBNAIL = 240
"""Width of a photograph in the contact sheet, pixels."""

ACROSS = 6
"""Photographs in a row of the contact sheet."""

CUT_PIXELS = 200_000
"""Most pixels of a photograph in which colours are compared; cuts through more follow noise."""

COLOURS = 5
"""Fewest pixels inside and outside for GrabCut, which fits five normal distributions to each."""


def make_masks(
    dataset: Dataset,
    mesh: Mesh,
    progress: Callable[[int, int], None] = lambda done, total: None,
    supported: Mesh | None = None,
) -> Dataset:
    """Write a mask of a mesh for each frame of a dataset, a contact sheet, and transforms.json; the
    same first for its test views, if they have no masks.

    progress: called (done, total) before each frame. supported: part of the mesh near points. The
    rest may only close the surface, and counts where it has the object's colours. Raises InputError
    if a frame has a mask already, if the mesh is in no image, or if a file cannot be read or
    written.
    """
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    for frame in dataset.frames:
        if frame.mask_path is not None or frame.rock_path is not None:
            raise InputError(
                f"frame {frame.name}: has a mask already; "
                "import the data without masks to make others"
            )
    tests = dataset.test_views()
    if tests is not None and not has_masks(tests.frames):
        make_masks(tests, mesh, progress, supported)
    depth, frames, seen = mesh_depth(mesh), [], False
    near = None if supported is None else mesh_depth(supported)
    thumbnails = []
    for k, frame in enumerate(dataset.frames):
        progress(k, len(dataset))
        mask, rgb = depth(frame.camera) > 0, frame.rgb()
        if near is not None:
            mask = _cut(rgb, mask, near(frame.camera) > 0)
        seen |= bool(mask.any())
        path = dataset.root / "masks" / f"{frame.name}.png"
        write_png(path, mask)
        frames.append(replace(frame, mask_path=path))
        thumbnails.append(_outlined(rgb, mask))
    if not seen:
        raise InputError(
            f"{dataset.root}: the mesh is in no image; mesh and poses do not fit, "
            "make masks with another"
        )
    write_sheet(dataset.root / SHEET, thumbnails, ACROSS)
    write_transforms(dataset.root, frames, dataset.up, dataset.unit)
    return replace(dataset, frames=tuple(frames))


def _cut(rgb: np.ndarray, mask: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """Narrow a mask [H,W] to pixels that are sure or have the object's colours, and fill its holes.

    GrabCut (Rother et al. 2004, OpenCV), which takes the pixels outside the mask as background. The
    mask stays as it is if none is sure, or none is outside.
    """
    import cv2

    height, width = mask.shape
    factor = int(np.ceil(np.sqrt(mask.size / CUT_PIXELS)))
    size = max(1, width // factor), max(1, height // factor)
    labels = np.where(_resized(mask, size), cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    labels[_resized(sure, size)] = cv2.GC_FGD
    outside = labels == cv2.GC_BGD
    if not sure.any() or min(outside.sum(), (~outside).sum()) < COLOURS:
        return mask
    colours = np.round(srgb_from_linear(rgb) * 255).astype(np.uint8)
    colours = np.asarray(cv2.resize(colours, size, interpolation=cv2.INTER_AREA))
    models = np.zeros((2, 1, 13 * COLOURS))
    cv2.setRNGSeed(0)
    cv2.grabCut(colours, labels, (0, 0, 0, 0), models[0], models[1], 5, cv2.GC_INIT_WITH_MASK)
    inside = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.float32)
    share = cv2.resize(inside, (width, height), interpolation=cv2.INTER_LINEAR)
    return binary_fill_holes(sure | mask & (share >= 0.5)) & mask


def _resized(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Mask resampled to a size (width, height): pixels at least half inside."""
    import cv2

    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5


def _outlined(rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Thumbnail of a photograph, uint8, darkened outside the mask, with a magenta outline."""
    import cv2

    size = (THUMBNAIL, max(1, round(THUMBNAIL * mask.shape[0] / mask.shape[1])))
    small = np.asarray(
        cv2.resize(srgb_from_linear(rgb), size, interpolation=cv2.INTER_AREA), np.float32
    )
    inside = _resized(mask, size)
    small[~inside] *= 0.45
    small[binary_dilation(inside) ^ inside] = [1, 0, 1]
    return np.round(np.clip(small, 0, 1) * 255).astype(np.uint8)


def write_sheet(path: Path, pictures: list[np.ndarray], across: int) -> None:
    """Write pictures uint8 [H,W,3] of the same width as a PNG, `across` in a row."""
    height = max(len(picture) for picture in pictures)
    padded = [np.pad(picture, ((0, height - len(picture)), (0, 0), (0, 0))) for picture in pictures]
    padded += [np.zeros_like(padded[0])] * (-len(padded) % across)
    rows = [np.hstack(padded[k : k + across]) for k in range(0, len(padded), across)]
    write_png(path, np.vstack(rows))
