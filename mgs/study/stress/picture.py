"""The picture of an experiment: one plot for each of its panels."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.plotting import STYLE, new_figure, save_figure
from mgs.report.figures import POLICY_STYLE
from mgs.study.statistics import interval
from mgs.study.stress.experiment import Experiment, Panel
from mgs.study.stress.verdict import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    Drawn = list[tuple[Panel, list[Row]]]

WIDTH, HEIGHT, PER_NAME = 2.7, 2.7, 0.17
"""Of a plot against numbers, and height of each name in a plot against names; inches."""
PANELS, NAMES = 3, 12
"""Most plots in a row, and most names in a plot that stands beside plots against numbers."""


def draw_experiment(path: Path, experiment: Experiment, rows: Sequence[Row]) -> None:
    """Draw all panels that have rows: those against numbers side by side, those against names
    beside or below them.

    Raises InputError if the file cannot be written."""
    import matplotlib

    rows = [*rows, *(experiment.derived(rows) if experiment.derived else ())]
    drawn = [(panel, of_it) for panel in experiment.panels if (of_it := _of(panel, rows))]
    with matplotlib.rc_context(STYLE):
        bands = _bands(drawn)
        widths = [[_width(panel, of_it) for panel, of_it in band] for band in bands]
        heights = [_height(band) for band in bands]
        figure = new_figure(max(sum(of_band) for of_band in widths), sum(heights))
        parts = figure.subfigures(len(bands), 1, squeeze=False, height_ratios=heights)[:, 0]
        for part, band, of_band in zip(parts, bands, widths, strict=True):
            axes = part.subplots(
                1, len(band), squeeze=False, gridspec_kw={"width_ratios": of_band}
            )[0]
            for axis, (panel, of_it) in zip(axes, band, strict=True):
                (_draw_lines if _numeric(panel, of_it) else _draw_names)(axis, panel, of_it)
                if panel.by:
                    axis.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
        save_figure(figure, path)


def _bands(drawn: Drawn) -> list[Drawn]:
    """Rows of panels from top to bottom."""
    lines = [(panel, of_it) for panel, of_it in drawn if _numeric(panel, of_it)]
    names = [(panel, of_it) for panel, of_it in drawn if not _numeric(panel, of_it)]
    if len(drawn) <= PANELS and all(
        len({row[panel.x] for row in of_it}) <= NAMES for panel, of_it in names
    ):
        return [lines + names]
    return [band for band in (lines, names) if band]


def _of(panel: Panel, rows: Sequence[Row]) -> list[Row]:
    named = {panel.x, panel.y, panel.by or panel.x}
    return [r for r in rows if named <= r.keys() and all(r.get(k) == v for k, v in panel.only)]


def _numeric(panel: Panel, rows: Sequence[Row]) -> bool:
    return not isinstance(rows[0][panel.x], str)


def _width(panel: Panel, rows: Sequence[Row]) -> float:
    """Inches; the letters of a name are about 0.06 inches wide."""
    return (
        WIDTH
        if _numeric(panel, rows)
        else WIDTH - 0.4 + 0.06 * max(len(row[panel.x]) for row in rows)
    )


def _height(band: Drawn) -> float:
    """Inches: of the plots, and of a legend above them."""
    heights = [
        HEIGHT if _numeric(panel, of_it) else _height_of_names(panel, of_it)
        for panel, of_it in band
    ]
    legend = max((len(_groups(panel, of_it)) + 1) // 2 if panel.by else 0 for panel, of_it in band)
    return max(heights) + 0.17 * legend


def _height_of_names(panel: Panel, rows: Sequence[Row]) -> float:
    names, groups = len({row[panel.x] for row in rows}), len(_groups(panel, rows))
    return 0.8 + PER_NAME * names * max(1.0, 0.7 * groups)


def _groups(panel: Panel, rows: Sequence[Row]) -> list[Any]:
    return list(dict.fromkeys(row[panel.by] for row in rows)) if panel.by else [None]


def _styles(groups: Sequence[Any]) -> list[dict[str, Any]]:
    """How to draw each group, keywords for matplotlib: policies as in all figures, others in the
    order of the same table."""
    of_policies = all(group in POLICY_STYLE for group in groups)
    table = (
        [POLICY_STYLE[group] for group in groups] if of_policies else cycle(POLICY_STYLE.values())
    )
    return [
        {"color": c, "marker": m, "label": group}
        for group, (c, m) in zip(groups, table, strict=False)
    ]


def _points(panel: Panel, rows: Sequence[Row], group: Any) -> tuple[list[Any], np.ndarray]:
    """Values of x, and for each of them the mean of y and its interval, [3,X]: mean, low, high."""
    of_group = [row for row in rows if panel.by is None or row[panel.by] == group]
    xs = list(dict.fromkeys(row[panel.x] for row in of_group))
    found = []
    for x in xs:
        values = [float(row[panel.y]) for row in of_group if row[panel.x] == x]
        mean = float(np.mean(values))
        found.append((mean, *(interval(values) or (mean, mean))))
    return xs, np.array(found).T


def _draw_lines(axis: Axes, panel: Panel, rows: Sequence[Row]) -> None:
    """Lines through the means, with their intervals as bands, against a number."""
    groups = _groups(panel, rows)
    crowded = len({row[panel.x] for row in rows}) > 30
    for group, style in zip(groups, _styles(groups), strict=True):
        xs, (mean, low, high) = _points(panel, rows, group)
        order = np.argsort(xs)
        x = np.asarray(xs, float)[order]
        axis.plot(x, mean[order], **(style | {"marker": ""} if crowded else style))
        axis.fill_between(x, low[order], high[order], color=style["color"], alpha=0.15, linewidth=0)
    if panel.log:
        axis.set_xscale("log")
        values = sorted({float(row[panel.x]) for row in rows})
        if len(values) < 8 and max(values) < 1e4 and min(values) > 1e-3:
            axis.set_xticks(values, [f"{value:.3g}" for value in values])
            axis.minorticks_off()
    axis.set(xlabel=panel.x_label, ylabel=textwrap.fill(panel.y_label, 31))


def _draw_names(axis: Axes, panel: Panel, rows: Sequence[Row]) -> None:
    """A line of its own for each name, from top to bottom: the mean as a point, its interval as a
    bar through it."""
    groups = _groups(panel, rows)
    names = list(dict.fromkeys(row[panel.x] for row in rows))
    for k, (group, style) in enumerate(zip(groups, _styles(groups), strict=True)):
        found, (mean, low, high) = _points(panel, rows, group)
        place = np.array([names.index(name) for name in found]) + (
            k - (len(groups) - 1) / 2
        ) * 0.6 / len(groups)
        axis.errorbar(
            mean,
            place,
            xerr=np.abs([mean - low, high - mean]),
            capsize=2,
            **(style | {"linestyle": "none"}),
        )
    axis.set_ylim(len(names) - 0.4, -0.6)
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.tick_params(axis="y", length=0)
    if all(0 <= float(row[panel.y]) <= 1 for row in rows):  # a share: zero belongs to its scale
        axis.update_datalim([(0.0, 0.0)])
    axis.margins(x=0.08)
    axis.autoscale(axis="x")
    axis.set(
        xlabel=textwrap.fill(panel.y_label, 40),
        ylabel=textwrap.fill(panel.x_label, 12 + len(names)),
    )
