"""Masks for photographs that have none: a mesh of the object is projected into them."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation

from mgs.colour import srgb_from_linear
from mgs.data.dataset import Dataset, read_records, write_transforms
from mgs.data.frames import has_masks
from mgs.data.meshes import Mesh
from mgs.errors import InputError
from mgs.images import write_png, write_sheet
from mgs.progress import report

SHEET = "masks.png"  # contact sheet, in the folder of the dataset
THUMBNAIL = 240  # width of a photograph in the contact sheet, pixels
ACROSS = 6  # photographs in a row of the contact sheet


def make_masks(dataset: Dataset, mesh: Mesh) -> Dataset:
    """Write a mask of a mesh for each frame of a dataset, a contact sheet, and transforms.json; the
    same first for its test views, if they have no masks. Raises InputError if a frame has a mask
    already, if the mesh is in no image, or if a file cannot be read or written."""
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    for frame in dataset.frames:
        if frame.mask_path is not None or frame.rock_path is not None:
            cure = "import the data without masks to make others"
            raise InputError(f"frame {frame.name}: has a mask already; {cure}")
    tests = dataset.test_views()
    if tests is not None and not has_masks(tests.frames):
        make_masks(tests, mesh)
    depth, frames, visible = mesh_depth(mesh), [], False
    thumbnails = []
    for k, frame in enumerate(dataset.frames):
        report("masks", k, len(dataset))
        mask, rgb = depth(frame.camera) > 0, frame.rgb()
        visible |= bool(mask.any())
        path = dataset.root / "masks" / f"{frame.name}.png"
        write_png(path, mask)
        frames.append(replace(frame, mask_path=path))
        thumbnails.append(_outlined(rgb, mask))
    if not visible:
        cure = "make masks with one that fits the poses"
        raise InputError(f"{dataset.root}: the mesh is in no image; {cure}")
    write_sheet(dataset.root / SHEET, thumbnails, ACROSS)
    about, _ = read_records(dataset.root / "transforms.json")
    place = {"place": about["place"]} if isinstance(about.get("place"), str) else {}
    write_transforms(dataset.root, frames, dataset.world, place)
    return replace(dataset, frames=tuple(frames))


def _outlined(rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Thumbnail of a photograph, uint8, darkened outside the mask, with a magenta outline."""
    import cv2

    size = (THUMBNAIL, max(1, round(THUMBNAIL * mask.shape[0] / mask.shape[1])))
    small = np.asarray(
        cv2.resize(srgb_from_linear(rgb), size, interpolation=cv2.INTER_AREA), np.float32
    )
    inside = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5
    small[~inside] *= 0.45
    small[binary_dilation(inside) ^ inside] = [1, 0, 1]
    return np.round(np.clip(small, 0, 1) * 255).astype(np.uint8)
