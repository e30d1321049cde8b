"""Points over rocks, tables and the figure of the charts (`studies.chart`)."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mgs.plotting import drawing
from studies.frame.output import (
    Content,
    group_styles,
    grouped,
    logarithmic,
    over_scenes,
    scene_mean,
    table,
)
from studies.frame.statistics import Row, interval, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SETTINGS = (
    "kind", "images", "density", "passes", "warm_passes", "warm_rate", "policy", "estimator",
)  # fmt: skip
"""Columns that name a point."""


def points_over_rocks(rows: Sequence[Row]) -> list[Row]:
    """A row for each point, with those of its rocks "of" it, and means of "seconds" and
    "psnr_more". "front": whether it has the rates of the base, and no such point of its kind and
    number of images has a higher PSNR in less time.

    The rows "of" it get "times" the seconds, and "psnr_more" and "psnr_mask_more" (dB) against the
    base of the kind on the same rock.
    """
    empty_columns = dict.fromkeys((*SETTINGS, "preset"))
    full_rows = [empty_columns | row | {"policy": row.get("policy") or ""} for row in rows]
    points = grouped(full_rows, *SETTINGS)
    for kind in grouped(points, "kind"):
        base_rows = {row["rock"]: row for row in base_of(kind["of"])["of"]}
        for point in kind["of"]:
            for row in point["of"]:
                base = base_rows[row["rock"]]
                row["times"] = row["seconds"] / base["seconds"]
                for key in ("psnr", "psnr_mask"):
                    row[f"{key}_more"] = row[key] - base[key]
            point["preset"], point["front"] = point["of"][0]["preset"], False
            for key in ("seconds", "psnr_more"):
                point[key] = float(np.mean([row[key] for row in point["of"]]))
    usual = [p for p in points if p["warm_rate"] == base_of(points)["warm_rate"]]
    for alike in grouped(usual, "kind", "images"):
        seconds, gains = ([point[key] for point in alike["of"]] for key in ("seconds", "psnr_more"))
        for point, on in zip(alike["of"], pareto_front(seconds, gains), strict=True):
            point["front"] = bool(on)
    return points


def base_of(points: Sequence[Row]) -> Row:
    return next(point for point in points if point["of"][0]["base"])


WORDS = {
    "density": "{:g} samples a pixel",
    "passes": "{} passes",
    "warm_rate": "later fits at {:g} times the first rates",
    "images": "{} images",
    "policy": "policy {}",
    "estimator": "estimator {}",
}
"""Settings of a point, in words."""


def changes(points: Sequence[Row]) -> list[Row]:
    """Points that differ from the base of their kind in one of WORDS, with the change in words."""
    changed = []
    for kind in grouped(points, "kind"):
        base = base_of(kind["of"])
        for point in kind["of"]:
            keys = [key for key in WORDS if point[key] != base[key]]
            if len(keys) == 1:
                words = WORDS[keys[0]].format(point[keys[0]])
                changed.append(point | {"change": f"{kind['kind']}: {words}"})
    return changed


def _settings_text(point: Row) -> str:
    passes = f"{point['passes']} passes"
    passes += f", then {point['warm_passes']}" if point["policy"] else ""
    name = f"**{point['preset']}**: " if point["preset"] else ""
    estimator = "" if point["estimator"] == "exact" else point["estimator"]
    density = WORDS["density"].format(point["density"])
    return name + ", ".join(part for part in (density, passes, point["policy"], estimator) if part)


def tables(rows: Sequence[Row]) -> str:
    """Table of single changes; of fits, then of runs, on the fronts or with a preset."""
    points = points_over_rocks(rows)
    columns: dict[str, Content] = {"change": "change"}
    columns |= {"times the seconds": scene_mean("times", ".2f", ends=False)}
    columns |= {"PSNR (dB)": scene_mean("psnr_more", "+.2f")}
    columns |= {"rock (dB)": scene_mean("psnr_mask_more", "+.2f")}
    texts = [table(columns, changes(points))]
    means = {
        "seconds": ("seconds", ".2g"),
        "PSNR (dB)": ("psnr", ".2f"),
        "SSIM": ("ssim", ".4f"),
        "rock (dB)": ("psnr_mask", ".2f"),
    }
    columns = {"on the front, or a preset": _settings_text, "images": "images"}
    columns |= {head: scene_mean(*of, ends=False) for head, of in means.items()}
    for kind in grouped(points, "kind"):
        shown = [point for point in kind["of"] if point["front"] or point["preset"]]
        texts.append(table(columns, sorted(shown, key=lambda p: (p["images"], p["seconds"]))))
    return "\n".join(texts)


TITLES = {"fit": "What a second buys: single fits", "run": "What a second buys: whole runs"}
"""Titles of the figures of the kinds."""


def draw(path: Path, points: Sequence[Row]) -> None:
    """Draw seconds against the gain in PSNR over the base, a panel for each kind, for points of the
    base's number of images: a line for each label, with intervals, samples a pixel beside the
    points, the best of each time and the names of presets.

    Raises InputError if the file cannot be written.
    """
    kinds = grouped(points, "kind")
    with drawing(path, 0.6 + 4.2 * len(kinds), 4.6) as figure:
        panels = figure.subplots(1, len(kinds), squeeze=False)[0]
        for axes, kind in zip(panels, kinds, strict=True):
            _draw_kind(axes, kind["of"])
            axes.set_title(TITLES[kind["kind"]])


def _label(point: Row) -> str:
    if not point["policy"]:
        return f"{point['passes']} passes"
    passes = f"{point['passes']}, then {point['warm_passes']} passes"
    return f"{point['policy']}, {passes if point['estimator'] == 'exact' else point['estimator']}"


def _draw_kind(axes: "Axes", points: Sequence[Row]) -> None:
    most, rate = (base_of(points)[key] for key in ("images", "warm_rate"))
    points = [p for p in points if (p["images"], p["warm_rate"]) == (most, rate)]
    points = [point | {"label": _label(point)} for point in points]
    front = sorted((point["seconds"], point["psnr_more"]) for point in points if point["front"])
    ahead = {"color": "black", "linewidth": 1, "zorder": 1, "label": "best of its time"}
    axes.step(*zip(*front, strict=True), where="post", **ahead)
    lines = grouped(sorted(points, key=lambda point: point["density"]), "label")
    looks = group_styles([line["label"] for line in lines])
    for line, look in zip(lines, looks, strict=True):
        seconds, gains = ([point[key] for point in line["of"]] for key in ("seconds", "psnr_more"))
        spread = [list(over_scenes(point["of"], "psnr_more").values()) for point in line["of"]]
        ends = [interval(one) or (gain, gain) for one, gain in zip(spread, gains, strict=True)]
        bars = np.abs(np.transpose(ends) - gains)
        drawn = {"elinewidth": 0.8, "markersize": 6, "linewidth": 0.6, "linestyle": ":"}
        axes.errorbar(seconds, gains, yerr=bars, **(look | drawn))
        offset, side = ((6, -9), "left") if line is lines[0] else ((-6, 4), "right")
        for point in line["of"]:
            text = " ".join(word for word in (f"{point['density']:g}", point["preset"]) if word)
            at = point["seconds"], point["psnr_more"]
            how = {"textcoords": "offset points", "fontsize": 7, "ha": side}
            axes.annotate(text, at, offset, **how)
    logarithmic(axes)
    axes.margins(0.13)
    axes.set(xlabel=f"seconds, {most} images", ylabel="PSNR over the base, test views (dB)")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, fontsize=8)
