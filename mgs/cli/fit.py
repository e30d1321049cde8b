"""`mgs fit`: fit a model to all images of a dataset."""

from pathlib import Path
from typing import Annotated

import typer

from mgs.cli.nbv import resume_and_print, start_and_print
from mgs.cli.options import Settings, merged, not_none, parse_gaussians, parse_settings, with_keys
from mgs.run.settings import NbvSettings


@with_keys(
    NbvSettings,
    *("train", "sh", "exposure", "pixel_noise", "prior_std", "seed", "refine_poses", "pose_noise"),
)
def fit(
    dataset: Path,
    out: Annotated[Path, typer.Option()],
    prior: Path | None = None,
    gaussians: str | None = None,
    passes: int | None = None,
    means: str | None = None,
    sh: int | None = None,
    density: str | None = None,
    loss: str | None = None,
    exposure: bool | None = None,
    refine_poses: bool | None = None,
    seed: int | None = None,
    settings: Settings = None,
    force: bool = False,
) -> None:
    """Fit a model to all images of a dataset, and measure it.

    By default means are free if the prior comes from photographs (points, masks or random), and
    colours have SH degree 1 if it comes from points or masks. Otherwise means are frozen and
    colours have degree 0. Photographs without masks are fitted whole, unless --prior is given. Test
    views are never fitted. The output is a run folder like that of `mgs nbv`, so all commands for
    runs accept it.

    - out: New folder for the run.
    - passes: Default: 30 with adaptive density or free means from photographs, else 10.
    - means: Default: free from photographs or with adaptive density, else frozen.
    - sh: Default: 3 with adaptive density, 1 with free means from photographs, else 0.
    - density: The defaults of adaptive are those of 3DGS. Default: split of whole scenes without
      --gaussians, else fixed.
    """
    from mgs.cli.terminal import Terminal
    from mgs.run.nbv import start_fit

    console = Terminal()
    train = not_none(passes=passes, means=means, density=density, loss=loss)
    options = not_none(sh=sh, exposure=exposure, seed=seed, refine_poses=refine_poses)
    values = merged(parse_settings(settings, fit), options | {"train": train})
    values |= {"prior": prior, "gaussians": parse_gaussians(gaussians), "force": force}
    run = start_and_print(dataset, out, console, start_fit, **values)
    if run.poses_moved:
        console.print(moves_in_words(run.poses_moved, run.dataset.unit))
    if prior is None and (seen := run.prior.numbers.get("triangulated")) is not None:
        others = run.prior.numbers["n"] - seen
        console.print(f"start: {seen:,} points of the cameras and {others:,} random ones")
    resume_and_print(run, console, run.settings.policy)


def moves_in_words(moves: dict[str, dict[str, float]], unit: str) -> str:
    """Format the mean and largest move of poses. moves: by frame, degrees and length."""
    name = max(moves, key=lambda one: moves[one]["degrees"])
    degrees = sum(move["degrees"] for move in moves.values()) / len(moves)
    length = sum(move["length"] for move in moves.values()) / len(moves)
    most = f"{name} most: {moves[name]['degrees']:.2f} and {moves[name]['length']:.3g}"
    return f"poses moved {degrees:.2f} degrees and {length:.3g} {unit} in the mean, {most}"
