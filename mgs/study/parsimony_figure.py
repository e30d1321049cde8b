"""The chart of `mgs.study.parsimony`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mgs.plotting import STYLE, new_figure, save_figure
from mgs.study.parsimony import CLOSE, axes_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#7f7f7f"

TITLES = {"gaussians": "number of Gaussians", "learned": "what is learned", "degree": "SH degree of the colours"}


def draw_parsimony(path: Path, found: dict[str, Any]) -> None:
    """A row of panels for each scene: PSNR against N, learned kinds and SH degree, with the automatic choice marked.

    found: the result of `run_study`. Raises InputError if the file cannot be written."""
    import matplotlib

    scenes = list(found["scenes"])
    with matplotlib.rc_context(STYLE):
        figure = new_figure(10, 0.7 + 2.5 * len(scenes))
        panels = figure.subplots(len(scenes), 3, squeeze=False, sharey="row")
        for row, scene in zip(panels, scenes, strict=True):
            axes = axes_of([one for one in found["rows"] if one["scene"] == scene])
            verdict = found["scenes"][scene]
            for panel, (axis, of) in zip(row, axes.items(), strict=True):
                _line(panel, axis, of)
                panel.axhspan(verdict["best"] - CLOSE, verdict["best"], color=GREY, alpha=0.15, lw=0)
            auto = next(one for one in axes["degree"] if one["degree"] == 0)
            _mark_auto(row, auto, verdict)
            row[0].set_ylabel(f"{scene}\nPSNR inside the rock (dB)")
        for panel, title in zip(panels[0], TITLES.values(), strict=True):
            panel.set_title(title)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        save_figure(figure, path)


def _line(panel: Axes, axis: str, rows: list[dict[str, Any]]) -> None:
    """PSNR along one axis; under each point what it costs."""
    if axis == "gaussians":
        x: list[float] = [row["gaussians"] for row in rows]
        panel.set_xscale("log")
        panel.set_xticks(x, [f"{n:,}" for n in x])
        panel.minorticks_off()
    else:
        x = list(range(len(rows)))
        panel.set_xticks(x, [str(row[axis]) for row in rows])
    panel.margins(x=0.15, y=0.25)
    y = [row["psnr_inside"] for row in rows]
    panel.plot(x, y, color=BLUE, marker="o", label="fixed choices" if axis == "gaussians" else None)
    for at, level, row in zip(x, y, rows, strict=True):
        cost = f"{row['parameters'] / 1000:,.0f}k\n{row['seconds']:.0f} s"
        panel.annotate(cost, (at, level), (0, -6), textcoords="offset points", ha="center", va="top", fontsize=7, color=GREY)


def _mark_auto(row: Any, auto: dict[str, Any], verdict: dict[str, Any]) -> None:
    """The automatic choice in all panels of a scene, and in the first one what pruning leaves of it."""
    style = {"color": ORANGE, "marker": "*", "markersize": 13, "linestyle": "none", "zorder": 3}
    for panel, x in zip(row, (auto["gaussians"], 3, 0), strict=True):
        panel.plot(x, auto["psnr_inside"], label="automatic" if panel is row[0] else None, **style)
    pruned = verdict["pruned"]
    x, y = [[one[key] for one in pruned] for key in ("gaussians", "psnr_inside")]
    row[0].plot(x, y, color=GREEN, marker="D", linestyle=":", label="automatic, pruned (noise 0.1, 0.2, 0.5 sigma)")
