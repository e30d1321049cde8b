"""Tables of a reproduction, in Markdown, of the rows of `mgs.study.reproduce_results`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mgs.report.tables import table_cell
from mgs.study.reproduce import LEADER

Rows = Sequence[Mapping[str, Any]]

PAPER_TABLE = (("D-Optimal NBV", 54, 25.97, 0.9654), ("Coverage-Greedy", 50, 26.06, 0.9648))
"""Table I of the paper: method, images, PSNR in dB and SSIM over all 100 views of its own rock, which is not ours."""

TABLE_COLUMNS = {
    "row": "policy",
    "images": "images",
    "test.psnr": "test views (dB)",
    "test.ssim": "SSIM",
    "test.psnr_mask": "test views, rock (dB)",
    "all.psnr": "all views (dB)",
    "all.ssim": "SSIM",
    "held_out.psnr": "held out (dB)",
    "choice_seconds": "a choice (s)",
    "seconds": "run (s)",
    "peak_megabytes": "memory (MB)",
}
"""Columns of Table I, and their headings."""


def table_markdown(rows: Rows, left: Sequence[str] = ()) -> str:
    """Table I: the paper's rows, and ours, of draws of `random` the mean. left: rows to come, which a line below names."""
    draws = [row for row in rows if row["row"].startswith("random,")]
    ours = [_mean_row(draws) if row is draws[0] else row for row in rows if row not in draws[1:]] if draws else list(rows)
    theirs = [
        {"row": f"the paper's {name}, on its rock", "images": images, "all.psnr": psnr, "all.ssim": ssim}
        for name, images, psnr, ssim in PAPER_TABLE
    ]
    lines = [[_cell(key, row.get(key)) for key in TABLE_COLUMNS] for row in [*theirs, *ours]]
    return _markdown(list(TABLE_COLUMNS.values()), lines) + (f"\nNot done yet: {'; '.join(left)}.\n" if left else "")


def _mean_row(draws: Rows) -> dict[str, Any]:
    """The row of Table I for the draws of `random`."""
    numbers = [key for key in TABLE_COLUMNS if key != "row"]
    mean: dict[str, Any] = {key: float(np.mean([row[key] for row in draws])) for key in numbers}
    return {"row": f"random, mean of {len(draws)}"} | mean | {"images": draws[0]["images"]}


def _cell(key: str, value: Any) -> str:
    """A cell of Table I."""
    if value is not None and key in ("seconds", "peak_megabytes"):
        return f"{value:.0f}"
    return table_cell(key, value)


def statistics_markdown(statistics: Mapping[str, Any]) -> str:
    """Areas under PSNR(images) of each policy, and the tests of the pairs, first over the full frame, then inside the rock."""
    full, rock = statistics["test_psnr"], statistics["test_psnr_mask"]
    areas = [[policy, *(f"{of['area'][policy]['mean']:.2f}" for of in (full, rock))] for policy in full["area"]]
    pairs = []
    for what, pair in [("full frame", pair) for pair in full["pairs"]] + [("rock", pair) for pair in rock["pairs"]]:
        p_values = ["–" if pair[p] is None else f"{pair[p]:.2g}" for p in ("p", "p_holm")]
        there = pair["elsewhere"]
        cells = [_with_interval(pair, "difference"), _ahead(pair), *p_values]
        cells.append(f"{_with_interval(there, 'difference')}, {_ahead(there)}" if there else "–")
        pairs.append([f"{pair['policy']} − {pair['other']}", what, *cells])
    heading = ["pair", "PSNR of", "difference of areas (dB)", "ahead on rocks", "p", "p, Holm"]
    heading.append("on scenes that chose no setting")
    return f"{_markdown(['policy', 'area, full frame (dB)', 'area, rock (dB)'], areas)}\n{_markdown(heading, pairs)}"


def _ahead(pair: Mapping[str, Any]) -> str:
    """On how many rocks the first of a pair is ahead."""
    return f"{pair['ahead']} of {pair['rocks']}"


def seeds_markdown(rows: Rows) -> str:
    """Largest gap in azimuth and PSNR of the last model for each policy and number of seeds, and its difference from four."""
    lines = []
    for row in rows:
        four = ["–"] * 2 if row["seeds"] == 4 else [_with_interval(row, key) for key in _over("four")]
        about = [f"{100 * row['first_coverage']:.1f}", f"{row['gap']:.0f} ({row['gap_max']:.0f})", f"{row['test_psnr']:.2f}"]
        lines.append([row["policy"], str(row["seeds"]), *about, *four])
    heading = ["policy", "seeds", "they see (%)", "largest gap (most), degrees", "test views (dB)", "over four seeds (dB)"]
    heading.append("rock (dB)")
    return _markdown(heading, lines)


def pools_markdown(rows: Rows) -> str:
    """PSNR of the last model for each pool and policy, its difference from `random`, and its share of the oracle's."""
    lines = []
    for row in rows:
        over = ["–"] * 2 if row["policy"] == "random" else [_with_interval(row, key) for key in _over("random")]
        led = [_with_interval(row, key) if key in row else "–" for key in ("test_psnr_led", "test_psnr_area_led")]
        share = "–" if row["test_psnr_share"] is None else f"{row['test_psnr_share']:.0%}"
        lines.append([row["pool"], row["policy"], f"{row['test_psnr']:.2f}", *over, *led, share])
    heading = [
        "pool",
        "policy",
        "test views (dB)",
        "over random (dB)",
        "rock (dB)",
        f"{LEADER} over it (dB)",
        "over the curve (dB)",
        "share of the oracle's",
    ]
    return _markdown(heading, lines)


def _over(what: str) -> list[str]:
    """The keys of differences, of the full frame and inside the rock."""
    return [f"test_psnr_over_{what}", f"test_psnr_mask_over_{what}"]


def _with_interval(row: Mapping[str, Any], key: str) -> str:
    """A difference with its interval, where it has one."""
    text = f"{row[key]:+.2f}"
    return text if row[f"{key}_low"] is None else f"{text} [{row[f'{key}_low']:+.2f}, {row[f'{key}_high']:+.2f}]"


def _markdown(heading: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table; all columns but the first are right-aligned."""
    rows = [heading, ["---", *["---:"] * (len(heading) - 1)], *lines]
    return "".join("| " + " | ".join(row) + " |\n" for row in rows)
