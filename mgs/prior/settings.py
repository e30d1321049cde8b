"""Settings of a prior."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mgs.errors import InputError


@dataclass(frozen=True)
class PriorSettings:
    """Settings of a prior.

    - gaussians: number of Gaussians, on the surface and behind it. "auto", the default if neither
      spacing nor density is given: as many as the closest camera resolves, up to a limit
      (`mgs.prior.surface.resolution`).
    - spacing: distance between samples, metres, in place of `gaussians`.
    - density: samples per square voxel of the cloud, in place of both; a voxel is about a pixel on
      the rock.
    - backing: Gaussians behind the surface per sample (`mgs.prior.initial`), 0 to 1; the paper: 0.
    - poisson_depth: octree depth of the Poisson reconstruction, 3 to 12; by default its finest
      cells are at most 1.5 voxels.
    - parts: number of Gaussians into which a fit will split each; there are as many times fewer.
    - seed: of all random draws.

    Raises InputError if a number is out of range, or `gaussians` and `spacing` are both given."""

    gaussians: int | Literal["auto"] | None = None
    spacing: float | None = None
    poisson_depth: int | None = None
    seed: int = 0
    backing: float = 0.5
    density: float | None = None
    parts: float = 1.0

    @property
    def resolved_by_cameras(self) -> bool:
        """Whether the cameras decide the number of Gaussians."""
        values = (self.gaussians, self.spacing, self.density)
        return self.gaussians == "auto" or values == (None, None, None)

    def refuse_shaping(self, why: str) -> None:
        """Raise InputError if a Poisson depth is set, which needs a cloud. why: end of the message,
        what the surface is made of instead."""
        if self.poisson_depth is not None:
            cure = "leave out either"
            raise InputError(f"prior: `poisson_depth` shapes a mesh of a cloud, but {why}; {cure}")

    def __post_init__(self) -> None:
        if isinstance(self.gaussians, int) and self.gaussians < 2:
            cure = "raise `gaussians`"
            raise InputError(f"prior: {self.gaussians} Gaussians are too few for a model; {cure}")
        if self.spacing is not None and not self.spacing > 0:
            raise InputError(f"prior: spacing {self.spacing} m must be positive")
        if self.gaussians is not None and self.spacing is not None:
            cure = "give one of them"
            raise InputError(f"prior: `gaussians` and `spacing` fix the same number; {cure}")
        if self.density is not None and not 0 < self.density < np.inf:
            raise InputError(f"prior: density {self.density} must be positive; correct it")
        if self.poisson_depth is not None and not 3 <= self.poisson_depth <= 12:
            why = f"`poisson_depth` {self.poisson_depth} is not within 3 to 12"
            raise InputError(f"prior: {why}; correct it")
        if not 0 <= self.backing <= 1:
            cure = "correct `backing`"
            raise InputError(f"prior: {self.backing} Gaussians per sample are not 0 to 1; {cure}")
