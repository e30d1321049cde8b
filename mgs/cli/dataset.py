"""`mgs dataset`: say what is wrong with a dataset, or make masks for one that has none."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

UNCERTAINTY = 2.0
"""By how much a prior may be wrong, over its depth tolerance, where masks are made of it.
benchmarks/own_data.py measures what the refinement loses or gains."""


class Action(StrEnum):
    """What to do with a dataset."""

    check = "check"
    masks = "masks"


def dataset(
    action: Annotated[
        Action,
        typer.Argument(
            help="check: read every file, and compare depth, masks and poses. masks: see below."
        ),
    ],
    path: Annotated[Path, typer.Argument(help="Folder of the dataset.")],
    prior: Annotated[
        Path | None, typer.Option(help="masks: the prior to project. Default: DATASET/prior.")
    ] = None,
    refine: Annotated[
        bool, typer.Option(help="masks: move outlines to where colours change, near the prior's.")
    ] = False,
) -> None:
    """Check that every file of a dataset can be read and has the right size, and that colour,
    depth, masks and poses agree.

    Prints every problem and its cure. The exit code is 2 where there is one. Test views are a
    dataset of their own: give DATASET/test.

    `mgs dataset masks DATASET` makes masks for a dataset that has none: it projects the prior into
    every image, with --refine moves the outlines to where colours change, writes masks/, and
    masks.png for a person to look at.
    """
    if action == Action.masks:
        _make_masks(path, path / "prior" if prior is None else prior, refine)
    else:
        _check(path)


def _make_masks(path: Path, prior: Path, refine: bool) -> None:
    from rich.console import Console
    from rich.progress import Progress

    from mgs.data.dataset import load_dataset
    from mgs.data.masks import SHEET, make_masks
    from mgs.prior.build import load_prior

    loaded, known = load_dataset(path), load_prior(prior)
    console = Console()
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("masks", total=len(loaded))
        made = make_masks(
            loaded,
            known.mesh,
            UNCERTAINTY * known.depth_tolerance,
            refine=refine,
            progress=lambda done, total: bar.update(task, completed=done),
        )
    console.print(
        f"{path}: {len(made)} masks of {prior}; look at {path / SHEET} before you use them"
    )


def _check(path: Path) -> None:
    from rich.console import Console
    from rich.progress import Progress

    from mgs.data.check import check_dataset, taken_frames
    from mgs.data.dataset import load_dataset
    from mgs.errors import InputError

    loaded = load_dataset(path)
    console = Console()
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("reading", total=len(loaded))
        check = check_dataset(loaded, lambda done, total: bar.update(task, completed=done))
    camera, (low, high) = loaded.frames[0].camera, check.depth_range
    missing = len(loaded) - len(taken_frames(loaded))
    count = f"{len(loaded)} frames" + (
        f" ({missing} of them on demand, not taken yet)" if missing else ""
    )
    console.print(
        f"{path}: {count}, {camera.width}x{camera.height}, rock on {check.mask_share:.0%} of the pixels"
    )
    if high > 0:
        console.print(
            f"depth of the rock {low:.2f} to {high:.2f} m; neighbours see through {check.seen_through:.1%} of it"
        )
    if check.problems:
        for problem in check.problems:
            console.print(f"- {problem}", soft_wrap=True, highlight=False)
        raise InputError(f"{path}: {len(check.problems)} problem(s), listed above")
    console.print("no problems found")
