"""`mgs eval`, `diagnose`, `report`, `simplify`: measure models, or make smaller ones."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mgs import runtime
from mgs.cli.options import not_none, refuse_unused
from mgs.cli.terminal import Terminal, echo, print_quality, progress_bar
from mgs.errors import InputError
from mgs.files import below, check_new_file, folder_locked, working_in
from mgs.policy.criteria import LEARN_LOSS, PRUNE_NOISE

NOISE = (
    "Of prune: allowed change of the training images, rms of a pixel value. "
    f"Default: {PRUNE_NOISE}."
)
LOSS = f"Of refit: allowed rise of the objective, dB. Default: {LEARN_LOSS}."

if TYPE_CHECKING:
    from mgs.reports.simplify import PrunedRun, RefittedRun


def evaluate(
    subjects: list[Path],
    dataset: Path | None = None,
    prior: Path | None = None,
    pictures: bool = True,
) -> None:
    """Measure PSNR and SSIM of models on test views, all views and held-out views; write
    RUN/metrics.json, and renders beside the truth.

    Held-out views are frames of the dataset that the run did not take. A run's refitted and pruned
    models are measured, too. The metrics of a file are written beside it. Metrics and pictures that
    are up to date are kept. The truth is the object on black. PSNR and SSIM are over the full
    frame, and masked to the pixels of the object. metrics.json also has the errors of alpha and
    depth, where the dataset has their truth.

    - subjects RUN|SPLATS...: Folders that `mgs nbv` wrote, or PLY, GLB, SPZ, MGS.
    - dataset: Dataset for a file. Default: that of the run whose folder holds it.
    - prior: Folder of the prior that an mgs file was written with, if it needs one.
    - pictures: Write truth, render and difference of each view to RUN/renders."""
    from mgs.reports.evaluation import evaluate as measured
    from mgs.reports.evaluation import evaluate_run
    from mgs.reports.simplify import PRUNED, REFITTED
    from mgs.reports.tables import comparison_rows, metrics_row
    from mgs.run.folder import open_run

    runtime.start()
    rows, lines = list[dict[str, Any]](), list[str]()
    with progress_bar():
        for subject in subjects:
            files = [subject]
            if subject.is_dir():
                for name in not_none(dataset=dataset, prior=prior):
                    raise InputError(f"--{name}: is for a file, not for {subject}; leave it out")
                run = open_run(subject)
                evaluate_run(run, pictures=pictures, say=lines.append)
                folder = f" ({subject.resolve().name})" if len(subjects) > 1 else ""
                rows += comparison_rows({f"{run.label}{folder}": run})
                smaller = [subject / name for name in (REFITTED, PRUNED)]
                files = [path for path in smaller if path.is_file()]
            for path in files:
                metrics = measured(path, dataset, prior=prior)
                name = path.name if path == subject else f"  {path.stem.partition('_')[2]}"
                rows.append(metrics_row(name, metrics))
                lines.append(f"wrote {path}.metrics.json")
    print_quality(Terminal(), rows)
    echo("\n".join(lines))


def diagnose(runs: list[Path], views: str | None = None, force: bool = False) -> None:
    """Draw maps of the Fisher information and the uncertainty of a run's model, for views and for
    Gaussians.

    Writes into RUN/diagnostics: for each view an EXR with the channels R G B A Z, fisher.colour,
    fisher.scale, fisher.rotation, fisher.opacity, information, uncertainty and unobserved, and a
    PNG that shows them; and information.ply, a point for each Gaussian, coloured by its
    information.

    - views: Frames to draw, as kf_0003,kf_0010. Default: a few held-out ones."""
    from mgs.reports.diagnostics import diagnose as mapped
    from mgs.run.folder import open_run

    names = None if views is None else [name.strip() for name in views.split(",") if name.strip()]
    if names == []:
        raise InputError(f"--views {views!r}: names no frame; give some, as in kf_0003,kf_0010")
    folders = [below(open_run(run).folder, "diagnostics") for run in runs]
    for folder in folders:
        check_new_file(folder / "information.ply", force)
    runtime.start()
    for run, folder in zip(runs, folders, strict=True):
        with folder_locked(folder), progress_bar():
            paths = mapped(run, names)
        for path in paths:
            echo(f"wrote {path}")


def simplify(
    runs: list[Path],
    method: Literal["prune", "refit"] = "prune",
    noise: Annotated[float | None, typer.Option(help=NOISE)] = None,
    learn: str | None = None,
    sh: str | None = None,
    loss: Annotated[float | None, typer.Option(help=LOSS)] = None,
    force: bool = False,
) -> None:
    """Make the model of a run smaller; write RUN/gaussians_pruned.ply or gaussians_refitted.ply.

    prune removes Gaussians that the training images hardly need. The change of these images is
    measured and stays within --noise.

    refit fits the views of the run again. The evidence (marginal likelihood of the images) and
    --loss choose the kinds of parameters that each Gaussian learns, and views left out the SH
    degree. Parameters that are not learned keep the prior's values, and are marked in the file.

    No test view is used, and the run itself is not changed.

    - method: prune: fewer Gaussians, no new fit; refit: fewer parameters, fitted again.
    - learn: Of refit: auto (default), each Gaussian learns the kinds of parameters that the
      evidence supports; all: all kinds.
    - sh: Of refit: SH degree 0, or auto (default): 1 if it predicts left-out views better."""
    from mgs.reports.simplify import PRUNED, REFITTED, prune_run, refit_run
    from mgs.run.folder import open_run

    of_prune, of_refit = not_none(noise=noise), not_none(learn=learn, sh=sh, loss=loss)
    refuse_unused(f"by the method {method}", **(of_refit if method == "prune" else of_prune))
    name = PRUNED if method == "prune" else REFITTED
    for run in runs:
        check_new_file(open_run(run).folder / name, force)
    runtime.start()
    for run in runs:
        with working_in(run), progress_bar():
            if method == "prune":
                lines = _pruned(prune_run(run, **of_prune), noise or PRUNE_NOISE)
            else:
                lines = _refitted(refit_run(run, **of_refit))
        echo("\n".join([*lines, f"wrote {run / name}"]))


def _pruned(result: "PrunedRun", noise: float) -> list[str]:
    share, before, after = 1 - result.after / result.before, result.before, result.after
    lines = [f"{before:,} Gaussians, {after:,} stay: {share:.0%} are left out"]
    values = f"predicted {result.predicted:.2g}, measured {result.actual:.2g}, allowed {noise:.2g}"
    lines.append(f"rms change of a pixel value: {values}")
    if result.psnr:
        decibels = "{:.2f} dB before, {:.2f} dB after".format(*result.psnr)
        lines.append(f"PSNR on the {result.views} views: {decibels}")
    return lines


def _refitted(result: "RefittedRun") -> list[str]:
    model, left_out = result.lean, result.lean.left_out
    share = model.parameters / result.before
    shares = ", ".join(f"{kind} {mask.mean():.0%}" for kind, mask in model.learned.items())
    count, degree = f"{model.parameters:,} parameters are learned", model.gaussians.sh_degree
    lines = [f"{count}, {share:.0%} of the run's {result.before:,}"]
    lines.append(f"learned by: {shares} of the Gaussians")
    tried = "SH degree 0: no other was tried"
    if left_out:
        more = "more" if left_out.pays else "not more"
        gain = f"degree 1 gains {left_out.gain:+.3f} dB, {more} than twice its standard error of"
        tried = f"SH degree {degree}: on views left out, neighbours together, {gain}"
        tried += f" {left_out.error:.3f}"
    lines.append(tried)
    if not result.psnr:
        return [*lines, "PSNR: there are no views on which to compare the models"]
    own, whole, lean = result.psnr
    other = f"{whole:.2f} dB where all parameters are fitted in the same way"
    values = f"{lean:.2f} dB, {other}; of the run's own model {own:.2f} dB"
    return [*lines, f"PSNR on the {result.views} views: {values}"]


def report(
    runs: list[Path],
    out: Path | None = None,
    figures: Literal["png", "pdf", "svg"] | None = None,
    html: Path | None = None,
    force: bool = False,
) -> None:
    """Compare runs: draw the orbit, information gain, coverage, PSNR against images and one test
    view, and make a table.

    If the dataset has no test views, PSNR is over all views, and the view drawn is one that the
    fewest runs were trained on. Figures need runs that are finished and measured by `mgs eval`.

    The page of --html takes unfinished runs, too, and draws the model that the run folder holds.

    - runs: Run folders, or folders of them; all of one dataset.
    - out: Folder for the figures and the table. Default: report; with --html none.
    - figures: Format of the figures. Default: png.
    - html: Interactive HTML page to write; one file that opens without a network."""
    if figures and html is not None and out is None:
        raise InputError(f"--figures {figures}: --html alone writes no figures; give --out, too")
    if html is not None:
        check_new_file(html, force)
    runtime.start()
    if out is not None or html is None:
        _write_figures(runs, out or Path("report"), figures or "png", force)
    if html is not None:
        from mgs.reports.page import write_page

        with progress_bar():
            size = write_page(html, runs)
        echo(f"wrote {html} ({size / 1e6:.1f} MB)")


def _write_figures(runs: list[Path], out: Path, kind: str, force: bool) -> None:
    from mgs.reports.tables import compare_runs, comparison_rows, report_files
    from mgs.reports.tables import report as compared_in
    from mgs.run.ending import why_ended

    for name in report_files(kind):
        check_new_file(out / name, force)
    by_label = compare_runs(runs)
    with folder_locked(out):
        files = compared_in(list(by_label.values()), out, kind)
    rows = comparison_rows(by_label)
    print_quality(Terminal(), rows)
    for row, run in zip(rows, by_label.values(), strict=True):
        if run.settings.budget:
            path = f"a path of {row['path']:.2f} {row['unit']}"
            echo(f"{row['policy']}: {path}; the run has ended: {why_ended(run.ended or {})}")
    for file in files:
        echo(f"wrote {file}")
    choices = any(run.settings.budget for run in by_label.values())
    if choices and not any(file.stem == "psnr" for file in files):
        echo("PSNR against images is left out: make all runs with evaluate_every to have it")
