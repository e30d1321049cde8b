"""Output of studies: tables as CSV, JSON and Markdown, and plots of rows with intervals."""

import csv
import io
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.files import write_json, write_text
from mgs.plotting import NO_GRID, STYLE, drawing
from mgs.provenance import versions
from mgs.reports.figures import POLICY_STYLE, STYLES
from mgs.reports.tables import markdown
from mgs.runtime import processor
from studies.frame.program import Work
from studies.frame.statistics import Row, interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Content = str | Callable[[Row], str]
"""Content of a column: a format such as "psnr:.2f" (key and format), or a function of the row."""


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write records as CSV and return the path. Columns are all keys in order of appearance. None
    and missing keys give empty cells."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    file = io.StringIO(newline="")
    writer = csv.DictWriter(file, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, file.getvalue())
    return path


def table(columns: Mapping[str, Content], rows: Iterable[Row]) -> str:
    """Markdown table of rows. columns: content by heading."""
    return markdown(
        list(columns), [[text_of(cell, row) for cell in columns.values()] for row in rows]
    )


def text_of(cell: Content, row: Row) -> str:
    """Text of a column's content for a row; a dash for a missing value."""
    if not isinstance(cell, str):
        return cell(row)
    key, _, form = cell.partition(":")
    value = row.get(key)
    return "–" if value is None else format(value, form)


def with_interval(row: Row, key: str) -> str:
    """A difference and its 95 % interval (KEY_low, KEY_high), if there is one."""
    if row.get(key) is None:
        return "–"
    if row[f"{key}_low"] is None:
        return f"{row[key]:+.2f}"
    return f"{row[key]:+.2f} [{row[f'{key}_low']:+.2f}, {row[f'{key}_high']:+.2f}]"


def over_scenes(rows: Iterable[Row], key: str) -> dict[str, float]:
    """Mean of a key over the rocks of each scene; NaN where a value is missing.

    A scene is the unit of statistics, because rocks of one scene are not independent.
    """
    values: dict[str, list[Any]] = {}
    for row in rows:
        values.setdefault(row["scene"], []).append(row[key])
    return {scene: float(np.mean(np.array(of, float))) for scene, of in values.items()}


