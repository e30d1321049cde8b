"""`mgs refit`: a run's model with no more parameters than its views pay for."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mgs.policy.criteria import LEARN_LOSS

if TYPE_CHECKING:
    from mgs.report.refitting import RefittedRun


def refit(
    run: Annotated[Path, typer.Argument(help="Folder that `mgs nbv` wrote.")],
    learn: Annotated[
        str,
        typer.Option(
            help="auto: each Gaussian learns the kinds of parameters that the evidence pays for; "
            "all: all of them."
        ),
    ] = "auto",
    sh: Annotated[
        str,
        typer.Option(
            help="SH degree of the colours: 0, or auto: 1 if that predicts views left out better."
        ),
    ] = "auto",
    loss: Annotated[
        float,
        typer.Option(help="Allowed rise of the objective by parameters that are left out, dB."),
    ] = LEARN_LOSS,
) -> None:
    """Fit the views of a run once more, with no more parameters than they pay for; write
    RUN/gaussians_refitted.ply.

    No test view is used for it: the kinds of parameters that a Gaussian learns are chosen by the
    evidence, the marginal likelihood of the images, and by --loss; the SH degree by views that are
    left out. Parameters that are not learned keep the prior's values, and are marked in the file.
    The run itself stays as it is.
    """
    from rich.console import Console

    from mgs import runtime
    from mgs.cli.progress import progress_bar
    from mgs.report.refitting import REFITTED, refit_run

    runtime.start()
    options: Any = {"learn": learn, "sh": sh, "loss": loss}
    with progress_bar() as bar:
        found = refit_run(run, say=bar, **options)
    for line in [*_lines(found), f"wrote {run / REFITTED}"]:
        Console(highlight=False).print(line, soft_wrap=True)


def _lines(found: RefittedRun) -> list[str]:
    """Describe a refitted run."""
    share = found.after / found.before
    shares = ", ".join(f"{kind} {share:.0%}" for kind, share in found.shares.items())
    lines = [
        f"{found.after:,} parameters are learned, {share:.0%} of the run's {found.before:,}",
        f"learned by: {shares} of the Gaussians",
    ]
    if found.left_out:
        more = "more" if found.left_out.pays else "not more"
        lines.append(
            f"SH degree {found.sh_degree}: on views left out, neighbours together, degree 1 gains "
            f"{found.left_out.gain:+.3f} dB, {more} than its standard error of "
            f"{found.left_out.error:.3f}"
        )
    else:
        lines.append("SH degree 0: no other was tried")
    if not found.psnr:
        return [*lines, "PSNR: there are no views on which to compare the models"]
    own, whole, lean = found.psnr
    lines.append(
        f"PSNR on the {found.views} views: {lean:.2f} dB, {whole:.2f} dB where all parameters are "
        f"fitted in the same way; of the run's own model {own:.2f} dB"
    )
    return lines
