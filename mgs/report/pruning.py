"""A smaller model of a run: pruned, and compared with the whole one on views that it was not fitted
to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mgs.policy.criteria import PRUNE_NOISE
from mgs.report.evaluation import mean_psnr, other_views
from mgs.run.folder import load_run
from mgs.splat_ply import write_ply

PRUNED = "gaussians_pruned.ply"


@dataclass(frozen=True)
class PrunedRun:
    """before, after: number of Gaussians. predicted, actual: rms change of the images that the
    model was fitted to, as in `mgs.splat.pruning.Pruned`. views: "test" or "held out"; psnr: on
    these, before and after, dB, None where there are none."""

    before: int
    after: int
    predicted: float
    actual: float
    views: str
    psnr: tuple[float, float] | None


def prune_run(
    run: str | Path, noise: float = PRUNE_NOISE, say: Callable[[str], None] = lambda stage: None
) -> PrunedRun:
    """Prune the model of a run by what the views that it took see of it
    (`mgs.splat.pruning.prune`), and write RUN/PRUNED.

    The views on which both models are compared are the test views of the dataset, where it has
    some, or else those never taken. say(stage) is called as a stage starts. Raises InputError as
    `load_run` and `prune`.
    """
    from mgs.splat.pruning import prune

    gaussians, dataset, trained, _ = load_run(Path(run))
    say("pruning")
    cameras = [frame.camera for frame in dataset.frames if frame.name in trained]
    found = prune(gaussians, cameras, noise)
    smaller = gaussians[found.kept]
    say("comparing")
    views, frames = other_views(dataset, trained)
    psnr = (mean_psnr(gaussians, frames), mean_psnr(smaller, frames)) if frames else None
    write_ply(Path(run) / PRUNED, smaller)
    return PrunedRun(len(gaussians), len(smaller), found.predicted, found.actual, views, psnr)
