"""What the charts measure, by the name of a preset: sizes of the data, and the values that each
factor takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mgs.study.sweep import Cell

KINDS = ("fit", "scoring", "core", "bytes", "presets")
"""The charts; "presets" is a table: `mgs nbv --preset` on scenes that the other charts do not
use."""


@dataclass(frozen=True)
class Plan:
    """width, height: of the images, pixels; half of them for "half". frames, test_views: of the
    data. images: how many are fitted, of which `seeds` at evenly spaced azimuths. repeats: how
    often a point is timed, if it is not said. The others are values of factors; run_passes: of the
    first fit of runs."""

    width: int
    height: int
    frames: int
    test_views: int
    seeds: int
    images: int
    repeats: int
    densities: tuple[float, ...]
    passes: tuple[int, ...]
    run_passes: tuple[int, ...]
    image_counts: tuple[int, ...]
    policies: tuple[str, ...]
    probes: tuple[int, ...]
    core_gaussians: int
    core_size: tuple[int, int]
    step_sizes: tuple[float, ...]


PLANS = {
    "quick": Plan(
        width=192, height=144, frames=24, test_views=8, seeds=4, images=8, repeats=2,
        densities=(1 / 8, 1 / 4, 1 / 2, 3 / 4), passes=(5, 10, 20), run_passes=(5, 10), image_counts=(4, 12),
        policies=("directional-i", "random"), probes=(1, 4),
        core_gaussians=10_000, core_size=(320, 240), step_sizes=(0.5, 1, 2, 4, 8),
    ),
    "full": Plan(
        width=320, height=240, frames=32, test_views=12, seeds=4, images=12, repeats=3,
        densities=(1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4), passes=(2, 5, 10, 20, 40), run_passes=(5, 10, 20),
        image_counts=(4, 6, 8, 16, 24),
        policies=("directional-i", "directional-d", "fisherrf", "uniform", "farthest", "random", "paper"),
        probes=(1, 2, 4, 8, 16, 32, 64), core_gaussians=100_000, core_size=(640, 480),
        step_sizes=(0.125, 0.25, 0.5, 1, 2, 4, 8, 16),
    ),
}  # fmt: skip
"""`quick` takes nine to eleven minutes on two quiet cores, `full` some hours."""

DENSITY = 1 / 8
"""Density of the prior of the default point (`mgs.prior.settings.PriorSettings`): about what `mgs
demo` has."""

SCENE = "boulder"
"""The scene of the charts."""

OTHER_SCENES = ("strata", "low-sun")
"""The scenes on which the presets are judged. On SCENE, contact-binary and pebbles they were
chosen."""


@dataclass(frozen=True)
class Data:
    """A dataset and its priors as cells. folder: of the dataset, below the study's folder or
    anywhere; cells: that make it."""

    label: str
    folder: str
    cells: tuple[Cell, ...] = ()

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(cell.name for cell in self.cells)

    def prior(self, density: float) -> Cell:
        """The cell of a prior of this density; its name has the pixels for each sample."""
        arguments = {"dataset": self.folder, "density": density}
        return Cell(
            f"prior/{self.label}-{1 / density:g}",
            "mgs.study.chart.subject:make_prior",
            arguments,
            self.needs,
        )


def synthetic(plan: Plan, scene: str, half: bool = False) -> Data:
    """The data of a scene, rendered by mgs; half: with images of half the width and height."""
    label = f"{scene}-half" if half else scene
    arguments = {
        "scene": scene, "width": plan.width // (1 + half), "height": plan.height // (1 + half), "frames": plan.frames,
        "test_views": 0 if half else plan.test_views,
    }  # fmt: skip
    cell = Cell(f"dataset/{label}", "mgs.study.chart.subject:make_dataset", arguments)
    return Data(label, f"cells/dataset/{label}/data", (cell,))


def own(dataset: Path) -> Data:
    """A dataset that is there already."""
    return Data(dataset.name, str(dataset.resolve()))
