"""A run's views fitted once more, with no more parameters than they pay for, and compared with the run's own model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mgs.active.criteria import LEARN_LOSS
from mgs.active.run_folder import load_run, read_settings
from mgs.data.dataset import Dataset, Frame
from mgs.errors import InputError
from mgs.gaussians import Gaussians
from mgs.prior.build import load_prior
from mgs.report.evaluation import evaluate
from mgs.splat_ply import write_ply

if TYPE_CHECKING:
    from mgs.active.evidence import LeftOut

REFITTED = "gaussians_refitted.ply"

LEARN, DEGREES = ("all", "auto"), ("0", "auto")
"""What `learn` and `sh` of `refit_run` may be."""

LARGEST_LOSS = 10.0
"""The largest `loss` of `refit_run`, dB: with that next to nothing is learned but colours."""


@dataclass(frozen=True)
class RefittedRun:
    """before, after: number of learned parameters. shares: {kind: share of the Gaussians that learned it}. left_out: as in
    `mgs.active.evidence.LeanModel`. sh_degree: of the model. views: "test" or "held out"; psnr: on these, of the run's own
    model, of one fitted like this one that learns everything, and of this one, dB, None where there are none."""

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
    """Fit the views that a run took once more (`mgs.active.evidence.lean_fit`), and write RUN/REFITTED.

    A vertex of the file has a byte for each kind of parameter, `learned_colour` and so on: 1 where it was learned; else the
    prior's values stand there. The run itself stays as it is. Both models are compared on the test views of the dataset, where
    it has some, or else on those never taken. say(stage) is called as a stage starts. Raises InputError as `load_run`, where
    learn or sh is unknown or both leave nothing to choose, loss is not from 0 to LARGEST_LOSS, the prior is not there, and as
    `lean_fit`.
    """
    from mgs.active.evidence import last_images, lean_fit

    if not 0 <= loss <= LARGEST_LOSS:
        raise InputError(f"--loss {loss}: must be from 0 to {LARGEST_LOSS:g} dB")
    for option, value, known in (("--learn", learn, LEARN), ("--sh", sh, DEGREES)):
        if value not in known:
            raise InputError(f"{option} {value}: is unknown; choose one of {', '.join(known)}")
    if (learn, sh) == ("all", "0"):
        raise InputError("refit: --learn all --sh 0 is what the run itself fitted; leave out one of them")
    run = Path(run)
    gaussians, dataset, taken, _ = load_run(run)
    settings = read_settings(run)
    by_name = {frame.name: frame for frame in dataset.frames}
    images = last_images(settings, load_prior(settings.prior), [by_name[name] for name in taken])
    found = lean_fit(images, settings, learn, sh, loss, say=say)
    say("comparing")
    views, frames = other_views(dataset, taken)
    models = (gaussians, found.whole, found.gaussians)
    own, whole, lean = (mean_psnr(model, frames) if frames else 0.0 for model in models)
    psnr = (own, whole, lean) if frames else None
    marks = {f"learned_{kind}": mask for kind, mask in found.learned.items()}
    write_ply(run / REFITTED, found.gaussians, marks)
    before = len(gaussians) * parameters_of_each(settings.train.means)
    shares = {kind: float(mask.mean()) for kind, mask in found.learned.items()}
    return RefittedRun(before, found.parameters, shares, found.left_out, found.gaussians.sh_degree, views, psnr)


def parameters_of_each(means: str) -> int:
    """How many parameters of a Gaussian a run learns. means: a name in `mgs.splat.MEANS`."""
    from mgs.splat import groups

    return max(columns.stop for columns in groups(0, means).values())


def other_views(dataset: Dataset, taken: Sequence[str]) -> tuple[str, Sequence[Frame]]:
    """The views on which two models of a run are compared: ("test", the test views) where the dataset has some, or else ("held
    out", those never taken). taken: names of frames."""
    tests = dataset.test_views()
    if tests:
        return "test", tests.frames
    return "held out", [frame for frame in dataset.with_images(taken) if frame.name not in taken]


def mean_psnr(gaussians: Gaussians, frames: Sequence[Frame]) -> float:
    """Mean PSNR over views, full frame, dB."""
    return float(evaluate(gaussians, frames, ())["all"]["psnr"])
