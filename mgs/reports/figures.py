"""Figures of reports: each function takes plain data and writes one file, a PNG, PDF or SVG. Raises
InputError if it cannot be written. A label is what a report calls a run."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.plotting import NO_GRID, crop, drawing, literal
from mgs.run.policies import POLICIES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLES: tuple[tuple[str, str | tuple[int, int, int]], ...] = (
    ("#5500bb", "<"), ("#770000", ">"), ("#335533", "h"), ("#0072B2", "o"), ("#56B4E9", "P"),
    ("#7f7f7f", "p"), ("#D55E00", "s"), ("#000066", "d"), ("#CC79A7", "D"), ("#E69F00", "v"),
    ("#009E73", "^"), ("#8888ee", "H"), ("#553355", (6, 1, 0)), ("#bbbb77", (4, 1, 0)),
    ("#7755dd", "8"), ("#8c510a", "*"), ("#000000", "X"),
)  # fmt: skip
"""Colours and markers of lines, all of which colour-blind readers can tell apart."""

POLICY_STYLE = dict(zip(POLICIES, STYLES, strict=False))  # the same in every figure

Curves = Mapping[str, tuple[Sequence[float], Sequence[float]]]
"""Label of a run -> x and y of its line."""


def line_styles(labels: Iterable[str]) -> list[dict[str, Any]]:
    """Style of the line of each label: keywords for matplotlib's `plot`. The first line of a policy
    has the style of the policy. All others take those of STYLES that are no policy's, one after the
    other, then all again with dashed and dotted lines."""
    spare = chain(
        ((style, "-") for style in STYLES[len(POLICY_STYLE) :]),
        ((style, dashes) for dashes in cycle(("--", ":")) for style in STYLES),
    )
    unused, styles = dict(POLICY_STYLE), []
    for label in labels:
        own = unused.pop(label.split(" ")[0], None)
        (colour, marker), dashes = (own, "-") if own else next(spare)
        style = {"color": colour, "marker": marker, "linestyle": dashes, "label": literal(label)}
        styles.append(style)
    return styles


ACROSS = 3  # most panels side by side in `orbit_figure`

SEED, CHOSEN, NEWEST = "#8a8a8a", "#0072B2", "#D55E00"
"""Colours of seeds, of chosen views, and of the one that was chosen last."""


def orbit_figure(
    path: str | Path,
    positions: np.ndarray,
    surface: np.ndarray,
    choices: Mapping[str, tuple[Sequence[int], Sequence[int]]],
    unit: str,
) -> None:
    """Draw the views that each run chose, from above, a panel for each run.

    positions: [C,3] camera centres, world. surface: [N,3] points of the rock. choices:
    label -> indices into positions: (seeds, chosen views in their order). unit: of the world."""
    columns = min(ACROSS, len(choices))
    lines = -(-len(choices) // columns)
    height = 2.75 * lines + (0.6 if columns > 1 else 1.1)
    with drawing(path, 2.7 * columns, height, NO_GRID) as figure:
        axes = figure.subplots(lines, columns, squeeze=False).ravel()
        for axis, (label, (seeds, views)) in zip(axes, choices.items(), strict=False):
            draw_cameras(axis, positions, surface, seeds, views)
            axis.set_title(_in_lines(label))
        for axis in axes[len(choices) :]:
            axis.remove()
        _draw_length(axes[0], unit)
        handles = axes[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=3 if columns > 1 else 1)
        several = "the views that each policy chose" if len(choices) > 1 else "the chosen views"
        figure.suptitle(f"From above: {several}")


def draw_cameras(
    axis: "Axes",
    positions: np.ndarray,
    surface: np.ndarray,
    seeds: Sequence[int],
    views: Sequence[int],
    newest: int | None = None,
) -> None:
    """Draw cameras from above into axes: all as rings, seeds as discs, chosen ones as discs with
    their order.

    newest: index of a camera to draw in NEWEST, with its line to the rock. Others: as
    `orbit_figure`."""
    xy, rock = positions[:, :2], surface[:: max(1, len(surface) // 6000), :2]
    centre = rock.mean(axis=0)
    axis.scatter(*rock.T, s=0.6, color="#b9b4ab", linewidths=0)
    hollow = {"facecolors": "white", "edgecolors": "#9a9a9a", "linewidths": 0.6}
    axis.scatter(*xy.T, s=14, label="candidate", **hollow)
    disc = {"s": 95, "linewidths": 0, "zorder": 3}
    axis.scatter(*xy[list(seeds)].T, color=SEED, label="seed", **disc)
    axis.scatter(*xy[list(views)].T, color=CHOSEN, label="chosen, in this order", **disc)
    if newest is not None:
        axis.plot(*np.stack([xy[newest], centre]).T, color=NEWEST, linewidth=1)
        axis.scatter(*xy[newest], color=NEWEST, **disc)
    text = {"color": "white", "fontsize": 7.5, "ha": "center", "va": "center_baseline"}
    for order, index in enumerate(views, 1):
        axis.annotate(str(order), xy[index], zorder=4, **text)
    span = np.abs(xy - centre).max() * 1.12
    low, high = centre - span, centre + span
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    axis.spines[:].set_visible(False)


def _draw_length(axis: "Axes", unit: str) -> None:
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    longest = float(np.ptp(axis.get_xlim())) / 4
    power = 10.0 ** np.floor(np.log10(longest))
    length = max(step * power for step in (1, 2, 5) if step * power <= longest)
    text, place = f"{length:g} {unit}", "lower left"
    bar = AnchoredSizeBar(axis.transData, length, text, place, pad=0, frameon=False, label_top=True)
    axis.add_artist(bar)


def curves_figure(
    path: str | Path, title: str, panels: Mapping[str, Curves], x: str = "images", **limits: float
) -> None:
    """Draw curves beside each other, a panel for each quantity and a line for each label.

    panels: title of the y axis -> curves. x: title of the x axis. limits: of the y axis, `bottom`
    or `top`."""
    from matplotlib.ticker import MaxNLocator

    with drawing(path, max(4.8, 3.6 * len(panels)), 3.1) as figure:
        figure.suptitle(title)
        axes = figure.subplots(1, len(panels), squeeze=False)[0]
        for axis, (y, curves) in zip(axes, panels.items(), strict=True):
            for (xs, ys), style in zip(curves.values(), line_styles(curves), strict=True):
                axis.plot(xs, ys, **style)
            axis.set(xlabel=x, ylabel=y)
            axis.set_ylim(**limits)
            axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        _legend_beside(figure)


def _legend_beside(figure: "Figure") -> None:
    """Put the legend of the first axes to the right of all, and widen the figure."""
    legend = figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper")
    box, (width, height), dpi = legend.get_window_extent(), figure.get_size_inches(), figure.dpi
    figure.set_size_inches(width + box.width / dpi, max(height, box.height / dpi + 0.1))


def comparison_figure(
    path: str | Path,
    truth: np.ndarray,
    renders: Mapping[str, np.ndarray],
    title: str,
    captions: Mapping[str, str],
) -> None:
    """Draw truth and renders of one view, and their absolute differences below (the paper's Fig.
    4), cropped to the rock.

    truth, renders: linear RGB [H,W,3]; captions: label -> text below it (PSNR, SSIM)."""
    window = crop(truth.max(axis=2) > 0)
    target = srgb_from_linear(truth)[window]
    images = {label: srgb_from_linear(image)[window] for label, image in renders.items()}
    differences = {label: np.abs(image - target).mean(axis=2) for label, image in images.items()}
    limit = max(float(np.quantile(d, 0.995)) for d in differences.values()) or 1.0
    columns, aspect = 1 + len(images), target.shape[0] / target.shape[1]
    with drawing(path, 2.7 * columns, 2.7 * aspect * 2 + 1.2, NO_GRID, dpi=150) as figure:
        figure.suptitle("One view: truth, renders, errors")
        axes = figure.subplots(2, columns)
        axes[0, 0].imshow(target, interpolation="nearest")
        axes[0, 0].set_title(f"truth\n{_in_lines(title)}")
        scale = {"cmap": "magma", "vmin": 0, "vmax": limit, "interpolation": "nearest"}
        for (above, below), (label, image) in zip(axes.T[1:], images.items(), strict=True):
            above.imshow(image, interpolation="nearest")
            above.set_title(f"{_in_lines(label)}\n{_in_lines(captions[label])}")
            map_ = below.imshow(differences[label], **scale)
        for axis in axes.flat:
            axis.set_axis_off()
        corner = axes[1, 0]
        place = {"ha": "right", "va": "center", "transform": corner.transAxes}
        corner.text(0.97, 0.5, "absolute\ndifference", **place)
        layout = {"orientation": "horizontal", "shrink": 0.6, "pad": 0.02, "aspect": 40}
        bar = figure.colorbar(map_, ax=list(axes[1, 1:]), **layout)
        meaning = "mean absolute difference of the sRGB channels, in [0, 1]"
        bar.set_label(meaning if columns > 2 else _in_lines(meaning))


def _in_lines(text: str) -> str:
    return "\n".join(textwrap.wrap(literal(text), 34))
