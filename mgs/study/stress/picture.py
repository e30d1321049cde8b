"""The picture of an experiment: one plot for each of its panels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.plotting import STYLE, new_figure
from mgs.study.stress.experiment import Experiment, Panel
from mgs.study.stress.verdict import Row, interval

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def experiment_figure(experiment: Experiment, rows: Sequence[Row]) -> Figure:
    """All panels side by side; a panel whose x is text is as wide as its bars need."""
    import matplotlib as mpl

    rows = [*rows, *(experiment.derived(rows) if experiment.derived else ())]
    drawn = [(panel, _of(panel, rows)) for panel in experiment.panels]
    drawn = [(panel, of_it) for panel, of_it in drawn if of_it]
    with mpl.rc_context(STYLE):
        widths = [_width(panel, of_it) for panel, of_it in drawn]
        figure = new_figure(max(4.0, sum(widths)), 3.4 if all(_numeric(p, r) for p, r in drawn) else 4.4)
        axes = figure.subplots(1, len(drawn), squeeze=False, gridspec_kw={"width_ratios": widths})[0] if drawn else []
        for axis, (panel, of_it) in zip(axes, drawn, strict=True):
            (_lines if _numeric(panel, of_it) else _bars)(axis, panel, of_it)
            axis.set_xlabel(panel.x_label)
            axis.set_ylabel(panel.y_label)
            if panel.by:
                axis.legend(fontsize=8)
    return figure


def _of(panel: Panel, rows: Sequence[Row]) -> list[Row]:
    return [r for r in rows if panel.x in r and panel.y in r and all(r.get(k) == v for k, v in panel.only)]


def _numeric(panel: Panel, rows: Sequence[Row]) -> bool:
    return not isinstance(rows[0][panel.x], str)


def _width(panel: Panel, rows: Sequence[Row]) -> float:
    bars = len({row[panel.x] for row in rows})
    return 3.6 if _numeric(panel, rows) else max(2.4, 1.2 + 0.3 * bars * len(_groups(panel, rows)))


def _groups(panel: Panel, rows: Sequence[Row]) -> list[Any]:
    return list(dict.fromkeys(row[panel.by] for row in rows)) if panel.by else [None]


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


def _lines(axis: Any, panel: Panel, rows: Sequence[Row]) -> None:
    for group in _groups(panel, rows):
        xs, (mean, low, high) = _points(panel, rows, group)
        order = np.argsort(xs)
        x = np.asarray(xs, float)[order]
        (line,) = axis.plot(x, mean[order], "o-" if len(x) < 30 else "-", label=group)
        axis.fill_between(x, low[order], high[order], color=line.get_color(), alpha=0.15, linewidth=0)
    if panel.log:
        axis.set_xscale("log")
        values = sorted({float(row[panel.x]) for row in rows})
        if len(values) < 8 and max(values) < 1e4 and min(values) > 1e-3:
            axis.set_xticks(values, [f"{value:.3g}" for value in values])
            axis.minorticks_off()


def _bars(axis: Any, panel: Panel, rows: Sequence[Row]) -> None:
    groups = _groups(panel, rows)
    names: list[str] = []
    for k, group in enumerate(groups):
        names, (mean, low, high) = _points(panel, rows, group)
        place = np.arange(len(names)) + (k - (len(groups) - 1) / 2) * 0.8 / len(groups)
        error = np.abs([mean - low, high - mean])
        axis.errorbar(place, mean, error, fmt="o", capsize=2, label=group)
    if min(float(row[panel.y]) for row in rows) >= 0:
        axis.set_ylim(bottom=0)
    axis.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=8)
