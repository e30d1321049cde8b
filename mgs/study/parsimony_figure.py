"""The chart of `mgs.study.parsimony`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mgs.plotting import STYLE, new_figure, save_figure
from mgs.study.parsimony import ALL, AUTO, CLOSE, LEARNED, axes_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#7f7f7f"

TITLES = {
    "gaussians": "number of Gaussians",
    "learned": "what is learned",
    "degree": "SH degree of the colours",
}


def draw_parsimony(path: Path, found: dict[str, Any]) -> None:
    """A row of panels for each scene: PSNR against N, learned kinds and SH degree, with the
    automatic choice marked.

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
                panel.axhspan(
                    verdict["best"] - CLOSE, verdict["best"], color=GREY, alpha=0.15, lw=0
                )
            _mark_auto(
                row,
                [one for one in found["rows"] if one["scene"] == scene and one["asked"] == AUTO],
                verdict,
            )
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
        panel.annotate(
            cost,
            (at, level),
            (0, -6),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=7,
            color=GREY,
        )


def _mark_auto(row: Any, rows: list[dict[str, Any]], verdict: dict[str, Any]) -> None:
    """What is chosen automatically, in all panels of a scene, and in the first one what pruning
    leaves of it. rows: of the automatic number of Gaussians."""
    number = next(one for one in rows if one["learned"] == ALL and one["degree"] == 0)
    chosen = next(one for one in rows if one["learned"] == AUTO)
    style = {"markersize": 13, "linestyle": "none", "zorder": 3}
    row[0].plot(
        number["gaussians"],
        number["psnr_inside"],
        "*",
        color=ORANGE,
        label="automatic number",
        **style,
    )
    pruned = verdict["pruned"]
    x, y = [[one[key] for one in pruned] for key in ("gaussians", "psnr_inside")]
    row[0].plot(
        x,
        y,
        color=GREEN,
        marker="D",
        linestyle=":",
        label="the same, pruned (noise 0.1, 0.2, 0.5 sigma)",
    )
    label = "number, kinds and degree automatic"
    for panel, x in zip(
        row, (chosen["gaussians"], len(LEARNED) - 1, chosen["degree"]), strict=True
    ):
        panel.plot(
            x,
            chosen["psnr_inside"],
            "P",
            color=RED,
            label=label if panel is row[0] else None,
            **style,
        )
    said = f"{chosen['parameters'] / 1000:,.0f}k\n{chosen['seconds']:.0f} s"
    at = (len(LEARNED) - 1, chosen["psnr_inside"])
    row[1].annotate(
        said,
        at,
        (0, 8),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=7,
        color=RED,
    )
