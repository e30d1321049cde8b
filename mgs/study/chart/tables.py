"""The tables of docs/speed-accuracy.md, as cells of text, made of what chart.json holds. Nothing is
measured here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from mgs.fit.settings import PASSES, WARM_PASSES
from mgs.study.chart.plan import DENSITY

Rows = list[dict[str, Any]]
Cells = list[list[str]]


def span(row: dict[str, Any], scale: float = 1.0) -> str:
    """Seconds of a row of `mgs chart`, times a scale, and their extremes where it was timed more
    than once."""
    value, low, high = (
        _digits(scale * row[key]) for key in ("seconds", "seconds_low", "seconds_high")
    )
    return value if low == high else f"{value} ({low} to {high})"


def _digits(value: float) -> str:
    """A number with three significant digits, or all before the point."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def settings_of(row: dict[str, Any]) -> str:
    """What differs in a fit or run of `mgs chart` from the default."""
    passes = f"{row['passes']} passes" + (f", then {row['warm_passes']}" if row["policy"] else "")
    parts = [f"{row['gaussians']:,} Gaussians", passes]
    parts += [
        row[key]
        for key, usual in (("policy", ""), ("optimiser", "natural"), ("estimator", "exact"))
        if row[key] != usual
    ]
    parts += [] if row["learned"] == "all" else [f"learned: {row['learned']}"]
    return ", ".join([*parts, *(["half the size"] if row["half"] else [])])


QUALITY = ("PSNR, dB", "SSIM", "PSNR, rock")
"""Headings of the qualities of `mgs chart`."""


def qualities(row: dict[str, Any]) -> list[str]:
    """Their cells."""
    return [f"{row['psnr']:.2f}", f"{row['ssim']:.4f}", f"{row['psnr_mask']:.2f}"]


def front(rows: Rows) -> Cells:
    """Fits of the usual number of images that lie on the front of seconds against PSNR."""
    return _by_seconds(
        row
        for row in rows
        if not row["policy"] and row["front"] and "crossed" in row["factors"].split("; ")
    )


def runs(rows: Rows) -> Cells:
    """Runs that lie on the front, and those of the presets."""
    return _by_seconds(row for row in rows if row["policy"] and (row["front"] or row["preset"]))


def _by_seconds(rows: Iterable[dict[str, Any]]) -> Cells:
    return [
        [
            (f"**{row['preset']}**: " if row["preset"] else "") + settings_of(row),
            span(row),
            *qualities(row),
        ]
        for row in sorted(rows, key=lambda row: float(row["seconds"]))
    ]


def factors(rows: Rows) -> Cells:
    """Points that differ from the default in one factor, and how they differ from it."""
    default = {
        "density": DENSITY,
        "passes": PASSES,
        "warm_passes": WARM_PASSES,
        "optimiser": "natural",
        "learned": "all",
        "estimator": "exact",
        "half": False,
    }
    count = Counter(row["images"] for row in rows).most_common(1)[0][0]
    lines = []
    for policy in ("", "d-optimal"):
        wanted = {**default, "policy": policy, "images": count}
        base = next(row for row in rows if all(row[key] == value for key, value in wanted.items()))
        for row in rows:
            differs = [key for key, value in wanted.items() if row[key] != value]
            if len(differs) != 1 or bool(row["policy"]) != bool(policy):
                continue
            value = (
                "half the size"
                if differs == ["half"]
                else f"{differs[0].replace('_', ' ')} {row[differs[0]]}"
            )
            changes = [f"{row['psnr'] - base['psnr']:+.2f}", f"{row['ssim'] - base['ssim']:+.4f}"]
            changes.append(f"{row['psnr_mask'] - base['psnr_mask']:+.2f}")
            kind = "run" if policy else "fit"
            lines.append([f"{kind}: {value}", f"{row['seconds'] / base['seconds']:.2f}", *changes])
    return lines


def scoring(rows: Rows) -> Cells:
    """Every way to score, the cheapest first."""
    exact = next(row for row in rows if row["variant"] == "exact")
    return [
        [
            row["variant"],
            span(row, 1e3),
            f"{row['seconds'] / exact['seconds']:.2f}",
            f"{row['tau']:.2f}",
            f"{100 * row['regret']:.1f} %",
        ]
        for row in sorted(rows, key=lambda row: float(row["seconds"]))
    ]


