"""The charts as PNG files, of their rows. Nothing is measured here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from mgs.plotting import STYLE, new_figure, save_figure
from mgs.study.chart.pareto import pareto_front
from mgs.study.chart.plan import DENSITY

Rows = Sequence[dict[str, Any]]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#666666")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

FIT_FACTORS = {
    "crossed": "number of Gaussians x passes", "half the size": "trained at half the size", "optimiser": "Adam, passes",
    "learned": "less is learned",
}  # fmt: skip
"""What the left panels show, by factor. A point of several factors is drawn as the first of its
own."""

RUN_FACTORS = {
    "crossed, run": "number of Gaussians x passes", "policy, run": "policy", "estimator, run": "estimator",
}  # fmt: skip
"""What the right panels show."""


def _points(axes: Any, rows: Rows, y: str, style: int, label: str, x: str = "seconds") -> None:
    """Points with error bars along the time."""
    xs, ys = np.array([row[x] for row in rows]), [row[y] for row in rows]
    error = (
        [xs - [row[f"{x}_low"] for row in rows], [row[f"{x}_high"] for row in rows] - xs]
        if f"{x}_low" in rows[0]
        else None
    )
    axes.errorbar(
        xs, ys, xerr=error, fmt=MARKERS[style % 7], color=COLOURS[style % 7], ms=4.5, mew=0.4, mec="white", elinewidth=0.8,
        ls="none", label=label,
    )  # fmt: skip


def _front(axes: Any, rows: Rows, y: str, flag: str, x: str = "seconds") -> None:
    """A staircase along the Pareto front: what can be had for the time."""
    on = sorted((row for row in rows if row[flag]), key=lambda row: float(row[x]))
    steps = [(row[x], row[y]) for row in on]
    corners = [(later[0], earlier[1]) for earlier, later in pairwise(steps)]
    stairs = [point for pair in zip_longest(steps, corners) for point in pair if point]
    axes.plot(*zip(*stairs, strict=True), color="black", lw=1, zorder=1, label="Pareto front")


def _seconds_axis(axes: Any) -> None:
    """A logarithmic axis with plain numbers at 1, 2 and 5."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())


