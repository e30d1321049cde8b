"""The figure of `mgs diagnose RUN --calibrate`: predicted and true errors, as maps and as
statistics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.report.calibration import BINS

COLOURS = ("#8a8a8a", "#c44e1f", "#3b6fb6", "#1b1b1b")
"""Of the predictions, in the order in which they come."""


def write_uncertainty(
    path: str | Path, rows: Sequence[dict[str, Any]], maps: Sequence[tuple[str, Any, Any, Any]]
) -> None:
    """Above, for each view in `maps` (name, error [H,W,3], sigma [H,W,3], inside [H,W]) the rms
    over the channels of both; below, for views that were not seen, AUSE, shares inside the
    intervals, and histograms of the probability integral transform, of every prediction in `rows`.
    Raises InputError if the file cannot be written."""
    import matplotlib as mpl

    from mgs.plotting import STYLE, new_figure, save_figure

    judged_on = "test" if any(row["views"] == "test" for row in rows) else "held out"
    shown = [row for row in rows if row["views"] == judged_on]
    with mpl.rc_context(STYLE):
        figure = new_figure(8.4, 6.4)
        above, below = figure.subfigures(2, 1, height_ratios=(1.15, 1))
        _draw_maps(above, maps)
        area, held, pit = below.subplots(1, 3)
        _draw_ause(area, shown)
        _draw_held(held, shown)
        _draw_pit(pit, shown)
        handles = [
            mpl.patches.Patch(color=c, label=row["prediction"])
            for c, row in zip(COLOURS, shown, strict=False)
        ]
        below.legend(handles=handles, loc="outside lower center", ncols=len(handles))
        save_figure(figure, path)


def _draw_maps(figure: Any, maps: Sequence[tuple[str, Any, Any, Any]]) -> None:
    from mgs.plotting import crop

    axes = figure.subplots(2, len(maps), squeeze=False)
    top = max(
        float(np.quantile(np.sqrt(np.square(error).mean(-1))[inside], 0.98))
        for _, error, _, inside in maps
    )
    image = None
    for column, (name, error, sigma, inside) in zip(axes.T, maps, strict=True):
        window = crop(inside)
        for axis, values, label in zip(
            column, (error, sigma), ("true error", "predicted"), strict=True
        ):
            rms = np.ma.masked_where(~inside, np.sqrt(np.square(values).mean(-1)))[window]
            image = axis.imshow(rms, cmap="inferno", vmin=0, vmax=top, interpolation="nearest")
            axis.set_title(f"{name}, {label}")
            axis.set_axis_off()
    figure.colorbar(image, ax=axes, label="rms of the channels, linear RGB", shrink=0.8)


def _draw_ause(axis: Any, rows: Sequence[dict[str, Any]]) -> None:
    """Bars of the AUSE of absolute errors; ticks at what each sigma would have if it were perfect;
    a line for a constant."""
    for i, (row, colour) in enumerate(zip(rows, COLOURS, strict=False)):
        area = row["ause"]["mae"]
        axis.bar(i, area["ause"], color=colour)
        axis.plot([i - 0.4, i + 0.4], [area["perfect"]] * 2, color="white", linewidth=2.5)
        axis.plot(
            [i - 0.4, i + 0.4],
            [area["perfect"]] * 2,
            color="black",
            linewidth=1,
            label="if it were perfect" if i == 0 else None,
        )
    axis.axhline(
        rows[0]["ause"]["mae"]["constant"],
        color="black",
        linewidth=1,
        linestyle="--",
        label="a constant",
    )
    axis.set_xticks([])
    axis.set_ylabel("AUSE of |error|")
    axis.set_ylim(0, 1.3 * rows[0]["ause"]["mae"]["constant"])
    axis.legend(loc="upper right", fontsize=8)


def _draw_held(axis: Any, rows: Sequence[dict[str, Any]]) -> None:
    """Shares of the errors inside the intervals of 90 %, in thirds of the pixels by sigma."""
    for i, (row, colour) in enumerate(zip(rows, COLOURS, strict=False)):
        axis.plot(
            np.arange(3) + 0.06 * (i - 1.5), row["held"]["0.9"][1:], "o", color=colour, markersize=5
        )
    axis.axhspan(0.87, 0.93, color="#e4e4e4", zorder=0)
    axis.set_xticks(range(3), ["least", "middle", "largest"])
    axis.set_xlim(-0.5, 2.5)
    axis.set_xlabel("third of the pixels by predicted error")
    axis.set_ylabel("inside the interval of 90 %")


def _draw_pit(axis: Any, rows: Sequence[dict[str, Any]]) -> None:
    edges = np.linspace(0, 1, BINS + 1)
    for row, colour in zip(rows, COLOURS, strict=False):
        axis.stairs(np.array(row["pit"]) * BINS, edges, color=colour, linewidth=1.4)
    axis.axhline(1, color="black", linewidth=0.8, linestyle="--")
    axis.set_xlabel("probability integral transform")
    axis.set_ylabel("density")
