"""Tables of a reproduction, in Markdown, of the rows of `mgs.study.reproduce_results`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mgs.report.tables import markdown, table_cell
from mgs.study.reproduce import LEADER

Rows = Sequence[Mapping[str, Any]]

PAPER_TABLE = (("D-Optimal NBV", 54, 25.97, 0.9654), ("Coverage-Greedy", 50, 26.06, 0.9648))
"""Table I of the paper: method, images, PSNR in dB and SSIM over all 100 views of its own rock,
which is not ours."""

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
    """Table I: the paper's rows, and ours, of draws of `random` the mean. left: rows to come, which
    a line below names."""
    draws = [row for row in rows if row["row"].startswith("random,")]
    ours = (
        [_mean_row(draws) if row is draws[0] else row for row in rows if row not in draws[1:]]
        if draws
        else list(rows)
    )
    theirs = [
        {
            "row": f"the paper's {name}, on its rock",
            "images": images,
            "all.psnr": psnr,
            "all.ssim": ssim,
        }
        for name, images, psnr, ssim in PAPER_TABLE
    ]
    lines = [[_cell(key, row.get(key)) for key in TABLE_COLUMNS] for row in [*theirs, *ours]]
    return markdown(list(TABLE_COLUMNS.values()), lines) + (
        f"\nNot done yet: {'; '.join(left)}.\n" if left else ""
    )


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
    """Areas under PSNR(images) of each policy, and the tests of the pairs, first over the full
    frame, then inside the rock."""
    full, rock = statistics["test_psnr"], statistics["test_psnr_mask"]
    areas = [
        [
            policy,
            *(f"{of['area'][policy]['mean']:.2f}" for of in (full, rock)),
            *(_reach(of, policy) for of in (full, rock)),
        ]
        for policy in full["area"]
    ]
    pairs = []
    for what, pair in [("full frame", pair) for pair in full["pairs"]] + [
        ("rock", pair) for pair in rock["pairs"]
    ]:
        p_values = ["–" if pair[p] is None else f"{pair[p]:.2g}" for p in ("p", "p_holm")]
        there = pair["elsewhere"]
        cells = [_with_interval(pair, "difference"), _ahead(pair), *p_values]
        cells.append(f"{_with_interval(there, 'difference')}, {_ahead(there)}" if there else "–")
        pairs.append([f"{pair['policy']} − {pair['other']}", what, *cells])
    heading = ["pair", "PSNR of", "difference of areas (dB)", "ahead on rocks", "p", "p, Holm"]
    heading.append("on scenes that chose no setting")
    return f"{markdown(AREA_COLUMNS, areas)}\n{markdown(heading, pairs)}"


AREA_COLUMNS = (
    "policy",
    "area, full frame (dB)",
    "area, rock (dB)",
    "images for what random ends with",
    "the same, rock",
)


def _reach(of: Mapping[str, Any], policy: str) -> str:
    """How many images a policy needs for what `random` has at the end, and on how many rocks it
    gets there, if not on all."""
    found = of["reach"].get(policy)
    if found is None or found["images"] is None:
        return "–"
    rocks = len(of["area_by_rock"][policy])
    return f"{found['images']:.1f}" + (
        f" ({found['rocks']} of {rocks} rocks)" if found["rocks"] < rocks else ""
    )


def _ahead(pair: Mapping[str, Any]) -> str:
    """On how many rocks the first of a pair is ahead."""
    return f"{pair['ahead']} of {pair['rocks']}"


def seeds_markdown(rows: Rows) -> str:
    """Largest gap in azimuth and PSNR of the last model for each policy and number of seeds, and
    its difference from four."""
    lines = []
    for row in rows:
        four = (
            ["–"] * 2 if row["seeds"] == 4 else [_with_interval(row, key) for key in _over("four")]
        )
        about = [
            f"{100 * row['first_coverage']:.1f}",
            f"{row['gap']:.0f} ({row['gap_max']:.0f})",
            f"{row['test_psnr']:.2f}",
        ]
        lines.append([row["policy"], str(row["seeds"]), *about, *four])
    heading = [
        "policy",
        "seeds",
        "they see (%)",
        "largest gap (most), degrees",
        "test views (dB)",
        "over four seeds (dB)",
    ]
    heading.append("rock (dB)")
    return markdown(heading, lines)


def pools_markdown(rows: Rows) -> str:
    """Tables with a row for each policy and a column for each pool: PSNR of the last model; by how
    much the LEADER is ahead of it, there, inside the rock, and over the whole curve; and, where
    there is an oracle, the share of what the oracle gains over `random`."""
    tables = [
        matrix(rows, "test views (dB)", lambda row: f"{row['test_psnr']:.2f}"),
        matrix(rows, f"{LEADER} over it (dB)", lambda row: led(row, "test_psnr_led")),
        matrix(rows, "inside the rock (dB)", lambda row: led(row, "test_psnr_mask_led")),
        matrix(rows, "over the whole curve (dB)", lambda row: led(row, "test_psnr_area_led")),
    ]
    if any(row["test_psnr_share"] is not None for row in rows):
        tables.append(matrix(rows, "share of the oracle's", _share))
    return "\n".join(tables)


def matrix(rows: Rows, title: str, cell: Callable[[Mapping[str, Any]], str]) -> str:
    """A table of the rows of pools, with a line for each policy and a column for each pool."""
    pools, policies = (list(dict.fromkeys(row[key] for row in rows)) for key in ("pool", "policy"))
    found = {(row["policy"], row["pool"]): cell(row) for row in rows}
    return markdown(
        [title, *pools],
        [[policy, *(found.get((policy, pool), "–") for pool in pools)] for policy in policies],
    )


def led(row: Mapping[str, Any], key: str) -> str:
    """By how much the LEADER is ahead of a row's policy, with its interval; a dash for itself."""
    return _with_interval(row, key) if key in row else "–"


def _share(row: Mapping[str, Any]) -> str:
    """The share of the oracle's gain."""
    return "–" if row["test_psnr_share"] is None else f"{row['test_psnr_share']:.0%}"


def _over(what: str) -> list[str]:
    """The keys of differences, of the full frame and inside the rock."""
    return [f"test_psnr_over_{what}", f"test_psnr_mask_over_{what}"]


def _with_interval(row: Mapping[str, Any], key: str) -> str:
    """A difference with its interval, where it has one."""
    text = f"{row[key]:+.2f}"
    return (
        text
        if row[f"{key}_low"] is None
        else f"{text} [{row[f'{key}_low']:+.2f}, {row[f'{key}_high']:+.2f}]"
    )
