"""What a prior is asked to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mgs.errors import InputError


@dataclass(frozen=True)
class PriorSettings:
    """What to build.

    gaussians: how many Gaussians in all, exactly; or spacing: metres between samples of the surface. Both None: a sample per
    voxel of the cloud, which is a pixel's footprint on the rock.
    backing: Gaussians behind the surface per sample on it (`mgs.prior.initial`); 0 puts all on the surface, as the paper does.
    poisson_depth: octree depth, None = cells of 1.5 voxels.
    noise: metres, and holes: share of the rock's points, by which the cloud is spoilt on purpose (see `degrade`).
    seed: root seed.
    """

    gaussians: int | None = None
    spacing: float | None = None
    poisson_depth: int | None = None
    noise: float = 0.0
    holes: float = 0.0
    seed: int = 0
    backing: float = 0.5


def _check(settings: PriorSettings) -> None:
    if settings.gaussians is not None and settings.gaussians < 2:
        raise InputError(f"prior: {settings.gaussians} Gaussians are too few for a model; ask for more with --gaussians")
    if settings.spacing is not None and not settings.spacing > 0:
        raise InputError(f"prior: spacing {settings.spacing} m must be positive; correct --spacing")
    if settings.gaussians is not None and settings.spacing is not None:
        raise InputError("prior: --gaussians and --spacing fix the same number; give one of them")
    if not 0 <= settings.noise < np.inf:
        raise InputError(f"prior: noise {settings.noise} m must be 0 or more; correct --prior-noise")
    if not 0 <= settings.backing <= 1:
        raise InputError(f"prior: backing {settings.backing} is a number of Gaussians per sample, 0 to 1; correct --backing")
    if not 0 <= settings.holes <= 0.9:
        raise InputError(f"prior: holes {settings.holes} is a share of the rock's points, 0 to 0.9; correct --holes")
