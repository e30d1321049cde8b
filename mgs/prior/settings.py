"""What a prior is asked to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mgs.errors import InputError


@dataclass(frozen=True)
class PriorSettings:
    """gaussians: exactly N samples, or spacing: metres between them (both None: one per voxel of the cloud, a pixel's
    footprint on the rock); poisson_depth: octree depth, None = cells of 1.5 voxels; noise: metres, and holes: share of the
    rock's points, by which the cloud is spoilt on purpose (see `degrade`); seed: root seed."""

    gaussians: int | None = None
    spacing: float | None = None
    poisson_depth: int | None = None
    noise: float = 0.0
    holes: float = 0.0
    seed: int = 0


def _check(settings: PriorSettings) -> None:
    if settings.gaussians is not None and settings.gaussians < 2:
        raise InputError(f"prior: {settings.gaussians} Gaussians are too few for a model; ask for more with --gaussians")
    if settings.spacing is not None and not settings.spacing > 0:
        raise InputError(f"prior: spacing {settings.spacing} m must be positive; correct --spacing")
    if settings.gaussians is not None and settings.spacing is not None:
        raise InputError("prior: --gaussians and --spacing fix the same number; give one of them")
    if not 0 <= settings.noise < np.inf:
        raise InputError(f"prior: noise {settings.noise} m must be 0 or more; correct --prior-noise")
    if not 0 <= settings.holes <= 0.9:
        raise InputError(f"prior: holes {settings.holes} is a share of the rock's points, 0 to 0.9; correct --holes")
