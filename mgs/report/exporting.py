"""Models for viewers of other programs: `mgs export`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.data.up import Up, upright
from mgs.gaussians import Gaussians
from mgs.run.folder import open_run
from mgs.splat.reference import sh_basis
from mgs.splat_files import load_gaussians, upward

DIRECTIONS = 64
"""Directions to which the coefficients of a converted colour are fitted."""

PART = 1 << 16
"""Gaussians whose colours are converted at a time."""


def read_model(source: str | Path) -> tuple[Gaussians, Up]:
    """Read the model of a run folder, in the coordinates that its dataset was made of, or of a file
    with the up that it has (`upward`). Raises InputError as `open_run`, `Run.state` and
    `load_gaussians`."""
    source = Path(source)
    if not source.is_dir():
        return load_gaussians(source), upward(source)
    run = open_run(source)
    return replace(run.gaussians, origin=run.dataset.origin), run.up


def in_srgb(g: Gaussians) -> Gaussians:
    """Convert linear colours to sRGB, which most viewers blend as it is; the rest is unchanged.

    The colour of each Gaussian is exact at SH degree 0. At higher degrees its coefficients are a
    least-squares fit over DIRECTIONS. Blending differs in any case: mixtures are a little darker.
    """
    if not g.linear:
        return g
    k = np.arange(DIRECTIONS) + 0.5
    z, turn = 1 - 2 * k / DIRECTIONS, np.pi * (1 + 5**0.5) * k
    across = np.sqrt(1 - z * z)
    directions = np.column_stack([across * np.cos(turn), across * np.sin(turn), z])
    directions = directions if g.sh_degree else directions[:1]
    basis = sh_basis(directions, g.sh_degree)
    inverse, sh = np.linalg.pinv(basis), np.empty_like(g.sh)
    for first in range(0, len(g), PART):
        part = slice(first, first + PART)
        colours = srgb_from_linear(0.5 + np.einsum("dk,nkc->ndc", basis, g.sh[part]))
        sh[part] = np.einsum("kd,ndc->nkc", inverse, colours - 0.5)
    return replace(g, sh=sh, linear=False)


def to_y_up(up: Up) -> np.ndarray:
    """Rotation [3,3] of a world with this upward direction into glTF's, in which +Y is up."""
    return np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ upright(up)
