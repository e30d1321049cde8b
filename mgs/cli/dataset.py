"""`mgs dataset check`: find out what is wrong with a dataset."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Action(StrEnum):
    """What to do with a dataset."""

    check = "check"


def dataset(
    action: Annotated[Action, typer.Argument(help="check: read every file; compare depth, masks and poses between frames.")],
    path: Annotated[Path, typer.Argument(help="Folder of the dataset.")],
) -> None:
    """Check a dataset: can every file be read, has it the right size, is no mask empty, do neighbouring frames agree?

    Prints every problem and how to mend it. The exit code is 2 if there are problems.
    """
    from rich.console import Console
    from rich.progress import Progress

    from mgs.data.check import check_dataset
    from mgs.data.dataset import load_dataset
    from mgs.errors import InputError

    loaded = load_dataset(path)
    console = Console()
    with Progress(console=console, transient=True) as bar:
        task = bar.add_task("reading", total=len(loaded))
        check = check_dataset(loaded, lambda done, total: bar.update(task, completed=done))
    camera, (low, high) = loaded.frames[0].camera, check.depth_range
    console.print(f"{path}: {len(loaded)} frames, {camera.width}x{camera.height}, rock on {check.mask_share:.0%} of the pixels")
    if high > 0:
        console.print(f"depth of the rock {low:.2f} to {high:.2f} m; neighbours see through {check.seen_through:.1%} of it")
    if check.problems:
        for problem in check.problems:
            console.print(f"- {problem}", soft_wrap=True, highlight=False)
        raise InputError(f"{path}: {len(check.problems)} problem(s), listed above")
    console.print("no problems found")
