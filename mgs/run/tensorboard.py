"""TensorBoard log of a run, an observer of the loop."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.data.dataset import Dataset
from mgs.run.state import Checkpoint

SCALARS = ("score", "information_gain", "coverage", "uncertainty", "residual", "loss")
"""Keys of steps.jsonl that are logged, with every PSNR."""


def tensorboard(folder: str | Path, dataset: Dataset | None = None) -> Callable[[Checkpoint], None]:
    """Make a callback for `on_step` that logs each new step to a TensorBoard folder.

    It logs SCALARS and every PSNR (dB) against the number of images, and, of a dataset, the truth
    and the render of the newest view. Needs the package tensorboardX.
    """
    from tensorboardX import SummaryWriter

    writer, known = SummaryWriter(str(folder), flush_secs=10), 0

    def on_step(state: Checkpoint) -> None:
        nonlocal known
        for line in state.steps[known:]:
            for key, value in line.items():
                if value is not None and (key in SCALARS or "psnr" in key):
                    writer.add_scalar(key, value, line["images"])
        if dataset is not None and len(state.steps) > known:
            from mgs.splat import render

            newest, images = dataset.frames[state.taken[-1]], len(state.taken)
            drawn = np.asarray(render(state.gaussians, newest.camera).rgb)
            for name, rgb in (("truth", newest.masked_rgb()), ("render", drawn)):
                picture = srgb_from_linear(np.clip(rgb, 0, 1))
                writer.add_image(f"newest_view/{name}", picture, images, dataformats="HWC")
        known = len(state.steps)
        writer.flush()

    return on_step
