"""A smaller model of a run: pruned, and compared with the whole one on other views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mgs.policy.criteria import PRUNE_NOISE
from mgs.report.evaluation import compare_models
from mgs.run.folder import open_run
from mgs.splat_ply import write_ply

PRUNED = "gaussians_pruned.ply"


@dataclass(frozen=True)
class PrunedRun:
    """Result of `prune_run`.

    before, after: number of Gaussians. predicted, actual: rms change of the training images
    (`mgs.splat.pruning.Pruned`). views: "test" or "held-out". psnr: on these, before and after, dB;
    None if there are none.
    """

    before: int
    after: int
    predicted: float
    actual: float
    views: str
    psnr: list[float] | None


def prune_run(
    run: str | Path, noise: float = PRUNE_NOISE, say: Callable[[str], None] = lambda stage: None
) -> PrunedRun:
    """Prune the model of a run by its training views (`mgs.splat.pruning.prune`), and write
    RUN/PRUNED.

    Both models are compared on the test views of the dataset, or without them on the held-out
    views. say(stage): called as a stage starts. Raises InputError as `open_run` and `prune`.
    """
    from mgs.splat.pruning import prune

    opened = open_run(run)
    gaussians, names = opened.state.gaussians, [frame.name for frame in opened.taken]
    say("pruning")
    cameras = [frame.camera for frame in opened.dataset.frames if frame.name in names]
    found = prune(gaussians, cameras, noise)
    smaller = gaussians[found.kept]
    say("comparing")
    views, psnr = compare_models([gaussians, smaller], opened.dataset, names)
    write_ply(opened.folder / PRUNED, smaller)
    return PrunedRun(len(gaussians), len(smaller), found.predicted, found.actual, views, psnr)
