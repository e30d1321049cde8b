"""Tables that commands print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.table import Table

from mgs.cli.terminal import Terminal

if TYPE_CHECKING:
    from mgs.run.state import Checkpoint

GROUPS = {"test": "test", "all": "all", "held_out": "held out"}
"""Sets of views -> their names in the headings of `print_quality`."""

SHOWN = {
    True: ("test.psnr", "test.ssim", "test.psnr_mask", "held_out.psnr", "held_out.psnr_mask"),
    False: (
        "all.psnr",
        "all.ssim",
        "held_out.psnr",
        "held_out.ssim",
        "held_out.psnr_mask",
        "held_out.ssim_mask",
    ),
}
"""Columns of `print_quality` with and without test views: as many as fit into 80 characters."""

MOST_NAMES = 8
"""Most seed views that are named in a line, not counted."""

MEASURED = {
    f"{prefix}{key}": f"{name}\n{views}"
    for prefix, views in (("test_", "test"), ("held_out_", "held out"), ("", "all"))
    for key, name in (("psnr", "PSNR"), ("psnr_mask", "masked PSNR"))
}
"""Metrics of steps.jsonl -> headings; a table of steps shows the first two that there are."""


def settings_table(keys: Sequence[tuple[str, str, str]]) -> Table:
    """Table of settings: key, default and description of each."""
    table = Table("--set KEY=VALUE", "", box=box.SIMPLE_HEAD, pad_edge=False)
    for key, default, text in keys:
        shown = f" Default: {default}." if default and "Default" not in text else ""
        table.add_row(key, text + shown)
    return table


def print_quality(console: Terminal, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the rows of `mgs.reports.tables.comparison_rows` as a table, for 80 columns."""
    from mgs.reports.tables import has_held_out, table_cell

    tested, new = any("test.psnr" in row for row in rows), has_held_out(rows)
    metrics = [key for key in SHOWN[tested] if new or not key.startswith("held_out.")]
    keys = ["images", *metrics, "coverage"]
    caption = "n: images; PSNR in dB, coverage in %"
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, caption=caption)
    table.add_column("policy", overflow="fold")
    for key in keys:
        table.add_column(_heading(key, new), justify="right", no_wrap=True)
    for row in rows:
        table.add_row(row["policy"], *(table_cell(key, row.get(key)) for key in keys))
    console.print(table)


def _heading(key: str, new: bool) -> str:
    """Heading of a column: metric and set of views. new: some views were held out."""
    views, _, metric = key.partition(".")
    if not metric:
        return {"coverage": "cover", "images": "n"}[key]
    name, _, mask = metric.partition("_")
    group = GROUPS[views] if new or views != "all" else "training"
    return ("masked\n" if mask else "") + f"{name.upper()}\n{group}"


def print_run(out: Path, state: Checkpoint, metrics: dict[str, Any], console: Terminal) -> None:
    """Print the steps of a run as a table, on a terminal only, then the quality of its model."""
    from mgs.reports.tables import metrics_row
    from mgs.run.ending import RunEnd, why_ended

    if console.is_terminal:  # a log has a line a step
        _print_steps(state.steps, console)
    last = state.steps[-1] if state.steps else {}
    coverage = 100 * last["coverage"] if last else None
    print_quality(console, [metrics_row(metrics["policy"], metrics) | {"coverage": coverage}])
    if "ended" in last and (last["ended"]["views"] or last["ended"]["reason"] != RunEnd.BUDGET):
        console.print(f"the run has ended: {why_ended(last['ended'])}", soft_wrap=True)
    console.print(f"wrote {out}", soft_wrap=True)


def _print_steps(steps: Sequence[Mapping[str, Any]], console: Terminal) -> None:
    """Print the steps of a run as a table."""
    measured = _measured(steps)
    columns = ["step", "image", "score", "coverage", "passes"]
    columns += [MEASURED[key] for key in measured] or ["loss", "stopped"]
    table = Table(box=None)
    for heading in (*columns, "seconds"):
        table.add_column(heading, no_wrap=heading != "image", overflow="fold")
    for line in steps:
        names = [line["name"]] if line["name"] else line["seed_names"]
        score = "" if line["score"] is None else f"{line['score']:.4g}"
        fit = ["", "", ""]
        if "loss" in line:
            fit = [passes(line), f"{line['loss']:.3g}", line["stop_reason"]]
        if measured:
            fit[1:] = [f"{line[key]:.2f}" if key in line else "" for key in measured]
        coverage, seconds = f"{100 * line['coverage']:.2f} %", sum(line["seconds"].values())
        table.add_row(str(line["step"]), "\n".join(names), score, coverage, *fit, f"{seconds:.1f}")
    console.print(table)


def _measured(steps: Sequence[Mapping[str, Any]]) -> list[str]:
    """The two keys of MEASURED to show: PSNR and masked PSNR over the first set that steps have."""
    return [key for key in MEASURED if any(key in line for line in steps)][:2]


def passes(line: Mapping[str, Any]) -> str:
    """Number of passes of the fit in a line of steps.jsonl."""
    return str(line["iterations"] // line["images"])


def step_line(line: Mapping[str, Any]) -> str:
    """A step in one line, for a log."""
    names = [line["name"]] if line["name"] else line["seed_names"]
    views = ", ".join(names) if len(names) <= MOST_NAMES else f"{len(names)} views"
    parts = [f"step {line['step']}: {views}"]
    parts.append(f"coverage {100 * line['coverage']:.2f} %")
    if "loss" in line:
        parts.append(f"{passes(line)} passes")
    measured = _measured([line])
    if not measured and (psnr := line.get("prediction", {}).get("psnr")):
        parts.append(f"masked PSNR of views not taken about {psnr:.1f} dB")
    for key in measured:
        parts.append(f"{' '.join(MEASURED[key].split())} views {line[key]:.2f} dB")
    return ", ".join([*parts, f"{sum(line['seconds'].values()):.1f} s"])


def certificate_line(record: Mapping[str, Any]) -> str:
    """Sentence of a certificate in steps.jsonl."""
    from mgs.policy.certificate import Certificate

    return Certificate(**record).sentence()
