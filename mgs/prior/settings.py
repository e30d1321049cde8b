"""Settings of a prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mgs.errors import InputError


@dataclass(frozen=True)
class PriorSettings:
    """What a prior is asked to be.

    gaussians: number N of samples on the surface. spacing: distance between them in metres, instead of N. With neither, the
    spacing is the edge of the cloud's voxels, about the size of a pixel on the rock.
    poisson_depth: depth of the octree of the Poisson reconstruction; None chooses it such that its finest cells have an edge of
    1.5 voxels or less.
    noise (metres), holes (share of points): by how much the rock's points are made worse on purpose, to study the effect
    (`mgs.prior.segmentation.degrade`).
    seed: root of every random draw.
    Raises InputError if N is below 2, the spacing is not positive, both are given, or noise or holes are out of range.
    """

    gaussians: int | None = None
    spacing: float | None = None
    poisson_depth: int | None = None
    noise: float = 0.0
    holes: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.gaussians is not None and self.gaussians < 2:
            raise InputError(f"prior: {self.gaussians} Gaussians are too few for a model; ask for more with --gaussians")
        if self.spacing is not None and not self.spacing > 0:
            raise InputError(f"prior: spacing {self.spacing} m must be positive; correct --spacing")
        if self.gaussians is not None and self.spacing is not None:
            raise InputError("prior: --gaussians and --spacing fix the same number; give one of them")
        if not 0 <= self.noise < np.inf:
            raise InputError(f"prior: noise {self.noise} m must be 0 or more; correct --prior-noise")
        if not 0 <= self.holes <= 0.9:
            raise InputError(f"prior: holes {self.holes} is a share of the rock's points, 0 to 0.9; correct --holes")