def _drawn(axes: Any) -> np.ndarray:
    """Points [P,2], pixels of the figure, on everything that is drawn in some axes: markers, and
    lines in small steps."""
    lines = [(line.get_xydata(), line.get_linestyle() != "None") for line in axes.lines]
    lines += [(segment, True) for bars in axes.collections for segment in bars.get_segments()]
    points = [np.zeros((0, 2))]
    for path, joined in lines:
        at = axes.transData.transform(np.asarray(path, np.float64).reshape(-1, 2))
        points.append(at)
        if joined:
            points += [
                np.linspace(a, b, 2 + int(np.abs(b - a).max() // 4)) for a, b in pairwise(at)
            ]
    return np.concatenate(points)


def _label(axes: Any, rows: Rows, x: str, y: str, text: Callable[[dict[str, Any]], str]) -> None:
    """Names beside points, each where it covers nothing that is drawn or written already, with a
    thin line to its point."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    figure = axes.figure
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # which lays the figure out
    renderer, boxes, drawn = canvas.get_renderer(), list[Any](), _drawn(axes)
    for row in sorted(rows, key=lambda row: -float(row[y])):
        for dx, dy in _OFFSETS:
            note = axes.annotate(
                text(row), (row[x], row[y]), xytext=(dx, dy), textcoords="offset points", fontsize=7,
                ha="left" if dx > 0 else "right", va="center",
                arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "#888888", "shrinkA": 0, "shrinkB": 2},
            )  # fmt: skip
            note.set_in_layout(False)
            note.update_positions(renderer)
            box = Text.get_window_extent(note, renderer).padded(2)  # without the line
            inside = (
                axes.bbox.x0 <= box.x0
                and box.x1 <= axes.bbox.x1
                and axes.bbox.y0 <= box.y0
                and box.y1 <= axes.bbox.y1
            )
            covers = ((drawn > (box.x0, box.y0)) & (drawn < (box.x1, box.y1))).all(axis=1).any()
            if (inside and not covers and not any(box.overlaps(other) for other in boxes)) or (
                dx,
                dy,
            ) == _OFFSETS[-1]:
                boxes.append(box)
                break
            note.remove()


_OFFSETS = tuple(
    (side * (6 + 1.2 * abs(dy)), dy)
    for dy in (0, 9, -9, 18, -18, 27, -27, 38, -38, 50, -50, 64, -64)
    for side in (1, -1)
)
"""Where a label is tried, points from its own point."""


def fit_figure(path: str | Path, rows: Rows) -> None:
    """Seconds against PSNR and SSIM, of fits (left) and of runs (right), with fronts; presets have
    names."""
    import matplotlib

    counts = Counter(row["images"] for row in rows)
    most = counts.most_common(1)[0][0]
    with matplotlib.rc_context(STYLE | {"legend.fontsize": 7, "legend.title_fontsize": 10}):
        figure = new_figure(10, 8)
        panels = figure.subplots(2, 2, sharex="col")
        for column, (is_run, factors) in enumerate(((False, FIT_FACTORS), (True, RUN_FACTORS))):
            own = [row for row in rows if bool(row["policy"]) is is_run and row["images"] == most]
            for axes, metric, flag, unit in zip(panels[:, column], *_METRICS, strict=True):
                _fit_panel(axes, own, metric, flag, factors)
                axes.set(ylabel=f"{metric.upper()} on the test views{unit}")
            panels[1, column].set(
                xlabel="seconds of the whole run" if is_run else "seconds of the fit"
            )
            title = f"{'runs to' if is_run else 'one fit of'} {most} images"
            panels[0, column].legend(title=title, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
        for axes, metric, flag, _ in zip(panels[:, 0], *_METRICS, strict=True):
            on = [row for row in rows if not row["policy"] and row["images"] == most and row[flag]]
            _label(
                axes,
                on,
                "seconds",
                metric,
                lambda row: f"{row['gaussians']:,}, {row['passes']} passes",
            )
        for axes, metric in zip(panels[:, 1], _METRICS[0], strict=True):
            _label(
                axes,
                [row for row in rows if row["preset"]],
                "seconds",
                metric,
                lambda row: str(row["preset"]),
            )
        save_figure(figure, path)


_METRICS = (("psnr", "ssim"), ("front", "front_ssim"), (", dB", ""))
"""What a row of panels shows: a quality, the column that tells its front, its unit."""


def passes_figure(path: str | Path, rows: Rows) -> None:
    """PSNR against what does not depend on a machine: passes (left), and the number of images
    (right)."""
    import matplotlib

    most = Counter(row["images"] for row in rows).most_common(1)[0][0]
    with matplotlib.rc_context(STYLE | {"legend.fontsize": 7}):
        figure = new_figure(10, 4)
        left, right = figure.subplots(1, 2)
        _passes_panel(left, [row for row in rows if row["images"] == most])
        _images_panel(right, rows)
        save_figure(figure, path)


def _passes_panel(axes: Any, rows: Rows) -> None:
    """Passes of all fits together against PSNR: a line for each number of Gaussians, of fits (-)
    and of runs (--)."""
    crossed = [row for row in rows if "crossed" in row["factors"]]
    for style, n in enumerate(sorted({row["gaussians"] for row in crossed})):
        look = {"color": COLOURS[style % 7], "marker": MARKERS[style % 7], "ms": 4, "lw": 1}
        for dashes, is_run in (("-", False), ("--", True)):
            some = sorted(
                (row for row in crossed if row["gaussians"] == n and bool(row["policy"]) is is_run),
                key=lambda row: int(row["total_passes"]),
            )
            label = None if is_run else f"{n:,} Gaussians"
            axes.plot(
                [r["total_passes"] for r in some],
                [r["psnr"] for r in some],
                ls=dashes,
                label=label,
                **look,
            )
    axes.plot([], [], "k--", lw=1, label="runs")
    _seconds_axis(axes)
    axes.set(
        xlabel="passes over the images, of all fits of a run together",
        ylabel="PSNR on the test views, dB",
    )
    axes.legend(loc="lower right")


def _images_panel(axes: Any, rows: Rows) -> None:
    """The number of images of one fit against PSNR, in the frame and inside the rock."""
    default = next(row for row in rows if not row["policy"])  # the first has the defaults
    some = [
        row
        for row in rows
        if not row["policy"] and all(row[key] == default[key] for key in _SETTINGS)
    ]
    some.sort(key=lambda row: int(row["images"]))
    for style, (metric, label) in enumerate((("psnr", "full frame"), ("psnr_mask", "rock"))):
        look = {"color": COLOURS[style], "marker": MARKERS[style], "ms": 4, "lw": 1}
        axes.plot([r["images"] for r in some], [r[metric] for r in some], label=label, **look)
    axes.set_xticks([row["images"] for row in some])
    axes.set(
        xlabel=f"images of one fit of {default['gaussians']:,} Gaussians",
        ylabel="PSNR on the test views, dB",
    )
    axes.legend(loc="center right")


_SETTINGS = ("gaussians", "passes", "optimiser", "learned", "half")
"""What two fits have to share to differ in their images alone."""


def _fit_panel(axes: Any, rows: Rows, metric: str, flag: str, factors: dict[str, str]) -> None:
    """Points by the first of their factors, the front, and stars for presets."""
    _seconds_axis(axes)
    axes.margins(0.08)
    _front(axes, rows, metric, flag)
    left = list(rows)
    for style, (factor, label) in enumerate(factors.items()):
        some = [row for row in left if factor in row["factors"].split("; ")]
        left = [row for row in left if row not in some]
        if some:
            _points(axes, some, metric, style, label)
    named = [row for row in rows if row["preset"]]
    if named:
        axes.plot(
            [r["seconds"] for r in named],
            [r[metric] for r in named],
            "k*",
            ms=10,
            label="preset",
            zorder=4,
        )


def scoring_figure(path: str | Path, rows: Rows) -> None:
    """Milliseconds a candidate against Kendall's tau and regret."""
    import matplotlib

    families = list(dict.fromkeys(row["family"] for row in rows))
    scaled = [
        row | {f"ms{end}": 1e3 * row[f"seconds{end}"] for end in ("", "_low", "_high")}
        for row in rows
    ]
    with matplotlib.rc_context(STYLE | {"legend.fontsize": 7}):
        figure = new_figure(11, 5.2)
        panels = figure.subplots(1, 2)
        for axes, metric, label in zip(
            panels,
            ("tau", "percent"),
            ("Kendall's tau with the exact scores", "regret, % of the best exact score"),
            strict=True,
        ):
            scaled = [row | {"percent": 100 * row["regret"]} for row in scaled]
            better = [row[metric] if metric == "tau" else -row[metric] for row in scaled]
            on = pareto_front([row["ms"] for row in scaled], better)
            _front(
                axes,
                [row | {"on": flag} for row, flag in zip(scaled, on, strict=True)],
                metric,
                "on",
                "ms",
            )
            for style, family in enumerate(families):
                _points(
                    axes,
                    [row for row in scaled if row["family"] == family],
                    metric,
                    style,
                    family,
                    "ms",
                )
            _seconds_axis(axes)
            axes.margins(0.12)
            axes.set(
                xlabel="milliseconds a candidate, information of the views taken included",
                ylabel=label,
            )
            _label(axes, scaled, "ms", metric, lambda row: str(row["variant"]))
        save_figure(figure, path)


def core_figure(path: str | Path, rows: Rows) -> None:
    """Milliseconds at the working size against the largest error on the small scene."""
    import matplotlib

    kinds = list(dict.fromkeys(row["computes"] for row in rows))
    scaled = [
        row | {f"ms{end}": 1e3 * row[f"seconds{end}"] for end in ("", "_low", "_high")}
        for row in rows
    ]
    with matplotlib.rc_context(STYLE):
        figure = new_figure(7, 4.6)
        axes = figure.subplots()
        for style, kind in enumerate(kinds):
            _points(
                axes, [row for row in scaled if row["computes"] == kind], "error", style, kind, "ms"
            )
        _seconds_axis(axes)
        axes.set_yscale("log")
        axes.margins(0.12)
        axes.set(
            xlabel="milliseconds at the working size",
            ylabel="largest error, of the largest entry of the float64 oracle",
        )
        axes.legend(loc="center right")
        _label(axes, scaled, "ms", "error", lambda row: str(row["row"]))
        save_figure(figure, path)


DASHES = {"one step": ":", "by H": "-", "by H, known": "--"}
"""Lines of the ways to round numbers."""


def bytes_figure(path: str | Path, rows: Rows) -> None:
    """Kilobytes sent against PSNR: images, and models of several sizes by how their numbers are
    rounded."""
    import matplotlib

    scaled = [row | {"kb": row["bytes"] / 1e3} for row in rows]
    usual = Counter(row["images"] for row in scaled if row["sent"] == "model").most_common(1)[0][0]
    models = [row for row in scaled if row["sent"] == "model" and row["images"] == usual]
    photos = [row for row in scaled if row["sent"] == "images" and row["density"] == DENSITY]
    with matplotlib.rc_context(STYLE | {"legend.fontsize": 7}):
        figure = new_figure(8, 5)
        axes = figure.subplots()
        for style, n in enumerate(sorted({row["gaussians"] for row in models})):
            _model_lines(axes, [row for row in models if row["gaussians"] == n], style)
        photos.sort(key=lambda row: float(row["kb"]))
        axes.plot(
            [r["kb"] for r in photos],
            [r["psnr"] for r in photos],
            "k-P",
            ms=5,
            lw=0.8,
            label="images as PNG",
        )
        shown = [*models, *photos]
        costs = [np.nan if row["quantiser"] == "by H, known" else row["kb"] for row in shown]
        on = pareto_front(costs, [row["psnr"] for row in shown])
        _front(
            axes,
            [row | {"on": flag} for row, flag in zip(shown, on, strict=True)],
            "psnr",
            "on",
            "kb",
        )
        for text, name in (
            ("one step a column", "one step"),
            ("steps by H, sent", "by H"),
            ("a bound", "by H, known"),
        ):
            axes.plot([], [], DASHES[name], color="#444444", lw=1, label=text)
        axes.plot([], [], "o", mfc="white", color="#444444", label="float32")
        _seconds_axis(axes)
        axes.set(xlabel="kilobytes sent", ylabel="PSNR on the test views, dB")
        axes.legend(loc="lower right", ncols=2)
        _label(axes, photos, "kb", "psnr", lambda row: f"{row['images']} images")
        save_figure(figure, path)


def _model_lines(axes: Any, rows: Rows, style: int) -> None:
    """One model: a line for each way to round its numbers, and an empty marker for float32."""
    look = {"marker": MARKERS[style % 7], "color": COLOURS[style % 7]}
    for quantiser, dash in DASHES.items():
        some = sorted(
            (row for row in rows if row["quantiser"] == quantiser), key=lambda row: float(row["kb"])
        )
        label = f"{rows[0]['gaussians']:,} Gaussians" if quantiser == "by H" else None
        axes.plot(
            [r["kb"] for r in some],
            [r["psnr"] for r in some],
            ls=dash,
            ms=3,
            lw=1,
            label=label,
            **look,
        )
    whole = [row for row in rows if row["quantiser"] == "float32"]
    axes.plot([r["kb"] for r in whole], [r["psnr"] for r in whole], ls="none", mfc="white", **look)


FIGURES: dict[str, tuple[str, Callable[[str | Path, Rows], None]]] = {
    "fit": ("fit", fit_figure),
    "passes": ("fit", passes_figure),
    "scoring": ("scoring", scoring_figure),
    "core": ("core", core_figure),
    "bytes": ("bytes", bytes_figure),
}
"""Each figure by its name: the chart whose rows it draws, and how."""