def core(rows: Rows) -> Cells:
    """Times and errors of the kernels."""
    return [[row["row"], row["computes"], span(row, 1e3), f"{row['error']:.2g}"] for row in rows]


def bytes_sent(rows: Rows) -> Cells:
    """Kilobytes of the smallest code that loses at most 0.1 dB, for every model and quantiser."""
    lines = []
    for n, images in dict.fromkeys((row["gaussians"], row["images"]) for row in rows):
        of = [row for row in rows if (row["gaussians"], row["images"]) == (n, images)]
        exact = next(row for row in of if row["quantiser"] == "float32")["psnr"]
        cells = []
        for name in ("float32", "one step", "by H", "by H, known", "PNG"):
            sizes = [
                row["bytes"]
                for row in of
                if row["quantiser"] == name and row["psnr"] >= exact - 0.1
            ]
            cells.append(f"{min(sizes) / 1e3:.1f} kB" if sizes else "none")
        lines.append([f"{n:,}, {images}: {exact:.2f} dB", *cells])
    return lines


def presets(rows: Rows) -> Cells:
    """The presets on scenes that the charts do not use."""
    return [
        [
            f"{row['scene']}, {row['preset']}", span(row), f"{row['psnr']:.2f}, {row['psnr_mask']:.2f}",
            f"{row['best']:.2f}, {row['best_psnr_mask']:.2f}",
            f"{row['best_passes']}, {row['best_warm_passes']}; {row['best_gaussians']:,} Gaussians",
            f"{row['loss']:.2f}", "yes" if row["holds"] else "no",
        ]
        for row in rows
    ]  # fmt: skip


TABLES: dict[str, tuple[str, tuple[str, ...], Callable[[Rows], Cells]]] = {
    "front": ("fit", ("on the front", "seconds", *QUALITY), front),
    "runs": ("fit", ("runs: front and presets", "seconds", *QUALITY), runs),
    "factors": ("fit", ("one factor changed", "times the seconds", *QUALITY), factors),
    "scoring": (
        "scoring",
        ("scores", "ms a candidate", "over exact", "Kendall's tau", "regret"),
        scoring,
    ),
    "core": ("core", ("kernel", "computes", "ms at the working size", "largest error"), core),
    "bytes": (
        "bytes",
        ("Gaussians, images", "float32", "one step", "by H", "by H, known", "images as PNG"),
        bytes_sent,
    ),
    "presets": (
        "presets",
        (
            "scene, preset",
            "seconds",
            "PSNR, rock only (dB)",
            "best of equal time",
            "which has passes",
            "loss, dB",
            "within 0.1 dB",
        ),
        presets,
    ),
}
"""By name: the kind of rows, the heading, and what makes cells of the rows."""


PICTURES = {
    "front": "Seconds against PSNR and SSIM of fits and runs",
    "scoring": "Milliseconds a candidate against tau and regret",
    "core": "Milliseconds against the largest error",
    "bytes": "Kilobytes sent against PSNR",
}
"""What the chart above a table shows."""


def chart_table(name: str, data: dict[str, Any]) -> tuple[str, tuple[str, ...], Cells, str]:
    """(chart, heading, cells, note) of one of TABLES; data: what chart.json holds. Without cells
    where nothing is measured yet.

    The chart is a line of Markdown, empty where there is none. The note tells the command, the
    machine, and how long the reference took of all that was timed.
    """
    kind, heading, cells = TABLES[name]
    if kind not in data:
        return "", heading, [], f"Not measured yet: `mgs chart OUT --only {kind}`."
    found = data[kind]
    machine = found["machine"]
    note = f"`{found['command']}` on {machine['threads']} thread{'' if machine['threads'] == 1 else 's'} ({machine['cpu']})"
    commit = f" ({data['versions']['commit']})" if "commit" in data["versions"] else ""
    note += f"; mgs {data['versions']['mgs']}{commit}"
    if kind != "bytes":
        note += f"; the reference took {found['reference_seconds']:.2f} s"
    picture = f"![{PICTURES[name]}](results/chart/{kind}.png)\n\n" if name in PICTURES else ""
    return picture, heading, cells(found["rows"]), f"{note}."
