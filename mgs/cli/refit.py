"""`mgs refit`: a run's model with no more parameters than its views pay for."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mgs.policy.criteria import LEARN_LOSS

if TYPE_CHECKING:
    from mgs.report.refitting import RefittedRun


def refit(
    run: Annotated[Path, typer.Argument(help="Folder that `mgs nbv` wrote.")],
    learn: Annotated[
        str,
        typer.Option(
            help="auto: each Gaussian learns the kinds of parameters that the evidence pays for; all: all of them."
        ),
    ] = "auto",
    sh: Annotated[
        str,
        typer.Option(
            help="SH degree of the colours: 0, or auto: 1 where that foretells views left out better."
        ),
    ] = "auto",
    loss: Annotated[
        float,
        typer.Option(
            help="By how much the objective of the fit may rise where parameters are left out, dB."
        ),
    ] = LEARN_LOSS,
) -> None:
    """Fit the views of a run once more, with no more parameters than they pay for; write
    RUN/gaussians_refitted.ply.

    What pays is decided without a test view: which kinds of parameters a Gaussian learns by the
    evidence, the marginal likelihood of the images, and by --loss; the SH degree by views that are
    left out. Parameters that are not learned keep the prior's values, and are marked in the file.
    The run itself stays as it is.
    """
    from rich.console import Console

    from mgs import runtime
    from mgs.cli.progress import progress_bar
    from mgs.report.refitting import REFITTED, refit_run

    runtime.start()
    console, asked = Console(highlight=False), {"learn": learn, "sh": sh, "loss": loss}
    with progress_bar() as bar:
        found = refit_run(run, say=bar, **asked)  # type: ignore[arg-type]
    for line in lines(found):
        console.print(line, soft_wrap=True)
    console.print(f"wrote {run / REFITTED}", soft_wrap=True)


def lines(found: RefittedRun) -> list[str]:
    """The lines that the command prints."""
    said = [
        f"{found.after:,} parameters are learned, {found.after / found.before:.0%} of the run's {found.before:,}"
    ]
    said.append(
        "learned by: "
        + ", ".join(f"{kind} {share:.0%}" for kind, share in found.shares.items())
        + " of the Gaussians"
    )
    if found.left_out:
        more = "more" if found.left_out.pays else "not more"
        gain = f"{found.left_out.gain:+.3f} dB, {more} than its standard error of {found.left_out.error:.3f}"
        said.append(
            f"SH degree {found.sh_degree}: on views left out, neighbours together, degree 1 gains {gain}"
        )
    else:
        said.append("SH degree 0: no other was tried")
    if found.psnr:
        own, whole, lean = found.psnr
        said.append(
            f"PSNR on the {found.views} views: {lean:.2f} dB, {whole:.2f} dB where all parameters are fitted in the same way; "
            f"of the run's own model {own:.2f} dB"
        )
    else:
        said.append("PSNR: there are no views on which to compare the models")
    return said
