"""Fits of 12 evenly spread views, antialiased or as in 3DGS, by the depth of the Gaussians below
the surface: `python benchmarks/antialiasing.py DATASET...`.

Made by `mgs synth-orbit boulder --scene boulder --orbit hemisphere --distances 1,2,3 --frames 60
--size 160x120 --test-views 16 --random-seed 1`, contact-binary likewise, and strata with `--orbit
circle` and no distances. A cell has PSNR on the test views in the full frame and inside the rock
(dB), and the median depth error (mm).
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import mgs
from mgs.prior import initial


def main(roots: list[str]) -> None:
    for root in roots:
        dataset = mgs.load_dataset(root)
        prior = mgs.build_prior(dataset)
        for antialiased in (False, True):
            for inset in (0.0, 0.3, 0.5, 0.6, 0.8):
                initial.INSET[antialiased] = inset
                with TemporaryDirectory() as folder:
                    train = {"antialiased": antialiased}
                    given = {"prior": prior, "seeds": 12, "budget": 0, "train": train}
                    run = mgs.run_nbv(dataset, Path(folder) / "run", **given)
                    test = mgs.evaluate_run(run)["test"]
                cell = f"{test['psnr']:.2f}, {test['psnr_mask']:.2f}"
                depth = f"{1000 * test['depth_error']:.0f}"
                how = "antialiased" if antialiased else "as 3DGS"
                print(Path(root).name, how, inset, cell, depth, flush=True)


main(sys.argv[1:])
