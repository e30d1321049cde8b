"""A run's views fitted once more, with no more parameters than they pay for, and compared with the
run's own model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mgs.errors import InputError
from mgs.files import check_writable
from mgs.fit.settings import TrainSettings
from mgs.policy.criteria import LEARN_LOSS
from mgs.prior.build import load_prior
from mgs.report.evaluation import mean_psnr, other_views
from mgs.run import inputs
from mgs.run.folder import load_run, read_checkpoint, read_settings
from mgs.splat_ply import write_ply

if TYPE_CHECKING:
    from mgs.report.evidence import LeftOut

REFITTED = "gaussians_refitted.ply"

LEARN, DEGREES = ("all", "auto"), ("0", "auto")
"""What `learn` and `sh` of `refit_run` may be."""

LARGEST_LOSS = 10.0
"""The largest `loss` of `refit_run`, dB: with that next to nothing is learned but colours."""


@dataclass(frozen=True)
class RefittedRun:
    """What `refit_run` found.

    before, after: number of learned parameters. shares: {kind: share of the Gaussians that learned
    it}. left_out: as in `mgs.report.evidence.LeanModel`. sh_degree: of the model. views: "test" or
    "held out"; psnr: on these, of the run's own model, of one fitted like this one that learns
    everything, and of this one, dB, None where there are none."""

    before: int
    after: int
    shares: dict[str, float]
    left_out: LeftOut | None
    sh_degree: int
    views: str
    psnr: tuple[float, float, float] | None


def refit_run(
    run: str | Path,
    learn: Literal["all", "auto"] = "auto",
    sh: Literal["0", "auto"] = "auto",
    loss: float = LEARN_LOSS,
    say: Callable[[str], None] = lambda stage: None,
) -> RefittedRun:
    """Fit the views that a run took once more (`mgs.report.evidence.lean_fit`), and write
    RUN/REFITTED.

    A vertex of the file has a byte for each kind of parameter, `learned_colour` and so on: 1 where
    it was learned; else the prior's values stand there. The run itself stays as it is. Both models
    are compared on the test views of the dataset, where it has some, or else on those never taken.
    say(stage) is called as a stage starts. Raises InputError as `load_run`, where learn or sh is
    unknown or both leave nothing to choose, loss is not from 0 to LARGEST_LOSS, the prior is not
    there, and as `lean_fit`.
    """
    from mgs.report.evidence import last_images, lean_fit

    if not 0 <= loss <= LARGEST_LOSS:
        raise InputError(f"--loss {loss}: must be from 0 to {LARGEST_LOSS:g} dB")
    for option, value, known in (("--learn", learn, LEARN), ("--sh", sh, DEGREES)):
        if value not in known:
            raise InputError(f"{option} {value}: is unknown; choose one of {', '.join(known)}")
    if (learn, sh) == ("all", "0"):
        raise InputError(
            "refit: --learn all --sh 0 leaves nothing to choose; leave out one of them"
        )
    run = Path(run)
    check_writable(run / REFITTED)
    gaussians, dataset, taken, _ = load_run(run)
    settings, state = read_settings(run), read_checkpoint(run)
    assert state is not None  # the model was read from it
    prior = load_prior(settings.prior)
    digest = inputs.prior_digest(prior)
    inputs.check_unchanged(run, state.inputs, digest, settings, dataset)
    by_name = {frame.name: frame for frame in dataset.frames}
    images = last_images(settings, prior, [by_name[name] for name in taken])
    found = lean_fit(images, settings, learn, sh, loss, say=say)
    say("comparing")
    views, frames = other_views(dataset, taken)
    models = (gaussians, found.whole, found.gaussians)
    own, whole, lean = (mean_psnr(model, frames) if frames else 0.0 for model in models)
    psnr = (own, whole, lean) if frames else None
    marks = {f"learned_{kind}": mask for kind, mask in found.learned.items()}
    write_ply(run / REFITTED, found.gaussians, marks)
    before = len(gaussians) * parameters_of_each(settings.train)
    shares = {kind: float(mask.mean()) for kind, mask in found.learned.items()}
    return RefittedRun(
        before, found.parameters, shares, found.left_out, found.gaussians.sh_degree, views, psnr
    )


def parameters_of_each(train: TrainSettings) -> int:
    """How many parameters of a Gaussian a run learns: those of the kinds whose rate is not 0."""
    from mgs.splat import groups

    return sum(
        of.stop - of.start for kind, of in groups(0, train.means).items() if train.rates[kind] > 0
    )
