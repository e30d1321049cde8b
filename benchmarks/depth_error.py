"""How deep into the rock a fitted model is seen: `python benchmarks/depth_error.py OUT.json
RUN...`.

The runs are on a dataset with exact depth images. Over the rock's pixels of all views: the shares
whose expected z-depth lies more than 5 and 20 cm behind the true one, and whose opacity is below
0.9, for the Gaussians before training and for the model of each run.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mgs import runtime
from mgs.data.dataset import Frame
from mgs.files import write_json
from mgs.gaussians import Gaussians

TOO_DEEP = (0.05, 0.20)
"""Metres."""
OPAQUE = 0.9


def shares(gaussians: Gaussians, frames: Sequence[Frame]) -> list[float]:
    """Of the rock's pixels that have depth: shares too deep by TOO_DEEP, and of less than
    OPAQUE."""
    from mgs.splat import ListCache, render

    cache, rows = ListCache(), []
    for frame in frames:
        image, rock = (
            render(gaussians, frame.camera, cache=cache),
            frame.mask() & (frame.depth() > 0),
        )
        behind = (np.asarray(image.depth) - frame.depth())[rock]
        rows.append(
            np.stack(
                [*(behind > limit for limit in TOO_DEEP), np.asarray(image.alpha)[rock] < OPAQUE], 1
            )
        )
    return np.concatenate(rows).mean(0).tolist()


def main(out: Path, runs: list[Path]) -> None:
    """Print a line for the start, and one a run; write them."""
    runtime.start()
    from mgs.prior.build import load_prior
    from mgs.prior.initial import initial_gaussians
    from mgs.provenance import command_line, versions
    from mgs.run import folder as run_folder
    from mgs.run.folder import load_run

    heading = [*(f"> {100 * limit:.0f} cm deep" for limit in TOO_DEEP), f"opacity < {OPAQUE}"]
    print(f"{'':30}" + "".join(f"{text:>16}" for text in heading))
    found = {}
    for run in runs:
        gaussians, dataset, trained, policy = load_run(run)
        settings, state = run_folder.read_settings(run), run_folder.read_checkpoint(run)
        seeds = [dataset.frames[i] for i in state.steps[0]["seeds"]]
        models = {f"{policy}, {len(trained)} images": gaussians}
        if run == runs[0]:
            models = {
                "before training": initial_gaussians(load_prior(settings.prior), seeds)[0]
            } | models
        for name, model in models.items():
            found[name] = shares(model, dataset.frames)
            print(f"{name:30}" + "".join(f"{share:16.1%}" for share in found[name]))
    limits = {"too_deep": TOO_DEEP, "opaque": OPAQUE}
    write_json(out, {"command": command_line(), **limits, "shares": found, "versions": versions()})


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(argument) for argument in sys.argv[2:]])
