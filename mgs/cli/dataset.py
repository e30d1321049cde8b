"""`mgs dataset`: check a dataset, or make masks for one that has none."""

from pathlib import Path
from typing import Literal

from mgs.cli.terminal import Terminal, progress_bar
from mgs.errors import InputError
from mgs.files import working_in


def dataset(action: Literal["check", "masks"], path: Path, prior: Path | None = None) -> None:
    """Check a dataset, or make masks for one that has none.

    `mgs dataset check DATASET` checks that every file can be read and has the right size, and that
    colour, depth, masks and poses agree. It prints every problem and its cure, and exits with code
    2 if there is one. Test views are a dataset of their own: check DATASET/test, too.

    `mgs dataset masks DATASET` projects the prior's mesh into every image and writes masks/. Look
    at masks.png, which shows them, before you use them.

    - action: check or masks: see above.
    - path: Folder of the dataset.
    - prior: For masks: folder of the prior. Default: DATASET/prior."""
    if action == "masks":
        _make_masks(path, prior or path / "prior")
    else:
        _check(path)


def _make_masks(path: Path, prior: Path) -> None:
    from mgs.data.dataset import load_dataset
    from mgs.data.masks import SHEET, make_masks
    from mgs.prior.build import load_prior

    data, mesh_prior = load_dataset(path), load_prior(prior)
    console = Terminal()
    with working_in(path), progress_bar("masks", console):
        masks = make_masks(data, mesh_prior.mesh)
    sheet = path / SHEET
    console.print(f"{path}: {len(masks)} masks of {prior}; look at {sheet} before you use them")


def _check(path: Path) -> None:
    from mgs.data.check import check_dataset, taken_frames
    from mgs.data.dataset import load_dataset

    data = load_dataset(path)
    console = Terminal()
    with progress_bar("reading", console):
        check = check_dataset(data)
    camera, (low, high) = data.frames[0].camera, check.depth_range
    absent = len(data) - len(taken_frames(data))
    waiting = f" ({absent} of them on demand, not taken yet)" if absent else ""
    rock = f"{camera.width}x{camera.height}, rock on {check.mask_share:.0%} of the pixels"
    console.print(f"{path}: {len(data)} frames{waiting}, {rock}")
    if high > 0:
        through = f"neighbours see through {check.seen_through:.1%} of it"
        console.print(f"depth of the rock {low:.2f} to {high:.2f} m; {through}")
    if check.problems:
        for problem in check.problems:
            console.print(f"- {problem}", soft_wrap=True, highlight=False)
        raise InputError(f"{path}: {len(check.problems)} problem(s), listed above")
    console.print("no problems found")
