"""Smaller models of a run, compared with the whole one on other views: `mgs simplify`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mgs.errors import InputError
from mgs.files import check_writable
from mgs.policy.criteria import LEARN_LOSS, PRUNE_NOISE
from mgs.progress import report
from mgs.reports.evaluation import compare_models
from mgs.run import inputs
from mgs.run.folder import open_run
from mgs.splat_places import to_source
from mgs.splat_ply import write_ply

if TYPE_CHECKING:
    from mgs.fit.evidence import LeanModel

PRUNED = "gaussians_pruned.ply"
REFITTED = "gaussians_refitted.ply"

CHOICES = {"learn": ("all", "auto"), "sh": ("0", "auto")}  # arguments of `refit_run`
LARGEST_LOSS = 10.0  # of `refit_run`, dB: with that next to nothing is learned but colours


@dataclass(frozen=True)
class PrunedRun:
    """Numbers of Gaussians before and after, rms change of the training images, predicted and
    actual, and PSNR before and after on `views`, "test" or "held-out", dB; None if there are
    none."""

    before: int
    after: int
    predicted: float
    actual: float
    views: str
    psnr: list[float] | None


def prune_run(run: str | Path, noise: float = PRUNE_NOISE) -> PrunedRun:
    """Prune the model of a run by its training views (`mgs.fit.pruning.prune`), and write
    RUN/PRUNED.

    Both models are compared on the test views of the dataset, or without them on the held-out
    views. Raises InputError as `open_run` and `prune`."""
    from mgs.fit.pruning import prune

    opened = open_run(run)
    gaussians, names = opened.state.gaussians, [frame.name for frame in opened.taken]
    report("pruning")
    cameras = [frame.camera for frame in opened.dataset.frames if frame.name in names]
    pruned = prune(gaussians, cameras, noise)
    smaller = gaussians[pruned.kept]
    report("comparing")
    views, psnr = compare_models([gaussians, smaller], opened)
    write_ply(opened.folder / PRUNED, to_source(smaller, opened.dataset.world))
    return PrunedRun(len(gaussians), len(smaller), pruned.predicted, pruned.actual, views, psnr)


@dataclass(frozen=True)
class RefittedRun:
    """Learned parameters of the run, the refitted model, and PSNR on `views`, "test" or "held-out",
    dB: of the run's own model, of one refitted with all parameters, and of the refitted one, or
    None."""

    before: int
    lean: "LeanModel"
    views: str
    psnr: list[float] | None


def refit_run(
    run: str | Path,
    learn: Literal["all", "auto"] = "auto",
    sh: Literal["0", "auto"] = "auto",
    loss: float = LEARN_LOSS,
) -> RefittedRun:
    """Fit the views of a run once more (`mgs.fit.evidence.lean_fit`), and write RUN/REFITTED.

    A vertex of the file has a byte for each kind of parameter, `learned_colour` and so on: 1 if it
    was learned; else the file holds the prior's value. The models are compared on the test views,
    or without them on the held-out views. Raises InputError as `open_run` and `lean_fit`, for wrong
    arguments, for a run whose density is not fixed, and if the prior or the images are not those of
    the run."""
    from mgs.fit.evidence import lean_fit
    from mgs.learning import images_of
    from mgs.scene import Scene
    from mgs.splat import groups

    if not 0 <= loss <= LARGEST_LOSS:
        raise InputError(f"loss {loss}: must be from 0 to {LARGEST_LOSS:g} dB")
    for (name, choices), value in zip(CHOICES.items(), (learn, sh), strict=True):
        if value not in choices:
            raise InputError(f"{name} {value!r}: unknown; choose one of {', '.join(choices)}")
    if (learn, sh) == ("all", "0"):
        raise InputError("learn all and sh 0 leave nothing to choose; leave out one of them")
    opened = open_run(run)
    if opened.settings.train.density != "fixed":
        needs = "fit anew with `mgs fit --density fixed` to refit"
        raise InputError(f"{opened.folder}: its fit changed the Gaussians of the prior; {needs}")
    path = check_writable(opened.folder / REFITTED)
    own, settings, prior = opened.state.gaussians, opened.settings, opened.prior
    digest = inputs.prior_digest(prior)
    inputs.check_unchanged(opened.folder, opened.state.inputs, digest, settings, opened.dataset)
    images = images_of(Scene(opened.dataset, prior, settings), opened.taken)
    lean = lean_fit(images, settings, learn, sh, loss)
    report("comparing")
    views, psnr = compare_models([own, lean.whole, lean.gaussians], opened)
    marks = {f"learned_{kind}": mask for kind, mask in lean.learned.items()}
    write_ply(path, to_source(lean.gaussians, opened.dataset.world), marks)
    columns, rates = groups(settings.sh, settings.train.means), settings.train.rates
    each = sum(of.stop - of.start for kind, of in columns.items() if rates[kind] > 0)
    return RefittedRun(len(own) * each, lean, views, psnr)
