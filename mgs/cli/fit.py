"""`mgs fit`: fit a model to all images of a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from mgs.cli.nbv import (
    MORE_HELP,
    resume_and_print,
    settings_of,
    start_and_print,
    with_settings_as_options,
)
from mgs.cli.options import DatasetFolder, Force, option, parse_gaussians

PANELS = {
    "Fitting": (
        "passes", "means", "sh", "density", "most_gaussians", "loss", "exposure", "antialiased",
        "alpha_weight", "optimiser", "rates",
    ),
    "Advanced": ("pixel_noise", "prior_std", "seed"),
}  # fmt: skip
"""Settings with an option of the same name, as `mgs.cli.nbv.PANELS`."""

DEFAULTS = {
    "passes": " Default: 30 with adaptive density or free means from photographs, else 10.",
    "means": " Default: free from photographs or with adaptive density, else frozen.",
    "sh": " Default: 3 with adaptive density, 1 with free means from photographs, else 0.",
    "loss": " Default: squared with frozen means, l1-dssim with free ones from photographs.",
    "antialiased": " Default with adaptive density: --no-antialiased.",
    "density": " The defaults of adaptive are all those of 3DGS.",
}
"""Help of the settings that `mgs.run.nbv.start_fit` decides by the prior."""


def fit(
    dataset: DatasetFolder,
    out: Annotated[Path, option("New folder for the run.")],
    prior: Annotated[
        Path | None,
        option("Folder of `mgs prior`. Default: DATASET/prior, or one built in the run."),
    ] = None,
    gaussians: Annotated[
        str | None,
        option("Build a prior of this many Gaussians in the run folder.", metavar="N|auto"),
    ] = None,
    force: Force = False,
    **options: Any,
) -> None:
    """Fit a model to all images of a dataset, and measure it.

    By default means are free if the prior comes from photographs (points, masks or random), and
    colours have SH degree 1 if it comes from points or masks. Otherwise means are frozen and
    colours have degree 0. Photographs without masks are fitted whole, unless --prior is given. Test
    views are never fitted. The output is a run folder like that of `mgs nbv`, so all commands for
    runs accept it.
    """
    from mgs.cli.terminal import Terminal
    from mgs.run.nbv import start_fit

    console = Terminal()
    given = {name: options[name] for name in options if options[name] not in (None, [])}
    asked = {"prior": prior, "gaussians": parse_gaussians(gaussians), "force": force}
    run = start_and_print(dataset, out, console, start_fit, **asked, **settings_of(given))
    numbers = run.prior.numbers
    if numbers["from"] == "random" and prior is None:
        console.print(
            f"start: {numbers['triangulated']:,} points of the cameras and "
            f"{numbers['n'] - numbers['triangulated']:,} random ones",
            soft_wrap=True,
        )
    resume_and_print(run, console, run.settings.policy)


with_settings_as_options(fit, PANELS, MORE_HELP | DEFAULTS)
