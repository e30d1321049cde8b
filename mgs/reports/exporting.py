"""Models for viewers of other programs: `mgs export`."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.data.dataset import target_of
from mgs.data.world import Vector, levelled
from mgs.errors import InputError
from mgs.fit.settings import RATES, TrainSettings
from mgs.gaussians import Gaussians
from mgs.memory import Deferred
from mgs.prior.exposure import exposure_of, without_gain
from mgs.run.folder import Run, open_run
from mgs.splat.reference import sh_basis
from mgs.splat_files import load_gaussians, upward
from mgs.splat_places import to_source

DIRECTIONS = 64  # directions to which the coefficients of a converted colour are fitted

REFIT = TrainSettings(
    optimiser="adam", tolerance=0, rates=dict.fromkeys(RATES, 0.0) | {"colour": RATES["colour"]}
)
"""Fit of colours alone, after which a linear model blends well in sRGB."""

PART = 1 << 16  # Gaussians that are converted at a time


def read_model(source: str | Path, prior: str | Path | None = None) -> tuple[Gaussians, Vector]:
    """Read the model that a run shows (`Run.shown`), in the coordinates that its dataset was made
    of, or that of a file with the up that it has (`upward`). prior: as in `load_gaussians`. Raises
    InputError as `open_run`, `Run.state` and `load_gaussians`."""
    source = Path(source)
    if not source.is_dir():
        return load_gaussians(source, prior), upward(source)
    if prior is not None:
        raise InputError(f"{source}: is a run, and needs no prior; leave out `prior`")
    run = open_run(source)
    return as_imported(run, run.gaussians[run.shown]), run.dataset.world.up


def as_imported(run: Run, g: Gaussians) -> Gaussians:
    """A model of a run in the coordinates that its dataset was made of."""
    world = run.dataset.world
    return replace(to_source(g, world), origin=world.origin)


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


def refit_in_srgb(run: Run, progress: Callable[[int, int], None]) -> Gaussians:
    """Fit the colours of a run's linear model, blended in sRGB, to the views taken; the rest is
    unchanged. progress(done, all) is called after each pass. Raises InputError if a file of a frame
    or, where exposures differ, of the prior cannot be read."""
    from mgs.fit.fitting import fit_gaussians

    frames = run.taken
    gains = exposure_of(run.prior)(frames) if run.settings.exposure else np.ones((len(frames), 3))
    targets = Deferred(range(len(frames)), lambda i: without_gain(target_of(frames[i]), gains[i]))
    cameras, model = [frame.camera for frame in frames], in_srgb(run.gaussians[run.shown])
    on_pass = lambda done, most, _: progress(done, most)  # noqa: E731
    return fit_gaussians(model, cameras, targets, REFIT, on_pass).gaussians


def to_y_up(up: Vector) -> np.ndarray:
    """Rotation [3,3] of a world with this upward direction into glTF's, in which +Y is up."""
    return np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ levelled(up)
