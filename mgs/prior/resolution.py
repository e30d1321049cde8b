"""How finely the training images resolve the surface, and the number of samples that follows from
it.

A detail whose period is shorter than two pixels is not in an image (Nyquist). So samples nearer to
each other than the pixels of the closest camera can only be told apart by noise. Here every part of
the surface asks its closest camera, and the samples of all parts are added up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mgs.camera import Camera
from mgs.data.meshes import Mesh
from mgs.errors import InputError

PIXELS_PER_SAMPLE = 1.15
"""Spacing of the samples over the size of the closest pixel. Finer models are no better, and much
finer ones are worse: they have more parameters than the images have values. A chosen constant,
judged by `mgs parsimony` (docs/parsimony.md)."""


@dataclass(frozen=True)
class Resolution:
    """pixel: size of the closest camera's pixel on the surface, metres, root mean square over the
    area. spacing: of samples
    that make the most of it, metres. area: of the surface that it was found for, square metres.
    samples: area / spacing²."""

    pixel: float
    spacing: float
    area: float

    @property
    def samples(self) -> int:
        return round(self.area / self.spacing**2)


def resolution(mesh: Mesh, cameras: Sequence[Camera]) -> Resolution:
    """The spacing of samples that the images of these cameras can tell apart, of the part of the
    mesh that counts as seen.

    The pixel of a camera on a face is z-depth / focal length, whatever the slant; the smallest
    counts of the cameras that have the face in their image, on the side that it faces. Whether
    something stands in between is not asked. N is the sum over faces of area / (PIXELS_PER_SAMPLE
    pixel)². Faces in no image have no say. Raises InputError if that is all of them.
    """
    corners = mesh.vertices[mesh.faces[mesh.seen]]
    middles = corners.mean(1)
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1) / 2
    pixel = np.full(len(areas), np.inf)
    for camera in cameras:
        at, z = camera.project(middles)
        inside = (z > 0) & (at >= 0).all(1) & (at < [camera.width, camera.height]).all(1)
        facing = np.einsum("fk,fk->f", crosses, camera.position - middles) > 0
        size = z / np.sqrt(camera.K[0, 0] * camera.K[1, 1])
        pixel = np.where(inside & facing & (size < pixel), size, pixel)
    known = np.isfinite(pixel) & (areas > 0)
    if not known.any():
        raise InputError(
            "prior: no frame has the mesh in its image, so nothing says how many Gaussians; give --gaussians N"
        )
    area = float(areas[known].sum())
    typical = float(np.sqrt(area / (areas[known] / pixel[known] ** 2).sum()))
    return Resolution(typical, PIXELS_PER_SAMPLE * typical, area)
