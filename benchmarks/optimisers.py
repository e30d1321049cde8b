"""How fast optimisers lower the objective: `python benchmarks/optimisers.py PREFIX DATASET:N
[DATASET:N ...]`.

Fits N Gaussians to 12 views of a dataset, spread evenly in azimuth, from the prior (cold), and goes
on from such a fit with one more view (warm). Every point is a fit of its own, since rates fall over
the length of a fit. Compared are the rows of `mgs.fit.optimisers.OPTIMISERS` and those of
`second_order.py`, which the fit does not have. Measured are the objective, PSNR inside the rock
over the dataset's test views, seconds, and work in passes: one is a render with gradients of every
view. The seconds of optimisers that the fit does not have are more than they would be there, where
a step is recorded once and replayed. Fits of fewer than 50,000 Gaussians are measured at more
lengths (the longest only with optimisers that the fit has). Writes PREFIX.json, and PREFIX_N.png
for each number of Gaussians; rows that PREFIX.json has are not measured again. Let nothing else
run.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import second_order

from mgs import runtime
from mgs.data.dataset import load_dataset, target_of
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.objective import Objective, objective
from mgs.fit.optimisers import INFORMATION_PASSES, OPTIMISERS
from mgs.fit.settings import RATES, TrainSettings
from mgs.gaussians import Gaussians
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.policy.criteria import regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.splat import ListCache, as_drjit, groups

VIEWS = 12
FIRST_RATES = {"colour": 0.02, "scale": 0.02, "rotation": 0.01, "opacity": 0.05}
"""Rates of the first version of mgs, whose optimiser was Adam."""
FAST_RATES = {kind: 2 * rate for kind, rate in RATES.items()}
"""The best that were found for Adam: at twice these it ends lower on the images fitted and worse on
the others."""
ROWS = {
    "Adam, first version's rates": ("adam", FIRST_RATES),
    "Adam, rates chosen for it": ("adam", FAST_RATES),
    "natural gradient": ("natural", RATES),
}
LENGTHS, LONG_LENGTHS, LM_STEPS = (5, 10, 20, 40), (100, 400), (5, 20)
"""Passes of the fits, those of small models only, and steps of Levenberg-Marquardt with large
models and with small ones."""
FOR_THE_END, FIRST_PASSES, LAST_STEPS, LAST_DAMPING = (
    "natural gradient, then Levenberg-Marquardt",
    40,
    5,
    1.0,
)
"""A row: a fit of so many passes by the natural gradient, and steps of Levenberg-Marquardt from
there on, hardly damped."""
LARGE = 50_000
"""Gaussians from which on a model is large."""
BY_LENGTH = {
    "natural gradient, steps cut as wholes": second_order.natural_cut_whole,
    "natural gradient, 11x11 blocks, steps cut as wholes": second_order.natural_by_blocks,
    "natural gradient, colours solved": second_order.natural_colours_solved,
}
BY_STEP = {
    "Levenberg-Marquardt, CG": {},
    "Levenberg-Marquardt, CG preconditioned by blocks": {"by_blocks": True},
    "Levenberg-Marquardt, CG, in opacity and scale squared": {"straighter": True},
}
"""Rows of `second_order.py`: those whose rates fall over the length of a fit; Levenberg-Marquardt,
as it is and changed."""


class _Case:
    """A dataset with the views to fit to, and those to judge by."""

    def __init__(self, root: Path, gaussians: int) -> None:
        self.dataset, self.cache, self.gaussians = load_dataset(root), ListCache(), gaussians
        tests = self.dataset.test_views()
        if tests is None:
            raise SystemExit(
                f"{root}: has no test views to judge by; make them with `mgs synth-orbit --test-views`"
            )
        self.tests = tests.frames
        prior, _ = build_prior(self.dataset, PriorSettings(gaussians=gaussians))
        positions = np.array([frame.camera.position for frame in self.dataset.frames])
        self.taken = seed_views(positions, prior.points.mean(0), VIEWS)
        self.added = [*self.taken, next(i for i in range(len(positions)) if i not in self.taken)]
        self.start = initial_gaussians(prior, [self.dataset.frames[i] for i in self.taken])[0]
        lam = regularisation(groups(0))
        self.lam = {kind: float(lam[c][0]) for kind, c in groups(0).items()}

    def images(self, views: list[int]) -> tuple[list[Any], list[np.ndarray]]:
        """Cameras and targets."""
        frames = [self.dataset.frames[i] for i in views]
        return [frame.camera for frame in frames], [target_of(frame) for frame in frames]

    def objective(self, views: list[int]) -> Objective:
        """What a fit to these views lowers."""
        return objective(self.start, *self.images(views), self.start, self.lam, self.cache)

    def fitted(
        self,
        model: Gaussians,
        views: list[int],
        optimiser: str,
        rates: dict[str, float],
        passes: int,
    ) -> Gaussians:
        """A fit of exactly so many passes."""
        train = TrainSettings(optimiser=optimiser, passes=passes, tolerance=0.0, rates=rates)
        return fit(
            model, *self.images(views), train, cache=self.cache, start=self.start, lam=self.lam
        ).gaussians

    def psnr(self, model: Gaussians) -> float:
        """PSNR inside the rock over the test views, dB."""
        found: float = evaluate(model, (), (), test_frames=self.tests)["test"]["psnr_inside"]
        return found


def study(case: _Case, done: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One record per fit: number of Gaussians, whether warm, which row, passes of work, seconds,
    objective, PSNR. Rows that are among the records that are done are left out."""
    records: list[dict[str, Any]] = []
    measured = {record["row"] for record in done if record["gaussians"] == case.gaussians}
    small = case.gaussians < LARGE
    lengths = LENGTHS + LONG_LENGTHS if small else LENGTHS

    def left(rows: dict[str, Any]) -> list[str]:
        return [row for row in rows if row not in measured]

    def record(
        begin: str, row: str, work: float, seconds: float, goal: Objective, model: Gaussians
    ) -> None:
        which = {
            "gaussians": case.gaussians,
            "start": begin,
            "row": row,
            "passes": work,
            "seconds": seconds,
        }
        records.append(which | {"phi": goal.phi(as_drjit(model)), "psnr_inside": case.psnr(model)})
        print(records[-1], flush=True)

    for (
        optimiser
    ) in OPTIMISERS:  # their kernels are compiled here, and the lists of both starts made
        case.fitted(case.start, case.added, optimiser, RATES, 1)
    before = case.fitted(case.start, case.taken, "natural", RATES, TrainSettings().passes)
    for begin, model, views in (("cold", case.start, case.taken), ("warm", before, case.added)):
        goal = case.objective(views)
        for row in left(ROWS):
            optimiser, rates = ROWS[row]
            for passes in lengths:
                began = time.perf_counter()
                found = case.fitted(model, views, optimiser, rates, passes)
                seconds = time.perf_counter() - began
                extra = (
                    -(-passes // INFORMATION_PASSES)
                    if OPTIMISERS[optimiser].uses_information
                    else 0
                )
                record(begin, row, passes + extra, seconds, goal, found)
        for row in left({FOR_THE_END: None}):
            began = time.perf_counter()
            near = as_drjit(case.fitted(model, views, "natural", RATES, FIRST_PASSES))
            first = time.perf_counter() - began
            extra = FIRST_PASSES + -(-FIRST_PASSES // INFORMATION_PASSES)
            for work, seconds, found in timed(
                second_order.levenberg_marquardt(goal, near, LAST_STEPS, damping=LAST_DAMPING)
            ):
                record(begin, row, extra + work, first + seconds, goal, found())
        for row in left(BY_LENGTH):
            for passes in lengths[:-1] if small else lengths:
                *_, (work, seconds, found) = timed(BY_LENGTH[row](goal, as_drjit(model), passes))
                record(begin, row, work, seconds, goal, found())
        for row in left(BY_STEP):
            steps = second_order.levenberg_marquardt(
                goal, as_drjit(model), LM_STEPS[small], **BY_STEP[row]
            )
            for work, seconds, found in timed(steps):
                record(begin, row, work, seconds, goal, found())
    return records


def timed(
    steps: Iterator[tuple[float, Gaussians]],
) -> Iterator[tuple[float, float, Callable[[], Gaussians]]]:
    """Work, seconds spent in the steps themselves, and what gives the model with NumPy fields,
    after each step."""
    seconds, began = 0.0, time.perf_counter()
    for work, model in steps:
        seconds += time.perf_counter() - began
        yield (
            work,
            seconds,
            lambda model=model: Gaussians(
                *(np.array(getattr(model, f.name)) for f in fields(model))
            ),
        )
        began = time.perf_counter()  # judging took time that is not the optimiser's


def draw(path: Path, records: list[dict[str, Any]]) -> None:
    """Objective and PSNR against passes and against seconds, cold above, warm below."""
    import matplotlib
    from matplotlib.ticker import NullFormatter

    colours = (
        "#D55E00",
        "#E69F00",
        "#0072B2",
        "#56B4E9",
        "#7755DD",
        "#CC79A7",
        "#009E73",
        "#000000",
        "#888888",
        "#770000",
    )
    columns = [
        ("passes", "phi"),
        ("seconds", "phi"),
        ("passes", "psnr_inside"),
        ("seconds", "psnr_inside"),
    ]
    names = {
        "passes": "work (passes)",
        "seconds": "seconds",
        "phi": "objective",
        "psnr_inside": "PSNR inside, test views (dB)",
    }
    with matplotlib.rc_context(STYLE):
        figure = new_figure(10.4, 5.8)
        axes = figure.subplots(2, 4, sharex="col")
        for line, begin in zip(axes, ("cold", "warm"), strict=True):
            for axis, (x, y) in zip(line, columns, strict=True):
                for row, colour in zip(
                    dict.fromkeys(r["row"] for r in records), colours, strict=True
                ):
                    shown = [r for r in records if (r["start"], r["row"]) == (begin, row)]
                    axis.plot(
                        [r[x] for r in shown],
                        [r[y] for r in shown],
                        "o-",
                        color=colour,
                        markersize=3,
                        label=row,
                    )
                axis.set(
                    xscale="log",
                    yscale="log" if y == "phi" else "linear",
                    ylabel=f"{names[y]}, {begin}",
                )
                most = max(r[x] for r in records)
                axis.set_xticks(
                    [
                        tick
                        for tick in (1, 2, 5, 10, 20, 40, 100, 400)
                        if min(r[x] for r in records) <= tick <= most
                    ]
                )
                axis.xaxis.set_major_formatter("{x:g}")
                axis.xaxis.set_minor_formatter(NullFormatter())
                if y == "phi":
                    axis.yaxis.set_major_formatter("{x:.0f}")
                    axis.yaxis.set_minor_formatter("{x:.0f}")
        for axis, (x, _) in zip(axes[1], columns, strict=True):
            axis.set(xlabel=names[x])
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        save_figure(figure, path)


def main(prefix: Path, given: list[str]) -> None:
    """Measure, write, draw."""
    runtime.start()
    path = prefix.with_suffix(".json")
    records: list[dict[str, Any]] = (
        json.loads(path.read_text())["records"] if path.is_file() else []
    )
    for root, gaussians in (case.rsplit(":", 1) for case in given):
        records += study(_Case(Path(root), int(gaussians)), records)
        draw(
            prefix.with_name(f"{prefix.name}_{gaussians}.png"),
            [r for r in records if r["gaussians"] == int(gaussians)],
        )
        made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
        write_json(path, made | {"records": records})


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
