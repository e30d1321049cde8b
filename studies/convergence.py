"""Predicted further fall of the objective of a run's last fit.

A fit stops long before the minimum, when held-out images no longer improve (docs/fit.md). The
Newton decrease, half of g^T (J^T J + lam)^-1 g, predicts the rest; it is exact for linear images.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mgs.camera import Camera
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.fit.evidence import last_images, objective_of
from mgs.fit.objective import newton_decrease
from mgs.gaussians import Gaussians
from mgs.prior.build import Prior
from mgs.run.folder import Run, open_run
from mgs.run.settings import NbvSettings
from mgs.splat import as_drjit

CG_ITERATIONS = 20
"""Iterations of conjugate gradients."""

CONVERGED_SHARE = 0.02
"""A fit has converged if the objective is predicted to fall by at most this share of itself."""


def remaining_decrease(
    gaussians: Gaussians,
    settings: NbvSettings,
    prior: Prior,
    frames: Sequence[Frame],
    cameras: Sequence[Camera],
) -> dict[str, Any]:
    """Objective of the last fit of a run, and its predicted further fall.

    gaussians: the fitted model; frames: those taken, in their order, so the seeds first. cameras:
    of all frames of the dataset.

    Returns "phi" (`mgs.fit.objective`, squared pixel values); "predicted_decrease", a share of phi;
    and "converged", whether that is at most CONVERGED_SHARE. Raises InputError if a frame cannot be
    read, or the fit changed its Gaussians, whose prior is not kept, or had another loss.
    """
    train = settings.train
    if train.density != "fixed" or train.loss != "squared":
        raise InputError(
            "convergence: is for a fixed number of Gaussians and squared differences; "
            "fit with --density fixed --loss squared"
        )
    goal = objective_of(last_images(settings, prior, frames, cameras), gaussians, settings)
    model = as_drjit(gaussians)
    phi = goal.phi(model)
    share = newton_decrease(goal, model, CG_ITERATIONS)[-1] / max(phi, 1e-30)
    return {"phi": phi, "predicted_decrease": share, "converged": bool(share <= CONVERGED_SHARE)}


def fit_line(run: str | Path | Run) -> str:
    """Describe how the last fit of a run ended, and how far it is from its minimum.

    Raises InputError as `open_run` and `remaining_decrease`.
    """
    run = run if isinstance(run, Run) else open_run(run)
    left = remaining_decrease(
        run.state.gaussians, run.settings, run.prior, run.taken, run.dataset.cameras
    )
    reason = run.state.steps[-1]["stop_reason"]
    how = "converged" if left["converged"] else f"ended as designed ({reason})"
    share = f"{100 * left['predicted_decrease']:.2g} %"
    return f"last fit: {how}; at its minimum the objective is predicted to be {share} lower"


if __name__ == "__main__":
    from studies.commands import start

    start("convergence")
