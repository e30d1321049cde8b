"""Sample spacing that the training images can resolve: a detail of a period under two pixels is in
no image (Nyquist), and samples closer than the closest camera's pixels differ by noise only."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mgs.camera import Camera
from mgs.data.meshes import Mesh
from mgs.data.visibility import in_image
from mgs.errors import InputError

# Spacing of the samples over the size of the closest pixel. Closer samples gain little, and much
# closer ones lose: the model then has more parameters than the images have values
# (docs/parsimony.md).
PIXELS_PER_SAMPLE = 0.9
PIXELS_OF_PHOTOGRAPHS = 1.15  # for photographs: more Gaussians need more passes (docs/fit.md)
MOST_GAUSSIANS = 200_000  # most that cameras decide: close-ups ask for millions. A chosen constant


@dataclass(frozen=True)
class Resolution:
    """Resolution of the closest camera on the surface."""

    pixel: float  # on the surface, metres, rms over the area
    spacing: float  # of the samples, metres
    area: float  # square metres

    @property
    def samples(self) -> int:
        """Number of samples, area / spacing^2."""
        return round(self.area / self.spacing**2)


def resolution(
    mesh: Mesh, cameras: Sequence[Camera], pixels: float = PIXELS_PER_SAMPLE
) -> Resolution:
    """Spacing of samples that these cameras can tell apart, for the seen part of the mesh.

    pixels: spacing of the samples over the size of the closest pixel. The pixel on a face is
    z-depth / focal length, whatever the slant; the smallest counts among the cameras that have the
    face in their image and in front, occluded or not. N is the sum over faces of area / (pixels
    pixel)^2; faces in no image do not count. Raises InputError if none is."""
    middles = mesh.vertices[mesh.faces[mesh.seen]].mean(1)
    crosses, areas = mesh.crosses[mesh.seen], mesh.areas[mesh.seen]
    pixel = np.full(len(areas), np.inf)
    for camera in cameras:
        at, z = camera.project(middles)
        inside = in_image(camera, at, z)
        facing = np.einsum("fk,fk->f", crosses, camera.position - middles) > 0
        size = z / np.sqrt(camera.K[0, 0] * camera.K[1, 1])
        pixel = np.where(inside & facing & (size < pixel), size, pixel)
    in_view = np.isfinite(pixel) & (areas > 0)
    if not in_view.any():
        why = "no frame shows the mesh, so nothing says how many Gaussians"
        raise InputError(f"prior: {why}; give `gaussians`")
    area = float(areas[in_view].sum())
    typical = float(np.sqrt(area / (areas[in_view] / pixel[in_view] ** 2).sum()))
    return Resolution(typical, pixels * typical, area)
