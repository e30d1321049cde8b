"""An oracle that sees the truth: at every step it takes the view whose fit is best on the test
views. It reads the images of all candidates, so it is no policy. It is greedy, so better choices
may exist."""

from argparse import Namespace
from dataclasses import replace

import numpy as np

import mgs
from mgs.evaluation import psnr_measure
from mgs.learning import fit_views
from studies import setups
from studies.frame.program import study_of


class Oracle:
    """Policy that fits to every candidate; its score is the mean PSNR over the test views, dB."""

    name, needs_fit = "oracle", True

    def __init__(self, tests: mgs.Dataset) -> None:
        self.measure = psnr_measure(tests, mgs.ListCache())

    def __call__(self, scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
        fits = (fit_views(scene, state.frames, (*state.taken, view), state)[0] for view in views)
        return np.array([self.measure(fit.gaussians, [])["psnr"] for fit in fits])


def sized(size: setups.SetupSize, options: Namespace) -> setups.SetupSize:
    """As in the set-ups, with two rocks by default."""
    return setups.sized(replace(size, count=2), options)


STUDY = replace(
    setups.STUDY,
    name="oracle",
    about="Compare policies as `setups` does, with an oracle that chooses the view which raises "
    "the PSNR of the test views most: an upper bound for policies, which cannot see test views.",
    cells=lambda size: [*setups.cells_of(size), *setups.cells_of(size, (setups.ORACLE,))],
    sized=sized,
)

if __name__ == "__main__":
    study_of("oracle")()
