"""The figure of a survey: trajectories, position error per frame, depth error, fused cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import Dataset
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.survey.flight import STAGES, Survey
from mgs.survey.fusion import Cloud

COLOURS = {"odometry": "#d1495b", "registered": "#edae49", "optimised": "#00798c"}
"""Colour of each of the STAGES."""


def draw_survey(
    path: str | Path, dataset: Dataset, survey: Survey, cloud: Cloud, numbers: dict[str, Any]
) -> None:
    """Write the figure of a survey as a PNG, atomically.

    cloud: fused from the survey; numbers: from `survey_numbers`. Raises InputError if it cannot be
    written.
    """
    import matplotlib

    around = survey.truth[:, :3, 3].mean(0)
    reach = float(np.abs(survey.truth[:, :3, 3] - around).max())
    points = cloud.points[np.argsort(cloud.points[:, 2])]
    stride = max(1, len(points) // 120_000)
    with matplotlib.rc_context(STYLE):
        figure = new_figure(17, 4.4, dpi=100)
        axes = figure.subplots(1, 4, gridspec_kw={"width_ratios": [1.1, 1, 1, 1.1]})
        _trajectories(axes[0], survey)
        _errors(axes[1], survey, numbers)
        _depth_error(axes[2], dataset, survey, numbers)
        x, y, z = points[::stride].T
        axes[3].scatter(x, y, c=z, s=0.4, cmap="viridis", linewidths=0, rasterized=True)
        axes[3].set(xlim=(around[0] - reach, around[0] + reach), xlabel="x, m", aspect="equal")
        axes[3].set(ylim=(around[1] - reach, around[1] + reach), ylabel="y, m")
        axes[3].set_title(f"fused cloud from above: {len(cloud.points):,} points")
        save_figure(figure, path)


def _trajectories(axis, survey: Survey) -> None:
    """True and estimated flight from above, and loop closures."""
    axis.plot(*survey.truth[:, :2, 3].T, color="0.6", lw=5, label="truth", solid_capstyle="round")
    for name, colour in COLOURS.items():
        x, y = getattr(survey, name)[:, :2, 3].T
        axis.plot(x, y, ".-", color=colour, lw=1.2, ms=4, label=STAGES[name])
    for k, loop in enumerate(survey.loops):
        ends = survey.optimised[[loop.i, loop.j], :2, 3]
        axis.plot(*ends.T, color="k", lw=1.5, label="loop closures" if k == 0 else None)
    axis.plot(*survey.truth[0, :2, 3], "k^", ms=8, label="start")
    axis.set(aspect="equal", title="trajectory from above", xlabel="x, m", ylabel="y, m")
    axis.legend(fontsize=8, loc="center")


def _errors(axis, survey: Survey, numbers: dict[str, Any]) -> None:
    """Position error of every frame but the first, whose pose is known, log scale."""
    for name, colour in COLOURS.items():
        offset = np.linalg.norm(getattr(survey, name)[:, :3, 3] - survey.truth[:, :3, 3], axis=1)
        label = f"{STAGES[name]}: rms {1e3 * numbers['error'][name]['ate_rms']:.0f} mm"
        error = 1e3 * np.maximum(offset[1:], 1e-4)
        axis.semilogy(np.arange(1, len(offset)), error, color=colour, label=label)
    axis.set(title="position error against truth", xlabel="frame", ylabel="mm")
    axis.margins(y=0.25)
    axis.legend(fontsize=8, loc="lower right")


def _depth_error(axis, dataset: Dataset, survey: Survey, numbers: dict[str, Any]) -> None:
    """Measured minus true depth of the first frame, as an image."""
    measured, true = survey.depths[0], dataset.frames[0].depth()
    error = np.where((measured > 0) & (true > 0), 1e3 * (measured - true), np.nan)
    limit = max(3e3 * numbers["depth_error_on_rock"], 1.0)
    axis.set_facecolor("0.85")
    axis.grid(visible=False)
    axis.spines[:].set_visible(False)
    picture = axis.imshow(error, cmap="RdBu", vmin=-limit, vmax=limit, interpolation="nearest")
    axis.figure.colorbar(picture, ax=axis, shrink=0.7, label="mm; blue: too far")
    lost = f"{numbers['returns_lost']:.0%} of all returns lost"
    axis.set(title=f"depth error of frame 0; grey: no return\n{lost}", xticks=[], yticks=[])
