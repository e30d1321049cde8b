"""Masks where there are none: a mesh of the object is projected into the photographs.

Its outline can be moved to where colours change (GrabCut, Rother et al. 2004, by OpenCV), within a
band as wide as the mesh may be wrong. Where that cuts off a part of the object, a fit learns that
nothing is there, which costs more than an outline that is a little too wide
(benchmarks/own_data.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, binary_fill_holes, label

from mgs.colour import srgb_from_linear
from mgs.data.dataset import Dataset, Frame, write_transforms
from mgs.data.meshes import Mesh
from mgs.errors import InputError
from mgs.images import write_png

ROUNDS = 3
"""Of GrabCut: each fits the colours of both sides anew."""

LEAST_BAND = 2
"""Least half width of the band in which the outline may move, pixels."""

LEAST_AGREEMENT = 0.75
"""Least intersection over union of a refined mask and the silhouette that it was made of."""

SHEET = "masks.png"
"""The contact sheet, in the folder of the dataset."""

THUMBNAIL = 240
"""Width of a photograph in the contact sheet, pixels."""

ACROSS = 6
"""Photographs in a row of the contact sheet."""


def refined_mask(silhouette: np.ndarray, rgb: np.ndarray, band: int) -> np.ndarray:
    """The mask of an object whose outline is about that of `silhouette`, bool [H,W].

    rgb: [H,W,3] linear, the photograph. band: pixels by which the outline may move either way. What
    is farther inside is the object and what is farther outside is not, whatever the colours. Holes
    are filled and only the largest piece is kept. A silhouette that is empty, or has no pixel
    farther inside, is returned as it is, and so is one from which the outline moves so far that the
    colours of object and background cannot be told apart.
    """
    import cv2

    sure, possible = (
        binary_erosion(silhouette, iterations=band),
        binary_dilation(silhouette, iterations=band),
    )
    if not sure.any() or possible.all():
        return silhouette
    state = np.where(silhouette, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    state[sure], state[~possible] = cv2.GC_FGD, cv2.GC_BGD
    cv2.setRNGSeed(0)  # GrabCut starts with k-means
    pixels = np.round(srgb_from_linear(rgb) * 255).astype(np.uint8)
    whole = (0, 0, 0, 0)  # no rectangle: the state says it
    cv2.grabCut(
        pixels, state, whole, np.zeros((1, 65)), np.zeros((1, 65)), ROUNDS, cv2.GC_INIT_WITH_MASK
    )
    pieces, _ = label(binary_fill_holes((state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD)))
    refined = pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:])
    return (
        refined
        if (refined & silhouette).sum() >= LEAST_AGREEMENT * (refined | silhouette).sum()
        else silhouette
    )


def make_masks(
    dataset: Dataset,
    mesh: Mesh,
    uncertainty: float,
    *,
    refine: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Dataset:
    """Write a mask for each frame of a dataset from a mesh of its object, and a contact sheet of
    them; transforms.json last.

    uncertainty: by how much the mesh may be wrong, in units of the world: with `refine` the half
    width of the band in which outlines move (`refined_mask`). progress: called as progress(frames
    done, all frames). Raises InputError if a frame has a mask already, if the mesh is in no image,
    or if a file cannot be read or written.
    """
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    for frame in dataset.frames:
        if frame.mask_path is not None or frame.rock_path is not None:
            raise InputError(
                f"frame {frame.name}: has a mask already; import the data without masks to make others"
            )
    depth, frames, middle, seen = mesh_depth(mesh), [], mesh.vertices.mean(0), False
    thumbnails = []
    for k, frame in enumerate(dataset.frames):
        progress(k, len(dataset))
        silhouette, rgb = depth(frame.camera) > 0, frame.rgb()
        pixels = (
            uncertainty * frame.camera.K[0, 0] / max(frame.camera.project(middle[None])[1][0], 1e-9)
        )
        mask = (
            refined_mask(silhouette, rgb, max(LEAST_BAND, round(pixels))) if refine else silhouette
        )
        seen |= bool(mask.any())
        path = dataset.root / "masks" / f"{frame.name}.png"
        write_png(path, mask)
        frames.append(replace(frame, mask_path=path))
        thumbnails.append(_outlined(frame, rgb, mask))
    if not seen:
        raise InputError(
            f"{dataset.root}: the mesh is in no image; mesh and poses do not fit, make masks with another"
        )
    _write_sheet(dataset.root / SHEET, thumbnails)
    write_transforms(dataset.root, frames, dataset.up, dataset.unit)
    return replace(dataset, frames=tuple(frames))


def _outlined(frame: Frame, rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A small picture of a photograph, uint8: what is outside of the mask is darkened, and the
    outline is drawn in magenta."""
    import cv2

    height = max(1, round(THUMBNAIL * mask.shape[0] / mask.shape[1]))
    small = np.asarray(
        cv2.resize(srgb_from_linear(rgb), (THUMBNAIL, height), interpolation=cv2.INTER_AREA),
        np.float32,
    )
    inside = (
        cv2.resize(mask.astype(np.float32), (THUMBNAIL, height), interpolation=cv2.INTER_AREA)
        >= 0.5
    )
    small[~inside] *= 0.45
    small[binary_dilation(inside) ^ inside] = [1, 0, 1]
    return np.round(np.clip(small, 0, 1) * 255).astype(np.uint8)


def _write_sheet(path: Path, pictures: list[np.ndarray]) -> None:
    """Pictures uint8 [H,W,3] of the same width, in rows, as a PNG."""
    height = max(len(picture) for picture in pictures)
    padded = [np.pad(picture, ((0, height - len(picture)), (0, 0), (0, 0))) for picture in pictures]
    padded += [np.zeros_like(padded[0])] * (-len(padded) % ACROSS)
    rows = [np.hstack(padded[k : k + ACROSS]) for k in range(0, len(padded), ACROSS)]
    write_png(path, np.vstack(rows))
