"""An oracle that looks at the truth: at every step the view whose fit is best on the test views.
What there is to be won.

It is no policy: it reads the images of all candidates, and of the test views. It is greedy, so
another choice could be better still.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mgs.data.dataset import Dataset, load_dataset
from mgs.fit.settings import COLOURS_ALONE
from mgs.prior.build import load_prior
from mgs.run.folder import State, read_checkpoint, read_settings, write_checkpoint
from mgs.run.loop import Loop, Progress, Stations
from mgs.run.nbv import start_run
from mgs.run.settings import NbvSettings
from mgs.run.stations import psnr_measure, real_stations
from mgs.splat import ListCache
from mgs.study.case import CURVES, test_views_of


class Oracle(Loop):
    """The loop, in which the choice is made by fitting every candidate in reach and looking at the
    test views."""

    def __init__(
        self,
        out: Path,
        settings: NbvSettings,
        dataset: Dataset,
        tests: Dataset,
        stations: Stations,
        progress: Progress,
    ) -> None:
        super().__init__(out, settings, dataset, stations, progress)
        self.judge = psnr_measure(tests, ListCache())

    def choose(self, state: State) -> tuple[int, float]:
        """The frame whose fit has the highest mean PSNR over the test views, and that PSNR in dB;
        of equals the first."""
        left = self.reachable(state)
        worth = [self.worth(state, frame) for frame in left]
        best = max(range(len(left)), key=lambda k: worth[k])
        return left[best], worth[best]

    def worth(self, state: State, frame: int) -> float:
        """Mean PSNR over the test views, dB, of the very fit that the loop does once it takes this
        frame."""
        taken = [*state.taken, frame]
        fit = self.fit(state, taken, self.targets(taken), len(state.steps), lambda done, most: None)
        return self.judge(fit.gaussians, [])["psnr"]


def run_oracle(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """A task, as `mgs.study.case.run_policy` with the same result. settings: without a policy.
    Goes on where it stopped."""
    run = out / "run"
    if not (run / "config.json").is_file():
        where = root / prior
        given = {
            "policy": "random",
            "evaluate_every": 1,
            **settings,
            "train": {**COLOURS_ALONE, **settings.get("train", {})},
        }
        start_run(root / dataset, run, prior=where, **given)
    state = choose_all(run)
    return {key: [step[key] for step in state.steps] for key in CURVES} | {"taken": state.taken}


def choose_all(run: Path) -> State:
    """Run or resume the oracle in a run folder to the end of its budget. Raises InputError if there
    are no test views."""
    settings = read_settings(run)
    loaded = load_dataset(settings.dataset)
    tests = test_views_of(loaded)
    stations = real_stations(loaded, load_prior(settings.prior), settings)
    oracle = Oracle(run, settings, loaded, tests, stations, lambda stage, done, total: None)
    state = oracle.marked(read_checkpoint(run) or oracle.first())
    write_checkpoint(run, state)
    while "ended" not in state.steps[-1]:
        state = oracle.next(state)
        write_checkpoint(run, state)
    return state
