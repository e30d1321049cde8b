"""Figures of the charts, from their rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.plotting import STYLE, new_figure, save_figure
from mgs.report.figures import line_styles
from mgs.study.statistics import pareto_front
from mgs.study.verdict import Row

Rows = Sequence[Row]

FACTORS = (
    {
        "crossed": "number of Gaussians x passes",
        "half the size": "trained at half the size",
        "optimiser": "Adam, passes",
        "learned": "less is learned",
    },
    {
        "crossed, run": "number of Gaussians x passes",
        "policy, run": "policy",
        "estimator, run": "estimator",
    },
)
"""Labels of factors in the panels of fits and of runs. A point of several factors is drawn as the
first of its own."""


def _points(axes: Any, rows: Rows, y: str, scale: float, style: dict[str, Any]) -> None:
    """Points with error bars along the time. scale: of the seconds."""
    low, x, high = (
        scale * np.array([row[f"seconds{end}"] for row in rows]) for end in ("_low", "", "_high")
    )
    values = [row[y] for row in rows]
    axes.errorbar(x, values, xerr=[x - low, high - x], **(style | {"linestyle": "none"}))


def _front(axes: Any, rows: Rows, y: str, scale: float = 1.0) -> None:
    """Staircase along the front of the rows: the best that the time allows."""
    x, values = zip(*sorted((scale * row["seconds"], row[y]) for row in rows), strict=True)
    axes.step(x, values, where="post", color="black", lw=1, zorder=1, label="Pareto front")


def _seconds_axis(axes: Any, label: str) -> None:
    """Logarithmic axis with plain numbers at 1, 2 and 5."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(label)


def fit_figure(path: Path, rows: Rows) -> None:
    """Seconds against PSNR and SSIM of fits (left) and of runs (right), with fronts and presets."""
    import matplotlib

    most = Counter(row["images"] for row in rows).most_common(1)[0][0]
    metrics = (("psnr", "front", "PSNR on the test views, dB"), ("ssim", "front_ssim", "SSIM"))
    with matplotlib.rc_context(STYLE | {"legend.fontsize": 7, "legend.title_fontsize": 10}):
        figure = new_figure(10, 8)
        panels = figure.subplots(2, 2, sharex="col")
        for column, name in enumerate(("one fit of", "runs to")):
            own = [r for r in rows if bool(r["policy"]) is bool(column) and r["images"] == most]
            for axes, (metric, flag, label) in zip(panels[:, column], metrics, strict=True):
                _front(axes, [row for row in own if row[flag]], metric)
                _fit_points(axes, own, metric, FACTORS[column])
                _seconds_axis(axes, f"seconds of {name} {most} images")
                axes.margins(0.08)
                axes.set_ylabel(label)
            title = f"{name} {most} images"
            panels[0, column].legend(title=title, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
        save_figure(figure, path)


def _fit_points(axes: Any, rows: Rows, metric: str, factors: dict[str, str]) -> None:
    """Points by the first of their factors, and named stars for presets."""
    left = list(rows)
    for (factor, label), style in zip(factors.items(), line_styles(factors), strict=True):
        some = [row for row in left if factor in row["factors"].split("; ")]
        left = [row for row in left if row not in some]
        if some:
            _points(axes, some, metric, 1.0, style | {"label": label})
    for row in rows:
        if row["preset"]:
            at = row["seconds"], row[metric]
            axes.plot(*at, "k*", ms=10, zorder=4)
            place = {"textcoords": "offset points", "fontsize": 8, "va": "top"}
            axes.annotate(row["preset"], at, (6, -6), **place)


def scoring_figure(path: Path, rows: Rows) -> None:
    """Milliseconds a candidate against Kendall's tau and regret."""
    import matplotlib

    rows = [row | {"percent": 100 * row["regret"], "kept": -row["regret"]} for row in rows]
    metrics = (
        ("tau", "tau", "Kendall's tau with the exact scores"),
        ("percent", "kept", "regret, % of the best exact score"),
    )
    styles = line_styles([row["variant"] for row in rows])
    with matplotlib.rc_context(STYLE | {"legend.fontsize": 7}):
        figure = new_figure(12, 5)
        for axes, (metric, gain, label) in zip(figure.subplots(1, 2), metrics, strict=True):
            on = pareto_front([row["seconds"] for row in rows], [row[gain] for row in rows])
            front = [row for row, flag in zip(rows, on, strict=True) if flag]
            _front(axes, front, metric, 1e3)
            for row, style in zip(rows, styles, strict=True):
                _points(axes, [row], metric, 1e3, style)
            _seconds_axis(axes, "milliseconds a candidate")
            axes.margins(0.12)
            axes.set_ylabel(label)
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right upper")
        save_figure(figure, path)
