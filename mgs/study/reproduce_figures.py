"""Figures of a reproduction. Each function takes rows of `mgs.study.reproduce_results` and writes
one PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.plotting import STYLE, new_figure, save_figure
from mgs.report.figures import line_styles

Rows = Sequence[dict[str, Any]]


def curves_figure(path: Path, rows: Rows) -> None:
    """PSNR on the test views against the number of images: means over the rocks, and the
    differences from `uniform`, with 95 % intervals of their means as bands."""
    import matplotlib

    policies = list(dict.fromkeys(row["policy"] for row in rows))
    with matplotlib.rc_context(STYLE):
        figure = new_figure(8.4, 3.6)
        left, right = figure.subplots(1, 2)
        for policy, style in zip(policies, line_styles(policies), strict=True):
            of = [row for row in rows if row["policy"] == policy]
            images = [row["images"] for row in of]
            left.plot(images, [row["test_psnr"] for row in of], **style)
            right.plot(images, [row["test_psnr_over_uniform"] for row in of], **style)
            if of[0]["rocks"] > 1:
                low, high = (
                    [row[f"test_psnr_over_uniform_{end}"] for row in of] for end in ("low", "high")
                )
                right.fill_between(images, low, high, color=style["color"], alpha=0.12, linewidth=0)
        count = rows[0]["rocks"]
        titles = (
            (f"mean of {count} rocks", "bands: 95 % intervals of the mean over rocks")
            if count > 1
            else ("one rock", "one rock")
        )
        left.set(xlabel="images", ylabel="PSNR on the test views (dB)", title=titles[0])
        right.set(xlabel="images", ylabel="difference from uniform (dB)", title=titles[1])
        left.legend(fontsize=8)
        save_figure(figure, path)


def seeds_figure(path: Path, rows: Rows) -> None:
    """PSNR of the last model against the number of seeds, with 95 % intervals of the difference
    from four seeds."""
    import matplotlib

    policies = list(dict.fromkeys(row["policy"] for row in rows))
    with matplotlib.rc_context(STYLE):
        figure = new_figure(4.6, 3.4)
        axis = figure.subplots()
        for policy, style in zip(policies, line_styles(policies), strict=True):
            of = [row for row in rows if row["policy"] == policy]
            _error_bars(axis, [row["seeds"] for row in of], of, "test_psnr_over_four", style)
        title = f"{rows[0]['images']} images in all, {_rocks(rows)}"
        axis.set(xlabel="seed views", ylabel="difference from four seeds (dB)", title=title)
        axis.legend(fontsize=8)
        save_figure(figure, path)


def pools_figure(path: Path, rows: Rows) -> None:
    """The last model's PSNR on the test views over that of `random`, for each pool and policy, with
    95 % intervals."""
    import matplotlib

    pools = list(dict.fromkeys(row["pool"] for row in rows))
    policies = [name for name in dict.fromkeys(row["policy"] for row in rows) if name != "random"]
    with matplotlib.rc_context(STYLE):
        figure = new_figure(1.5 * len(pools) + 2.2, 3.6)
        axis = figure.subplots()
        for k, (policy, style) in enumerate(zip(policies, line_styles(policies), strict=True)):
            of = [row for row in rows if row["policy"] == policy]
            x = np.arange(len(pools)) + 0.7 * ((k + 0.5) / len(policies) - 0.5)
            _error_bars(axis, x, of, "test_psnr_over_random", style | {"linestyle": "none"})
        axis.axhline(0, color="black", linewidth=0.8)
        axis.set_xticks(range(len(pools)), pools)
        axis.set(ylabel="PSNR on the test views,\nover random (dB)", title=_rocks(rows))
        figure.legend(loc="outside right upper", fontsize=8)
        save_figure(figure, path)


def _error_bars(axis: Any, x: Any, rows: Rows, key: str, style: dict[str, Any]) -> None:
    """Draw the means of a key, with their intervals if there are any."""
    means = np.array([row[key] for row in rows])
    bars = None
    if rows[0]["rocks"] > 1:
        bars = np.abs(
            np.array([[row[f"{key}_{end}"] for row in rows] for end in ("low", "high")]) - means
        )
    axis.errorbar(x, means, bars, elinewidth=0.9, capsize=2, **style)


def _rocks(rows: Rows) -> str:
    """How many rocks the numbers are of."""
    count = rows[0]["rocks"]
    return f"mean of {count} rocks, with 95 % intervals" if count > 1 else "one rock"
