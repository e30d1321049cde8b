"""Figures that compare runs: each function takes plain data and writes one PNG.
`mgs.report.writing` calls them.

"Label" is what a run is called in a report: its policy, and its folder if several runs have the
same policy. Every function raises InputError if its file cannot be written.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.data.up import PLUS_Z, Up, upright
from mgs.plotting import STYLE, crop, new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

POLICY_STYLE: dict[str, tuple[str, str | tuple[int, int, int]]] = {
    "d-optimal": ("#0072B2", "o"),
    "coverage": ("#D55E00", "s"),
    "random": ("#009E73", "^"),
    "uniform": ("#CC79A7", "D"),
    "farthest": ("#E69F00", "v"),
    "t-optimal": ("#56B4E9", "P"),
    "a-optimal": ("#000000", "X"),
    "fisherrf": ("#7f7f7f", "p"),
    "e-optimal": ("#8c510a", "*"),
    "directional-i": ("#5500bb", "<"),
    "directional-d": ("#770000", ">"),
    "paper": ("#335533", "h"),
    "i-optimal": ("#7755dd", "d"),
    "block-d": ("#bbbb77", (4, 1, 0)),
    "angle": ("#553355", (6, 1, 0)),
    "cover": ("#000066", "8"),
    "completeness": ("#8888ee", "H"),
}
"""Colour and marker of each policy, the same in every figure. The first seven colours are those of
Okabe and Ito; the others were chosen so that colour-blind people can tell them all apart. The
markers tell them apart in grey."""


def line_styles(labels: Iterable[str]) -> list[dict[str, Any]]:
    """How to draw the line of each label: keywords for matplotlib's `plot`.

    The first line of a policy in POLICY_STYLE has the policy's colour and marker. A second line of
    the same policy, and one of a policy of the user's own, takes colour and marker of a policy that
    has no line, from the end of the table. When none are left, they are used again, for dashed
    lines.
    """
    labels = list(labels)
    first = {label.split(" ")[0]: label for label in reversed(labels)}
    taken = {
        label: POLICY_STYLE[policy] for policy, label in first.items() if policy in POLICY_STYLE
    }
    free = [style for style in reversed(POLICY_STYLE.values()) if style not in taken.values()]
    spare = chain(
        ((style, "-") for style in free), cycle((style, "--") for style in POLICY_STYLE.values())
    )
    styles = []
    for label in labels:
        (colour, marker), dashes = (taken[label], "-") if label in taken else next(spare)
        styles.append({"color": colour, "marker": marker, "linestyle": dashes, "label": label})
    return styles


def orbit_figure(
    path: str | Path,
    positions: np.ndarray,
    surface: np.ndarray | None,
    choices: Mapping[str, tuple[Sequence[int], Sequence[int]]],
    up: Up = PLUS_Z,
    unit: str = "m",
) -> None:
    """The orbit from above, in one panel for each run: all poses, the seeds, and the chosen views,
    numbered in their order.

    positions: [C,3] camera centres, world. surface: [N,3] points of the rock, or None to leave it
    out. choices: label -> (indices of the seeds, indices of the chosen views in their order), into
    positions. up, unit: of the world (`mgs.data.dataset.Dataset`); where +Z is not up, the world is
    turned by `mgs.data.up.upright` before it is drawn.
    """
    import matplotlib
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    turn, (x, y, _) = upright(up), axis_names(up, unit)
    positions = np.asarray(positions) @ turn.T
    surface = None if surface is None else np.asarray(surface) @ turn.T
    with matplotlib.rc_context(STYLE):
        figure = new_figure(3.1 * len(choices) + 0.8, 3.9)
        axes = figure.subplots(1, len(choices), sharex=True, sharey=True, squeeze=False)[0]
        last = max((len(chosen) for _, chosen in choices.values()), default=1)
        norm = Normalize(1, max(last, 2))
        for axis, (policy, (seeds, chosen)) in zip(axes, choices.items(), strict=True):
            _orbit_panel(axis, positions, surface, list(seeds), list(chosen), norm)
            axis.set(
                title=_in_lines(f"{policy}: {len(seeds)} seeds, {len(chosen)} chosen"), xlabel=x
            )
        axes[0].set_ylabel(y)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        bar = figure.colorbar(ScalarMappable(norm, "viridis"), ax=list(axes), shrink=0.8, pad=0.01)
        bar.locator = MaxNLocator(integer=True)
        bar.set_label("step at which the view was chosen")
        for _ in range(
            3
        ):  # panels of a fixed aspect: matplotlib's layout finds room for titles of two lines by and by only
            figure.draw_without_rendering()
        save_figure(figure, path)


def axis_names(up: Up, unit: str) -> tuple[str, str, str]:
    """What the axes of a world are called that is turned so that +Z is up: x, y and z only where it
    had not to be turned."""
    names = ("x", "y", "z") if up == PLUS_Z else ("horizontal", "horizontal, across", "up")
    return (f"{names[0]} ({unit})", f"{names[1]} ({unit})", f"{names[2]} ({unit})")


def _orbit_panel(
    axis: Axes,
    positions: np.ndarray,
    surface: np.ndarray | None,
    seeds: list[int],
    chosen: list[int],
    norm: Any,
) -> None:
    """The panel of one run in `orbit_figure`. norm: scale of the colours by which the order of the
    choices is shown."""
    xy = np.asarray(positions)[:, :2]
    centre = xy.mean(axis=0) if surface is None else np.asarray(surface)[:, :2].mean(axis=0)
    if surface is not None:
        rock = np.asarray(surface)[:: max(1, len(surface) // 6000)]
        axis.scatter(rock[:, 0], rock[:, 1], s=0.6, color="#b9b4ab", linewidths=0, zorder=1)
    axis.scatter(
        xy[:, 0],
        xy[:, 1],
        s=12,
        facecolors="white",
        edgecolors="#9a9a9a",
        linewidths=0.6,
        label="candidate",
        zorder=2,
    )
    axis.scatter(
        xy[seeds, 0],
        xy[seeds, 1],
        s=46,
        marker="*",
        color="#D55E00",
        linewidths=0,
        label="seed",
        zorder=4,
    )
    order = np.arange(1, len(chosen) + 1)
    axis.scatter(
        xy[chosen, 0],
        xy[chosen, 1],
        s=26,
        c=order,
        cmap="viridis",
        norm=norm,
        linewidths=0,
        label="chosen",
        zorder=3,
    )
    for number, index in zip(order, chosen, strict=True):
        outward = xy[index] - centre
        outward = outward / max(float(np.linalg.norm(outward)), 1e-9)
        axis.annotate(
            str(number),
            xy[index],
            xytext=tuple(outward * 9),
            textcoords="offset points",
            fontsize=6,
            ha="center",
            va="center",
        )
    span = np.abs(xy - centre).max() * 1.2
    axis.set(
        xlim=(centre[0] - span, centre[0] + span),
        ylim=(centre[1] - span, centre[1] + span),
        aspect="equal",
    )


def gain_figure(path: str | Path, gains: Mapping[str, Sequence[float]]) -> None:
    """Information gain (the paper's Eq. 7) of the view that each step selected, one line for each
    run (the paper's Fig. 2).

    gains: label -> gain of each step after the seeds.
    """
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = new_figure(4.8, 3.1)
        axis = figure.subplots()
        for values, style in zip(gains.values(), line_styles(gains), strict=True):
            axis.plot(np.arange(1, len(values) + 1), values, **style)
        axis.set(xlabel="active step", ylabel=r"$\mathrm{IG}_D$ of the selected view")
        axis.set_ylim(bottom=0)
        _whole_steps(axis)
        _legend_beside(figure)
        save_figure(figure, path)


def coverage_figure(
    path: str | Path, coverage: Mapping[str, tuple[Sequence[int], Sequence[float]]]
) -> None:
    """Surface coverage after each step, and what each step added to it, one line for each run (the
    paper's Fig. 3).

    coverage: label -> (number of images in the training set, share of the surface observed, 0 to
    1), after the seeds and then after each step.
    """
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = new_figure(7.2, 3.1)
        left, right = figure.subplots(1, 2)
        for (images, shares), style in zip(coverage.values(), line_styles(coverage), strict=True):
            percent = 100 * np.asarray(shares, float)
            left.plot(images, percent, **style)
            right.plot(list(images)[1:], np.diff(percent), **style)
        left.set(xlabel="images", ylabel=r"surface coverage $C$ (%)")
        right.set(xlabel="images", ylabel="coverage gained (percentage points)")
        right.axhline(0, color="#9a9a9a", linewidth=0.8, zorder=0)
        for axis in (left, right):
            _whole_steps(axis)
        _legend_beside(figure)
        save_figure(figure, path)


def psnr_figure(
    path: str | Path, panels: Mapping[str, Mapping[str, tuple[Sequence[int], Sequence[float]]]]
) -> None:
    """PSNR against the number of images, one line for each run, in one panel for each thing that is
    measured.

    panels: what is measured -> label -> (numbers of images, PSNR in dB).
    """
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = new_figure(3.6 * len(panels), 3.1)
        axes = figure.subplots(1, len(panels), squeeze=False)[0]
        for axis, (what, curves) in zip(axes, panels.items(), strict=True):
            for (images, decibels), style in zip(curves.values(), line_styles(curves), strict=True):
                axis.plot(images, decibels, **style)
            axis.set(xlabel="images in the training set", ylabel=f"PSNR, {what} (dB)")
            _whole_steps(axis)
        _legend_beside(figure)
        save_figure(figure, path)


def _legend_beside(figure: Figure) -> None:
    """Put the legend of a figure's first axes to the right of all axes, where it covers no line,
    and make the figure larger by the room that it takes."""
    legend = figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper")
    box, (width, height) = legend.get_window_extent(), figure.get_size_inches()
    figure.set_size_inches(
        width + box.width / figure.dpi, max(height, box.height / figure.dpi + 0.1)
    )


def _whole_steps(axis: Axes) -> None:
    """Put the ticks of the x axis at whole numbers."""
    from matplotlib.ticker import MaxNLocator

    axis.xaxis.set_major_locator(MaxNLocator(integer=True))


def comparison_figure(
    path: str | Path,
    truth: np.ndarray,
    renders: Mapping[str, np.ndarray],
    *,
    title: str = "",
    captions: Mapping[str, str] | None = None,
) -> None:
    """Truth and renders of one view, each with its absolute difference below (the paper's Fig. 4),
    cropped to the rock.

    truth, renders: linear RGB [H,W,3]; captions: policy -> text under its name (PSNR, SSIM).
    """
    import matplotlib

    window = crop(truth.max(axis=2) > 0)
    shown = srgb_from_linear(truth)[window]
    images = {policy: srgb_from_linear(image)[window] for policy, image in renders.items()}
    differences = {policy: np.abs(image - shown).mean(axis=2) for policy, image in images.items()}
    limit = max(float(np.quantile(d, 0.995)) for d in differences.values()) or 1.0
    columns, aspect = 1 + len(images), shown.shape[0] / shown.shape[1]
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = new_figure(2.7 * columns, 2.7 * aspect * 2 + 0.9, dpi=150)
        axes = figure.subplots(2, columns)
        axes[0, 0].imshow(shown, interpolation="nearest")
        axes[0, 0].set_title(f"truth\n{_in_lines(title)}")
        for column, (policy, image) in enumerate(images.items(), 1):
            axes[0, column].imshow(image, interpolation="nearest")
            caption = f"\n{_in_lines(captions[policy])}" if captions and policy in captions else ""
            axes[0, column].set_title(_in_lines(policy) + caption)
            map_ = axes[1, column].imshow(
                differences[policy], cmap="magma", vmin=0, vmax=limit, interpolation="nearest"
            )
        for axis in axes.flat:
            axis.set_axis_off()
        axes[1, 0].text(
            0.97,
            0.5,
            "absolute\ndifference",
            ha="right",
            va="center",
            transform=axes[1, 0].transAxes,
        )
        bar = figure.colorbar(
            map_, ax=list(axes[1, 1:]), orientation="horizontal", shrink=0.6, pad=0.02, aspect=40
        )
        label = "mean absolute difference of the sRGB channels, in [0, 1]"
        bar.set_label(label if columns > 2 else _in_lines(label))
        save_figure(figure, path)


def _in_lines(text: str, width: int = 34) -> str:
    """Text in lines of at most that many characters: what fits above one column of a figure."""
    return "\n".join(textwrap.wrap(text, width))
