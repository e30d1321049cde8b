"""Small rocks for the experiments, each made once, and the operations that experiments share."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mgs.camera import Camera
from mgs.data.dataset import Dataset, load_dataset, target_of
from mgs.data.frames import Frame
from mgs.fit.fitting import Fit, fit_gaussians
from mgs.fit.settings import MEAN_RATE, PASSES, RATES, TrainSettings
from mgs.gaussians import Gaussians
from mgs.policy.criteria import MEAN_STD, PRIOR_STD, Score, d_optimal, lam_by_kind, regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import Prior, load_prior
from mgs.prior.initial import initial_gaussians, pixel_on
from mgs.splat import ListCache, fisher, groups
from studies.case import Case, Rock, Size, judge
from studies.output import Panel
from studies.sweep import Cell
from studies.verdict import Claim

Array = NDArray[np.floating]

CACHE = 1 << 28
"""Budget of the block lists of one lab, bytes."""


@dataclass(frozen=True)
class StressSize:
    """Size of all experiments.

    images: of every dataset. gaussians: of each prior. rocks: (scene, seed) of all experiments.
    others: more of them, for some experiments. turns: sets of views of a rock, turned against one
    another. repeats: draws of each random fault. few_views: numbers of views with free means.
    passes: lengths of fits.
    """

    images: Size
    gaussians: int
    rocks: tuple[tuple[str, int], ...]
    others: tuple[tuple[str, int], ...]
    turns: int
    repeats: int
    few_views: tuple[int, ...]
    passes: tuple[int, ...]

    def case(self, scene: str, seed: int) -> Case:
        """Case of a rock."""
        return Case(Rock(scene, seed), self.images, {"gaussians": self.gaussians, "seed": seed})


SIZES = {
    "quick": StressSize(
        images=Size(160, 120, 24, 8),
        gaussians=3000,
        rocks=(("boulder", 0), ("boulder", 1)),
        others=(("contact-binary", 0), ("low-sun", 0)),
        turns=2,
        repeats=1,
        few_views=(2, 4, 8),
        passes=(1, 2, 5, 10, 20, 60, 120),
    ),
    "full": StressSize(
        images=Size(320, 240, 32, 12),
        gaussians=10_000,
        rocks=(*(("boulder", seed) for seed in range(5)), ("strata", 0), ("strata", 1)),
        others=tuple(
            (s, seed) for s in ("contact-binary", "low-sun", "pebbles") for seed in range(3)
        ),
        turns=3,
        repeats=3,
        few_views=(2, 3, 4, 6, 8),
        passes=(1, 2, 5, 10, 20, 40, 80, 160, 320, 640),
    ),
}


@dataclass(frozen=True)
class Experiment:
    """A question about where the method fails.

    cells(size): the work; results may have "rows", records with the `run` they belong to.
    """

    question: str
    cells: Callable[[StressSize], list[Cell]]
    claims: Sequence[Claim]
    panels: Sequence[Panel]


def rock_cell(
    name: str, task: str, size: StressSize, rock: tuple[str, int], **more: Any
) -> list[Cell]:
    """Cells of a task on one rock: those of its case, and NAME/SCENE-SEED. The task is called with
    scene="SCENE-SEED", dataset and prior."""
    label = f"{rock[0]}-{rock[1]}"
    return size.case(*rock).with_task(f"{name}/{label}", task, scene=label, **more)


def cells_per_rock(
    name: str, task: str, arguments: Callable[[StressSize], dict[str, Any]]
) -> Callable[[StressSize], list[Cell]]:
    """`rock_cell` for each rock of a size."""
    return lambda size: [
        cell for rock in size.rocks for cell in rock_cell(name, task, size, rock, **arguments(size))
    ]


def turns(count: int) -> list[tuple[str, float]]:
    """Names of sets of views, and the share of their spacing by which each is turned."""
    return [(f"turn {k}", k / count) for k in range(count)]


@dataclass(frozen=True)
class Lab:
    """A rock to experiment on: frames, a prior, and a dataset whose test views judge models."""

    frames: tuple[Frame, ...]
    prior: Prior
    dataset: Dataset
    cache: ListCache = field(default_factory=lambda: ListCache(CACHE))

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of all frames."""
        return [frame.camera for frame in self.frames]

    def changed(self, **fields: Any) -> Lab:
        """Copy with other frames or another prior, and a cache of its own."""
        return replace(self, cache=ListCache(CACHE), **fields)

    def even(self, count: int, turn: float = 0.0) -> list[int]:
        """Views at evenly spaced azimuths. turn: share of the spacing by which they are turned."""
        angle = -2 * np.pi * turn / count
        c, s = np.cos(angle), np.sin(angle)
        about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        centre = self.prior.points.mean(0)
        positions = np.array([camera.position for camera in self.cameras])
        return seed_views((positions - centre) @ about_z.T, np.zeros(3), count)

    def left(self, taken: Sequence[int]) -> list[int]:
        """Frames that are not taken."""
        return [i for i in range(len(self.frames)) if i not in taken]

    def start(self, taken: Sequence[int]) -> Gaussians:
        """Gaussians before training, in the colours of the views taken."""
        pixel = pixel_on(self.prior, self.cameras)
        return initial_gaussians(self.prior, [self.frames[i] for i in taken], pixel, linear=False)[
            0
        ]

    def lam(self, means: str = "frozen") -> Array:
        """Lambda of each column of the information [P], with the default settings of `mgs nbv`."""
        stds = PRIOR_STD | {"mean": MEAN_STD * self.prior.spacing}
        return regularisation(groups(0, means), prior_std=stds)

    def fit(
        self,
        taken: Sequence[int],
        passes: int = PASSES,
        means: str = "frozen",
        with_prior: bool = True,
        model: Gaussians | None = None,
        start: Gaussians | None = None,
    ) -> Fit:
        """Fit of exactly so many passes, otherwise with the default settings of `mgs nbv`.

        with_prior: lambda holds the parameters near `start`. model: initial values. Both are the
        Gaussians before training by default.
        """
        start = self.start(taken) if start is None else start
        rates = RATES | {"mean": MEAN_RATE * self.prior.spacing}
        settings = TrainSettings(passes=passes, tolerance=0.0, means=means, rates=rates)  # type: ignore[arg-type]
        lam = lam_by_kind(self.lam(means), groups(0, means)) if with_prior else None
        frames = [self.frames[i] for i in taken]
        return fit_gaussians(
            start if model is None else model,
            [frame.camera for frame in frames],
            [target_of(frame) for frame in frames],
            settings,
            None,
            self.cache,
            start,
            lam,
        )

    def information(
        self, model: Gaussians, views: Sequence[int], means: str = "frozen"
    ) -> list[Array]:
        """Exact Fisher information [N,P] of each of some views."""
        found = (fisher(model, self.cameras[i], cache=self.cache, means=means) for i in views)
        return [F.astype(np.float64) for F in found]

    def scores(
        self,
        model: Gaussians,
        taken: Sequence[int],
        left: Sequence[int],
        score: Score = d_optimal,
        means: str = "frozen",
    ) -> Array:
        """Score of each view left by a criterion."""
        H, lam = np.sum(self.information(model, taken, means), axis=0), self.lam(means)
        return np.array([score(F, H, lam) for F in self.information(model, left, means)])

    def quality(self, model: Gaussians) -> dict[str, float]:
        """PSNR on the test views, dB: of whole images (psnr), and inside the rock (psnr_mask)."""
        found = judge(model, self.dataset)
        return {"psnr": found["psnr"], "psnr_mask": found["psnr_mask"]}


@functools.lru_cache(maxsize=2)
def open_lab(dataset: Path, prior: Path) -> Lab:
    """Lab of a dataset and a prior."""
    loaded = load_dataset(dataset)
    return Lab(loaded.frames, load_prior(prior), loaded)