def grouped(rows: Iterable[Row], *keys: str) -> list[Row]:
    """A row for each group of the same values of `keys`, with these and the group's rows "of"."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return [dict(zip(keys, group, strict=True)) | {"of": of} for group, of in groups.items()]


def scene_mean(key: str, form: str, ends: bool = True, **only: Any) -> Content:
    """Content for a row of `grouped`: mean over scenes with its 95 % interval; a dash where a value
    is missing. only: entries that rows must have."""

    def cell(group: Row) -> str:
        rows = [row for row in group["of"] if only.items() <= row.items()]
        values = list(over_scenes(rows, key).values())
        if np.isnan(values).any():
            return "–"
        between, middle = interval(values), format(float(np.mean(values)), form)
        if between is None or not ends:
            return middle
        return f"{middle} [{between[0]:{form}}, {between[1]:{form}}]"

    return cell


def write_table(work: Work, name: str, rows: Sequence[Row], text: str, **more: Any) -> list[Path]:
    """Write NAME.csv of rows with command and commit, NAME.md of a text, and NAME.json with both,
    the command, the machine and more entries. Returns the paths."""
    out, command = work.out, work.command
    record = {"command": command, "machine": processor(), "versions": versions(), **more}
    write_json(out / f"{name}.json", record | {"rows": rows, "markdown": text})
    write_text(out / f"{name}.md", f"{text}\n`{command}`\n")
    anywhere = command.replace(str(work.options.out), "OUT")  # names no folder of this machine
    origin = {"command": anywhere, "commit": versions().get("commit", "")}
    paths = [out / f"{name}{end}" for end in (".csv", ".json", ".md")]
    write_csv(paths[0], [row | origin | row for row in rows])
    return paths


def read_rows(path: Path) -> list[Row]:
    """Read the rows that `write_table` wrote as CSV: numbers, True and False, None where empty."""
    with open(path, newline="", encoding="utf-8") as file:
        return [{key: _value(text) for key, text in row.items()} for row in csv.DictReader(file)]


def _value(text: str) -> Any:
    if text in ("True", "False"):
        return text == "True"
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text or None


def tables_of(path: Path) -> list[str]:
    """Markdown tables of a study's NAME.csv, by `tables` of its module. A page takes its tables
    from these when the site is built."""
    tables = import_module(f"studies.{path.stem}").tables(read_rows(path))
    return re.findall(r"^\|.*?(?=\n\n|\n*\Z)", tables, re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Panel:
    """Plot of rows: the mean of column y over rows with its 95 % interval, against column x.

    by: column with a line for each value. log: x is logarithmic. only: entries that a row must
    have. Text in column x gives one line of the plot for each value.
    """

    x: str
    y: str
    x_label: str
    y_label: str
    by: str | None = None
    log: bool = False
    only: tuple[tuple[str, Any], ...] = ()
    title: str = ""


WIDTH, HEIGHT, PER_NAME, PER_LETTER = 2.7, 2.7, 0.17, 0.06
"""Size of a plot against numbers, height of a name and width of its letters; inches."""

COLUMNS = 3
"""Most plots side by side."""


def draw_panels(path: Path, panels: Sequence[Panel], rows: Sequence[Row], title: str = "") -> None:
    """Draw the panels that have rows. title: of all.

    Panels with the same groups share a legend, also where some have only the first of them.
    """
    drawn = [(panel, chosen) for panel in panels if (chosen := _rows_of(panel, rows))]
    columns = min(COLUMNS, len(drawn))
    lines = [drawn[k : k + columns] for k in range(0, len(drawn), columns)]
    heights = [max(_size(*plot)[1] for plot in line) for line in lines]
    widths = [max(_size(*plot)[0] for plot in drawn[k::columns]) for k in range(columns)]
    ratios = {"width_ratios": widths, "height_ratios": heights}
    groups = [_groups(*plot) for plot in drawn]
    most = max(range(len(groups)), key=lambda k: len(groups[k]))
    alike = all(one == groups[most][: len(one)] != [None] for one in groups)
    shared = len(drawn) > 1 and alike
    with drawing(path, sum(widths), sum(heights), STYLE | {"legend.fontsize": 8}) as figure:
        axes = figure.subplots(len(lines), columns, squeeze=False, gridspec_kw=ratios).ravel()
        for axis, (panel, chosen) in zip(axes, drawn, strict=False):
            (_draw_lines if _numeric(panel, chosen) else _draw_names)(axis, panel, chosen)
            if panel.by and not shared:
                across = _legend_columns(_groups(panel, chosen))
                axis.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=across)
                title = title or panel.title
            else:
                axis.set_title(panel.title)
        for axis in axes[len(drawn) :]:
            axis.remove()
        if title:
            figure.suptitle(title)
        if shared:
            handles, labels = axes[most].get_legend_handles_labels()
            side = "lower" if title else "upper"
            figure.legend(handles, labels, loc=f"outside {side} center", ncols=2 * columns)


def draw_matrix(path: Path, panel: Panel, rows: Sequence[Row]) -> None:
    """Draw a column y of rows as numbers in a matrix: x across, `by` down, best mean first.

    Blue is above 0, orange below. A number is bold where its interval (columns y_low, y_high) is on
    one side of 0. Raises InputError if the file cannot be written.
    """
    across = list(dict.fromkeys(row[panel.x] for row in rows))
    cells = {(row[panel.by or ""], row[panel.x]): row for row in rows}
    groups = list(dict.fromkeys(row[panel.by or ""] for row in rows))

    def value(group: Any, x: Any, end: str = "") -> float:
        found = cells.get((group, x), {}).get(f"{panel.y}{end}")
        return float("nan") if found is None else float(found)

    groups.sort(key=lambda group: -np.nanmean([value(group, x) for x in across]))
    numbers = np.array([[value(group, x) for x in across] for group in groups])
    limit = float(np.nanmax(np.abs(numbers))) or 1.0
    with drawing(path, 1.6 + 0.95 * len(across), 0.9 + 0.3 * len(groups), NO_GRID) as figure:
        axes = figure.subplots()
        scale = {"cmap": "PuOr", "vmin": -1.6 * limit, "vmax": 1.6 * limit, "aspect": "auto"}
        axes.imshow(numbers, **scale)
        for i, group in enumerate(groups):
            for k, x in enumerate(across):
                sure = value(group, x, "_low") > 0 or value(group, x, "_high") < 0
                weight = "bold" if sure else "normal"
                text = "–" if np.isnan(numbers[i, k]) else f"{numbers[i, k]:+.2f}"
                axes.text(k, i, text, ha="center", va="center", fontweight=weight)
        axes.set_xticks(range(len(across)), across)
        axes.set_yticks(range(len(groups)), groups)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.set_title(panel.title)


def _rows_of(panel: Panel, rows: Sequence[Row]) -> list[Row]:
    needed = {panel.x, panel.y, panel.by or panel.x}
    return [r for r in rows if needed <= r.keys() and all(r.get(k) == v for k, v in panel.only)]


def _numeric(panel: Panel, rows: Sequence[Row]) -> bool:
    return not isinstance(rows[0][panel.x], str)


def _groups(panel: Panel, rows: Sequence[Row]) -> list[Any]:
    return list(dict.fromkeys(row[panel.by] for row in rows)) if panel.by else [None]


def _legend_columns(groups: Sequence[Any]) -> int:
    """Columns of a legend that is no wider than its plot."""
    return 1 if max(len(str(group)) for group in groups) > 15 else 2


def _size(panel: Panel, rows: Sequence[Row]) -> tuple[float, float]:
    """Width and height of a plot with its legend, inches."""
    groups, names = len(_groups(panel, rows)), list(dict.fromkeys(row[panel.x] for row in rows))
    across = _legend_columns(_groups(panel, rows))
    legend = 0.17 * -(-groups // across) if panel.by else 0.0
    if _numeric(panel, rows):
        return WIDTH, HEIGHT + legend
    height = 0.8 + PER_NAME * len(names) * max(1.0, 0.6 * groups)
    return WIDTH + PER_LETTER * max(map(len, names)), height + legend


GROUP_STYLES = [STYLES[k] for k in (3, 6, 10, 8, 9, 0, 4, 5)]
"""Styles of groups that are no policies, bright ones first."""


def group_styles(groups: Sequence[Any]) -> list[dict[str, Any]]:
    """Keywords for matplotlib: policies as in all figures, others as in GROUP_STYLES."""
    of_policies = all(group in POLICY_STYLE for group in groups)
    looks = [POLICY_STYLE[one] for one in groups] if of_policies else cycle(GROUP_STYLES)
    pairs = zip(groups, looks, strict=False)
    return [{"color": c, "marker": m, "label": group} for group, (c, m) in pairs]


def _points(panel: Panel, rows: Sequence[Row], group: Any) -> tuple[list[Any], np.ndarray]:
    """Values of x, and [3,X] for each of them: mean of y, low and high end of its interval."""
    values: dict[Any, list[float]] = {}
    for row in rows:
        if panel.by is None or row[panel.by] == group:
            values.setdefault(row[panel.x], []).append(float(row[panel.y]))
    means = [float(np.mean(of_x)) for of_x in values.values()]
    ends = [interval(of_x) or (m, m) for of_x, m in zip(values.values(), means, strict=True)]
    return list(values), np.array([(m, *pair) for m, pair in zip(means, ends, strict=True)]).T


def _draw_lines(axis: "Axes", panel: Panel, rows: Sequence[Row]) -> None:
    """Lines through the means against a number, with their intervals as bands."""
    groups = _groups(panel, rows)
    crowded = len({row[panel.x] for row in rows}) > 30
    for group, style in zip(groups, group_styles(groups), strict=True):
        xs, points = _points(panel, rows, group)
        order = np.argsort(xs)
        x, (mean, low, high) = np.asarray(xs, float)[order], points[:, order]
        alone = {"marker": "*", "markersize": 13, "color": "black", "zorder": 3}
        look = alone if len(x) == 1 else {"marker": ""} if crowded else {}
        axis.plot(x, mean, **(style | look))
        axis.fill_between(x, low, high, color=style["color"], alpha=0.15, linewidth=0)
    if panel.log:
        logarithmic(axis)
    elif all(isinstance(row[panel.x], int) for row in rows):
        axis.xaxis.get_major_locator().set_params(integer=True)
    axis.set(xlabel=panel.x_label, ylabel=textwrap.fill(panel.y_label, 31))


def logarithmic(axis: "Axes") -> None:
    """Make the x axis logarithmic, with plain numbers where it spans few decades."""
    from matplotlib.ticker import LogLocator, NullFormatter

    low, high = axis.dataLim.intervalx
    axis.set_xscale("log")
    axis.xaxis.set_minor_formatter(NullFormatter())
    if low > 1e-3 and high < min(1e6, 300 * low):
        subs = (1, 2, 5) if high > 12 * low else (1, 1.5, 2, 3, 5, 7)
        axis.xaxis.set_major_locator(LogLocator(subs=subs))
        axis.xaxis.set_major_formatter(lambda x, _: f"{x:g}" if x < 1e4 else f"{x / 1000:g}k")


def _draw_names(axis: "Axes", panel: Panel, rows: Sequence[Row]) -> None:
    """A line for each name: the mean as a point, its interval as a bar."""
    groups = _groups(panel, rows)
    names = list(dict.fromkeys(row[panel.x] for row in rows))
    for k, (group, style) in enumerate(zip(groups, group_styles(groups), strict=True)):
        shown, (mean, low, high) = _points(panel, rows, group)
        offset = (k - (len(groups) - 1) / 2) * 0.6 / len(groups)
        place = [names.index(name) + offset for name in shown]
        bars = np.abs([mean - low, high - mean])
        axis.errorbar(mean, place, xerr=bars, capsize=2, **(style | {"linestyle": "none"}))
    axis.set_ylim(len(names) - 0.4, -0.6)
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.tick_params(axis="y", length=0)
    if all(0 <= float(row[panel.y]) <= 1 for row in rows):  # a share: its scale begins at zero
        axis.update_datalim([(0.0, 0.0)])
    axis.margins(x=0.08)
    axis.autoscale(axis="x")
    y_label = textwrap.fill(panel.x_label, 12 + len(names))
    axis.set(xlabel=textwrap.fill(panel.y_label, 31), ylabel=y_label)
