"""What an experiment is: cells of work, claims about their rows, and panels of a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mgs.study.stress.lab import Preset, scene_cell
from mgs.study.stress.verdict import Claim, Row
from mgs.study.sweep import Cell


@dataclass(frozen=True)
class Panel:
    """One plot of an experiment's rows: the mean of column y over runs, with its 95 % interval,
    against column x.

    by: column whose values are lines of their own. log: whether x is logarithmic. Where x is text,
    each value has a bar. only: entries that a row must have to count; it must have the columns too.
    """

    x: str
    y: str
    x_label: str
    y_label: str
    by: str | None = None
    log: bool = False
    only: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class Experiment:
    """A question about where the method fails. cells(preset): the work; the result of each holds
    "rows", a list of records with a `run` each. derived(rows): more rows, for the picture alone."""

    question: str
    cells: Callable[[Preset], list[Cell]]
    claims: Sequence[Claim]
    panels: Sequence[Panel]
    derived: Callable[[Sequence[Row]], list[Row]] | None = None
    data: Callable[[Preset], list[Cell]] = lambda preset: []


def cells_per_rock(
    name: str, task: str, arguments: Callable[[Preset], dict[str, Any]]
) -> Callable[[Preset], list[Cell]]:
    """The usual cells: one for each of the preset's rocks, named EXPERIMENT/SCENE, which needs the
    cell of its dataset."""

    def cells(preset: Preset) -> list[Cell]:
        return [rock_cell(name, task, preset, *rock, **arguments(preset)) for rock in preset.rocks]

    return cells


def rock_cell(
    name: str, task: str, preset: Preset, scene: str, seed: int, **arguments: Any
) -> Cell:
    """One such cell; the task is told the scene's name and seed as `scene`."""
    data = scene_cell(preset, scene, seed)
    return Cell(
        f"{name}/{scene}-{seed}", task, {"scene": f"{scene}-{seed}", **arguments}, (data.name,)
    )


def turns(count: int) -> list[tuple[str, float]]:
    """Sets of views of one rock: a suffix for the name of the run, and by which share of their
    spacing they are turned."""
    return [(f"turn {k}", k / count) for k in range(count)]
