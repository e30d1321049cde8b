"""Settings of a prior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mgs.errors import InputError


@dataclass(frozen=True)
class PriorSettings:
    """What a prior is asked to be.

    gaussians: number of Gaussians, on the surface and behind it. spacing: distance between samples
    on the surface in metres,
    instead of a number. density: instead of both, samples on the surface for each square of the
    edge of the cloud's voxels, which is about the size of a pixel on the rock; read only without
    them. With none of the three, or where the number is "auto": as many as the closest pixel of a
    frame can tell apart (`mgs.prior.resolution`).
    backing: Gaussians behind the surface for each sample on it (`mgs.prior.initial`). With 0 all
    lie on it, as in the paper.
    poisson_depth: depth of the octree of the Poisson reconstruction; None chooses it such that its
    finest cells have an edge of
    1.5 voxels or less.
    noise (metres), holes (share of points): by how much the rock's points are made worse on
    purpose, to study the effect (`mgs.prior.segmentation.degrade`).
    seed: root of every random draw.
    Raises InputError if the number is below 2, the spacing is not positive, both are given, or
    backing, noise or holes are out of range.
    """

    gaussians: int | Literal["auto"] | None = None
    spacing: float | None = None
    poisson_depth: int | None = None
    noise: float = 0.0
    holes: float = 0.0
    seed: int = 0
    backing: float = 0.5
    density: float | None = None

    @property
    def resolved_by_cameras(self) -> bool:
        """Whether the number of Gaussians is left to what the cameras can tell apart."""
        return self.gaussians == "auto" or (self.gaussians, self.spacing, self.density) == (
            None,
            None,
            None,
        )

    def refuse_shaping(self, why: str) -> None:
        """Raises InputError where noise, holes or a Poisson depth are asked for, which shape a mesh
        that is built of a cloud.

        why: the end of the message, what the surface is made of instead.
        """
        options = {
            "--prior-noise": self.noise > 0,
            "--holes": self.holes > 0,
            "--poisson-depth": self.poisson_depth is not None,
        }
        if given := " and ".join(option for option, is_given in options.items() if is_given):
            raise InputError(
                f"prior: {given} shape a mesh that is built of a cloud, but {why}; leave out either"
            )

    def __post_init__(self) -> None:
        if isinstance(self.gaussians, int) and self.gaussians < 2:
            raise InputError(
                f"prior: {self.gaussians} Gaussians are too few for a model; ask for more with --gaussians"
            )
        if self.spacing is not None and not self.spacing > 0:
            raise InputError(f"prior: spacing {self.spacing} m must be positive; correct --spacing")
        if self.gaussians is not None and self.spacing is not None:
            raise InputError(
                "prior: --gaussians and --spacing fix the same number; give one of them"
            )
        if self.density is not None and not 0 < self.density < np.inf:
            raise InputError(f"prior: density {self.density} must be positive; correct it")
        if not 0 <= self.noise < np.inf:
            raise InputError(
                f"prior: noise {self.noise} m must be 0 or more; correct --prior-noise"
            )
        if not 0 <= self.holes <= 0.9:
            raise InputError(
                f"prior: holes {self.holes} is a share of the rock's points, 0 to 0.9; correct --holes"
            )
        if not 0 <= self.backing <= 1:
            raise InputError(
                f"prior: backing {self.backing} is a number of Gaussians per sample, 0 to 1; correct --backing"
            )
