"""The paper's claim that free positions collapse on few images, with 3DGS from random points.

`python benchmarks/sparse_start.py OUT` fits the hemispheres of `mgs reproduce --only setups`: to 4
images, and 8 more chosen by `d-optimal`. Frozen and free means from the mesh; free means from as
many random points in the box that the cameras see.
"""

import sys
from pathlib import Path

import numpy as np

import mgs
from mgs import runtime

runtime.start()

from mgs.files import read_json  # noqa: E402
from mgs.study.reproduce import SIZES  # noqa: E402
from mgs.study.rocks import FRESH  # noqa: E402
from mgs.study.setups import SETUPS, case_of  # noqa: E402
from mgs.study.sweep import run_cells  # noqa: E402

MODELS = {
    "frozen, mesh": {},
    "free, mesh": {"means": "free"},
    "free, random points": {"means": "free"},
}
"""Settings of the fits by name."""


def main(out: Path, rocks: int) -> None:
    """Run all models that are not done; print mean PSNR and masked PSNR on test views, dB."""
    found: dict[tuple[str, int], list[list[float]]] = {}
    for rock in FRESH[:rocks]:
        case = case_of(rock, SETUPS["hemisphere"], SIZES["quick"].setups)
        run_cells(out, case.cells(), lambda cell, done, total: print(cell, flush=True))
        data, mesh = mgs.load_dataset(out / case.dataset), mgs.load_prior(out / case.prior)
        count = len(mesh.points) + mesh.backed
        points = mgs.build_prior(data, source="random", gaussians=count)
        for model, train in MODELS.items():
            for budget in (0, 8):
                run = (
                    out
                    / "sparse"
                    / f"{rock.name}-{model.replace(', ', '-').replace(' ', '-')}-{budget}"
                )
                if not (run / "metrics.json").is_file():
                    prior = points if "points" in model else mesh
                    given = {
                        "prior": prior,
                        "policy": "d-optimal",
                        "budget": budget,
                        "train": train,
                    }
                    mgs.evaluate(mgs.run_nbv(data, run, **given))
                test = read_json(run / "metrics.json")["test"]
                numbers = [test["psnr"], test["psnr_mask"]]
                found.setdefault((model, 4 + budget), []).append(numbers)
                print(rock.name, model, 4 + budget, np.round(numbers, 2), flush=True)
    for (model, images), numbers in found.items():
        print(f"| {model} | {images} | {' | '.join(f'{x:.2f}' for x in np.mean(numbers, 0))} |")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 4)
