"""Figure of predicted and true errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.plotting import crop, drawing, literal
from studies.calibration import BINS

PREDICTION_COLOURS = ("#8a8a8a", "#c44e1f", "#3b6fb6", "#1b1b1b")
"""Colours of the predictions in `uncertainty_figure`, in their order."""


def uncertainty_figure(
    path: str | Path, rows: Sequence[dict[str, Any]], maps: Sequence[tuple[str, Any, Any, Any]]
) -> None:
    """Draw predicted and true errors.

    Above: rms over the channels of both, for each view of `maps` (name, error [H,W,3], sigma
    [H,W,3], inside [H,W]). Below: AUSE, shares inside the intervals, and histograms of the
    probability integral transform, for every prediction in `rows`
    (`studies.calibration.judged`), over test views or else held-out views.
    """
    from matplotlib.patches import Patch

    judged_on = "test" if any(row["views"] == "test" for row in rows) else "held out"
    shown = [row for row in rows if row["views"] == judged_on]
    coloured = list(zip(shown, PREDICTION_COLOURS, strict=False))
    with drawing(path, 8.4, 6.7) as figure:
        figure.suptitle("Predicted errors of unseen views beside the true ones")
        above, below = figure.subfigures(2, 1, height_ratios=(1.15, 1))
        _draw_maps(above, maps)
        area, held, pit = below.subplots(1, 3)
        _draw_ause(area, coloured)
        _draw_held(held, coloured)
        _draw_pit(pit, coloured)
        handles = [Patch(color=colour, label=row["prediction"]) for row, colour in coloured]
        below.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def _draw_maps(figure: Any, maps: Sequence[tuple[str, Any, Any, Any]]) -> None:
    """Draw true error above predicted error, a column for each view."""

    def rms(values: np.ndarray) -> np.ndarray:
        return np.sqrt(np.square(values).mean(-1))

    axes = figure.subplots(2, len(maps), squeeze=False)
    top = max(float(np.quantile(rms(error)[inside], 0.98)) for _, error, _, inside in maps)
    scale = {"cmap": "inferno", "vmin": 0, "vmax": top, "interpolation": "nearest"}
    image = None
    for column, (name, error, sigma, inside) in zip(axes.T, maps, strict=True):
        panels = (("true error", error), ("predicted", sigma))
        for axis, (label, values) in zip(column, panels, strict=True):
            image = axis.imshow(np.ma.masked_where(~inside, rms(values))[crop(inside)], **scale)
            axis.set_title(literal(f"{name}, {label}"))
            axis.set_axis_off()
    figure.colorbar(image, ax=axes, label="rms of the channels, linear RGB", shrink=0.8)


def _draw_ause(axis: Any, rows: Sequence[tuple[dict[str, Any], str]]) -> None:
    """Draw AUSE as bars, with ticks for a perfect sigma and a line for a constant one."""
    for i, (row, colour) in enumerate(rows):
        area = row["ause"]
        ends, perfect = [i - 0.4, i + 0.4], [area["perfect"]] * 2
        axis.bar(i, area["ause"], color=colour)
        axis.plot(ends, perfect, color="white", linewidth=2.5)
        label = "if it were perfect" if i == 0 else None
        axis.plot(ends, perfect, color="black", linewidth=1, label=label)
    constant = rows[0][0]["ause"]["constant"]
    axis.axhline(constant, color="black", linewidth=1, linestyle="--", label="a constant")
    axis.set_xticks([])
    axis.set_ylabel("AUSE (lower is better)")
    axis.set_ylim(0, 1.3 * constant)
    axis.legend(loc="upper right", fontsize=8)


def _draw_held(axis: Any, rows: Sequence[tuple[dict[str, Any], str]]) -> None:
    """Draw shares of the errors inside the intervals of 90 %, in thirds of the pixels by sigma."""
    for i, (row, colour) in enumerate(rows):
        x = np.arange(3) + 0.06 * (i - 1.5)
        axis.plot(x, row["held"]["0.9"][1:], "o", color=colour, markersize=5)
    axis.axhspan(0.87, 0.93, color="#e4e4e4", zorder=0)
    axis.set_xticks(range(3), ["least", "middle", "largest"])
    axis.set_xlim(-0.5, 2.5)
    axis.set_xlabel("third of the pixels by predicted error")
    axis.set_ylabel("inside the interval of 90 %")


def _draw_pit(axis: Any, rows: Sequence[tuple[dict[str, Any], str]]) -> None:
    """Draw histograms of the probability integral transform."""
    edges = np.linspace(0, 1, BINS + 1)
    for row, colour in rows:
        axis.stairs(np.array(row["pit"]) * BINS, edges, color=colour, linewidth=1.4)
    axis.axhline(1, color="black", linewidth=0.8, linestyle="--")
    axis.set_xlabel("probability integral transform")
    axis.set_ylabel("density")
